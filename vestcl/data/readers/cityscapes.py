"""Cityscapes snippets: ROOT/leftImg8bit_sequence/SPLIT/CITY/CITY_%06d_%06d_leftImg8bit.png, 30 frames each.

Only the 20th frame of a snippet is annotated; its name is the snippet's name, and its camera file is for all 30.
What else there is goes by the frame's name too: rightImg8bit_sequence, disparity_sequence or disparity, gtFine.
Camera files are for 2048 x 1024: K is scaled for images that were resized, and cropped ones are refused.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from vestcl.data import calibration, fit
from vestcl.data.calibration import Matrix
from vestcl.data.readers import files
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import DisparityFile, EgoVehicleFile, ImageFile, LabelFile
from vestcl.io.atomic import read_bytes
from vestcl.io.images import image_size
from vestcl.io.strict_json import parse_json

#: (height, width) that camera files are for.
NATIVE: Final = (1024, 2048)

#: Frames of a snippet before and after the annotated one.
BEFORE: Final = 19
AFTER: Final = 10

#: Frames per second.
FPS: Final = 17.0

#: Metres between two cameras of one car, at most.
LONGEST_BASELINE: Final = 100.0

#: Bytes of the largest camera file that is read.
_LARGEST: Final = 1 << 20

_FRAMES: Final = "leftImg8bit_sequence"
_NAME: Final = re.compile(r"([a-z-]+)_(\d{6})_(\d{6})(?:_leftImg8bit(?i:\.png))?", re.ASCII)


@dataclass(frozen=True)
class _Camera:
    """A camera file's numbers: K [3, 3] of 2048 x 1024 with centres at +0.5, fx in px and the baseline in metres."""

    path: Path
    K: Matrix
    fx: float
    baseline: float


def open_cityscapes(path: str | Path, snippet: str | None = None) -> Clip:
    """A snippet: left frames, right ones, disparity, labels and the own bonnet where they are there; no poses.

    Args:
        path: a frame's file, or its path without `_leftImg8bit.png`; or any folder of the left frames, from ROOT to
            CITY, together with ``snippet``.
        snippet: name of the annotated frame, "frankfurt_000000_000294"; not needed where there is only one.

    Raises:
        ValueError: a file is missing or malformed, or the snippet is not known; the message names it.

    Source: SPEC section 9; README of the Cityscapes scripts.
    """
    folder, name = _find(Path(path), snippet)
    root, tail = folder.parents[2], Path(folder.parent.name) / folder.name
    camera = _read_camera(root / "camera" / tail / f"{name}_camera.json")
    frames = _frames(folder, name)
    size = image_size(next(iter(frames.values())))
    K = fit.fit_intrinsics(camera.K, NATIVE, size, str(camera.path))
    rights = _rights(root / "rightImg8bit_sequence" / tail, list(frames), camera)
    bonnet = _find_file(root / "gtFine" / tail, f"{name}_gtFine_labelIds")
    samples = []
    for index, (frame, file) in enumerate(frames.items()):
        sample = Sample(
            frame,
            ImageFile(file, *size),
            K,
            timestamp=index / FPS,
            depth=_depth(root, tail, frame, camera),
            labels=_labels(root, tail, frame),
            ego_vehicle=EgoVehicleFile(bonnet) if bonnet else None,
            right=rights.get(frame),
        )
        samples.append(sample)
    return Clip(name, "Cityscapes", tuple(samples))


def snippets(path: str | Path) -> list[str]:
    """Names of the snippets that have frames below ``path``, sorted: 500 for SPLIT = val.

    Args:
        path: ROOT, ROOT/leftImg8bit_sequence, or its SPLIT or CITY folders.
    """
    return sorted(name for _, name in _below(Path(path)))


def is_frame(path: Path) -> bool:
    """Whether ``path`` is a frame's file, or its path without `_leftImg8bit.png`."""
    return bool(_NAME.fullmatch(path.name)) and _FRAMES in path.parts and not path.is_dir()


def _find(path: Path, snippet: str | None) -> tuple[Path, str]:
    """The CITY folder of the left frames, and the snippet's name."""
    if is_frame(path):
        city, sequence, number = _parts(path.name)
        for name in snippets(path.parent):
            at = _parts(name)
            if at[:2] == (city, sequence) and at[2] - BEFORE <= number <= at[2] + AFTER:
                return path.parent, name
        raise ValueError(f"{path}: belongs to no snippet with a camera file")
    found = [(folder, name) for folder, name in _below(path) if snippet in (None, name)]
    if len(found) == 1:
        return found[0]
    names = snippets(path)
    some = ", ".join(names[:3]) + (f" ... {names[-1]}" if len(names) > 3 else "")
    if not names:
        raise ValueError(f"{path}: has no snippet: frames in {_FRAMES}/SPLIT/CITY and their camera/SPLIT/CITY files")
    raise ValueError(f"{path}: `snippet` must be one of its {len(names)}: {some}; got {snippet}")


def _frames(folder: Path, name: str) -> dict[str, Path]:
    """The files of a snippet's frames by name; at either end some may be missing, between them none."""
    city, sequence, annotated = _parts(name)
    numbers = range(max(annotated - BEFORE, 0), annotated + AFTER + 1)
    names = [f"{city}_{sequence}_{n:06}" for n in numbers]
    found = {frame: file for frame in names if (file := _find_file(folder, f"{frame}_leftImg8bit"))}
    whole = names[names.index(next(iter(found))) : names.index(list(found)[-1]) + 1] if found else names
    for frame in whole:
        if frame not in found:
            raise ValueError(f"{folder / f'{frame}_leftImg8bit.png'}: no such file")
    return found


def _find_file(folder: Path, stem: str) -> Path | None:
    """The PNG of a name; its suffix may be in any case. Folders of a city are long, so that they are not listed."""
    candidates = (folder / f"{stem}{suffix}" for suffix in (".png", ".PNG", ".Png"))
    return next((path for path in candidates if files.is_present(path)), None)


def _rights(folder: Path, frames: list[str], camera: _Camera) -> dict[str, RightCamera]:
    """By frame."""
    found = {frame: file for frame in frames if (file := _find_file(folder, f"{frame}_rightImg8bit"))}
    if not found:
        return {}
    size = image_size(next(iter(found.values())))
    K = fit.fit_intrinsics(camera.K, NATIVE, size, str(camera.path))
    right_from_left = calibration.translation((-camera.baseline, 0, 0))
    return {frame: RightCamera(ImageFile(file, *size), K, right_from_left) for frame, file in found.items()}


def _below(path: Path) -> Iterator[tuple[Path, str]]:
    """CITY folder of left frames and snippet's name of all the camera files that have frames."""
    top = path / _FRAMES if (path / _FRAMES).is_dir() else path
    if _FRAMES not in top.parts:
        return
    levels = 2 - top.parts[::-1].index(_FRAMES)  # SPLIT and CITY, without what the path already has
    cities = sorted(top.glob("/".join(["*"] * levels))) if levels > 0 else [top]
    for city in cities:
        cameras = city.parents[2] / "camera" / city.parent.name / city.name
        frames = (file.name for file in city.iterdir() if not file.name.startswith("."))
        numbered = {_parts(frame) for frame in frames if frame.lower().endswith("_leftimg8bit.png")}
        for file in sorted(cameras.glob("*_camera.json")):
            name = file.name.removesuffix("_camera.json")
            place, sequence, annotated = _parts(name)
            if any((place, sequence, n) in numbered for n in range(annotated - BEFORE, annotated + AFTER + 1)):
                yield city, name


def _parts(name: str) -> tuple[str, str, int]:
    """City, sequence, and number of the frame."""
    match = _NAME.fullmatch(name)
    if not match:
        raise ValueError(f"{name}: must be named CITY_000000_000000")
    return match[1], match[2], int(match[3])


def _read_camera(path: Path) -> _Camera:
    encoded = read_bytes(path, _LARGEST)
    try:
        content = parse_json(encoded)
        inner = content["intrinsic"]
        fx, fy, u0, v0 = (_number(inner[key]) for key in ("fx", "fy", "u0", "v0"))
        baseline = _number(content["extrinsic"]["baseline"])
    except (ValueError, TypeError) as error:  # of JSON, of its encoding, of a number
        raise ValueError(f"{path}: is not a Cityscapes camera file ({error})") from error
    except KeyError as error:
        raise ValueError(f"{path}: has no {error}") from error
    K = calibration.intrinsics(fx, fy, u0, v0)
    calibration.check_intrinsics(K, str(path))
    if not 0 < baseline < LONGEST_BASELINE:
        raise ValueError(f"{path}: `baseline` must be positive, got {baseline}")
    return _Camera(path, calibration.from_integer_centres(K), fx, baseline)


def _number(value: Any) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise TypeError(f"{value!r:.40} is not a number")
    try:
        return float(value)
    except OverflowError:
        return float("inf")


def _depth(root: Path, tail: Path, frame: str, camera: _Camera) -> DisparityFile | None:
    for folder in ("disparity_sequence", "disparity"):
        if path := _find_file(root / folder / tail, f"{frame}_disparity"):
            return DisparityFile(path, camera.baseline, camera.fx)
    return None


def _labels(root: Path, tail: Path, frame: str) -> LabelFile | None:
    if train_ids := _find_file(root / "gtFine" / tail, f"{frame}_gtFine_labelTrainIds"):
        return LabelFile(train_ids, "trainIds")
    label_ids = _find_file(root / "gtFine" / tail, f"{frame}_gtFine_labelIds")
    return LabelFile(label_ids, "labelIds") if label_ids else None

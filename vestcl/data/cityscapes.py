"""Cityscapes snippets: ROOT/leftImg8bit_sequence/SPLIT/CITY/CITY_%06d_%06d_leftImg8bit.png, 30 frames each.

Only the 20th frame of a snippet is annotated; its name is the snippet's name, and its camera file is for all 30.
What else there is goes by the frame's name too: rightImg8bit_sequence, disparity_sequence or disparity, gtFine.
Pictures that were made smaller on the disk are fine: camera files are for 2048 x 1024, and K is scaled.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch

from vestcl import geometry
from vestcl.data import calibration
from vestcl.data.calibration import Matrix
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import DisparityFile, EgoVehicleFile, ImageFile, LabelFile
from vestcl.io.atomic import read_bytes
from vestcl.io.images import image_size

#: (height, width) that camera files are for.
NATIVE: Final = (1024, 2048)

#: Frames of a snippet before and after the annotated one.
BEFORE: Final = 19
AFTER: Final = 10

#: Frames a second.
FPS: Final = 17.0

_FRAMES: Final = "leftImg8bit_sequence"
_NAME: Final = re.compile(r"([a-z-]+)_(\d{6})_(\d{6})(?:_leftImg8bit\.png)?")


@dataclass(frozen=True)
class _Camera:
    """A camera file's numbers: K [3, 3] of 2048 x 1024 with centres at +0.5, fx in px and the baseline in metres."""

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
        ValueError: a file is missing or malformed, or the snippet is not told; the message names it.

    Source: SPEC section 9; README of the Cityscapes scripts.
    """
    folder, name = _find(Path(path), snippet)
    root, tail = folder.parents[2], Path(folder.parent.name) / folder.name
    camera = _read_camera(root / "camera" / tail / f"{name}_camera.json")
    frames = _frames(folder, name)
    height, width = image_size(next(iter(frames.values())))
    K = geometry.scale_intrinsics(torch.from_numpy(camera.K), width / NATIVE[1], height / NATIVE[0]).numpy()
    right_from_left = calibration.translation((-camera.baseline, 0, 0))
    bonnet = root / "gtFine" / tail / f"{name}_gtFine_labelIds.png"
    samples = []
    for index, (frame, file) in enumerate(frames.items()):
        second = root / "rightImg8bit_sequence" / tail / f"{frame}_rightImg8bit.png"
        sample = Sample(
            frame,
            ImageFile(file, height, width),
            K,
            timestamp=index / FPS,
            depth=_depth(root, tail, frame, camera),
            labels=_labels(root, tail, frame),
            ego_vehicle=EgoVehicleFile(bonnet) if bonnet.is_file() else None,
            right=RightCamera(ImageFile(second, height, width), K, right_from_left) if second.is_file() else None,
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
    files = {f"{city}_{sequence}_{n:06}": folder / f"{city}_{sequence}_{n:06}_leftImg8bit.png" for n in numbers}
    there = [index for index, file in enumerate(files.values()) if file.is_file()]
    whole = list(files.items())[there[0] : there[-1] + 1] if there else list(files.items())
    for _, file in whole:
        if not file.is_file():
            raise ValueError(f"{file}: no such file")
    return dict(whole)


def _below(path: Path) -> Iterator[tuple[Path, str]]:
    """CITY folder of left frames and snippet's name of all the camera files that have frames."""
    top = path / _FRAMES if (path / _FRAMES).is_dir() else path
    if _FRAMES not in top.parts:
        return
    levels = 2 - top.parts[::-1].index(_FRAMES)  # SPLIT and CITY, less what the path already has
    cities = sorted(top.glob("/".join(["*"] * levels))) if levels > 0 else [top]
    for city in cities:
        cameras = city.parents[2] / "camera" / city.parent.name / city.name
        numbered = {_parts(frame.name) for frame in city.glob("*_leftImg8bit.png")}
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
    encoded = read_bytes(path)
    try:
        content = json.loads(encoded)
        inner = content["intrinsic"]
        fx, fy, u0, v0 = (float(inner[key]) for key in ("fx", "fy", "u0", "v0"))
        baseline = float(content["extrinsic"]["baseline"])
    except (ValueError, TypeError) as error:  # of JSON, of its encoding, of a number
        raise ValueError(f"{path}: is no Cityscapes camera file ({error})") from error
    except KeyError as error:
        raise ValueError(f"{path}: has no {error}") from error
    K = calibration.intrinsics(fx, fy, u0, v0)
    calibration.check_intrinsics(K, str(path))
    if not 0 < baseline < float("inf"):
        raise ValueError(f"{path}: `baseline` must be positive, got {baseline}")
    return _Camera(calibration.from_integer_centres(K), fx, baseline)


def _depth(root: Path, tail: Path, frame: str, camera: _Camera) -> DisparityFile | None:
    for folder in ("disparity_sequence", "disparity"):
        path = root / folder / tail / f"{frame}_disparity.png"
        if path.is_file():
            return DisparityFile(path, camera.baseline, camera.fx)
    return None


def _labels(root: Path, tail: Path, frame: str) -> LabelFile | None:
    train_ids = root / "gtFine" / tail / f"{frame}_gtFine_labelTrainIds.png"
    label_ids = root / "gtFine" / tail / f"{frame}_gtFine_labelIds.png"
    if train_ids.is_file():
        return LabelFile(train_ids, "trainIds")
    return LabelFile(label_ids, "labelIds") if label_ids.is_file() else None

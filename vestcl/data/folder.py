"""A plain folder of frames with one camera.json: what everything else is brought to.

    camera.json          {"fx": 721.5, "fy": 721.5, "cx": 609.6, "cy": 172.9, "pixel_centre": "integer", ...}
    image/*.png|jpg      or images/, or left/, or the pictures beside camera.json; ordered by name
    right/*.png|jpg      the right camera, if camera.json has "baseline" or "right"       (names as in image/)
    depth/*.png|exr|npy  z-depth; PNG needs "depth_scale"                                 (names as in image/)
    labels/*.png         classes; needs "label_ids"                                       (names as in image/)
    poses.txt            a line a frame, 3x4 or 4x4 world_from_cam
    times.txt            a line a frame, seconds; without it "fps" tells the time

Keys of camera.json: fx, fy, cx, cy in pixels (required); pixel_centre "integer" (0 is the centre of the first pixel, as
in OpenCV and KITTI; the default) or "half" (0 is its edge); width, height, which the pictures are then held against;
fps; depth_scale, file units per metre (KITTI 256); label_ids "trainIds", "labelIds" or "virtual_kitti"; baseline,
metres from the left camera to a right one with parallel axes; right {fx, fy, cx, cy} where its numbers differ.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, get_args

from vestcl.data import calibration, files
from vestcl.data.calibration import Matrix
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import DepthFile, ImageFile, LabelFile
from vestcl.io.atomic import read_bytes
from vestcl.io.images import image_size
from vestcl.io.labels import LabelKind

#: Folders that frames are looked for in, the first that is there; else they are beside camera.json.
FRAMES: Final = ("image", "images", "left")

_NUMBERS: Final = ("fx", "fy", "cx", "cy")
_OTHERS: Final = ("pixel_centre", "width", "height", "fps", "depth_scale", "label_ids", "baseline", "right")
_CENTRES: Final = ("integer", "half")
_DEPTHS: Final = (".png", ".exr", ".npy")


@dataclass(frozen=True, eq=False)
class CameraFile:
    """What a camera.json says."""

    path: Path
    K: Matrix
    """[3, 3] px, pixel centres at +0.5."""
    size: tuple[int, int] | None = None
    """(height, width)."""
    fps: float | None = None
    depth_scale: float | None = None
    label_ids: LabelKind | None = None
    baseline: float | None = None
    K_right: Matrix | None = None


def open_folder(path: str | Path, fov: float | None = None) -> Clip:
    """The frames of a folder, with all that lies beside them. A frame without a depth or label file has none.

    Args:
        path: the folder.
        fov: horizontal field of view in degrees, in place of a camera.json that is not there.

    Raises:
        ValueError: a file is missing or malformed; the message names it.

    Source: SPEC section 9.
    """
    folder = Path(path)
    frames = frames_of(folder)
    if not frames:
        raise ValueError(f"{folder}: has no pictures, neither beside camera.json nor in {', '.join(FRAMES)}")
    size = image_size(frames[0])
    camera = _camera(folder, size, fov)
    times, poses = _table(folder / "times.txt", len(frames)), _table(folder / "poses.txt", len(frames))
    samples = []
    for index, frame in enumerate(frames):
        depth = _beside(folder / "depth", frame.stem, _DEPTHS)
        labels = _beside(folder / "labels", frame.stem, (".png",))
        if labels is not None and camera.label_ids is None:
            raise ValueError(f"{camera.path}: must tell `label_ids` for {labels}")
        time = None if camera.fps is None else index / camera.fps
        sample = Sample(
            frame.stem,
            ImageFile(frame, *size),
            camera.K,
            timestamp=time if times is None else float(times[index, 0]),
            world_from_cam=None if poses is None else poses[index],
            depth=None if depth is None else DepthFile(depth, _scale(camera, depth)),
            labels=None if labels is None or camera.label_ids is None else LabelFile(labels, camera.label_ids),
            right=_right(folder, frame, camera),
        )
        samples.append(sample)
    return Clip(folder.resolve().name, "folder", tuple(samples))


def frames_of(folder: Path) -> list[Path]:
    """The pictures that `open_folder` takes as frames."""
    for name in FRAMES:
        if (folder / name).is_dir():
            return files.images(folder / name)
    return files.images(folder)


def read_camera(path: str | Path) -> CameraFile:
    """A camera.json, as the head of this file tells.

    Raises:
        ValueError: no such file, no JSON, a key that is missing or unknown, or a value out of range.
    """
    path = Path(path)
    try:
        content = json.loads(read_bytes(path))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: is no JSON ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: must be an object")
    known = (*_NUMBERS, *_OTHERS)
    if unknown := sorted(set(content) - set(known)):
        raise ValueError(f"{path}: unknown keys {', '.join(unknown)}; it may have {', '.join(known)}")
    centre = content.get("pixel_centre", "integer")
    kind = content.get("label_ids")
    for key, value, allowed in (("pixel_centre", centre, _CENTRES), ("label_ids", kind, (None, *get_args(LabelKind)))):
        if value not in allowed:
            raise ValueError(f"{path}: `{key}` must be one of {', '.join(filter(None, allowed))}, got {value!r}")
    right = content.get("right")
    if right is not None and (not isinstance(right, dict) or set(right) != set(_NUMBERS)):
        raise ValueError(f"{path}: `right` must have {', '.join(_NUMBERS)} and nothing else, got {right!r}")
    height, width = _positive(path, content, "height"), _positive(path, content, "width")
    return CameraFile(
        path,
        _intrinsics(path, content, centre),
        size=None if height is None or width is None else (int(height), int(width)),
        fps=_positive(path, content, "fps"),
        depth_scale=_positive(path, content, "depth_scale"),
        label_ids=kind,
        baseline=_positive(path, content, "baseline"),
        K_right=None if right is None else _intrinsics(path, right, centre),
    )


def _camera(folder: Path, size: tuple[int, int], fov: float | None) -> CameraFile:
    path = folder / "camera.json"
    if fov is not None:
        if path.is_file():
            raise ValueError(f"{path}: tells the camera; leave out `fov`")
        return CameraFile(path, calibration.intrinsics_from_fov(fov, *size))
    if not path.is_file():
        raise ValueError(f"{path}: no such file; write one with fx, fy, cx, cy, or give `fov` in degrees")
    camera = read_camera(path)
    if camera.size not in (None, size):
        raise ValueError(f"{path}: is for pictures of {camera.size} (height, width), but they are {size}")
    return camera


def _intrinsics(path: Path, content: Mapping[str, Any], centre: str) -> Matrix:
    if missing := [key for key in _NUMBERS if not isinstance(content.get(key), int | float)]:
        raise ValueError(f"{path}: must have the numbers {', '.join(missing)}")
    K = calibration.intrinsics(*(float(content[key]) for key in _NUMBERS))
    calibration.check_intrinsics(K, str(path))
    return calibration.from_integer_centres(K) if centre == "integer" else K


def _positive(path: Path, content: Mapping[str, Any], key: str) -> float | None:
    value = content.get(key)
    if value is not None and not (isinstance(value, int | float) and 0 < value < float("inf")):
        raise ValueError(f"{path}: `{key}` must be a positive number, got {value!r}")
    return value


def _table(path: Path, frames: int) -> Matrix | None:
    """The rows of times.txt or the matrices of poses.txt; None where there is no such file."""
    if not path.is_file():
        return None
    rows = files.read_poses(path) if path.name == "poses.txt" else files.read_rows(path, (1,))
    if len(rows) != frames:
        raise ValueError(f"{path}: must have a line for each of {frames} frames, got {len(rows)}")
    return rows


def _beside(folder: Path, stem: str, suffixes: tuple[str, ...]) -> Path | None:
    candidates = (folder / f"{stem}{suffix}" for suffix in suffixes)
    return next((path for path in candidates if path.is_file()), None)


def _scale(camera: CameraFile, depth: Path) -> float | None:
    if depth.suffix == ".png" and camera.depth_scale is None:
        raise ValueError(f"{camera.path}: must tell `depth_scale`, file units per metre, for {depth}")
    return camera.depth_scale


def _right(folder: Path, frame: Path, camera: CameraFile) -> RightCamera | None:
    path = _beside(folder / "right", frame.stem, files.IMAGE_SUFFIXES)
    if path is None:
        return None
    if camera.baseline is None:
        raise ValueError(f"{camera.path}: must tell `baseline` in metres for {path}")
    K = camera.K if camera.K_right is None else camera.K_right
    return RightCamera(ImageFile(path, *image_size(path)), K, calibration.translation((-camera.baseline, 0, 0)))

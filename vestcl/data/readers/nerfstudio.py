"""nerfstudio's transforms.json: images with poses, as `ns-process-data` and other tools write it.

    transforms.json      {"camera_model": "OPENCV", "fl_x": ..., "fl_y": ..., "cx": ..., "cy": ..., "w": ..., "h": ...,
                          "k1": ..., "frames": [{"file_path": "images/frame_00001.png", "transform_matrix": [[...]]}]}

A frame's own numbers take the place of those on top. Without fl_x the focal length comes from camera_angle_x, radians;
without cx, cy the principal point is in the middle. Paths are relative to the file; a path without a suffix is .png or
.jpg. transform_matrix is world_from_cam with OpenGL's camera axes (x right, y up, z backward); applied_transform and
applied_scale, by which the file's world was made, are undone. Pixel centres are at half integers.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from vestcl.data import calibration, fit
from vestcl.data.calibration import Matrix
from vestcl.data.lens import Distortion
from vestcl.data.readers.files import IMAGE_SUFFIXES
from vestcl.data.readers.posed import Posed, check_options, is_file, posed_clip
from vestcl.data.sample import Clip
from vestcl.io.images import image_size
from vestcl.io.strict_json import read_object

FILE: Final = "transforms.json"

#: camera_model -> the coefficients that it has; "k4" of a perspective camera is another one than OpenCV's.
MODELS: Final[Mapping[str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}

#: camera_model of a file that has none.
_DEFAULT: Final = "OPENCV"
_FISHEYE: Final = "OPENCV_FISHEYE"
_COEFFICIENTS: Final = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

#: OpenGL's camera axes to OpenCV's: y and z change their sign.
_GL_FROM_CV: Final = np.diag([1.0, -1.0, -1.0, 1.0])

#: The largest number of a file, and the smallest scale: with them all products are finite, and matrices have inverses.
_MOST: Final = 1e12
_LEAST_SCALE: Final = 1e-9

#: Bytes of the largest file that is read.
_LARGEST: Final = 1 << 28


def is_nerfstudio(path: Path) -> bool:
    """Whether ``path`` is a folder with transforms.json, or such a file itself."""
    if path.is_dir():
        return (path / FILE).exists()
    return path.is_file() and path.name.startswith("transforms") and path.suffix.lower() == ".json"


def open_nerfstudio(path: str | Path, fps: float | None = None, scale: float = 1.0) -> Clip:
    """The frames of a transforms.json in natural order of their paths.

    Args:
        path: the file, or its folder.
        fps: frames per second, which the file does not have; None is not known.
        scale: metres per unit of its poses.

    Raises:
        ValueError: a file that is missing or malformed, a camera model that is not in `MODELS`, or cameras that can't
            be of the images; the message names the frame and the key.

    Source: nerfstudio's documentation, "Data conventions".
    """
    check_options(fps, scale)
    file = Path(path) / FILE if Path(path).is_dir() else Path(path)
    content = read_object(file, _LARGEST)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{file}: `frames` must be a list of one frame or more, got {_text(frames)}")
    original_from_world = _original_from_world(file, content)
    images = [_posed(file, content, frame, number, original_from_world) for number, frame in enumerate(frames)]
    return posed_clip(file.resolve().parent.name, "nerfstudio", images, fps, scale)


def _posed(file: Path, content: Mapping[str, Any], frame: Any, number: int, original_from_world: Matrix) -> Posed:
    where = f"{file}: frame {number}"
    if not isinstance(frame, dict):
        raise ValueError(f"{where}: must be an object, got {_text(frame)}")
    image = _image(file.parent, frame.get("file_path"), where)
    entries = {**content, **{key: value for key, value in frame.items() if value is not None}}
    size = _size(entries, where)
    K = _intrinsics(entries, size or image_size(image), where)
    pose = original_from_world @ _matrix(
        frame.get("transform_matrix"), ((4, 4), (3, 4)), f"{where}: `transform_matrix`"
    )
    world_from_cam = _without_scale(pose, where) @ _GL_FROM_CV
    calibration.check_rigid(world_from_cam, f"{where}: `transform_matrix`")
    return Posed(image, where, K, size, _distortion(entries, where), world_from_cam)


def _image(folder: Path, name: Any, where: str) -> Path:
    """The file of a frame; a name without a suffix gets that of a file that is there."""
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise ValueError(f"{where}: `file_path` must be the path of an image, got {_text(name)}")
    path = folder / name
    if path.suffix.lower() in IMAGE_SUFFIXES:
        if not is_file(path):
            raise ValueError(f"{where}: there is no image {path}")
        return path
    suffixes = [variant for suffix in IMAGE_SUFFIXES for variant in (suffix, suffix.upper())]
    found = next((other for suffix in suffixes if is_file(other := Path(f"{path}{suffix}"))), None)
    if found is None:
        raise ValueError(f"{where}: there is no image {path} with one of the suffixes {', '.join(IMAGE_SUFFIXES)}")
    return found


def _size(entries: Mapping[str, Any], where: str) -> fit.Size | None:
    width, height = (_number(entries, key, where) for key in ("w", "h"))
    if width is None and height is None:
        return None
    if width is None or height is None:
        raise ValueError(f"{where}: must have both `w` and `h`, or neither")
    if min(width, height) < 1 or width != int(width) or height != int(height):
        raise ValueError(f"{where}: `w` and `h` must be whole numbers of 1 or more, got {width:g} and {height:g}")
    return int(height), int(width)


def _intrinsics(entries: Mapping[str, Any], size: fit.Size, where: str) -> Matrix:
    height, width = size
    fx, fy = _focal(entries, "x", width, where), _focal(entries, "y", height, where)
    if fx is None:
        raise ValueError(f"{where}: must have `fl_x` in pixels or `camera_angle_x` in radians")
    cx, cy = (_number(entries, key, where) for key in ("cx", "cy"))
    K = calibration.intrinsics(
        fx, fx if fy is None else fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy
    )
    calibration.check_intrinsics(K, where)
    return K


def _focal(entries: Mapping[str, Any], axis: str, side: int, where: str) -> float | None:
    """Of an axis, px; None where the file does not state it."""
    focal, angle = (_number(entries, f"{name}_{axis}", where) for name in ("fl", "camera_angle"))
    if focal is not None or angle is None:
        return focal
    if not 0 < angle < math.pi:
        raise ValueError(f"{where}: `camera_angle_{axis}` must be between 0 and pi radians, got {angle:g}")
    return side / 2 / math.tan(angle / 2)


def _distortion(entries: Mapping[str, Any], where: str) -> Distortion | None:
    model = _DEFAULT if entries.get("camera_model") is None else entries["camera_model"]
    if not isinstance(model, str) or model not in MODELS:
        raise ValueError(f"{where}: `camera_model` must be one of {', '.join(MODELS)}, got {_text(model)}")
    values = {key: _number(entries, key, where) or 0.0 for key in _COEFFICIENTS}
    if other := [key for key, value in values.items() if value and key not in MODELS[model]]:
        takes = ", ".join(MODELS[model]) or "no distortion"
        raise ValueError(
            f"{where}: camera model {model} takes {takes}; `{other[0]}` must be 0, got {values[other[0]]:g}"
        )
    if not any(values.values()):
        return None if model != _FISHEYE else Distortion(True, (0.0,) * 4)
    names = MODELS[_FISHEYE] if model == _FISHEYE else _COEFFICIENTS
    return Distortion(model == _FISHEYE, tuple(values[key] for key in names))


def _original_from_world(file: Path, content: Mapping[str, Any]) -> Matrix:
    """[4, 4], the inverse of applied_scale applied_transform; the identity without them."""
    applied = np.eye(4)
    if content.get("applied_transform") is not None:
        where = f"{file}: `applied_transform`"
        applied = _matrix(content["applied_transform"], ((3, 4), (4, 4)), where)
        if not np.linalg.det(applied[:3, :3]) > 1e-12:
            raise ValueError(f"{where} must be a rotation and a shift, got {applied[:3].tolist()}")
    scale = _number(content, "applied_scale", str(file))
    if scale is not None and not scale >= _LEAST_SCALE:
        raise ValueError(f"{file}: `applied_scale` must be {_LEAST_SCALE:g} or more, got {scale:g}")
    applied[:3] *= 1.0 if scale is None else scale
    return np.asarray(np.linalg.inv(applied), np.float64)


def _without_scale(pose: Matrix, where: str) -> Matrix:
    """A pose whose rotation is one again: the world's unit is in its shift only."""
    factor = float(np.cbrt(np.linalg.det(pose[:3, :3])))
    if not (math.isfinite(factor) and factor > 1e-12):
        raise ValueError(f"{where}: `transform_matrix` must be a rotation and a shift, got {pose.tolist()}")
    rigid = pose.copy()
    rigid[:3, :3] /= factor
    left, _, right = np.linalg.svd(rigid[:3, :3])  # files round their numbers
    nearest = left @ right
    if np.allclose(nearest, rigid[:3, :3], atol=1e-3):
        rigid[:3, :3] = nearest
    return rigid


def _matrix(value: Any, shapes: tuple[tuple[int, int], ...], where: str) -> Matrix:
    """[4, 4] of a list of lists with the last row or without it."""
    rows = value if isinstance(value, list) and all(isinstance(row, list) for row in value) else []
    shape = len(rows), len(rows[0]) if rows else 0
    numbers = [entry for row in rows for entry in row]
    is_matrix = shape in shapes and all(len(row) == shape[1] for row in rows) and all(map(_is_number, numbers))
    if not is_matrix:
        wanted = " or ".join(f"[{height}, {width}]" for height, width in shapes)
        raise ValueError(f"{where} must be {wanted} finite numbers, got {_text(value)}")
    matrix = np.eye(4)
    matrix[: shape[0]] = rows
    if not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise ValueError(f"{where} must have the last row (0, 0, 0, 1), got {matrix[3].tolist()}")
    matrix[3] = 0, 0, 0, 1
    return matrix


def _number(entries: Mapping[str, Any], key: str, where: str) -> float | None:
    value = entries.get(key)
    if value is None:
        return None
    if not _is_number(value):
        raise ValueError(f"{where}: `{key}` must be a finite number, at most {_MOST:g}, got {_text(value)}")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MOST


def _text(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."

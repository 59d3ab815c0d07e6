"""COLMAP's text model: cameras.txt, images.txt, and the images.

    cameras.txt    CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]
    images.txt     IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of points, which may be empty
    images/NAME    in the folder of the text files or up to two above it

Quaternion and shift are camera_from_world with camera axes x right, y down, z forward. Pixel centres are at half
integers. Lines that begin with # are comments.
"""

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from vestcl.data import calibration, fit
from vestcl.data.calibration import Matrix
from vestcl.data.lens import Distortion
from vestcl.data.readers.posed import Posed, check_options, is_file, posed_clip, rotation_of
from vestcl.data.sample import Clip
from vestcl.io.atomic import read_bytes

CAMERAS: Final = "cameras.txt"
IMAGES: Final = "images.txt"
BINARY: Final = "images.bin"

#: Where the model is looked for in a project's folder.
_MODELS: Final = ("", "sparse/0", "sparse", "colmap/sparse/0", "colmap")

#: Folders that images are looked for in.
_FOLDERS: Final = ("images", "image", "")

#: MODEL -> how many numbers it has. f cx cy | fx fy cx cy, then the distortion: k | k1 k2 | k1 k2 p1 p2 | k1 k2 k3 k4.
PARAMETERS: Final[Mapping[str, int]] = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
}

#: The last point of a line: -1 is a point that no other image shows.
_POINT: Final = re.compile(r"\S*\d\S* \S*\d\S* (-1|\d+)")

#: Models of one focal length.
_ONE_FOCAL: Final = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE: Final = "OPENCV_FISHEYE"

#: Other characters that end a line in Python may be part of a name.
_LINE_END: Final = re.compile(r"\r\n|\r|\n")

#: Bytes of the largest text file that is read.
_LARGEST: Final = 1 << 30


class _Camera(NamedTuple):
    K: Matrix
    size: fit.Size
    distortion: Distortion | None


def model_folder(path: Path) -> Path | None:
    """The folder of the text files in ``path``, or of a binary model, or of one text file; None where is none."""
    if not path.is_dir():
        return None
    folders = [path / name for name in _MODELS]
    text = next((folder for folder in folders if (folder / IMAGES).exists() and (folder / CAMERAS).exists()), None)
    binary = next((folder for folder in folders if (folder / BINARY).exists()), None)
    part = (folder for folder in folders[1:] if (folder / IMAGES).exists() or (folder / CAMERAS).exists())
    return text or binary or next(part, None)


def open_colmap(path: str | Path, fps: float | None = None, scale: float = 1.0) -> Clip:
    """The images of a text model in natural order of their names.

    Args:
        path: the folder of the text files, or the project's folder above it.
        fps: frames per second, which the model does not have; None is not known.
        scale: metres per unit of the model.

    Raises:
        ValueError: a file that is missing or malformed, a camera model that is not in `PARAMETERS`, or cameras that
            can't be of the images; the message names the line.

    Source: COLMAP's documentation, "Output format".
    """
    check_options(fps, scale)
    project, folder = Path(path), model_folder(Path(path))
    if folder is None:
        raise ValueError(f"{path}: has no {CAMERAS} and {IMAGES}, neither there nor in sparse/0 or sparse")
    if not (folder / IMAGES).exists() and (folder / BINARY).exists():
        convert = f"colmap model_converter --input_path {folder} --output_path {folder} --output_type TXT"
        raise ValueError(f"{folder}: has COLMAP's binary model; write the text files: {convert}")
    cameras, posed = _cameras(folder / CAMERAS), list(_images(folder / IMAGES))
    if not posed:
        raise ValueError(f"{folder / IMAGES}: must have one image or more, got none")
    images = _image_folder(folder, posed[0][1])
    listed = []
    for where, name, number, world_from_cam in posed:
        if number not in cameras:
            known = ", ".join(map(str, cameras)) or "none"
            raise ValueError(f"{where}: its camera must be one of {CAMERAS}, {known}, got {number}")
        camera = cameras[number]
        listed.append(Posed(images / name, where, camera.K, camera.size, camera.distortion, world_from_cam))
    return posed_clip(project.resolve().name, "COLMAP", listed, fps, scale)


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Where a line is, and the line, without comments; blank ones are kept."""
    try:
        text = read_bytes(path, _LARGEST).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is not text") from error
    for number, line in enumerate(_LINE_END.split(text), start=1):
        if not line.lstrip().startswith("#"):
            yield f"{path}: line {number}", line.strip()


def _cameras(path: Path) -> dict[int, _Camera]:
    cameras: dict[int, _Camera] = {}
    for where, line in _lines(path):
        if not line:
            continue
        words = line.split()
        if len(words) < 4:
            raise ValueError(f"{where} must be CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line[:60]!r}")
        number, model = _whole(words[0], where), words[1]
        if model not in PARAMETERS:
            raise ValueError(f"{where}: the camera model must be one of {', '.join(PARAMETERS)}, got {model[:40]}")
        if number in cameras:
            raise ValueError(f"{where}: there is another camera {number}")
        size = _whole(words[3], where), _whole(words[2], where)
        if min(size) < 1:
            raise ValueError(f"{where}: WIDTH and HEIGHT must be 1 or more, got {words[2]} and {words[3]}")
        cameras[number] = _camera(model, size, _numbers(words[4:], where), where)
    return cameras


def _camera(model: str, size: fit.Size, numbers: list[float], where: str) -> _Camera:
    if len(numbers) != PARAMETERS[model]:
        raise ValueError(f"{where}: {model} must have {PARAMETERS[model]} parameters, got {len(numbers)}")
    focals = 1 if model in _ONE_FOCAL else 2
    fx, fy = numbers[0], numbers[focals - 1]
    K = calibration.intrinsics(fx, fy, *numbers[focals : focals + 2])
    calibration.check_intrinsics(K, where)
    k = numbers[focals + 2 :]
    if model == _FISHEYE:
        return _Camera(K, size, Distortion(True, tuple(k)))
    coefficients = (*k, *[0.0] * (8 - len(k)))  # OpenCV's order, as COLMAP's
    return _Camera(K, size, Distortion(False, coefficients) if any(k) else None)


def _images(path: Path) -> Iterator[tuple[str, str, int, Matrix]]:
    """Where an image is listed, its name, its camera and world_from_cam; the line of points after it is skipped."""
    lines = _lines(path)
    for where, line in lines:
        if not line:
            continue
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise ValueError(f"{where} must be IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:60]!r}")
        numbers = _numbers(words[1:8], where)
        cam_from_world = calibration.rigid(rotation_of(numbers[:4], where), numbers[4:])
        calibration.check_rigid(cam_from_world, where)
        if "\0" in words[9]:
            raise ValueError(f"{where}: NAME must be the path of an image, got {words[9][:60]!r}")
        yield where, words[9], _whole(words[8], where), calibration.invert(cam_from_world)
        _check_points(*next(lines, ("", "")))


def _check_points(where: str, line: str) -> None:
    """Refuse what is no line of points: else a file without these lines would lose every second image."""
    words = line.split()
    if len(words) % 3 or (words and not _POINT.fullmatch(" ".join(words[-3:]))):
        raise ValueError(
            f"{where} must be the points X Y POINT3D_ID of the image before, or empty, got {line[:60]!r}; "
            f"{IMAGES} has two lines per image"
        )


def _image_folder(model: Path, name: str) -> Path:
    """The folder that the model's first image is in."""
    above = [model, *model.absolute().parents[:2]]
    folders = [folder / images for folder in above for images in _FOLDERS]
    found = next((folder for folder in folders if is_file(folder / name)), None)
    if found is None:
        looked = ", ".join(str(folder) for folder in folders)
        raise ValueError(f"{model / IMAGES}: there is no image {name}; it looked in {looked}")
    return found


def _whole(word: str, where: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) < 19):
        raise ValueError(f"{where}: must have a whole number in place of {word[:40]!r}")
    return int(word)


def _numbers(words: list[str], where: str) -> list[float]:
    if wrong := [word for word in words if "_" in word or not word.isascii()]:
        raise ValueError(f"{where}: must have a number in place of {wrong[0][:40]!r}")
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{where}: must have finite numbers, got {' '.join(words)[:60]}")
    return numbers

"""camera.json: the camera of a folder's frames, read strictly. What it may hold is listed in
vestcl/data/readers/folder.py, and by the JSON schema camera.schema.json next to this file."""

import difflib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from vestcl.data import calibration, fit
from vestcl.data.calibration import Matrix
from vestcl.data.lens import Distortion
from vestcl.io.labels import LabelKind
from vestcl.io.strict_json import read_object

#: Bytes of the largest camera.json that is read.
_LARGEST: Final = 1 << 20

#: The format: keys, choices and bounds come from here, and are checked below, with a line that names the key.
SCHEMA_FILE: Final = Path(__file__).with_name("camera.schema.json")
SCHEMA: Final[Mapping[str, Any]] = json.loads(SCHEMA_FILE.read_text(encoding="utf-8"))

_KEYS: Final[Mapping[str, Mapping[str, Any]]] = SCHEMA["properties"]
_NUMBERS: Final = tuple(SCHEMA["required"])
_SIZE: Final = ("width", "height")
_COEFFICIENTS: Final = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE: Final = ("k1", "k2", "k3", "k4")
_CAMERA: Final = tuple(_KEYS["right"]["properties"])
_CHOICES: Final = {key: tuple(filter(None, about["enum"])) for key, about in _KEYS.items() if "enum" in about}

#: The largest of each number: a hundred times what has been seen, or more.
_MOST: Final = {key: float(about["maximum"]) for key, about in _KEYS.items() if "maximum" in about}


@dataclass(frozen=True, eq=False)
class LensCamera:
    """One camera of a camera.json."""

    K: Matrix
    """[3, 3] px, pixel centres at +0.5."""
    size: fit.Size | None = None
    """(height, width) that K is for."""
    distortion: Distortion | None = None

    def fit(self, size: fit.Size, path: Path) -> "LensCamera":
        """The camera of images of ``size``, see `fit.fit_intrinsics`.

        Raises:
            ValueError: it can't be of such images.
        """
        K = fit.fit_intrinsics(self.K, self.size, size, str(path), "This camera.json settles it:")
        return replace(self, K=K, size=size)


@dataclass(frozen=True, eq=False)
class CameraFile:
    """The content of a camera.json."""

    path: Path
    camera: LensCamera
    fps: float | None = None
    depth_scale: float | None = None
    label_ids: LabelKind | None = None
    baseline: float | None = None
    right: LensCamera | None = None
    """None is as the left one."""


def read_camera(path: str | Path) -> CameraFile:
    """A camera.json, as vestcl/data/readers/folder.py lists its keys.

    Raises:
        ValueError: no such file, no JSON, a key that is missing or unknown, or a value out of range.
    """
    path = Path(path)
    content = read_object(path, _LARGEST)
    _check_keys(path, content, tuple(_KEYS))
    camera = _camera(path, content, content)
    right = content.get("right")
    return CameraFile(
        path,
        camera,
        fps=_positive(path, content, "fps"),
        depth_scale=_positive(path, content, "depth_scale"),
        label_ids=_choice(path, content, "label_ids"),
        baseline=_positive(path, content, "baseline"),
        right=None if right is None else _right(path, right, content, camera),
    )


def _check_keys(path: Path, content: Mapping[str, Any], known: tuple[str, ...]) -> None:
    unknown = sorted(set(content) - set(known))
    if not unknown:
        return
    near = [match for key in unknown for match in difflib.get_close_matches(key, known, 1, cutoff=0.7)]
    guess = f" (did you mean {', '.join(near)}?)" if near else ""
    names = ", ".join(key if key.isprintable() else repr(key) for key in unknown)
    raise ValueError(f"{path}: unknown keys {names[:200]}{guess}; it may have {', '.join(known)}")


def _camera(path: Path, content: Mapping[str, Any], top: Mapping[str, Any]) -> LensCamera:
    if missing := [key for key in _NUMBERS if not _is_number(content.get(key))]:
        raise ValueError(f"{path}: must have the numbers {', '.join(missing)}")
    K = calibration.intrinsics(*(_bounded(path, content, key) for key in _NUMBERS))
    calibration.check_intrinsics(K, str(path))
    K = calibration.from_integer_centres(K) if _choice(path, top, "pixel_centre") in (None, "integer") else K
    return LensCamera(K, _size(path, content), _distortion(path, content))


def _right(path: Path, content: Any, top: Mapping[str, Any], left: LensCamera) -> LensCamera:
    if not isinstance(content, dict) or set(_NUMBERS) - set(content) or set(content) - set(_CAMERA):
        others = ", ".join(_CAMERA[len(_NUMBERS) :])
        wanted = f"`right` must have {', '.join(_NUMBERS)} and nothing else but {others}"
        raise ValueError(f"{path}: {wanted}, got {_shown(content)}")
    camera = _camera(path, content, top)
    if left.distortion is not None and not set(content) & set(_COEFFICIENTS):
        raise ValueError(f"{path}: `right` must have its own distortion, as the left camera has (0 for none)")
    return camera if camera.size is not None else replace(camera, size=left.size)


def _size(path: Path, content: Mapping[str, Any]) -> fit.Size | None:
    width, height = (_positive(path, content, key) for key in _SIZE)
    if width is None and height is None:
        return None
    if width is None or height is None:
        got = "width" if height is None else "height"
        raise ValueError(f"{path}: must have both `width` and `height`, or neither, got `{got}` only")
    if width != int(width) or height != int(height):
        raise ValueError(f"{path}: `width` and `height` must be whole numbers, got {width} and {height}")
    return int(height), int(width)


def _distortion(path: Path, content: Mapping[str, Any]) -> Distortion | None:
    there = [key for key in _COEFFICIENTS if content.get(key) is not None]
    model = _choice(path, content, "distortion")
    if wrong := [key for key in there if not _is_number(content[key])]:
        raise ValueError(f"{path}: `{wrong[0]}` must be a number, got {_shown(content[wrong[0]])}")
    values = {key: _bounded(path, content, key) for key in there}
    if model is not None and not there:
        raise ValueError(f"{path}: `distortion` {model} must come with its coefficients, {', '.join(_FISHEYE)} ...")
    if model == "fisheye" and (wrong := [key for key in there if key not in _FISHEYE]):
        raise ValueError(f"{path}: a fisheye has {', '.join(_FISHEYE)}, not {', '.join(wrong)}")
    if model is None and "k4" in values and not {"p1", "p2", "k5", "k6"} & set(values):
        raise ValueError(f'{path}: `k4` needs "distortion": "fisheye", or "opencv" where it is part of a quotient')
    if not any(values.values()):
        return None
    names = _FISHEYE if model == "fisheye" else _COEFFICIENTS
    return Distortion(model == "fisheye", tuple(values.get(key, 0.0) for key in names))


def _positive(path: Path, content: Mapping[str, Any], key: str) -> float | None:
    value = content.get(key)
    if value is None:
        return None
    if not _is_number(value) or not value > 0:
        raise ValueError(f"{path}: `{key}` must be a positive number, got {_shown(value)}")
    return _bounded(path, content, key)


def _bounded(path: Path, content: Mapping[str, Any], key: str) -> float:
    if abs(content[key]) > _MOST[key]:
        raise ValueError(f"{path}: `{key}` must be at most {_MOST[key]:g}, got {_shown(content[key])}")
    return float(content[key])


def _choice(path: Path, content: Mapping[str, Any], key: str) -> Any:
    value = content.get(key)
    if value is not None and value not in _CHOICES[key]:
        raise ValueError(f"{path}: `{key}` must be one of {', '.join(_CHOICES[key])}, got {_shown(value)}")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."

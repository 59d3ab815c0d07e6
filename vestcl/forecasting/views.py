"""Cameras to show a forecast from, given in a few words: "source", "right", "left" or "0.5,0,0,yaw=-5".

A camera is at x metres to the right, y down and z forward of the source camera, along the source camera's axes,
and is turned: yaw > 0 to the right, pitch > 0 up, roll > 0 clockwise (its right side goes down, so the image turns
counter-clockwise). Roll comes first, yaw last:

    next_from_tgt = [[R_y(yaw) R_x(pitch) R_z(roll), (x, y, z)], [0, 1]]        tgt_from_next = next_from_tgt^-1

        R_y = [[c, 0, s], [0, 1, 0], [-s, 0, c]]   R_x = [[1, 0, 0], [0, c, -s], [0, s, c]]
        R_z = [[c, -s, 0], [s, c, 0], [0, 0, 1]]   with c, s = cos and sin of the angle
"""

import re
from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl.data import calibration
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.forecasting.result import View

#: What follows the three numbers: three angles, the field of view, the name.
_ANGLES: Final = ("yaw", "pitch", "roll")
_KEYS: Final = (*_ANGLES, "fov", "name")

#: A view's name is a folder's, so it neither leads elsewhere nor hides.
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,99}")

_EXPECTED: Final = (
    '"source", "right", "left" or "x,y,z[,yaw=deg][,pitch=deg][,roll=deg][,fov=deg][,name=...]" with metres to the '
    "right, down and forward"
)


def parse_view(text: str, camera: Clip | Sample) -> View:
    """The camera that ``text`` describes.

    - "source": the source camera itself, tgt_from_next = I.
    - "right": the right camera of the stereo rig, tgt_from_next = right_from_left, with its own K.
    - "left": as far to the left as the right camera is to the right, tgt_from_next = right_from_left^-1, with the
      source's K. No camera was ever there.
    - "x,y,z", and after it in any order "yaw=", "pitch=", "roll=", "fov=" (degrees) and "name=": a camera moved and
      turned as described at the top of this file. ``fov`` is horizontal: fx = W / (2 tan(fov / 2)), fy = fx fy0 / fx0
      (the pixels keep their shape), with the source's principal point. Without ``name`` it is made of what differs from
      the source, "x0.5_yaw-5".

    Args:
        text: as above.
        camera: the source camera, and its rig; of a clip the first frame's.

    Returns:
        The view, at the size of ``camera``.

    Raises:
        ValueError: another word, an invalid number, an angle or name out of range, or a clip without a right
            camera; the message says what is expected.
    """
    sample = camera if isinstance(camera, Sample) else camera[0]
    word = text.strip()
    if word == "source":
        return View("source", np.eye(4))
    if word in ("right", "left"):
        return _of_rig(word, sample)
    parts = [part.strip() for part in word.split(",")]
    position = _numbers(text, parts[:3])
    options = _options(text, parts[3:])
    angles = {name: _number(text, options.get(name, "0")) for name in _ANGLES}
    tgt_from_next = calibration.invert(_pose(position, angles))
    name = options.get("name") or _default_name(position, angles, options.get("fov"))
    check_name(name)
    return View(name, tgt_from_next, _zoomed(text, options["fov"], sample) if "fov" in options else None)


def parse_views(texts: Iterable[str], camera: Clip | Sample) -> list[View]:
    """`parse_view` of each.

    Raises:
        ValueError: as `parse_view`, or two views of one name.
    """
    views = [parse_view(text, camera) for text in texts]
    names = [view.name for view in views]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"`view` must have different names, got {', '.join(twice)} twice; add name=...")
    return views


def seen_by(view: View, sample: Sample) -> Sample | RightCamera | None:
    """The rig's camera at the position of ``view``, whatever the view's name: its images are the truth.

    Args:
        view: a camera.
        sample: of the time in question.

    Returns:
        ``sample`` itself, its right camera at the sample's size, or None if there is no camera there.
    """
    at_source = np.array_equal(view.tgt_from_next, np.eye(4))
    if at_source and (view.K is None or np.array_equal(view.K, sample.K)):
        return sample
    if sample.right is None or view.K is None:
        return None
    right = sample.right.resized(sample.height, sample.width)
    there = np.array_equal(view.tgt_from_next, right.right_from_left) and np.array_equal(view.K, right.K)
    return right if there else None


def check_name(name: str) -> None:
    """Refuse a view's name that is not a plain folder name.

    Raises:
        ValueError: empty, of more than 100 letters, with something else than letters, digits and "._+-", with one of
            these four first, or the name of forecast.json.
    """
    if not _NAME.fullmatch(name) or name.lower() == "forecast.json":
        wanted = "a name of letters, digits and '._+-', at most 100, that starts with one of the former"
        raise ValueError(f"`view` must have {wanted}, got {name[:120]!r}")


def _of_rig(word: str, sample: Sample) -> View:
    if sample.right is None:
        side = 0.5 if word == "right" else -0.5
        raise ValueError(
            f"`view` {word!r} needs a stereo clip, and sample {sample.name} has no right camera; "
            f'give numbers, as "{side},0,0" for half a metre to the {word}'
        )
    if word == "right":
        return View("right", sample.right.right_from_left, sample.right.resized(sample.height, sample.width).K)
    return View("left", calibration.invert(sample.right.right_from_left))


def _numbers(text: str, words: list[str]) -> NDArray[np.float64]:
    if len(words) != 3:
        raise ValueError(f"`view` must be {_EXPECTED}, got {text!r}")
    return np.array([_number(text, word) for word in words])


def _number(text: str, word: str) -> float:
    try:
        number = float(word)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise ValueError(f"`view` must be {_EXPECTED}, got {text!r}: {word!r} is not a finite number")
    return number


def _options(text: str, parts: list[str]) -> dict[str, str]:
    options: dict[str, str] = {}
    for part in parts:
        key, _, value = (piece.strip() for piece in part.partition("="))
        if key not in _KEYS or not value or key in options:
            raise ValueError(
                f"`view` may have {', '.join(f'{k}=' for k in _KEYS)}, each once, got {part!r} in {text!r}"
            )
        options[key] = value
    return options


def _pose(position: NDArray[np.float64], degrees: dict[str, float]) -> NDArray[np.float64]:
    """next_from_tgt [4, 4]."""
    (cy, cp, cr), (sy, sp, sr) = (turn(np.radians([degrees[name] for name in _ANGLES])) for turn in (np.cos, np.sin))
    yaw = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    pitch = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    roll = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return calibration.rigid(yaw @ pitch @ roll, position)


def _zoomed(text: str, fov: str, sample: Sample) -> NDArray[np.float64]:
    degrees = _number(text, fov)
    if not 0 < degrees < 180:
        raise ValueError(f"`view` {text!r}: its `fov` must be between 0 and 180 degrees, got {degrees:g}")
    focal = calibration.intrinsics_from_fov(degrees, sample.height, sample.width)[0, 0]
    (fx, _, cx), (_, fy, cy), _ = sample.K
    return calibration.intrinsics(focal, focal * fy / fx, cx, cy)


def _default_name(position: NDArray[np.float64], angles: dict[str, float], fov: str | None) -> str:
    offsets = dict(zip("xyz", position, strict=True)) | angles
    parts = [f"{key}{value:g}" for key, value in offsets.items() if value]
    parts += [] if fov is None else [f"fov{float(fov):g}"]
    return "_".join(parts) or "x0"

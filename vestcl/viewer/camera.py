"""The browser's camera as a view, its image on the browser's canvas, and camera paths through keyframes.

Cameras of the page have OpenCV's axes, as all of vestcl (x right, y down, z forward); the page's origin is the source
camera at the time that is shown.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator  # type: ignore[import-untyped]
from scipy.spatial.transform import Rotation, Slerp  # type: ignore[import-untyped]

from vestcl.data import calibration
from vestcl.forecasting.result import View

Matrix = NDArray[np.float64]


class Pose(NamedTuple):
    """A camera of the page."""

    wxyz: tuple[float, float, float, float]
    """Unit quaternion of next_from_tgt."""
    position: tuple[float, float, float]
    """m, in the axes of the source camera at the time that is shown."""
    fov: float
    """Vertical, of the canvas, rad."""
    aspect: float
    """Width over height of the canvas."""


#: The source camera itself.
SOURCE: Final = View("source", np.eye(4))


def view_of(pose: Pose, K: Matrix, height: int, width: int) -> View:
    """The camera whose image fills the canvas from side to side, or from top to bottom where that is nearer.

    f_y = H / (2 tan(fov / 2)) if the image is as high as the canvas, f_x = W / (2 tan(fov / 2) aspect) if it is as
    wide; f_x / f_y is the source's, and the centre is the image's.

    Args:
        pose: of the page's camera.
        K: [3, 3] px, of the source camera.
        height: px, of the image.
        width: px.
    """
    turn = Rotation.from_quat(np.roll(np.asarray(pose.wxyz, np.float64), -1)).as_matrix()
    next_from_tgt = calibration.rigid(turn, np.asarray(pose.position, np.float64))
    half, shape = math.tan(pose.fov / 2), K[1, 1] / K[0, 0]
    if _fills_width(pose.aspect, shape, height, width):
        fx = width / (2 * half * pose.aspect)
        fy = fx * shape
    else:
        fy = height / (2 * half)
        fx = fy / shape
    return View("viewer", calibration.invert(next_from_tgt), calibration.intrinsics(fx, fy, width / 2, height / 2))


def fov_of(K: Matrix, height: int, width: int, aspect: float) -> float:
    """The canvas's vertical field of view, rad, that shows what the source camera does.

    Args:
        K: [3, 3] px.
        height: px.
        width: px.
        aspect: of the canvas.
    """
    if _fills_width(aspect, K[1, 1] / K[0, 0], height, width):
        return 2 * math.atan(width / (2 * float(K[0, 0]) * aspect))
    return 2 * math.atan(height / (2 * float(K[1, 1])))


def on_canvas(image: NDArray[np.uint8], aspect: float, shape: float = 1.0) -> NDArray[np.uint8]:
    """The image [H, W, 3] between black bars, which give it the canvas's aspect.

    Args:
        image: RGB.
        aspect: of the canvas.
        shape: f_y / f_x, by which its pixels are wider than high.
    """
    height, width, _ = image.shape
    if _fills_width(aspect, shape, height, width):
        bar = max(round((width * shape / aspect - height) / 2), 0)
        return np.pad(image, ((bar, bar), (0, 0), (0, 0)))
    bar = max(round((height * aspect / shape - width) / 2), 0)
    return np.pad(image, ((0, 0), (bar, bar), (0, 0)))


def _fills_width(aspect: float, shape: float, height: int, width: int) -> bool:
    return aspect <= width * shape / height


@dataclass(frozen=True)
class Keyframe:
    """A camera and a time that a path goes through."""

    pose: Pose
    ahead: float
    """Intervals after t."""


def camera_path(keyframes: Sequence[Keyframe], frames: int) -> list[Keyframe]:
    """Cameras evenly spaced in time through keyframes, which are as far apart as each other.

    Places, fields of view and times by cubic polynomials that don't overshoot (Fritsch and Butland 1984), rotations by
    spherical linear interpolation.

    Args:
        keyframes: two or more.
        frames: how many, two or more.

    Raises:
        ValueError: fewer.
    """
    if len(keyframes) < 2 or frames < 2:
        raise ValueError(f"`keyframes` and `frames` must be 2 or more, got {len(keyframes)} and {frames}")
    knots, times = np.arange(len(keyframes)), np.linspace(0, len(keyframes) - 1, frames)
    turns = Rotation.from_quat([np.roll(key.pose.wxyz, -1) for key in keyframes])
    quaternions = np.roll(Slerp(knots, turns)(times).as_quat(), 1, axis=1)
    numbers = np.array([[*key.pose.position, key.pose.fov, key.ahead] for key in keyframes])
    smooth = PchipInterpolator(knots, numbers)(times)
    aspect = keyframes[0].pose.aspect
    return [
        Keyframe(Pose(_floats(q), _floats(row[:3]), float(row[3]), aspect), float(row[4]))
        for q, row in zip(quaternions, smooth, strict=True)
    ]


def quaternion_of(dst_from_src: Matrix) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a rigid motion [4, 4]."""
    return _floats(np.roll(Rotation.from_matrix(dst_from_src[:3, :3]).as_quat(), 1))


def _floats(values: ArrayLike) -> tuple:  # type: ignore[type-arg]
    return tuple(float(value) for value in np.asarray(values))

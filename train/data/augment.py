"""Augmentation that keeps geometry true: what is done to the images is done to cameras and motions, too.

A window is cut out, resized, mirrored and coloured as a whole, in NumPy, before the networks' input is made of it: the
prior follows from the mirrored motions by itself.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Final, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl import geometry
from vestcl.data.resize import resize_image, resize_labels
from vestcl.forecasting.network.input import CameraPath
from vestcl.scene.layers import Layers
from vestcl.scene.perceived import PerceivedFrame

Element = TypeVar("Element", bound=np.generic)
Value = TypeVar("Value")
Matrix = NDArray[np.float64]

#: Largest change of brightness, contrast and saturation at strength 1, as factors 1 +- that; the largest exponent is
#: e^GAMMA, and the largest turn of the hue that share of a whole one. Half of it all is what monocular depth networks
#: are trained with (Godard et al. 2019: 0.2, 0.2, 0.2, hue 0.1), gamma for a camera's exposure added, hue reduced:
#: skies and asphalt don't turn green.
BRIGHTNESS, CONTRAST, SATURATION, GAMMA, HUE = 0.4, 0.4, 0.4, 0.3, 0.05

#: Luma of RGB (ITU-R BT.601).
LUMA: Final = np.array([0.299, 0.587, 0.114])

#: x -> -x.
_MIRROR: Final = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class TrainingWindow:
    """Two frames of a clip and what is to be forecast from them, all of one size."""

    prev: PerceivedFrame
    """At t - 1."""
    cur: PerceivedFrame
    """At t."""
    target: NDArray[np.float32]
    """[3, H, W] RGB in [0, 1], at t + k."""
    target_K: Matrix  # noqa: N815 (the matrix K)
    """[3, 3] px."""
    tgt_from_next: Matrix
    """[4, 4] m: the target's camera relative to the source camera at t + k; identity if it is the same."""
    future_from_cur: Matrix | None
    """[4, 4] m: the camera's true motion from t to t + k; None where it is not known."""
    path_from_cur: tuple[Matrix, ...] = ()
    """The same to t + 1, t + 2 ...; none where a pose is unknown."""
    path: CameraPath | None = None
    """The camera's motion as it is forecast; None is constant velocity."""

    @property
    def size(self) -> tuple[int, int]:
        """(height, width), px."""
        height, width = self.target.shape[1:]
        return height, width


def crop(window: TrainingWindow, top: int, left: int, height: int, width: int) -> TrainingWindow:
    """The part that starts at (left, top): c_x - left, c_y - top; nothing else changes.

    Args:
        window: whole.
        top: rows cut off above.
        left: columns cut off at the left.
        height: rows that stay.
        width: columns that stay.

    Returns:
        The part; its images are views of the whole's.

    Raises:
        ValueError: a part that is not inside.

    Source: SPEC section 7.
    """
    rows, columns = window.size
    if min(top, left, height - 1, width - 1) < 0 or top + height > rows or left + width > columns:
        raise ValueError(f"`crop` must lie in {rows}x{columns}, got {height}x{width} at row {top}, column {left}")

    def cut(planes: NDArray[Element]) -> NDArray[Element]:
        return planes[:, top : top + height, left : left + width]

    return _mapped(window, cut, cut, lambda K: geometry.crop_intrinsics(torch.from_numpy(K), left, top).numpy())


def resize(window: TrainingWindow, height: int, width: int) -> TrainingWindow:
    """Everything at another size: K' = diag(s_x, s_y, 1) K; images by mean over area, all else the nearest pixel.

    Args:
        window: at its own size.
        height: px.
        width: px.

    Returns:
        The window; itself where that is its size.

    Raises:
        ValueError: a size that is not positive.

    Source: SPEC section 1.
    """
    rows, columns = window.size
    if (rows, columns) == (height, width):
        return window
    return _mapped(
        window,
        lambda image: resize_image(image, height, width),
        lambda planes: resize_labels(planes, height, width),
        lambda K: geometry.scale_intrinsics(torch.from_numpy(K), width / columns, height / rows).numpy(),
    )


def flip(window: TrainingWindow) -> TrainingWindow:
    """The world in a mirror, x -> -x.

    With S = diag(-1, 1, 1): images mirrored left to right, K' = [[-1, 0, W], [0, 1, 0], [0, 0, 1]] K S, so that
    c_x' = W - c_x; velocities S v; motions S R S and S t, which makes (w, x, -y, -z) of a quaternion, and a left
    camera of a right one.

    Args:
        window: any.

    Returns:
        Its mirror image; flipped twice it is as before.

    Source: SPEC section 7.
    """
    mirrored_pixels = np.array([[-1.0, 0.0, window.size[1]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    turned = _mapped(window, _mirror, _mirror, lambda K: mirrored_pixels @ K @ _MIRROR[:3, :3])
    return replace(
        turned,
        prev=_mirror_motion(turned.prev),
        cur=_mirror_motion(turned.cur),
        tgt_from_next=_conjugate(turned.tgt_from_next),
        future_from_cur=None if turned.future_from_cur is None else _conjugate(turned.future_from_cur),
        path_from_cur=tuple(map(_conjugate, turned.path_from_cur)),
        path=None if turned.path is None else _mirror_path(turned.path),
    )


@dataclass(frozen=True, eq=False)
class Colour:
    """A change of colour: x -> clip(A x^gamma + b, 0, 1), the same for every pixel and frame."""

    gamma: float
    """Exponent."""
    matrix: Matrix
    """A [3, 3]."""
    offset: float
    """b."""

    def __call__(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """[3, H, W] RGB in [0, 1] -> the same, in its own memory.

        The sums are written out: a matrix product's last bits depend on how many threads share it.
        """
        red, green, blue = torch.from_numpy(np.ascontiguousarray(image)).pow(self.gamma).numpy()
        a = self.matrix.astype(np.float32)
        mixed = [a[i, 0] * red + a[i, 1] * green + a[i, 2] * blue + np.float32(self.offset) for i in range(3)]
        return np.stack(mixed).clip(0, 1)


def draw_colour(rng: np.random.Generator, strength: float, grey: float) -> Colour:
    """Brightness, contrast about ``grey``, saturation, gamma and hue, each uniform in its range.

    A = f c (L + s (I - L)) H and b = f (1 - c) grey: brightness f and contrast c are factors, L = 1 w^T gives luma, so
    that saturation s scales what differs from it, and H turns the hue about the grey axis.

    Args:
        rng: five numbers are drawn.
        strength: 0 = none, 1 = the full ranges.
        grey: level that contrast leaves where it is.

    Returns:
        The change, for all images of a window.

    Raises:
        ValueError: a strength outside [0, 1].
    """
    if not 0 <= strength <= 1:
        raise ValueError(f"`strength` must be 0 ... 1, got {strength}")
    brightness, contrast, saturation, gamma, hue = strength * rng.uniform(-1, 1, 5)
    factor, spread = 1 + BRIGHTNESS * brightness, 1 + CONTRAST * contrast
    luma = np.outer(np.ones(3), LUMA)
    colourful = luma + (1 + SATURATION * saturation) * (np.eye(3) - luma)
    matrix = factor * spread * colourful @ _hue_turn(2 * np.pi * HUE * hue)
    return Colour(float(np.exp(GAMMA * gamma)), matrix, float(factor * (1 - spread) * grey))


def colour(window: TrainingWindow, change: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> TrainingWindow:
    """``change`` applied to every image of a window: the frames', the backgrounds' and the target."""
    return _mapped(window, change, _same, _same)


def mean_luma(image: NDArray[np.float32]) -> float:
    """The mean of an image's luma, [3, H, W] -> a level in [0, 1]."""
    return float(LUMA @ image.mean(axis=(1, 2), dtype=np.float64))


def _hue_turn(angle: float) -> Matrix:
    """[3, 3]: a turn about the grey axis, radians; greys stay."""
    axis = np.full(3, 3**-0.5)
    cross = np.cross(np.eye(3), axis)
    return np.cos(angle) * np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * np.outer(axis, axis)


def _mapped(
    window: TrainingWindow,
    picture: Callable[[Any], Any],
    planes: Callable[[Any], Any],
    intrinsics: Callable[[Matrix], Matrix],
) -> TrainingWindow:
    """The window with its images, its other planes (depths, masks, velocities) and its K changed."""

    def frame(frame: PerceivedFrame) -> PerceivedFrame:
        changed = {
            field.name: (picture if "image" in field.name else planes)(getattr(frame.layers, field.name))
            for field in fields(Layers)
        }
        return replace(
            frame,
            K=intrinsics(frame.K),
            layers=Layers(**changed),
            velocity=planes(frame.velocity),
            own=planes(frame.own),
        )

    return replace(
        window,
        prev=frame(window.prev),
        cur=frame(window.cur),
        target=picture(window.target),
        target_K=intrinsics(window.target_K),
    )


def _same(value: Value) -> Value:
    return value


def _mirror(planes: NDArray[Element]) -> NDArray[Element]:
    return planes[:, :, ::-1]


def _conjugate(dst_from_src: Matrix) -> Matrix:
    return _MIRROR @ dst_from_src @ _MIRROR


def _mirror_path(path: CameraPath) -> CameraPath:
    """A rotation vector (x, y, z) is (x, -y, -z) in the mirror, a translation (-x, y, z)."""
    signs = np.array([1, -1, -1, -1, 1, 1, 1], np.float32)
    return path._replace(future_from_cur=tuple(map(_conjugate, path.future_from_cur)), measured=path.measured * signs)


def _mirror_motion(frame: PerceivedFrame) -> PerceivedFrame:
    """A frame's velocities and motion, seen in the mirror."""
    velocity = frame.velocity * np.array([-1, 1, 1], np.float32)[:, None, None]
    known = frame.prev_from_cur
    return replace(frame, velocity=velocity, prev_from_cur=None if known is None else _conjugate(known))

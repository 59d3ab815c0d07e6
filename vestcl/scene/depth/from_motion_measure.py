"""Inverse depth of every pixel, as flow to several earlier images shows it while the camera moves."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.scene.flow.correspondence import Correspondence
from vestcl.scene.flow.parallax import epipolar, moved_pixels
from vestcl.scene.flow.pose import Pose

#: Forward-backward error, and distance to the epipolar line, beyond which flow gives no depth, px.
_FLOW_ERROR, _OFF_LINE = 1.0, 1.0

#: Error of the flow along the line, px: a constant, and a share of the flow, as long flow is found less well.
_FLOW_STD, _FLOW_SHARE = 0.3, 0.015

#: Noise of an image, grey levels (0 to 1), over a window of this many pixels per side in which flow is found: where the
#: brightness hardly changes along the epipolar line, on bare asphalt, flow finds whatever the noise and the smoothing
#: of flow make of it.
_GREY_STD, _WINDOW = 0.03, 9

#: Views whose inverse depths differ by more standard deviations than that don't see the same object.
_AGREE: Final = 3.0

#: Pixels that compare the lengths of two motions: those that moved along their lines by more px, in both.
_MOVED: Final = 2.0

#: Fewer pixels than that compare nothing.
_FEWEST: Final = 200

#: A pose that fewer of the correspondences agree with is rejected.
_INLIERS: Final = 0.3

Array = NDArray[np.float64]


class Measured(NamedTuple):
    """What flow measures, in units of the reference motion's length."""

    inverse: Array
    """[H, W] 1/unit, may be below 0 where nothing static can be."""
    std: Array
    """[H, W] 1/unit; infinite where nothing was measured."""
    moving: NDArray[np.bool_]
    """[H, W], True where reliable flow leads off the epipolar line, or behind infinity."""
    lengths: list[float]
    """Per view the length of its translation in units; 0 where it only turned or is rejected."""
    speed_before: float = 0.0
    """Length of the motion to the last image but one over that of the motion to the last one; 0 = unknown."""


def measure(
    image: NDArray[np.float32], correspondences: Sequence[Correspondence], poses: Sequence[Pose], K: Array
) -> Measured | None:
    """s = argmin |p' x (K R K^-1 p + s K t)|^2 for each view, in closed form; the views' weighted mean.

    The first view with a translation sets the unit of length; each other one is scaled by the median ratio of its
    inverse depths to the reference's. A view that disagrees with the first one that sees the pixel is left out there.

    Args:
        image: [3, H, W] RGB in [0, 1].
        correspondences: from the image to each earlier one, the latest first.
        poses: of the same.
        K: [3, 3] px.

    Returns:
        The measurement; None if no view has a translation.
    """
    lengths = [0.0] * len(poses)
    reference: tuple[Array, Array] | None = None
    moving = np.zeros(correspondences[0].flow_uv.shape[1:], bool)
    texture = _texture(image)
    total, weight = np.zeros(moving.shape), np.zeros(moving.shape)
    for index, (correspondence, pose) in enumerate(zip(correspondences, poses, strict=True)):
        if not pose.dst_from_src[:3, 3].any() or pose.inliers < _INLIERS:
            continue
        inverse, std, off = _triangulate(correspondence, pose.dst_from_src, K, texture)
        if reference is None:
            reference, lengths[index], moving = (inverse, std), 1.0, off
        else:
            lengths[index] = _ratio(reference, (inverse, std))
            if not lengths[index]:
                continue
            inverse, std = inverse / lengths[index], std / lengths[index]
        mean = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)
        spread = np.sqrt(std**2 + 1 / np.maximum(weight, 1e-12))
        use = np.isfinite(std) & ((weight == 0) | (np.abs(inverse - mean) < _AGREE * spread))
        precision = np.where(use, std**-2.0, 0.0)
        total, weight = total + precision * np.where(use, inverse, 0.0), weight + precision
    if reference is None:
        return None
    known = weight > 0
    mean = np.divide(total, weight, out=np.zeros_like(total), where=known)
    std = np.where(known, np.maximum(weight, 1e-12) ** -0.5, np.inf)
    return Measured(mean, std, moving | (known & (mean < -_AGREE * std)), lengths, _speed_before(poses, lengths))


def _speed_before(poses: Sequence[Pose], lengths: Sequence[float]) -> float:
    """|x_2 t_2 - R_2 R_1^T x_1 t_1| / x_1, of the motions R, t of length x to the earlier images."""
    if len(poses) < 2 or not lengths[0] or not lengths[1]:
        return 0.0
    (turn, step), (turn_both, both) = ((pose.dst_from_src[:3, :3], pose.dst_from_src[:3, 3]) for pose in poses[:2])
    before = lengths[1] * both - lengths[0] * turn_both @ turn.T @ step
    return float(np.linalg.norm(before) / lengths[0])


def moving_by_turn(correspondence: Correspondence, turn: Array, K: Array) -> NDArray[np.bool_]:
    """[H, W], True where reliable flow differs from that of a camera that only turned: what moves there is no parallax.

    Args:
        correspondence: from the image to an earlier one.
        turn: [4, 4], the camera's motion between them; its translation is not looked at.
        K: [3, 3] px.
    """
    turned, _ = epipolar(K, turn, *correspondence.flow_uv.shape[1:])
    off = np.hypot(*(moved_pixels(correspondence.flow_uv) - turned[:2] / np.maximum(turned[2], 1e-3)))
    return np.asarray((correspondence.error[0] < _FLOW_ERROR) & (off > 2 * _OFF_LINE))


def _texture(image: NDArray[np.float32]) -> Array:
    """Sums of products of the image's derivatives over a window, xx, yy and xy: [3, H, W]."""
    grey = cv2.GaussianBlur(cv2.cvtColor(image.transpose(1, 2, 0), cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    x, y = (cv2.Sobel(grey, cv2.CV_32F, *order) / 8 for order in ((1, 0), (0, 1)))
    products = [cv2.boxFilter(product, -1, (_WINDOW, _WINDOW), normalize=False) for product in (x * x, y * y, x * y)]
    return np.stack(products).astype(np.float64)


def _triangulate(
    correspondence: Correspondence, motion: Array, K: Array, texture: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Inverse depth [H, W] in units of the motion's length, its standard deviation, and what is off its line."""
    flow, error = correspondence
    moved = moved_pixels(flow)
    a, b = epipolar(K, motion, *flow.shape[1:])
    b = b[:, None, None]
    constant, slope = a[:2] - moved * a[2], b[:2] - moved * b[2]
    steepness = np.maximum(slope[0] ** 2 + slope[1] ** 2, 1e-9)
    inverse = -(constant[0] * slope[0] + constant[1] * slope[1]) / steepness
    z = np.maximum(a[2] + inverse * b[2], 1e-3)
    off = np.abs(constant[0] * slope[1] - constant[1] * slope[0]) / np.sqrt(steepness) / z
    noise = np.hypot(_FLOW_STD, _FLOW_SHARE * np.hypot(*flow)) + error[0].clip(max=_FLOW_ERROR) / 2
    xx, yy, xy = texture
    contrast = slope[0] ** 2 * xx + slope[1] ** 2 * yy + 2 * slope[0] * slope[1] * xy
    noise = np.sqrt(noise.astype(np.float64) ** 2 + _GREY_STD**2 * (steepness / np.maximum(contrast, 1e-12)))
    returns = (error[0] < _FLOW_ERROR) & (noise < _FLOW_ERROR)
    std = np.where(returns & (off < _OFF_LINE), noise * z / np.sqrt(steepness), np.inf)
    return inverse, std, returns & (off > 2 * _OFF_LINE)


def _ratio(reference: tuple[Array, Array], other: tuple[Array, Array]) -> float:
    """Median of other over reference where both are sure; 0 where too few are."""
    sure = np.ones(reference[0].shape, bool)
    for inverse, std in (reference, other):
        sure &= inverse * _FLOW_STD > _MOVED * std
    if sure.sum() < _FEWEST:
        return 0.0
    return float(np.median(other[0][sure] / reference[0][sure]))

"""Depth made better by motion: what flow shows of a static scene while the camera moves is a second stereo pair."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.scene import checked
from vestcl.scene.depth.road_plane import pixels_through
from vestcl.scene.flow.correspondence import Correspondence, check_size

#: Standard deviation of dense inverse search where its flow returns, px (0.2 and 0.35 serve equally well).
_FLOW_STD: Final = 0.25

#: Forward-backward error, and distance to the epipolar line, beyond which flow gives no depth, px.
_FLOW_ERROR, _OFF_LINE = 1.0, 1.0

#: Depth and flow agree if they differ, along the line, by fewer pixels plus that share of the flow.
_AGREE, _AGREE_SHARE = 1.5, 0.05

#: Where nothing else is known, only flow gives depth if a pixel of flow is worth less than that, in 1/m: on KITTI's
#: car at 1.2 m per frame, everywhere but within 40 px of the point it drives to.
_WEAKEST: Final = 0.02

#: Islands of up to this many pixels whose inverse depth differs from what surrounds them by more than so much, 1/m,
#: are rejected: 0.003 / m is a disparity of 1 px on KITTI.
_ISLAND, _ISLAND_STEP = 200, 0.003

#: Inverse depths are counted in such steps, 1/m, for OpenCV's filter of islands, which takes integers.
_INVERSE_STEP: Final = 2e-4


class OtherFrame(NamedTuple):
    """Another frame of the same scene."""

    correspondence: Correspondence
    """From the frame whose depth is sought to the other one."""
    dst_from_src: NDArray[np.float64]
    """[4, 4] m, the camera's motion between them."""


def refine_depth(
    depth: ArrayLike,
    inverse_std: float,
    K: ArrayLike,
    views: Sequence[OtherFrame],
    static: ArrayLike,
) -> NDArray[np.float32]:
    """Weighted least squares over s = 1/z: (s - 1/z)^2 / std^2 + sum over views of |p'(s) - p - flow|^2 / flow_std^2.

    p'(s) = project(K (R K^-1 p + s t)) moves on the epipolar line as s changes; one Gauss-Newton step from 1/z is
    exact enough, as both are close where they agree. Where they don't, one of them is wrong and the pixel has no
    depth; where depth is missing and flow keeps to the line, only flow gives it.

    Args:
        depth: [1, H, W] m; 0 = invalid.
        inverse_std: of 1 / depth, 1/m: for a stereo pair that is the error of its disparity, px, over fx b.
        K: [3, 3] px.
        views: other frames; none leaves all as it is.
        static: [1, H, W] bool, True where the scene is static; elsewhere depth stays as it is.

    Returns:
        [1, H, W] m; 0 = invalid.

    Raises:
        ValueError: shapes, numbers that aren't finite, or an ``inverse_std`` that is not positive.
    """
    depth = checked.depth("depth", depth)
    static = checked.mask("static", static, depth)
    K = checked.matrix("K", K, 3)
    if not inverse_std > 0:
        raise ValueError(f"`inverse_std` must be above 0, got {inverse_std}")
    for view in views:
        check_size("views", view.correspondence, depth)
    if not views:
        return depth
    known = depth > 0
    given = np.divide(1, depth, out=np.zeros_like(depth), where=known)
    weight = np.where(known, np.float32(inverse_std**-2), np.float32(0))
    total, refuted = weight * given, np.zeros_like(static)
    for view in views:
        measured, precision, trusted = _measure(given, known, K, view)
        reach = _AGREE + _AGREE_SHARE * np.hypot(*view.correspondence.flow_uv)[None]
        agrees = np.abs(measured - given) * np.sqrt(precision) < reach
        strong = precision > _WEAKEST**-2
        use = trusted & static & np.where(known, agrees, strong)
        total += np.where(use, precision / _FLOW_STD**2 * measured, 0)
        weight += np.where(use, precision / _FLOW_STD**2, 0)
        refuted |= known & static & (view.correspondence.error < _FLOW_ERROR) & ~(trusted & agrees)
    inverse = np.divide(total, weight, out=np.zeros_like(depth), where=(weight > 0) & ~refuted)
    inverse = np.where(static, _without_islands(inverse), inverse)  # what moves may well be small
    return np.divide(1, inverse, out=np.zeros_like(depth), where=inverse > 0)


def _measure(
    given: NDArray[np.float32], known: NDArray[np.bool_], K: NDArray[np.float64], view: OtherFrame
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Inverse depth [1, H, W] by the flow only, |dp'/ds|^2 (px m)^2, and whether the flow keeps to its line."""
    flow, error = view.correspondence
    moved = moved_pixels(flow)
    start, slope = epipolar(K, view.dst_from_src, *flow.shape[1:])
    inverse, unknown = given[0].astype(np.float64), ~known[0]
    if unknown.any():  # there a first step finds where to linearise
        guess = inverse[unknown]
        guess += _step(start[:, unknown], slope, moved[:, unknown], guess).step
        inverse[unknown] = np.clip(guess, 0, 1 / 3)
    step, off_line, precision, z = _step(start, slope, moved, inverse)
    measured = inverse + step
    trusted = (error[0] < _FLOW_ERROR) & (off_line < _OFF_LINE**2) & (measured > 0) & (z > 0)
    return measured[None].astype(np.float32), precision[None].astype(np.float32), trusted[None]


class _Step(NamedTuple):
    """A Gauss-Newton step of inverse depths."""

    step: NDArray[np.float64]
    """[...] 1/m."""
    off_line: NDArray[np.float64]
    """[...] px^2, the squared distance of what flow shows from the epipolar line."""
    precision: NDArray[np.float64]
    """[...] |dp'/ds|^2 (px m)^2."""
    z: NDArray[np.float64]
    """[...], above 0 in front of the other camera."""


def _step(
    start: NDArray[np.float64], slope: NDArray[np.float64], moved: NDArray[np.float64], inverse: NDArray[np.float64]
) -> _Step:
    """From ``inverse`` [...] 1/m, for p' = a + s b with a ``start`` [3, ...] and b ``slope`` [3]."""
    x, y, z = (a + inverse * b for a, b in zip(start, slope, strict=True))
    squared = z**2
    along, down = ((slope[i] * start[2] - start[i] * slope[2]) / squared for i in (0, 1))
    right, below = moved[0] - x / z, moved[1] - y / z
    precision = along**2 + down**2
    step = (along * right + down * below) / np.maximum(precision, 1e-9)
    off_line = (right - along * step) ** 2 + (below - down * step) ** 2
    return _Step(step, off_line, precision, z)


def pixel_centres(height: int, width: int) -> NDArray[np.float64]:
    """p [2, H, W] px, x then y."""
    centres = np.empty((2, height, width))
    centres[0], centres[1] = np.arange(width) + 0.5, (np.arange(height) + 0.5)[:, None]
    return centres


def moved_pixels(flow_uv: NDArray[np.float32]) -> NDArray[np.float64]:
    """p + flow(p) [2, H, W] px at pixel centres."""
    return pixel_centres(*flow_uv.shape[1:]) + flow_uv


def epipolar(
    K: NDArray[np.float64], dst_from_src: NDArray[np.float64], height: int, width: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """a = K R K^-1 p [3, H, W] and b = K t [3]: at inverse depth s, p is seen at p' = a + s b, divided by its third."""
    homography = K @ dst_from_src[:3, :3] @ np.linalg.inv(K)
    return pixels_through(homography, height, width), K @ dst_from_src[:3, 3]


def _without_islands(inverse: NDArray[np.float32]) -> NDArray[np.float32]:
    """Small regions that stick out of their surroundings become 0."""
    steps = np.where(inverse[0] > 0, (inverse[0] / _INVERSE_STEP).round() + 1, 0).clip(0, 32767).astype(np.int16)
    cv2.filterSpeckles(steps, 0, _ISLAND, round(_ISLAND_STEP / _INVERSE_STEP))
    return np.where(steps[None] > 0, inverse, np.float32(0))

"""A network's depth and the parallax of a moving camera, each where it is good.

A network gives metres and a dense map, with errors of some 10 % that are the same over whole regions. Parallax gives
nearly exact ratios of depths where the camera moved and the scene is static: no scale, nothing near the point that it
drives to, and nothing on what moves. So the network gives the length of the motion, parallax a smooth correction of the
network, and at each pixel both are averaged by their precision.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.scene import checked
from vestcl.scene.depth.from_motion import CAMERA_HEIGHT, observe
from vestcl.scene.depth.from_motion_measure import Measured
from vestcl.scene.depth.road_plane import fit_road
from vestcl.scene.flow.correspondence import Correspondence, correspond
from vestcl.scene.motion.ego_motion import ego_motion

#: Inverse depths that take part in the scale: of a standard deviation below that share of themselves, nearer than this
#: many metres by the network.
_SURE, _FAR = 0.1, 60.0

#: Fewer such pixels, as a share of the image, give no scale.
_FEWEST: Final = 0.005

#: Standard deviation of the smooth correction's filter, as a share of the image's width.
_SMOOTH: Final = 0.06

#: Strength of "no correction", in pixels with a standard deviation of the network's.
_PRIOR: Final = 0.05

#: Rounds of reweighting of the correction: residuals as large as the network's error count half.
_ROUNDS: Final = 3

#: Relative error of a network, at least and at most; what is measured lies between.
_LEAST, _MOST = 0.04, 0.3

#: Where the network's error seems larger, it is the parallax that is too weak to be measured.
_REFUTED: Final = 0.2

#: Rounds of the line through a network without a unit, and its smallest inverse depth as a share of the largest.
_ROUNDS_OF_LINE, _NOTHING = 10, 1e-3

#: A pixel's two inverse depths that differ by more standard deviations do not show the same.
_AGREE: Final = 3.0

#: The correction's largest factor.
_LARGEST: Final = 2.0

#: Standard deviation of a network's inverse depth on the road, as a share, for a network without a unit.
_ROAD: Final = 0.03

Array = NDArray[np.float64]


class CombinedDepth(NamedTuple):
    """The last image, in space."""

    depth: NDArray[np.float32]
    """[1, H, W] m, above 0 wherever the network's is."""
    prev_from_cur: Array
    """[4, 4] m: from the last camera to the one before."""
    error: float | None
    """Relative error of the network's depth after the correction, as parallax measures it. None where there is too
    little parallax: depth is the network's, and motion what explains the flow at that depth."""


def combine_depth(
    estimate: ArrayLike,
    images: Sequence[ArrayLike],
    K: ArrayLike,
    *,
    metric: bool = True,
    static: ArrayLike | None = None,
    correspondence: Correspondence | None = None,
    camera_height: float = CAMERA_HEIGHT,
) -> CombinedDepth:
    """1/z = (s / std_s^2 + e / std_e^2) / (1 / std_s^2 + 1 / std_e^2) of parallax s and the corrected network e.

    e = exp(c) / z_network with a smooth c, the robust mean of log(s z_network) over the pixels around. s is measured up
    to the motion's length, which is the median of s z_network.

    Args:
        estimate: [1, H, W] m by a network; 0 = unknown.
        images: [3, H, W] each, RGB in [0, 1], consecutive, oldest first; the last three are looked at. With only one
            there is no parallax, and no motion.
        K: [3, 3] px.
        metric: whether the network gives metres. Else 1/z is a v + b of its inverse depth v: parallax gives b / a, and
            the road, ``camera_height`` below the camera, gives a.
        static: [1, H, W] bool, True where the scene may be static; None is everywhere.
        correspondence: from the last image to the one before, where it is known already.
        camera_height: m.

    Returns:
        Depth of the last image and the camera's motion, in the network's metres.

    Raises:
        ValueError: no image, shapes, or numbers that are not finite.
    """
    depth = checked.depth("estimate", estimate)
    if not images:
        raise ValueError("`images` must be one or more, got none")
    frames = [checked.planes(f"images[{i}]", image, 3, depth) for i, image in enumerate(images)]
    K = checked.matrix("K", K, 3)
    still = np.ones_like(depth, bool) if static is None else checked.mask("static", static, depth)
    inverse = np.divide(1.0, depth[0], out=np.zeros(depth.shape[1:]), where=depth[0] > 0)
    if len(frames) == 1:
        return CombinedDepth(_depth_of(inverse if metric else _by_road(inverse, K, camera_height)), np.eye(4), None)
    flow = correspond(frames[-1], frames[-2]) if correspondence is None else correspondence
    motion, measured = observe(frames, K, flow)
    if not metric:
        inverse = _by_road(inverse if measured is None else _shifted(measured, inverse, still[0]), K, camera_height)
    scale = None if measured is None else _scale(measured, inverse, still[0])
    if measured is not None and scale is not None:
        motion[:3, 3] *= scale * measured.lengths[0]
        in_metres = measured._replace(inverse=measured.inverse / scale, std=measured.std / scale)
        corrected, error = _corrected(in_metres, inverse, still[0])
        if error < _REFUTED:
            return CombinedDepth(_depth_of(_fused(in_metres, corrected, error)), motion, error)
    by_network = _depth_of(inverse)
    return CombinedDepth(by_network, ego_motion(by_network, still, flow, K).dst_from_src, None)


def _by_road(inverse: Array, K: Array, camera_height: float) -> Array:
    """The inverse depth in 1/m of a network without a unit: the road is ``camera_height`` below the camera."""
    plane = fit_road(inverse, np.where(inverse > 0, _ROAD * inverse, np.inf), K)
    return inverse if plane is None else inverse / (camera_height * float(np.linalg.norm(plane)))


def _shifted(measured: Measured, inverse: Array, static: NDArray[np.bool_]) -> Array:
    """v + b / a with the line s = a v + b through the parallax s, by least squares with Cauchy's weights."""
    sure = static & ~measured.moving & (measured.std < _SURE * measured.inverse) & (inverse > 0)
    if sure.mean() < _FEWEST:
        return inverse
    v, s = inverse[sure], measured.inverse[sure]
    slope, offset = float(np.median(s / v)), 0.0
    for _ in range(_ROUNDS_OF_LINE):
        error = np.hypot(measured.std[sure], _MOST * s)
        root = 1 / error / np.sqrt(1 + ((s - slope * v - offset) / (_LEAST * s)) ** 2)
        slope, offset = np.linalg.lstsq(np.stack([v, np.ones_like(v)], 1) * root[:, None], s * root, rcond=None)[0]
    if slope <= 0 or np.median(np.abs(s - slope * v - offset) / s) > _REFUTED:
        return inverse
    return np.where(inverse > 0, np.maximum(inverse + offset / slope, _NOTHING * float(v.max())), 0.0)


def _sure(measured: Measured, inverse: Array, static: NDArray[np.bool_]) -> NDArray[np.bool_]:
    sure = static & ~measured.moving & (measured.std < _SURE * measured.inverse)
    return np.asarray(sure & (inverse > 1 / _FAR))


def _scale(measured: Measured, inverse: Array, static: NDArray[np.bool_]) -> float | None:
    """Metres of the measurement's unit: the median ratio of the inverse depths; None where too few are sure."""
    sure = _sure(measured, inverse, static)
    if sure.mean() < _FEWEST:
        return None
    return float(np.median(measured.inverse[sure] / inverse[sure]))


def _corrected(measured: Measured, inverse: Array, static: NDArray[np.bool_]) -> tuple[Array, float]:
    """The network's inverse depth times exp of a smooth correction, and its relative error after it."""
    sure = _sure(measured, inverse, static)
    ratio = np.where(sure, measured.inverse / np.where(sure, inverse, 1), 1)
    residual = np.log(ratio.clip(1 / _LARGEST**2, _LARGEST**2))
    spread = np.where(sure, measured.std / np.maximum(measured.inverse, 1e-9), 1.0)
    correction, error = np.zeros_like(inverse), _MOST
    sigma = _SMOOTH * inverse.shape[1]
    for _ in range(_ROUNDS):
        left = residual - correction
        error = float(np.clip(1.4826 * np.median(np.abs(left[sure])), _LEAST, _MOST))
        weight = np.where(sure, error**2 / (error**2 + spread**2) / (1 + (left / error) ** 2), 0.0)
        total, share = (cv2.GaussianBlur(plane, (0, 0), sigma) for plane in (weight * residual, weight))
        correction = total / (share + _PRIOR)
    bounded = correction.clip(-np.log(_LARGEST), np.log(_LARGEST))
    return inverse * np.exp(bounded), error


def _fused(measured: Measured, inverse: Array, error: float) -> Array:
    """Mean of both inverse depths by their precision; the network's where they do not agree or the scene moves."""
    std = error * np.maximum(inverse, 1e-6)
    agrees = np.abs(measured.inverse - inverse) < _AGREE * np.hypot(measured.std, std)
    use = agrees & np.isfinite(measured.std) & ~measured.moving & (inverse > 0)
    precision = np.where(use, np.where(use, measured.std, 1.0) ** -2.0, 0.0)
    total = precision * np.where(use, measured.inverse, 0) + inverse / std**2
    return np.asarray(total / (precision + std**-2.0))


def _depth_of(inverse: Array) -> NDArray[np.float32]:
    return np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)[None].astype(np.float32)

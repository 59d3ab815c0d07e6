"""From measured inverse depth to a complete map: the road's plane, static objects, and smoothing along edges."""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.scene import checked
from vestcl.scene.depth import completion
from vestcl.scene.morphology import dilated
from vestcl.scene.motion.mask import without_specks

#: Off the road: by more standard deviations than that, and by more than that share of the road's inverse depth.
_OFF, _OFF_SHARE = 3.0, 0.25

#: The plane's standard deviation where flow agrees with it, a share of its inverse depth and as many 1/m; where flow
#: is silent, all of it, and no less than this many 1/m: there what is around decides.
_PLANE, _PLANE_FAR, _UNSEEN = 0.04, 0.001, 0.02

#: Nearer than that, 1/m, the plane is road: beyond, hills and bends end it.
_ROAD_END: Final = 1 / 120

#: Regions of dynamic objects of less than that share of the image's pixels are dropped.
_SMALLEST: Final = 0.0006

#: A region that fills that share of its convex hull is assumed to be one object, a car, with holes in its flow.
_SOLID: Final = 0.6

#: The column, of an object's columns sorted by the depth of their feet, whose depth the whole object takes.
_FOOT: Final = 0.6

#: Above an object, up to that many camera heights over the camera and down to that share of its foot's depth, its roof
#: may be; what flow finds farther away there than this many 1/m is rejected, as the roof moves with the object.
_TALL, _WAIST, _VEILED_BELOW = 0.45, 0.5, 0.008

#: While the camera drives objects' depths spread to pixels up to that share of the image's width from them: 4 px of 640
#: are what flow misses of an outline.
_RIM: Final = 0.006

#: A measurement counts half if its standard deviation is that share of itself plus this many 1/m.
_HALF_SHARE, _HALF = 0.15, 0.002

#: Strength of the smoother and how much it minds edges of the image (of 255). From 600 to 3000 in strength the next
#: frame of KITTI odometry, warped by depth and motion, loses 0.2 dB.
_STRENGTH, _EDGES = 600.0, 5.0

#: Nothing but the sky is farther, m.
FAR: Final = 500.0

Array = NDArray[np.float64]


class Standing(NamedTuple):
    """Dynamic objects on the road."""

    instances: NDArray[np.int32]
    """[H, W], 0 = none."""
    feet: Array
    """[n + 1] 1/m by object, of where it touches the road."""
    veiled: NDArray[np.bool_]
    """[H, W], True above objects, where their upper parts may be and what was measured may be theirs."""


def standing(inverse: Array, std: Array, moving: NDArray[np.bool_], road: Array, at_rest: bool = False) -> Standing:
    """Objects that are farther than the road behind them by their flow, or leave their epipolar line: they move.

    A connected region of such pixels is one object. It is where its lowest pixels touch the road. While the camera
    drives only parts of it are found, and it fills their convex hull; at rest its outline is known.

    Args:
        inverse: [H, W] 1/m, as measured.
        std: [H, W] 1/m; infinite = unknown.
        moving: [H, W], what is off its line.
        road: [H, W] 1/m of the plane, below 0 above its horizon.
        at_rest: whether the camera is: then ``moving`` is certain, above the horizon as well.
    """
    found = moving.copy() if at_rest else (_behind(inverse, std, road) | moving) & (road > _ROAD_END)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(without_specks(found), connectivity=8)
    feet, instances, veiled = [0.0], np.zeros(labels.shape, np.int32), np.zeros(labels.shape, bool)
    for label in range(1, count):
        x, y, width, height, area = stats[label]
        if area < _SMALLEST * labels.size:
            continue
        box = np.s_[y : y + height, x : x + width]
        inside = labels[box] == label if at_rest else _hull(labels[box] == label)
        lowest = height - 1 - inside[::-1].argmax(0)
        foot = float(np.quantile(road[box][lowest, np.arange(width)], _FOOT))
        if foot <= _ROAD_END:
            continue
        feet.append(foot)
        instances[box][inside] = len(feet) - 1
        above = np.s_[: y + height, x : x + width]
        veiled[above] |= (road[above] > -_TALL * feet[-1]) & (road[above] < _WAIST * feet[-1])
    return Standing(instances, np.array(feet), veiled & (instances == 0) & (inverse < _VEILED_BELOW))


def _hull(region: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The convex hull of what is True [h, w], with bare doors and windows, if most of it is True: cars are convex."""
    y, x = np.nonzero(region)
    corners = cv2.convexHull(np.column_stack([x, y]).astype(np.int32))
    hull = cv2.fillConvexPoly(region.astype(np.uint8), corners, 1) > 0
    return hull if region.mean() >= _SOLID * hull.mean() else region


def reach(instances: NDArray[np.int32], veiled: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where objects' depths may spread to: up to edges of the image close to them, and to what they veil.

    Beyond is the road, or static background, which would hide them at their depth as soon as they drive away.

    Args:
        objects: [H, W], 0 = none.
        veiled: [H, W].
    """
    return dilated(instances > 0, _RIM * instances.shape[1]) | veiled


def combine(inverse: Array, std: Array, road: Array) -> tuple[Array, Array]:
    """Inverse depth and its standard deviation [H, W] with the plane where it agrees, or where nothing else is known.

    Args:
        inverse: [H, W] 1/m, as measured.
        std: [H, W] 1/m; infinite = unknown.
        road: [H, W] 1/m of the plane, below 0 above its horizon.
    """
    below = road > 0
    known = np.isfinite(std) & ~(below & _behind(inverse, std, road))
    fits = known & below & (np.abs(inverse - road) < np.maximum(_OFF * std, _OFF * _PLANE * road))
    agrees = fits & (std < _OFF_SHARE * road)  # what would fit anything confirms nothing
    plane_std = np.where(agrees, np.hypot(_PLANE * road, _PLANE_FAR), np.maximum(road, _UNSEEN))
    plane_weight = np.where(below & (fits | ~known), plane_std**-2.0, 0.0)
    weight = np.where(known, std**-2.0, 0.0)
    total = weight + plane_weight
    fused = np.divide(weight * inverse + plane_weight * road, total, out=np.zeros_like(inverse), where=total > 0)
    return fused, np.where(total > 0, np.maximum(total, 1e-12) ** -0.5, np.inf)


def _behind(inverse: Array, std: Array, road: Array) -> NDArray[np.bool_]:
    """Where what was measured lies below the road, and so is wrong, or moves."""
    return np.asarray(np.isfinite(std) & (inverse < road - np.maximum(_OFF * std, _OFF_SHARE * road)))


def confidence_of(inverse: Array, std: Array) -> Array:
    """[H, W] in [0, 1]: 1 / (1 + (std / half)^2) with half = a share of s, plus a constant."""
    half = _HALF_SHARE * np.maximum(inverse, 0) + _HALF
    return np.where(np.isfinite(std), 1 / (1 + (np.where(np.isfinite(std), std, 0) / half) ** 2), 0.0)


def smooth(inverse: Array, confidence: Array, road: Array, image: NDArray[np.float32]) -> Array:
    """r + G(c (s - r)) / G(c), G the edge-aware smoother guided by the image: bare asphalt stays a plane.

    Args:
        inverse: [H, W] 1/m, s.
        confidence: [H, W] in [0, 1], c.
        road: [H, W] 1/m of the plane, r, which is taken as 0 above its horizon.
        image: [3, H, W] RGB in [0, 1].

    Source: Min et al., Fast Global Image Smoothing Based on Weighted Least Squares, 2014.
    """
    guide, ground = checked.pixels(image), np.maximum(road, 0)
    weight = np.maximum(confidence, 1e-4)
    planes = weight * (inverse - ground), weight
    total, share = (completion.smooth(guide, plane.astype(np.float32), _STRENGTH, _EDGES) for plane in planes)
    return np.asarray(ground + total / np.maximum(share, 1e-9), np.float64)

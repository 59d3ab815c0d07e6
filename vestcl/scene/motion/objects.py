"""How dynamic objects move: regions of the foreground, and each one's velocity from flow and depth."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.constants import SKY_DEPTH
from vestcl.scene import checked
from vestcl.scene.depth.completion import smooth
from vestcl.scene.depth.road_plane import linear, rays_of
from vestcl.scene.flow.correspondence import Correspondence, sample
from vestcl.scene.flow.parallax import moved_pixels

#: Neighbours whose depths differ by a larger factor belong to different objects.
_JUMP: Final = 0.08

#: Regions of fewer pixels, as a share of the image, are too small to measure and follow only the camera.
_SMALLEST: Final = 0.0003

#: Forward-backward error beyond which flow is rejected, px.
_FLOW_ERROR: Final = 1.0

#: Error of flow, px; residuals beyond this many times of it count linearly (Huber).
_FLOW_STD, _HUBER = 0.5, 2.0

#: This many neighbouring pixels have the same error, and count as one.
_CORRELATED: Final = 50.0

#: What is expected of a velocity before anything is measured, metres per frame: 20 m/s at 10 Hz across and ahead, and
#: nothing jumps.
_SPEED_STD: Final = (2.0, 0.1, 2.0)

#: An object counts as moving if that explains its flow better by this: mean robust cost, in variances of flow.
_GAIN: Final = 1.5

#: Pixels of an object that take part, evenly chosen: neighbours are redundant.
_PIXELS: Final = 3000

#: Residual flow beyond this many pixels is a wrong match, not motion, and below this many it is noise.
_LARGEST, _NOISE = 40.0, 0.2

#: Up to that share of trusted flow around a pixel nothing is corrected, from that one on everything: bare asphalt has
#: little, and would move up and down.
_WEAK, _STRONG = 0.15, 0.35

#: Gauss-Newton rounds.
_ROUNDS: Final = 6


def segment(mask: NDArray[np.bool_], depth: NDArray[np.float32]) -> NDArray[np.int32]:
    """The foreground cut into objects: connected, and with no jump of depth inside.

    Args:
        mask: [1, H, W], True = background.
        depth: [1, H, W] m, above 0.

    Returns:
        [H, W]: 1 ... n by object, 0 = background and objects too small to measure.
    """
    foreground, log_depth = ~mask[0], np.log(depth[0])
    jump = np.zeros_like(foreground)
    jump[:, 1:] |= np.abs(np.diff(log_depth, axis=1)) > _JUMP
    jump[1:] |= np.abs(np.diff(log_depth, axis=0)) > _JUMP
    inner = (foreground & ~jump).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(inner, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= _SMALLEST * foreground.size
    large[0] = False
    renumbered = np.where(large, np.cumsum(large), 0).astype(np.int32)
    return _grown(renumbered[labels], foreground)


def _grown(instances: NDArray[np.int32], foreground: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Foreground that no object owns goes to the nearest one, if it touches it: others are too small to measure."""
    if not instances.any():
        return instances
    _, nearest = cv2.distanceTransformWithLabels(
        (instances == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    _, parts = cv2.connectedComponents(foreground.astype(np.uint8), connectivity=8)
    owner, part = np.zeros((2, nearest.max() + 1), np.int32)
    owner[nearest[instances > 0]], part[nearest[instances > 0]] = instances[instances > 0], parts[instances > 0]
    return np.where(foreground & (part[nearest] == parts), owner[nearest], 0)


def velocities(
    instances: NDArray[np.int32],
    depth: NDArray[np.float32],
    depth_prev: NDArray[np.float32],
    inverse_std: float,
    correspondence: Correspondence,
    prev_from_cur: NDArray[np.float64],
    K: NDArray[np.float64],
) -> NDArray[np.float64]:
    """v_n [n + 1, 3] m per frame, in the camera's axes at t: object n was at x - v_n, had the camera not moved.

    min over v of the Huber costs of project(K (R (x - v) + t)) - p - flow(p), and of the inverse depth there against
    what the frame before measured, plus |v|^2 / SPEED_STD^2. Row 0, and objects that need no motion of their own to be
    explained, are 0.

    Args:
        objects: [H, W], from `segment`.
        depth: [1, H, W] m at t; 0 = invalid.
        depth_prev: [1, H, W] m at t - 1; 0 = invalid.
        inverse_std: of 1 / depth, 1/m.
        correspondence: from t to t - 1.
        prev_from_cur: [4, 4] m, the camera's motion.
        K: [3, 3] px.

    Source: SPEC section 8.
    """
    result = np.zeros((int(instances.max()) + 1, 3))
    moved = moved_pixels(correspondence.flow_uv)
    before = np.divide(1, depth_prev, out=np.zeros_like(depth_prev), where=depth_prev > 0)
    inverse_prev = sample(before, moved[0] - 0.5, moved[1] - 0.5)[0]
    believed = (instances > 0) & (depth[0] > 0) & (correspondence.error[0] < _FLOW_ERROR)
    for instance, here in enumerate(pixels_by_instance(instances, believed, len(result))):
        if instance == 0 or len(here) < _SMALLEST / 2 * instances.size:
            continue
        y, x, points = some_points(here, _PIXELS, depth, K)
        measured = np.column_stack([moved[:, y, x].T, inverse_prev[y, x]])
        result[instance] = _velocity(points, measured, inverse_std, prev_from_cur, K)
    return result


def pixels_by_instance(instances: NDArray[np.int32], where: NDArray[np.bool_], count: int) -> list[NDArray[np.intp]]:
    """Flat indices, rising, of the pixels of objects 0 to ``count`` - 1 that are True in ``where`` [H, W]."""
    flat = np.flatnonzero(where)
    of = instances.ravel()[flat]
    order = np.argsort(of, kind="stable")
    return np.split(flat[order], np.cumsum(np.bincount(of, minlength=count))[:-1])


def some_points(
    here: NDArray[np.intp], most: int, depth: NDArray[np.float32], K: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Rows and columns of at most this many pixels of ``here`` [N], flat, evenly chosen; their points, [N, 3] m."""
    y, x = np.divmod(here[:: -(-len(here) // most)], depth.shape[2])
    rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], axis=1) @ np.linalg.inv(K).T
    return y, x, rays * depth[0, y, x, None]


def follow_flow(
    velocity: NDArray[np.float32],
    image: NDArray[np.float32],
    depth: NDArray[np.float32],
    correspondence: Correspondence,
    prev_from_cur: NDArray[np.float64],
    K: NDArray[np.float64],
) -> NDArray[np.float32]:
    """``velocity`` corrected, at constant depth, by what flow shows beyond it: v - z' K^-1 r, as far as r is not noise.

    r = p + flow(p) - project(K (R (x - v) + t)), smoothed up to the image's edges and shrunk by the error of flow:
    r max(0, 1 - NOISE^2 / |r|^2). Shadows that travel with a car, bodies that bend and errors of depth continue as
    before, too.

    Args:
        velocity: [3, H, W] m per frame.
        image: [3, H, W] RGB in [0, 1].
        depth: [1, H, W] m, above 0; the sky keeps its velocity.
        correspondence: from t to t - 1.
        prev_from_cur: [4, 4] m.
        K: [3, 3] px.

    Returns:
        [3, H, W] m per frame.
    """
    height, width = depth.shape[1:]
    points = rays_of(K, height, width) * depth - velocity
    there = linear(prev_from_cur[:3, :3], points) + prev_from_cur[:3, 3, None, None]
    q = linear(K, there)
    residual = moved_pixels(correspondence.flow_uv) - q[:2] / np.maximum(q[2], 0.1)
    believed = (depth[0] < SKY_DEPTH) & (q[2] > 0.1) & (np.hypot(*residual) < _LARGEST)
    guide, share = checked.pixels(image), (believed / (1 + correspondence.error[0] ** 4)).astype(np.float32)
    weight = np.maximum(smooth(guide, share), np.float32(1e-6))
    planes = (np.where(believed, share * plane, 0).astype(np.float32) for plane in residual)
    spread = np.stack([smooth(guide, plane) / weight for plane in planes])
    shrunk = spread * np.maximum(0, 1 - _NOISE**2 / np.maximum((spread**2).sum(0), 1e-9))
    focal = np.array([K[0, 0], K[1, 1]])[:, None, None]
    trust = ((weight - _WEAK) / (_STRONG - _WEAK)).clip(0, 1) * (depth[0] < SKY_DEPTH)
    corrected = velocity.copy()
    corrected[:2] -= (trust * shrunk * there[2] / focal).astype(np.float32)
    return corrected


def _velocity(
    points: NDArray[np.float64], measured: NDArray[np.float64], inverse_std: float, prev_from_cur: NDArray[np.float64],
    K: NDArray[np.float64],
) -> NDArray[np.float64]:  # fmt: skip
    """One object's v [3], or 0 if that explains as much. ``measured`` [N, 3]: px, px, 1/m."""
    known = np.column_stack([np.ones((len(points), 2), bool), measured[:, 2] > 0])
    spread = np.array([_FLOW_STD, _FLOW_STD, 2 * inverse_std])
    prior = np.diag(np.square(np.reciprocal(_SPEED_STD)))
    v, cost = np.zeros(3), []
    for _ in range(_ROUNDS):
        predicted, jacobian = _predict(points, v, prev_from_cur, K)
        residual = np.where(known, (measured - predicted) / spread, 0)
        weight = known * np.minimum(1, _HUBER / np.maximum(np.abs(residual), 1e-9)) / _CORRELATED
        scaled = jacobian / spread[:, None]
        normal = np.einsum("nij,ni,nik->jk", scaled, weight, scaled) + prior
        right = np.einsum("nij,ni,ni->j", scaled, weight, residual) - prior @ v
        v = v + np.linalg.solve(normal, right)
        cost.append(_cost(residual))
    predicted, _ = _predict(points, v, prev_from_cur, K)
    gain = cost[0] - _cost(np.where(known, (measured - predicted) / spread, 0))
    return v if gain > _GAIN else np.zeros(3)


def _cost(residual: NDArray[np.float64]) -> float:
    """Mean over points of the sum of Huber costs."""
    size = np.abs(residual)
    return float(np.where(size < _HUBER, size**2 / 2, _HUBER * (size - _HUBER / 2)).sum(1).mean())


def _predict(
    points: NDArray[np.float64], v: NDArray[np.float64], prev_from_cur: NDArray[np.float64], K: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(u, v, 1/z) [N, 3] in the frame before, and its derivative by v [N, 3, 3]."""
    turn, shift = prev_from_cur[:3, :3], prev_from_cur[:3, 3]
    x, y, z = ((points - v) @ turn.T + shift).T
    z = np.maximum(z, 0.1)
    u, w = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    zero = np.zeros_like(z)
    rows = [[K[0, 0] / z, zero, -K[0, 0] * x / z**2], [zero, K[1, 1] / z, -K[1, 1] * y / z**2], [zero, zero, -1 / z**2]]
    by_position = np.stack([np.stack(row, axis=1) for row in rows], axis=1)
    return np.stack([u, w, 1 / z], axis=1), -by_position @ turn

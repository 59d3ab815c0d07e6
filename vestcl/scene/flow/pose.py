"""How a camera turned and which way it went between two images, from dense flow only: the essential matrix."""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.scene.flow.correspondence import Correspondence
from vestcl.scene.flow.parallax import moved_pixels, pixel_centres
from vestcl.scene.motion.ego_motion import rigid

#: Every which pixel, both ways, takes part: neighbours of a dense flow are redundant.
_STRIDE: Final = 6

#: Forward-backward error beyond which flow is rejected, px.
_FLOW_ERROR: Final = 0.5

#: Distance to the epipolar line of RANSAC's inliers, and where the refinement's Cauchy loss bends, px.
_OFF_LINE, _BEND = 0.7, 0.3

#: A rotation by itself explains flow that it meets within this many px. If it explains that share of the image's lower
#: half, where a road would stream past, the camera has not moved.
_TURNED, _STILL_SHARE = 0.6, 0.6

#: Fewer points than that are not used.
_FEWEST: Final = 50

#: Gauss-Newton rounds; a pose from RANSAC is there after five.
_ROUNDS: Final = 8

#: Step of the numeric derivatives, rad: well above float64's rounding, well below a pixel.
_STEP: Final = 1e-6

Array = NDArray[np.float64]


class Pose(NamedTuple):
    """Motion of a camera up to its length."""

    dst_from_src: Array
    """[4, 4]; the translation is of length 1, or 0 if the camera only turned."""
    inliers: float
    """Share of the trusted flow that agrees."""


def relative_pose(correspondence: Correspondence, K: Array) -> Pose:
    """argmin over R, |t| = 1 of sum rho(x_dst^T [t]x R x_src / gradient), the Sampson distance with Cauchy's rho.

    It has several minima, as a turn and a step aside look similar. So it is searched from what RANSAC over five points
    finds and from a motion along the camera's axis, and the lowest is taken. Where a rotation by itself explains the
    lower half of the image, t = 0.

    Args:
        correspondence: from src to dst.
        K: [3, 3] px, of both, pixel centres at +0.5.

    Returns:
        The motion up to scale; the identity where there is too little flow to believe.

    Source: Nister, An Efficient Solution to the Five-Point Relative Pose Problem, 2004, through OpenCV.
    """
    src_uv, dst_uv = _pairs(correspondence)
    if len(src_uv) < _FEWEST:
        return Pose(np.eye(4), 0.0)
    src, dst = _rays(src_uv, K), _rays(dst_uv, K)
    focal = float(K[0, 0])
    turn = _refine_turn(src, dst, focal)
    explained = np.hypot(*_turn_residual(turn, src, dst).T) * focal < _TURNED
    lower = src_uv[:, 1] > correspondence.flow_uv.shape[1] / 2
    judged = explained[lower] if lower.sum() >= _FEWEST else explained
    if judged.mean() > _STILL_SHARE:
        return Pose(rigid(turn, np.zeros(3)), float(explained.mean()))
    start = _five_points(src_uv, dst_uv, K)
    if start is None:
        return Pose(np.eye(4), 0.0)
    starts = start, rigid(turn, np.array([0.0, 0.0, 1.0]))
    motion = min((_refine(each, src, dst, focal) for each in starts), key=lambda each: _cost(each, src, dst, focal))
    motion = _in_front(motion, src, dst)
    off = np.abs(_sampson(motion, src, dst)) * focal
    return Pose(motion, float((off < _OFF_LINE).mean()))


def _pairs(correspondence: Correspondence) -> tuple[Array, Array]:
    """[N, 2] px in src and dst."""
    moved = moved_pixels(correspondence.flow_uv)
    start = pixel_centres(*correspondence.flow_uv.shape[1:])
    grid = np.s_[:, _STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE]
    believed = correspondence.error[grid][0] < _FLOW_ERROR
    return start[grid][:, believed].T.copy(), moved[grid][:, believed].T.copy()


def _rays(uv: Array, K: Array) -> Array:
    """K^-1 (u, v, 1) [N, 3]."""
    return np.column_stack([uv, np.ones(len(uv))]) @ np.linalg.inv(K).T


def _turn_residual(turn: Array, src: Array, dst: Array) -> Array:
    """[N, 2] in units of the focal length."""
    turned = src @ cv2.Rodrigues(turn)[0].T
    return np.asarray(turned[:, :2] / turned[:, 2:] - dst[:, :2])


def _refine_turn(src: Array, dst: Array, focal: float) -> Array:
    """The rotation vector [3] that explains most flow by itself."""
    turn = np.zeros(3)
    for _ in range(_ROUNDS):
        residual = _turn_residual(turn, src, dst)
        columns = [(_turn_residual(turn + step, src, dst) - residual) / _STEP for step in np.eye(3) * _STEP]
        weight = np.repeat(_cauchy(np.hypot(*residual.T) * focal, _TURNED), 2)
        turn = turn + _solve(np.stack([column.ravel() for column in columns], 1), residual.ravel(), weight)
    return turn


def _five_points(src_uv: Array, dst_uv: Array, K: Array) -> Array | None:
    """[4, 4] by RANSAC, or nothing."""
    cv2.setRNGSeed(0)  # RANSAC draws from OpenCV's own generator: the same frames give the same motion
    essential, inliers = cv2.findEssentialMat(
        src_uv, dst_uv, K, method=cv2.USAC_MAGSAC, prob=0.9999, threshold=_OFF_LINE
    )
    if essential is None or essential.shape != (3, 3) or inliers is None:
        return None
    agree = inliers[:, 0] > 0
    if agree.sum() < _FEWEST:
        return None
    _, turn, shift, _ = cv2.recoverPose(essential, src_uv[agree], dst_uv[agree], K)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, shift[:, 0]
    return motion


def _refine(motion: Array, src: Array, dst: Array, focal: float) -> Array:
    """Gauss-Newton over a turn of the camera and a turn of its direction."""
    for _ in range(_ROUNDS):
        residual = _sampson(motion, src, dst)
        columns = [(_sampson(_nudged(motion, step), src, dst) - residual) / _STEP for step in np.eye(5) * _STEP]
        weight = _cauchy(residual * focal, _BEND)
        motion = _nudged(motion, _solve(np.stack(columns, 1), residual, weight))
    return motion


def _cost(motion: Array, src: Array, dst: Array, focal: float) -> float:
    return float(np.log1p((_sampson(motion, src, dst) * focal / _BEND) ** 2).mean())


def _in_front(motion: Array, src: Array, dst: Array) -> Array:
    """``motion`` with the sign of its translation that has most points in front of the camera."""
    turned, shift = src @ motion[:3, :3].T, motion[:3, 3]
    inverse = -(np.cross(dst, turned) * np.cross(dst, shift)).sum(1)  # times |dst x t|^2, of dst ~ R src + t / z
    if np.median(inverse) >= 0:
        return motion
    return np.block([[motion[:3, :3], -shift[:, None]], [motion[3:]]])


def _nudged(motion: Array, step: Array) -> Array:
    """The camera turned by step[:3] rad, its direction by step[3:] in the plane across it."""
    direction = motion[:3, 3]
    _, _, across = np.linalg.svd(direction[None])
    moved = direction + step[3:] @ across[1:]
    nudged = np.eye(4)
    nudged[:3, :3] = cv2.Rodrigues(step[:3])[0] @ motion[:3, :3]
    nudged[:3, 3] = moved / np.linalg.norm(moved)
    return nudged


def _sampson(motion: Array, src: Array, dst: Array) -> Array:
    """Signed distance [N] of the pairs to their epipolar lines, in units of the focal length."""
    x, y, z = motion[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ motion[:3, :3]
    lines_dst, lines_src = src @ essential.T, dst @ essential
    (a, b, c), (d, e, _) = lines_dst.T, lines_src.T
    gradient = np.sqrt((a**2 + b**2) + (d**2 + e**2))
    distance = dst[:, 0] * a + dst[:, 1] * b + dst[:, 2] * c
    return np.asarray(distance / np.maximum(gradient, 1e-12))


def _cauchy(residual: Array, bend: float) -> Array:
    return np.asarray(1 / (1 + (residual / bend) ** 2))


def _solve(jacobian: Array, residual: Array, weight: Array) -> Array:
    """The weighted least-squares step."""
    normal = (jacobian * weight[:, None]).T @ jacobian
    damping = 1e-9 * np.trace(normal) * np.eye(len(normal))
    return np.linalg.solve(normal + damping, -(jacobian * weight[:, None]).T @ residual)

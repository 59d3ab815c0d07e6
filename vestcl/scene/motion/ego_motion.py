"""The camera's motion without a network: correspondences and depth, PnP with RANSAC, constant velocity."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.data.calibration import power
from vestcl.scene import checked
from vestcl.scene.flow.correspondence import Correspondence, check_size

#: Every which pixel, both ways, takes part: neighbours of a dense flow are redundant.
_STRIDE: Final = 4

#: Forward-backward error beyond which flow is rejected, px.
_FLOW_ERROR: Final = 0.5

#: Depths beyond are not trusted for a position, metres.
_FAR: Final = 80.0

#: Reprojection error of an inlier, px; RANSAC's rounds and confidence.
_REPROJECTION, _ROUNDS, _CONFIDENCE = 1.0, 300, 0.9999

#: Fewer points than that, or a smaller share of inliers, are no motion.
_FEWEST: Final = 24
_INLIERS: Final = 0.15


class CameraMotion(NamedTuple):
    """A camera's motion between two frames."""

    dst_from_src: NDArray[np.float64]
    """[4, 4] m."""
    inliers: float
    """Share of the correspondences that agree with it."""


def ego_motion(
    depth: ArrayLike, mask: ArrayLike, correspondence: Correspondence, K: ArrayLike, *, far: float = _FAR
) -> CameraMotion:
    """dst_from_src that brings what the pixels of src show to where flow finds it in dst.

    min over (R, t) of sum |project(K (R x_i + t)) - (p_i + flow(p_i))|^2 over the inliers that RANSAC found, with
    x_i from the depth. Pixels take part that are static background, have a depth up to ``far``, and whose flow
    there and back returns.

    Args:
        depth: [1, H, W] m of src; 0 = invalid.
        mask: [1, H, W] bool, True where src may show static background.
        correspondence: from src to dst.
        K: [3, 3] px, of both.
        far: m.

    Returns:
        The motion; the identity with no inliers where nothing consistent is found.

    Raises:
        ValueError: shapes or numbers that aren't finite.

    Source: SPEC section 8; Lepetit et al., EPnP, 2009, through OpenCV's solvePnPRansac, refined by Levenberg-Marquardt.
    """
    depth = checked.depth("depth", depth)
    mask = checked.mask("mask", mask, depth)
    K = checked.matrix("K", K, 3)
    check_size("correspondence", correspondence, depth)
    points_xyz, points_uv = _pairs(depth, mask, correspondence, K, far)
    if len(points_xyz) < _FEWEST:
        return CameraMotion(np.eye(4), 0.0)
    cv2.setRNGSeed(0)  # RANSAC draws from OpenCV's own generator: the same frames give the same motion
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points_xyz,
        points_uv,
        K,
        None,
        iterationsCount=_ROUNDS,
        reprojectionError=_REPROJECTION,
        confidence=_CONFIDENCE,
    )
    if not found or inliers is None or len(inliers) < max(_FEWEST, _INLIERS * len(points_xyz)):
        return CameraMotion(np.eye(4), 0.0)
    agree = inliers[:, 0]
    refined = cv2.solvePnPRefineLM(points_xyz[agree], points_uv[agree], K, None, turn, shift)
    turn, shift = (np.asarray(vector, np.float64)[:, 0] for vector in refined)
    return CameraMotion(rigid(turn, shift), len(agree) / len(points_xyz))


def _pairs(
    depth: NDArray[np.float32], mask: NDArray[np.bool_], correspondence: Correspondence, K: NDArray[np.float64],
    far: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Points of src [N, 3] m and where dst shows them [N, 2] px."""
    height, width = depth.shape[1:]
    y, x = np.mgrid[_STRIDE // 2 : height : _STRIDE, _STRIDE // 2 : width : _STRIDE]
    z = depth[0, y, x].astype(np.float64)
    use = mask[0, y, x] & (z > 0) & (z < far) & (correspondence.error[0, y, x] < _FLOW_ERROR)
    pixels = np.stack([x + 0.5, y + 0.5], axis=-1)
    rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1) @ np.linalg.inv(K).T
    moved = pixels + correspondence.flow_uv[:, y, x].transpose(1, 2, 0)
    return (rays * z[..., None])[use], moved[use]


def constant_velocity(
    motions: Sequence[NDArray[np.float64]], elapsed: Sequence[float] | None = None
) -> NDArray[np.float64]:
    """``next_from_cur`` by the last motions: their mean translation, and their mean turn about the vertical axis.

    Each is brought to one interval first, as a screw motion. A car pitches and rolls about a mean that it returns to,
    so the best forecast of either is to stay.

    Args:
        motions: [4, 4] each, ``cur_from_prev`` of consecutive frames, oldest first; at least one.
        elapsed: intervals of the clip that each took, above 0; None is one each.

    Returns:
        [4, 4] m, over one interval.

    Raises:
        ValueError: no motion, or another number of them than of ``elapsed``.
    """
    if not motions:
        raise ValueError("`motions` must have at least one motion")
    if elapsed is not None:
        if len(elapsed) != len(motions) or min(elapsed) <= 0:
            raise ValueError(f"`elapsed` must be {len(motions)} numbers above 0, as `motions`, got {list(elapsed)}")
        motions = [power(motion, 1 / taken) for motion, taken in zip(motions, elapsed, strict=True)]
    yaw = np.mean([cv2.Rodrigues(motion[:3, :3])[0][1, 0] for motion in motions])
    return rigid(np.array([0.0, yaw, 0.0]), np.mean([motion[:3, 3] for motion in motions], axis=0))


def rigid(turn: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] of a rotation vector [3] rad and a translation [3] m."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = cv2.Rodrigues(turn)[0], shift
    return matrix

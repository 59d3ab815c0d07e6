"""Background masks with no weights at all: whatever moves in a way that the camera's motion can't explain."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.scene import checked
from vestcl.scene.flow.correspondence import Correspondence, check_size
from vestcl.scene.flow.parallax import epipolar, moved_pixels, pixel_centres

#: Forward-backward error beyond which flow is rejected, px.
_FLOW_ERROR: Final = 1.0

#: Flow that is off by more pixels than that, plus a share of the rigid flow, shows object motion. Depth errors of
#: a static scene stay below on KITTI.
_MOVES, _MOVES_SHARE = 2.0, 0.15

#: Holes and specks up to that share of the image's width are closed and dropped, and so are regions of less than
#: that share of its pixels: a pedestrian at 25 m has 0.1 %.
_BRUSH, _SMALLEST = 0.006, 0.0008

#: A region is road, and no object on it, if more than that share of it lies flat: its normal is that close to vertical.
#: What seems to move there is a line whose flow slides along it, a reflection or a shadow.
_ROAD, _FLAT = 0.7, 0.8


def motion_mask(
    depth: ArrayLike, correspondence: Correspondence, dst_from_src: ArrayLike, K: ArrayLike
) -> NDArray[np.bool_]:
    """M: False where |p + flow(p) - project(K (R x + t))| exceeds what errors of depth explain, over whole regions.

    Args:
        depth: [1, H, W] m; 0 = invalid, without a result: such pixels count as background.
        correspondence: from that frame to another one.
        dst_from_src: [4, 4] m, the camera's motion between them.
        K: [3, 3] px.

    Returns:
        [1, H, W], True = static background.

    Raises:
        ValueError: shapes or numbers that aren't finite.

    Source: SPEC section 8.
    """
    depth = checked.depth("depth", depth)
    dst_from_src = checked.matrix("dst_from_src", dst_from_src, 4)
    check_size("correspondence", correspondence, depth)
    K = checked.matrix("K", K, 3)
    rigid = rigid_pixels(depth, K, dst_from_src)
    still = np.hypot(*(rigid - pixel_centres(*depth.shape[1:])))
    off = np.hypot(*(moved_pixels(correspondence.flow_uv) - rigid))
    believed = (depth[0] > 0) & (correspondence.error[0] < _FLOW_ERROR)
    moves = believed & (off > _MOVES + _MOVES_SHARE * still)
    return ~_regions(moves, lies_flat(depth[0], K))[None]


def rigid_pixels(
    depth: NDArray[np.float32], K: NDArray[np.float64], dst_from_src: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where a static scene of ``depth`` [1, H, W] is seen from dst: [2, H, W] px; invalid depth counts as infinite."""
    start, slope = epipolar(K, dst_from_src, *depth.shape[1:])
    inverse = np.divide(1, depth[0], out=np.zeros_like(depth[0]), where=depth[0] > 0)
    q = start + inverse * slope[:, None, None]
    return q[:2] / np.maximum(q[2], 1e-6)


def lies_flat(depth: NDArray[np.float32], K: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Where the surface [H, W] is horizontal: of a plane n . x = 1, 1/z = n . K^-1 p, the gradient of 1/z gives n."""
    inverse = cv2.blur(np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0), (5, 5))
    right, down = cv2.Sobel(inverse, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(inverse, cv2.CV_32F, 0, 1, scale=1 / 8)
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    normal_x, normal_y = K[0, 0] * right, K[1, 1] * down
    normal_z = inverse - (x - K[0, 2]) * right - (y - K[1, 2]) * down
    return np.abs(normal_y) > _FLAT * np.sqrt(normal_x**2 + normal_y**2 + normal_z**2)


def without_specks(found: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """``found`` [H, W] as 0 and 1, without specks, its holes closed."""
    side = max(3, 2 * round(_BRUSH * found.shape[1] / 2) + 1)
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    opened = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, brush)
    return np.asarray(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, brush, iterations=2), np.uint8)


def _regions(moves: NDArray[np.bool_], flat: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The regions of ``moves`` [H, W] that are large, and no road."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(without_specks(moves), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    instances = (area >= _SMALLEST * moves.size) & (np.bincount(labels[flat], minlength=count) <= _ROAD * area)
    instances[0] = False
    return instances[labels]

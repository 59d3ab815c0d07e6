"""Depth for every pixel: what was measured, spread up to the edges of the image."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.scene import checked

#: Strength of the smoother and how much it minds edges of the image (of 255). From 20 to 1000 in strength the forecast
#: on KITTI odometry loses 1.5 dB at t+1; 2 to 8 in edges makes no difference.
_STRENGTH, _EDGES = 20.0, 4.0

#: Its damping from round to round, and its rounds: OpenCV's own.
_DAMPING, _ROUNDS = 0.25, 3

#: Nothing is set farther than that without better information, metres.
_FAR: Final = 500.0


def complete_depth(depth: ArrayLike, image: ArrayLike) -> NDArray[np.float32]:
    """Inverse depth by normalised edge-aware smoothing, G(s m) / G(m), where it is missing; m = 1 where it is known.

    Args:
        depth: [1, H, W] m; 0 = invalid, at least one valid.
        image: [3, H, W] RGB in [0, 1].

    Returns:
        [1, H, W] m, above 0; what was valid is unchanged.

    Raises:
        ValueError: shapes, numbers that aren't finite, or no valid depth.

    Source: Min et al., Fast Global Image Smoothing Based on Weighted Least Squares, 2014.
    """
    depth = checked.depth("depth", depth)
    image = checked.planes("image", image, 3, depth)
    known = depth > 0
    if known.all():
        return depth
    guide = checked.pixels(image)
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=known)[0]
    share = smooth(guide, known[0].astype(np.float32))
    spread = smooth(guide, inverse) / np.maximum(share, np.float32(1e-12))
    nothing = share <= 1e-9  # an edge all round it: the median of all
    spread = np.where(nothing, np.median(inverse[known[0]]), spread)
    return np.where(known, depth, 1 / np.maximum(spread, np.float32(1 / _FAR)))


def smooth(
    guide: NDArray[np.uint8], plane: NDArray[np.float32], strength: float = _STRENGTH, edges: float = _EDGES
) -> NDArray[np.float32]:
    """G: ``plane`` [H, W] smoothed up to the edges of ``guide`` [H, W, 3]."""
    filtered = cv2.ximgproc.fastGlobalSmootherFilter(
        guide, plane, strength, edges, lambda_attenuation=_DAMPING, num_iter=_ROUNDS
    )
    return np.asarray(filtered, np.float32)

"""Errors of a depth map against a scan, as depth estimation reports them."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vestcl.scene import checked

#: Metres between which depths are compared, as KITTI's benchmark has it.
NEAREST, FARTHEST = 1e-3, 80.0

#: Rows and columns that Garg et al. (Unsupervised CNN for Single View Depth Estimation, 2016) compare, as shares.
_GARG: Final = (0.40810811, 0.99189189, 0.03594771, 0.96405229)


class DepthScores(NamedTuple):
    """Over the pixels that have a true depth."""

    abs_rel: float
    """mean |z - z*| / z*."""
    median_ratio: float
    """median z / z*: the error of the scale."""
    scaled_abs_rel: float
    """AbsRel of z / median ratio: the error of the shape."""
    delta_1: float
    """Share of the pixels with max(z / z*, z* / z) < 1.25."""
    pixels: int


def depth_scores(depth: ArrayLike, truth: ArrayLike, *, farthest: float = FARTHEST, crop: bool = False) -> DepthScores:
    """Errors of one depth map.

    Args:
        depth: [1, H, W] m; 0 = unknown, which is left out.
        truth: [1, H, W] m; 0 = unknown.
        farthest: m; true depths beyond are left out, and depths are clipped to it.
        crop: whether only Garg's crop of the image is compared.

    Returns:
        The errors.

    Raises:
        ValueError: shapes, numbers that are not finite, or no pixel that both know.

    Source: Eigen et al., Depth Map Prediction from a Single Image using a Multi-Scale Deep Network, 2014.
    """
    true = checked.depth("truth", truth)
    found = checked.depth("depth", depth, true)
    use = (true > NEAREST) & (true < farthest) & (found > 0)
    if crop:
        height, width = true.shape[1:]
        top, bottom = (int(share * height) for share in _GARG[:2])
        left, right = (int(share * width) for share in _GARG[2:])
        inside = np.zeros_like(use)
        inside[:, top:bottom, left:right] = True
        use &= inside
    if not use.any():
        raise ValueError(f"`depth` and `truth` must have a pixel up to {farthest:g} m in common, got none")
    ratio = found[use].clip(max=farthest).astype(np.float64) / true[use]
    median = float(np.median(ratio))
    near = np.maximum(ratio, 1 / ratio) < 1.25
    errors = (float(np.abs(ratio / scale - 1).mean()) for scale in (1.0, median))
    return DepthScores(next(errors), median, next(errors), float(near.mean()), int(use.sum()))

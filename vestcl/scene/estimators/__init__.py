"""Depth and classes from one picture, by public networks through `transformers` (extra ``estimators``)."""

from vestcl.scene.estimators.depth import DepthEstimator
from vestcl.scene.estimators.segmentation import SegmentationEstimator
from vestcl.scene.estimators.sources import with_estimates

__all__ = ["DepthEstimator", "SegmentationEstimator", "with_estimates"]

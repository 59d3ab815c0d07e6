"""Depth and classes from one image by public networks: ONNX files through OpenCV, checkpoints through `transformers`.

`transformers` is the extra ``estimators``; OpenCV is there in any case.
"""

from vestcl.scene.estimators.depth import DepthEstimator
from vestcl.scene.estimators.onnx import OnnxDepth, OnnxSegmentation
from vestcl.scene.estimators.segmentation import SegmentationEstimator
from vestcl.scene.estimators.sources import with_estimates

__all__ = ["DepthEstimator", "OnnxDepth", "OnnxSegmentation", "SegmentationEstimator", "with_estimates"]

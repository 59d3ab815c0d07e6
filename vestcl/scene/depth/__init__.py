"""Depth from several sources: a network's combined with what parallax measures, and its errors against scans."""

from vestcl.scene.depth.combine import CombinedDepth, combine_depth
from vestcl.scene.depth.scores import DepthScores, depth_scores

__all__ = ["CombinedDepth", "DepthScores", "combine_depth", "depth_scores"]

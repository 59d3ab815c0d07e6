"""Depth from several sources: a network's combined with what parallax measures, and its errors against scans."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vestcl.scene.depth.combine import CombinedDepth, combine_depth
    from vestcl.scene.depth.scores import DepthScores, depth_scores

__all__ = ["CombinedDepth", "DepthScores", "combine_depth", "depth_scores"]

#: Loaded on first use: parts of `vestcl.scene.flow`, which these import, need modules of this package.
_FILES = {
    **dict.fromkeys(("CombinedDepth", "combine_depth"), "combine"),
    **dict.fromkeys(("DepthScores", "depth_scores"), "scores"),
}


def __getattr__(name: str) -> Any:
    if name not in _FILES:
        raise AttributeError(f"module 'vestcl.scene.depth' has no attribute {name!r}")
    return getattr(importlib.import_module(f"vestcl.scene.depth.{_FILES[name]}"), name)

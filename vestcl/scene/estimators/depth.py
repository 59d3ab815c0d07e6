"""Metric depth from one image: ZoeDepth and Depth Anything V2.

ZoeDepth's checkpoint for indoor and outdoor has two heads and lets all images of a batch vote on one of them, so a
dark street may be measured as a room. Here its vote is always for KITTI.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from vestcl.scene.estimators._checkpoint import Checkpoint
from vestcl.scene.estimators._estimator import Estimator, check_finite
from vestcl.scene.estimators._preparation import Preparation

#: ZoeDepth's head for streets.
DOMAIN: Final = "kitti"

#: Metres. What is nearer is set to it: interpolation overshoots at edges, and the splatter shows nothing nearer.
NEAREST: Final = 0.1

#: Metres. Indoor networks end at 10 (NYU) or 20 (Hypersim), those for streets at 80 (KITTI, Virtual KITTI).
_OUTDOOR: Final = 40.0

_NETWORKS: Final = {
    "zoedepth": "ZoeDepthForDepthEstimation",
    "depth_anything": "DepthAnythingForDepthEstimation",
}


class _AlwaysVotes(nn.Module):
    """Stands for ZoeDepth's classifier of domains: one-hot logits whatever it sees."""

    def __init__(self, index: int, count: int) -> None:
        super().__init__()
        self.index, self.count = index, count

    def forward(self, embedding: torch.Tensor) -> torch.Tensor:
        """[B, C] -> [B, count]."""
        logits = embedding.new_zeros(len(embedding), self.count)
        logits[:, self.index] = 1
        return logits


@dataclass(frozen=True, eq=False)
class DepthEstimator(Estimator[np.float32]):
    """Depth of an image, metres; `load` makes one.

    The same image always gives the same bits on the same machine with the same number of threads.
    """

    model: Any
    preparation: Preparation
    domain: int | None
    """Which of several heads of ZoeDepth measures; None where there is but one."""
    flip: bool
    """Whether the mirrored image is estimated, too, and the two are averaged."""
    device: str

    @classmethod
    def load(
        cls,
        name_or_path: str | Path,
        *,
        size: tuple[int, int] | None = None,
        flip: bool | None = None,
        device: str = "cpu",
        local_files_only: bool = False,
    ) -> "DepthEstimator":
        """Open a checkpoint of ZoeDepth or of a metric Depth Anything.

        Args:
            name_or_path: a folder, or a name on huggingface.co: it is **downloaded** when first used (0.1 to 1.4 GB)
                and kept in the hub's own cache. `Intel/zoedepth-nyu-kitti`, `Intel/zoedepth-kitti`,
                `depth-anything/Depth-Anything-V2-Metric-Outdoor-Small-hf` (or Base, Large).
            size: (height, width) px at which the network sees images, rounded to its multiples; None: the checkpoint's
                size: the image's proportions, 384 px (ZoeDepth) or 518 px (Depth Anything) high.
            flip: average with the mirrored image, at twice the time; None is as published: ZoeDepth does.
            device: of torch.
            local_files_only: whether nothing may be downloaded. Without it and without a network, some 20 s pass before
                the hub is given up.

        Raises:
            ImportError: transformers is not installed.
            ValueError: no such checkpoint; another network; one of relative depth, or for rooms; damaged files.

        Source: SPEC section 8; Bhat et al., ZoeDepth, 2023; Yang et al., Depth Anything V2, 2024.
        """
        checkpoint = Checkpoint.open(name_or_path, _NETWORKS, local_files_only=local_files_only)
        zoe = checkpoint.config.model_type == "zoedepth"
        domain = _zoe_domain(checkpoint) if zoe else None
        if not zoe:
            _check_metric(checkpoint)
        preparation = Preparation.read(checkpoint.name, checkpoint.preparation, zoe=zoe, size=size)
        model: Any = checkpoint.load(device)
        if domain is not None:
            count = len(checkpoint.config.bin_configurations)
            model.metric_head.mlp_classifier = _AlwaysVotes(domain, count).to(device)
        return cls(model, preparation, domain, zoe if flip is None else flip, device)

    def _estimate(self, seen: torch.Tensor, height: int, width: int) -> torch.Tensor:
        depth = self._measure(seen)
        if self.flip:
            depth = (depth + self._measure(seen.flip(-1)).flip(-1)) / 2
        rows, columns = self.preparation.padding(height, width)
        padded = (height + 2 * rows, width + 2 * columns)
        depth = functional.interpolate(depth, padded, mode="bicubic", align_corners=False)
        depth = depth[..., rows : rows + height, columns : columns + width].clamp(min=NEAREST)
        check_finite(depth, "depths")
        return depth.contiguous()

    def _measure(self, seen: torch.Tensor) -> torch.Tensor:
        output = self.model(pixel_values=seen)
        if self.domain is not None and int(output.domain_logits.sum(0).argmax()) != self.domain:
            # Those are the votes that the network itself has counted, wherever a version of transformers takes them.
            raise RuntimeError(
                "ZoeDepth's vote for KITTI was not counted: this version of transformers is not supported"
            )
        return output.predicted_depth[:, None]


def _zoe_domain(checkpoint: Checkpoint) -> int | None:
    heads = checkpoint.config.bin_configurations
    if len(heads) == 1:
        _check_range(checkpoint, heads[0]["max_depth"])
        return None
    names = [head["name"] for head in heads]
    if DOMAIN not in names:
        raise ValueError(f"{checkpoint.name}: must have a head named {DOMAIN}, got {', '.join(names)}")
    _check_range(checkpoint, heads[names.index(DOMAIN)]["max_depth"])
    return names.index(DOMAIN)


def _check_metric(checkpoint: Checkpoint) -> None:
    kind = checkpoint.config.depth_estimation_type
    if kind != "metric":
        remedy = "depth-anything/Depth-Anything-V2-Metric-Outdoor-Small-hf is metric"
        raise ValueError(f"{checkpoint.name}: must estimate metric depth, got {kind} depth, without a unit; {remedy}")
    _check_range(checkpoint, checkpoint.config.max_depth)


def _check_range(checkpoint: Checkpoint, farthest: float) -> None:
    if farthest < _OUTDOOR:
        wanted = f"must be made for streets, up to {_OUTDOOR:g} m or farther"
        raise ValueError(f"{checkpoint.name}: {wanted}, got a network for rooms, up to {farthest:g} m")

"""Cityscapes' classes from one image: SegFormer and Mask2Former."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch.nn import functional

from vestcl.scene.estimators._checkpoint import Checkpoint
from vestcl.scene.estimators._estimator import Estimator, check_finite
from vestcl.scene.estimators._preparation import Preparation

#: Cityscapes' classes by train id.
CLASSES: Final = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation", "terrain",
    "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle",
)  # fmt: skip

_NETWORKS: Final = {
    "segformer": "SegformerForSemanticSegmentation",
    "mask2former": "Mask2FormerForUniversalSegmentation",
}


@dataclass(frozen=True, eq=False)
class SegmentationEstimator(Estimator[np.uint8]):
    """Train ids of an image; `load` makes one. `vestcl.io.labels.background` makes the mask M of them."""

    model: Any
    preparation: Preparation
    device: str

    @classmethod
    def load(
        cls,
        name_or_path: str | Path,
        *,
        size: tuple[int, int] | None = None,
        device: str = "cpu",
        local_files_only: bool = False,
    ) -> "SegmentationEstimator":
        """Open a checkpoint of SegFormer or Mask2Former that was trained on Cityscapes.

        Args:
            name_or_path: a folder, or a name on huggingface.co: it is **downloaded** when first used (15 MB to 1 GB)
                and kept in the hub's own cache. `nvidia/segformer-b0-finetuned-cityscapes-1024-1024` (to b5),
                `facebook/mask2former-swin-tiny-cityscapes-semantic` (or small, large).
            size: (height, width) px at which the network sees images; None: the checkpoint's size, which is
                often a square whatever the image's proportions. A size of the image's own proportions keeps cars
                and people as the network has learnt them.
            device: of torch.
            local_files_only: whether nothing may be downloaded. Without it and without a network, some 20 s pass before
                the hub is given up.

        Raises:
            ImportError: transformers is not installed.
            ValueError: no such checkpoint; another network; other classes than Cityscapes' 19; damaged files.

        Source: SPEC section 8; Xie et al., SegFormer, 2021; Cheng et al., Mask2Former, 2022.
        """
        checkpoint = Checkpoint.open(name_or_path, _NETWORKS, local_files_only=local_files_only)
        _check_classes(checkpoint)
        preparation = Preparation.read(checkpoint.name, checkpoint.preparation, zoe=False, size=size)
        return cls(checkpoint.load(device), preparation, device)

    def _estimate(self, seen: torch.Tensor, height: int, width: int) -> torch.Tensor:
        """argmax_c of the class scores, which are brought to the image's size bilinearly."""
        output = self.model(pixel_values=seen)
        scores = output.logits if hasattr(output, "logits") else _of_queries(output, seen.shape[-2], seen.shape[-1])
        check_finite(scores, "scores")
        scores = functional.interpolate(scores, (height, width), mode="bilinear", align_corners=False)
        return scores.argmax(1, keepdim=True).to(torch.uint8)


def _of_queries(output: Any, height: int, width: int) -> torch.Tensor:
    """Mask2Former's sum_q p(class c | q) sigmoid(mask_q), without "no object", at the size that the network saw."""
    masks = functional.interpolate(output.masks_queries_logits, (height, width), mode="bilinear", align_corners=False)
    classes = output.class_queries_logits.softmax(-1)[..., :-1]
    return torch.einsum("bqc,bqhw->bchw", classes, masks.sigmoid())


def _check_classes(checkpoint: Checkpoint) -> None:
    named = {int(index): str(label) for index, label in checkpoint.config.id2label.items()}
    got = [named[index].strip().lower().replace("-", " ").replace("_", " ") for index in sorted(named)]
    if got == list(CLASSES):
        return
    if len(got) != len(CLASSES):
        difference = f"{len(got)} classes ({', '.join(got[:3])} ...)"
    else:
        index = next(i for i, (label, wanted) in enumerate(zip(got, CLASSES, strict=True)) if label != wanted)
        difference = f"{got[index]} as class {index}, which is {CLASSES[index]}"
    raise ValueError(f"{checkpoint.name}: must have Cityscapes' {len(CLASSES)} classes in order, got {difference}")

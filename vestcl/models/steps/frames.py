"""What goes into the forecaster: frames checked, their depths as the networks see them, and the encoder's grid."""

from typing import Final, NamedTuple

import torch
from torch.nn import functional

from vestcl import constants
from vestcl.models.networks.encoder import STRIDE, upsample_features
from vestcl.scene.layers import LayerBatch
from vestcl.shapes import check

#: A mask's pixel below is foreground, whatever a resize made of 0 and 1.
FOREGROUND_BELOW: Final = 0.5


class EncodedFrame(NamedTuple):
    """A frame and what the encoder makes of its two layers."""

    layers: LayerBatch
    """With the depths that the networks are to see."""
    features: torch.Tensor
    """[B, C, H, W]."""
    background_grid: torch.Tensor
    """[B, C, ceil(H / 4), ceil(W / 4)], of the background: the encoder's own grid."""
    same: bool
    """Whether the backgrounds are the frames themselves."""
    camera_grid: torch.Tensor | None = None
    """What ego-motion forecasting sees in the background, `EgoMotion.look`; None where the model has no EMF."""

    @property
    def background_features(self) -> torch.Tensor:
        """[B, C, H, W]; ``features`` itself where no image has foreground."""
        return self.features if self.same else upsample_features(self.background_grid, *self.features.shape[2:])


def check_frames(frame_prev: LayerBatch, frame_cur: LayerBatch, K: torch.Tensor) -> None:
    """Refuse frames that differ in size or kind.

    Raises:
        ValueError: a tensor of another shape than [B, 3 or 1, H, W], a ``K`` that isn't [B, 3, 3], or a depth that is
            not finite and above 0.
    """
    shapes = LayerBatch("B 3 H W", "B 1 H W", "B 1 H W", "B 3 H W", "B 1 H W")  # type: ignore[arg-type]
    tensors = {
        f"{name}.{field}": (getattr(frame, field), str(getattr(shapes, field)))
        for name, frame in (("frame_prev", frame_prev), ("frame_cur", frame_cur))
        for field in LayerBatch._fields
    }
    check(**tensors, K=(K, "B 3 3"))
    for name, (tensor, _) in tensors.items():
        if name.endswith("depth"):
            least, most = tensor.aminmax()  # both are NaN where one is
            if not 0 < least <= most < torch.inf:
                raise ValueError(f"`{name}` must be finite and above 0 m, got {least} to {most}")


def with_depth(layers: LayerBatch, metres: float | None) -> LayerBatch:
    """All depths replaced by ``metres``, the background's behind foreground by BEHIND times it; None leaves them."""
    if metres is None:
        return layers
    flat = torch.full_like(layers.depth, metres)
    behind = torch.where(layers.mask < FOREGROUND_BELOW, constants.BEHIND * flat, flat)
    return layers._replace(depth=flat, background_depth=behind)


def grid_depth(depth: torch.Tensor) -> torch.Tensor:
    """1 / mean(1 / D) over each cell of the encoder's grid: rigid motion moves pixels in proportion to 1 / D.

    Args:
        depth: [B, 1, H, W] m, above 0.

    Returns:
        [B, 1, ceil(H / 4), ceil(W / 4)] m; differentiable.
    """
    return grid_mean(depth.reciprocal()).reciprocal()


def grid_mean(image: torch.Tensor) -> torch.Tensor:
    """Mean over each cell, [B, C, H, W] -> [B, C, ceil(H / 4), ceil(W / 4)]; cells at the border over what is there."""
    return functional.avg_pool2d(image, STRIDE, ceil_mode=True, count_include_pad=False)

"""How much a forecast may cost: what a trained network may compute more coarsely, with the weights that it has.

`Skip` leaves out what changes nothing; this leaves out what changes something. `vestcl bench pareto` measures how much
each field costs and saves, and `vestcl.models.inference.quality` chooses by that.
"""

import math
from dataclasses import dataclass

import torch
from torch.nn import functional


@dataclass(frozen=True)
class Effort:
    """Knobs of a `Forecaster`. The defaults are exact: each computes what the network was trained to."""

    min_transmittance: float = 0.0
    """A pixel takes no more points once less than that of what is behind shines through; see `vestcl.splat`."""
    splat_scale: float = 1.0
    """Clouds are splatted at this fraction of the view's height and width, and what they leave is enlarged."""
    blocks: int | None = None
    """Only the first so many blocks of object motion run, from coarse to fine; None is all of them, 0 none."""
    paint_scale: float = 1.0
    """Refinement's correction of the splatted colour is computed at this fraction of the view's height and width, and
    enlarged. A network that paints anew (`RefineConfig.base` "none") has no such correction and takes 1 alone."""

    def __post_init__(self) -> None:
        if not 0 <= self.min_transmittance < 1:
            raise ValueError(f"`min_transmittance` must be in [0, 1), got {self.min_transmittance}")
        for name in ("splat_scale", "paint_scale"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"`{name}` must be in (0, 1], got {getattr(self, name)}")
        if self.blocks is not None and (not isinstance(self.blocks, int) or self.blocks < 0):
            raise ValueError(f"`blocks` must be a whole number, 0 or more, or None, got {self.blocks}")


def fraction(height: int, width: int, scale: float) -> tuple[int, int]:
    """ceil(scale H), ceil(scale W): the size in pixels of ``scale`` of a picture."""
    return math.ceil(scale * height), math.ceil(scale * width)


def reduced(image: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Means over cells of a grid that covers the picture, cells' edges at whole pixels.

    Args:
        image: [B, C, H, W].
        height: rows of the grid, at most H.
        width: columns, at most W.

    Returns:
        [B, C, height, width]; ``image`` itself where that is its size. Differentiable.
    """
    rows, columns = image.shape[2:]
    if (rows, columns) == (height, width):
        return image
    if rows % height == columns % width == 0:  # the same means, faster
        return functional.avg_pool2d(image, (rows // height, columns // width))
    return functional.adaptive_avg_pool2d(image, (height, width))


def enlarged(image: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Bilinear, [B, C, h, w] -> [B, C, height, width]; ``image`` itself where that is its size. Differentiable."""
    if image.shape[2:] == (height, width):
        return image
    return functional.interpolate(image, (height, width), mode="bilinear", align_corners=False)

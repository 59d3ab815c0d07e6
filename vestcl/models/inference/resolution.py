"""Images at a fraction of a view's size, and back."""

import math

import torch
from torch.nn import functional


def fraction(height: int, width: int, scale: float) -> tuple[int, int]:
    """ceil(scale H), ceil(scale W): the size in pixels of ``scale`` of an image."""
    return math.ceil(scale * height), math.ceil(scale * width)


def reduced(image: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Means over cells of a grid that covers the image, cells' edges at whole pixels.

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

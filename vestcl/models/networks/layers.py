"""What several networks share: shapes checked at the boundary, normalisation, exact resizing, depth as an input."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import torch
from torch import nn
from torch.nn import functional

from vestcl.models.config import LOG_DEPTH_FAR, LOG_DEPTH_NEAR
from vestcl.shapes import check

Nested = TypeVar("Nested")
"""A tensor, or a named tuple of tensors and such."""


def channels_last(image: torch.Tensor) -> torch.Tensor:
    """The same numbers with each pixel's channels side by side in memory: two to five times as fast on a CPU."""
    return image.contiguous(memory_format=torch.channels_last)


def side_by_side(images: Sequence[torch.Tensor]) -> torch.Tensor:
    """torch.cat(images, dim=1), each pixel's channels side by side, in an eighth of the time of cat and a copy to that.

    Args:
        images: [B, C_i, H, W], in any memory order; those of one order with the result cost least.

    Returns:
        [B, sum of C_i, H, W]; differentiable.
    """
    return torch.cat([image.permute(0, 2, 3, 1) for image in images], dim=3).permute(0, 3, 1, 2)


def group_norm(channels: int, per_group: int) -> nn.GroupNorm:
    """GroupNorm with groups of at least ``per_group`` channels, all of one size; one group where there are fewer."""
    groups = max(1, channels // per_group)
    while channels % groups:
        groups -= 1
    return nn.GroupNorm(groups, channels)


def upsample(image: torch.Tensor, factor: int, height: int, width: int) -> torch.Tensor:
    """Bilinear by a whole factor, then cut at the right and at the bottom to height x width.

    Cell k comes to cover [factor k, factor (k + 1)) whatever the size, so odd sizes move nothing.

    Args:
        image: [B, C, h, w] with factor h >= height and factor w >= width.
        factor: enlargement.
        height: rows out.
        width: columns out.

    Returns:
        [B, C, height, width]; differentiable.
    """
    if factor > 1:
        image = functional.interpolate(image, scale_factor=factor, mode="bilinear", align_corners=False)
    return image[..., :height, :width]


def frame_pair(
    features_prev: torch.Tensor,
    features_cur: torch.Tensor,
    depth_prev: torch.Tensor,
    depth_cur: torch.Tensor,
    mask_prev: torch.Tensor,
    mask_cur: torch.Tensor,
    channels: int,
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """What the motion networks see of two frames: F, log(clamp(D)), M of each, for `side_by_side`.

    Args:
        features_prev: [B, channels, H, W] at t - 1.
        features_cur: the same at t.
        depth_prev: [B, 1, H, W] m; clamped to [LOG_DEPTH_NEAR, LOG_DEPTH_FAR].
        depth_cur: the same at t.
        mask_prev: [B, 1, H, W], 1 on the static background.
        mask_cur: the same at t.
        channels: that the features must have.

    Returns:
        Twice [B, channels, H, W] and two [B, 1, H, W]; differentiable in all.

    Raises:
        ValueError: an argument of another shape.
    """
    wanted, one = f"B {channels} H W", "B 1 H W"
    check(
        features_prev=(features_prev, wanted), features_cur=(features_cur, wanted),
        depth_prev=(depth_prev, one), depth_cur=(depth_cur, one),
        mask_prev=(mask_prev, one), mask_cur=(mask_cur, one),
    )  # fmt: skip
    return frame_planes(features_prev, depth_prev, mask_prev), frame_planes(features_cur, depth_cur, mask_cur)


def frame_planes(features: torch.Tensor, depth: torch.Tensor, mask: torch.Tensor) -> list[torch.Tensor]:
    """F, log(clamp(D)), M of a frame; arguments as of `frame_pair`, not checked."""
    return [features, depth.clamp(LOG_DEPTH_NEAR, LOG_DEPTH_FAR).log(), mask]


def joined(parts: Sequence[Nested]) -> Nested:
    """One after the other along the first axis: tensors, or named tuples of such, however deep; None stays."""
    first: Any = parts[0]
    if isinstance(first, torch.Tensor):
        return torch.cat(list(parts))  # type: ignore[arg-type, return-value]
    if first is None:
        return first  # type: ignore[return-value]
    return type(first)(*(joined(field) for field in zip(*parts, strict=True)))


def mapped(function: Callable[[torch.Tensor], torch.Tensor], value: Nested) -> Nested:
    """``function`` of a tensor, or of each in named tuples of such, however deep; None stays."""
    if value is None:
        return value
    if isinstance(value, torch.Tensor):
        return function(value)  # type: ignore[return-value]
    return type(value)(*(mapped(function, part) for part in value))  # type: ignore[attr-defined]


def tensors_in(value: Any) -> Iterator[torch.Tensor]:
    """Those in tuples and lists, however deep."""
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, tuple | list):
        for part in value:
            yield from tensors_in(part)

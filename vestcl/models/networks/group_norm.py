"""GroupNorm whose mean and deviation one pass notes and another one borrows."""

import math
from collections.abc import Callable, Sequence
from typing import cast

import torch
from torch import nn

#: How a pass through a network normalises: the layer, and what it is given.
Normalise = Callable[[nn.GroupNorm, torch.Tensor], torch.Tensor]


def own(norm: nn.GroupNorm, x: torch.Tensor) -> torch.Tensor:
    """By the statistics of ``x`` itself, as GroupNorm is meant."""
    return cast(torch.Tensor, norm(x))


class NotedStatistics:
    """Mean and 1 / standard deviation of each GroupNorm, in the order of use.

    `note` normalises as GroupNorm does, and keeps what it found. `borrowed` gives a second pass through the same layers
    that normalises by it, whatever part of the image it sees: so an encoder's features of a crop equal those of the
    whole image. No gradient flows through what is borrowed.
    """

    def __init__(self) -> None:
        self._noted: list[tuple[torch.Tensor, torch.Tensor]] = []

    def note(self, norm: nn.GroupNorm, x: torch.Tensor) -> torch.Tensor:
        """norm(x); [B, C, H, W]."""
        batch, channels = x.shape[:2]
        cells, dtype = math.prod(x.shape[2:]), x.dtype
        y, mean, deviation = torch.native_group_norm(
            x, norm.weight, norm.bias, batch, channels, cells, norm.num_groups, norm.eps
        )
        self._noted.append((mean.detach(), deviation.detach()))
        return y.to(dtype)

    def borrowed(self, rows: Sequence[int] | torch.Tensor) -> Normalise:
        """A skip as many images as ``rows``, image i by the statistics of the noted image rows[i]."""
        noted = iter(self._noted)

        def normalise(norm: nn.GroupNorm, x: torch.Tensor) -> torch.Tensor:
            mean, scale = (tensor[rows].repeat_interleave(x.shape[1] // norm.num_groups, 1) for tensor in next(noted))
            scale = scale * norm.weight
            shift = norm.bias - mean * scale
            return torch.addcmul(shift[:, :, None, None], x, scale[:, :, None, None]).to(x.dtype)

        return normalise

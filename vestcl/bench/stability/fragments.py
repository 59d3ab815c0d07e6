"""Fragments layer by layer, in torch and in any precision: what the dividing peer and the bounds walk over."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch


@dataclass(frozen=True)
class Layers:
    """The fragments of one cloud, those in front of all others first: slice k is every pixel's k-th fragment."""

    points: torch.Tensor
    """[F]."""
    pixels: torch.Tensor
    """[F], row * width + column."""
    slices: list[slice]
    offsets: torch.Tensor
    """[F, 2] px, from the point to the pixel's centre; differentiable."""
    shapes: torch.Tensor
    """[F], 1 - d2 / r^2; differentiable."""


def list_layers(points_uv: torch.Tensor, z: torch.Tensor, radii: torch.Tensor, height: int, width: int) -> Layers:
    """Every (point, pixel) with d2 < r^2, composited in the order (z, index).

    Args:
        points_uv: [N, 2] px.
        z: [N] m, none before the near plane.
        radii: [N] px, positive.
        height: of the image, px.
        width: of the image, px.
    """
    order = torch.sort(z.detach(), stable=True).indices
    uv, r = points_uv.detach()[order], radii.detach()[order, None]
    limits = uv.new_tensor([width, height])
    low, high = ((uv + side).clamp(min=uv.new_zeros(2), max=limits) for side in (-r - 0.5, r + 0.5))
    low, extent = low.floor().long(), (high.ceil() - low.floor()).long()
    counts = extent.prod(dim=1)
    nearest = torch.repeat_interleave(counts)
    nth = torch.arange(len(nearest)) - (counts.cumsum(0) - counts)[nearest]
    x, y = low[nearest, 0] + nth % extent[nearest, 0], low[nearest, 1] + nth // extent[nearest, 0]
    d2 = (x + 0.5 - uv[nearest, 0]) ** 2 + (y + 0.5 - uv[nearest, 1]) ** 2
    inside = d2 < r[nearest, 0] ** 2
    points, pixels = order[nearest[inside]], (y * width + x)[inside]
    ranks = _rank_among_equals(pixels, height * width)
    by_rank = torch.sort(ranks, stable=True).indices
    points, pixels = points[by_rank], pixels[by_rank]
    ends = [0, *torch.bincount(ranks).cumsum(0).tolist()]
    centres = torch.stack([pixels % width, pixels // width], dim=1) + 0.5
    offsets = centres.to(uv.dtype) - points_uv[points]
    shapes = 1 - offsets.square().sum(dim=1) / radii[points].square()
    return Layers(points, pixels, [slice(*pair) for pair in pairwise(ends)], offsets, shapes)


def transmittances(layers: Layers, alphas: torch.Tensor, pixels: int) -> tuple[torch.Tensor, torch.Tensor]:
    """T in front of each fragment [F], and T_end [pixels]: one product after the other, in the alphas' precision."""
    t, before = alphas.new_ones(pixels), torch.empty_like(alphas)
    for part in layers.slices:
        here = t[layers.pixels[part]]
        before[part] = here
        t[layers.pixels[part]] = here * (1 - alphas[part])
    return before, t


def look_behind(
    layers: Layers, step: Callable[[slice, torch.Tensor], torch.Tensor], behind: torch.Tensor
) -> torch.Tensor:
    """Walk back to front: behind[pixels of a layer] = step(layer, behind there). What each fragment found, [F]."""
    found = behind.new_empty(len(layers.pixels))
    for part in reversed(layers.slices):
        there = behind[layers.pixels[part]]
        found[part] = there
        behind[layers.pixels[part]] = step(part, there)
    return found


def _rank_among_equals(values: torch.Tensor, bound: int) -> torch.Tensor:
    """For each entry the number of equal entries before it; values in [0, bound)."""
    order = torch.sort(values, stable=True).indices
    counts = torch.bincount(values, minlength=bound)
    ranks = torch.empty_like(values)
    ranks[order] = torch.arange(len(values)) - (counts.cumsum(0) - counts)[values[order]]
    return ranks

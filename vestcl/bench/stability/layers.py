"""Fragments layer by layer, in torch and in any precision, for the bounds and for the dividing peer."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch

from vestcl.reference.splat import fragments, rank_among_equals


@dataclass(frozen=True)
class Layers:
    """The fragments of one cloud, the front ones first: slice k is every pixel's k-th fragment."""

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
    nearest, x, y = fragments(points_uv.detach()[order], radii.detach()[order], height, width)
    pixels = y * width + x
    ranks = rank_among_equals(pixels, height * width)
    by_rank = torch.sort(ranks, stable=True).indices
    points, x, y = order[nearest[by_rank]], x[by_rank], y[by_rank]
    ends = [0, *torch.bincount(ranks).cumsum(0).tolist()]
    offsets = (torch.stack([x, y], dim=1) + 0.5).to(points_uv.dtype) - points_uv[points]
    shapes = 1 - offsets.square().sum(dim=1) / radii[points].square()
    return Layers(points, pixels[by_rank], [slice(*pair) for pair in pairwise(ends)], offsets, shapes)


def scan(
    layers: Layers, start: torch.Tensor, values: torch.Tensor, combine: Callable[..., torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Combine a pixel's ``start`` with the ``values`` of its fragments, front to back; differentiable.

    Args:
        layers: F fragments.
        start: [P], by pixel.
        values: [F].
        combine: `torch.mul` (of 1 - alpha: transmittances) or `torch.add`.

    Returns:
        The result in front of each fragment [F], and behind all of a pixel's [P].
    """
    total, in_front = start, [start[:0]]
    for part in layers.slices:
        here = total[layers.pixels[part]]
        in_front.append(here)
        total = total.index_put((layers.pixels[part],), combine(here, values[part]))
    return torch.cat(in_front), total

"""Fragments in torch alone: steps 1 to 4 of the story that vestcl.bench.splat.torch_peers tells."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import torch

from vestcl import constants

#: log(1 - alpha) of alpha = 1: exp of it is 0 in float64, and a scan of it stays finite.
LOG_OF_NOTHING: Final = -800.0


class Candidates(NamedTuple):
    """Step 2: n points, k x k pixels each; dx [n, k] and dy [n, k] lead from the point to their centres."""

    alphas: torch.Tensor
    """[n, k, k], without meaning where there is no fragment."""
    pixels: torch.Tensor
    """[n, k, k] int32."""
    dx: torch.Tensor
    dy: torch.Tensor


def expand(
    u: torch.Tensor, v: torch.Tensor, radii: torch.Tensor, opacities: torch.Tensor, k: int, height: int, width: int
) -> Candidates:
    """Step 2, for points [n]. Nothing but elementwise: torch.compile makes one loop of it."""
    steps = torch.arange(k, dtype=u.dtype)
    x = (u - radii + 0.5).floor()[:, None] + steps
    y = (v - radii + 0.5).floor()[:, None] + steps
    dx, dy = x + 0.5 - u[:, None], y + 0.5 - v[:, None]
    r2 = (radii * radii)[:, None]
    across = torch.where((x >= 0) & (x < width), dx * dx, 2 * r2)
    down = torch.where((y >= 0) & (y < height), dy * dy, 2 * r2)
    d2 = down[:, :, None] + across[:, None, :]
    alphas = opacities[:, None, None] * (1 - d2 / r2[:, :, None])
    places = (y.int() * width)[:, :, None] + x.int()[:, None, :]
    return Candidates(alphas, torch.where(d2 < r2[:, :, None], places, height * width), dx, dy)


def widest(radii: torch.Tensor) -> int:
    """k of step 2: an open interval of length 2 r holds at most so many pixel centres."""
    return math.ceil(2 * float(radii.detach().max()))


@dataclass(frozen=True)
class Fragments:
    """Steps 1 to 4. F fragments by pixel and front to back."""

    order: torch.Tensor
    """[n], the points front to back."""
    candidates: Candidates
    places: torch.Tensor
    """[F], where among the candidates a fragment is."""
    points: torch.Tensor
    """[F]."""
    starts: torch.Tensor
    """[height * width + 1], each pixel's first fragment."""
    alphas: torch.Tensor
    """[F] float64."""
    transmittances: torch.Tensor
    """[F] float64."""

    @property
    def pixels(self) -> torch.Tensor:
        """[F] int64."""
        return torch.repeat_interleave(self.starts.diff())

    @property
    def weights(self) -> torch.Tensor:
        """[F], in the features' precision."""
        return (self.alphas * self.transmittances).to(self.candidates.dx.dtype)


def list_fragments(
    size: tuple[int, int],
    points_uv: torch.Tensor,
    z: torch.Tensor,
    radii: torch.Tensor,
    opacities: torch.Tensor,
    expanding: Callable[..., Candidates] = expand,
) -> Fragments:
    """Steps 1 to 4, on an image of ``size``, for one cloud of N > 0 finite points: points_uv [N, 2], the others [N]."""
    height, width = size
    u, v = points_uv.unbind(1)
    shown = (u > -radii) & (u < width + radii) & (v > -radii) & (v < height + radii) & (z >= constants.NEAR)
    order = shown.nonzero()[:, 0]
    bits = z[order].view(torch.int32 if z.dtype == torch.float32 else torch.int64)
    order = order[torch.sort(bits, stable=True).indices]
    k = widest(radii)
    candidates = Candidates(*expanding(u[order], v[order], radii[order], opacities[order], k, *size))
    pixels, places = torch.sort(candidates.pixels.view(-1), stable=True)
    counts = torch.bincount(pixels, minlength=height * width)[: height * width]
    starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    places = places[: starts[-1]]
    points = order[places // k**2]
    alphas = candidates.alphas.view(-1)[places].double()
    return Fragments(order, candidates, places, points, starts, alphas, scan_transmittances(alphas, starts))


def scan_transmittances(alphas: torch.Tensor, starts: torch.Tensor) -> torch.Tensor:
    """Step 4."""
    logs = torch.log1p(-alphas).clamp(min=LOG_OF_NOTHING)
    scan = torch.cat([logs.new_zeros(1), logs.cumsum(0)])
    return (scan[:-1] - scan[starts[:-1]].repeat_interleave(starts.diff())).exp()

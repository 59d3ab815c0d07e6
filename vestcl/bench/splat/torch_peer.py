"""The fastest exact splatting in torch that we could write, as a peer of vestcl.splat.

1. Points that reach the image, front to back: one sort of their depths' bits (a radix sort, parallel).
2. Every point's k x k candidate pixels, k = ceil(2 r): alpha, and pixel (height * width where there is no fragment).
3. One stable sort of the pixels, int32: fragments by pixel, front to back. Two small sorts take less than half the
   time of one by an int64 key (pixel, depth).
4. Transmittance: T = exp of a segmented scan of log(1 - alpha) in float64, as one global scan less its value at the
   pixel's start.
5. image = sum of w f, a sparse matrix times the features: embedding_bag, and sampled_addmm for its gradient.

The backward is written by hand: a product f.g of each fragment, a segmented scan from the back, and sums over the
points' candidates:
    dL/da_i = T_i f_i.g - (sum over j behind i of w_j f_j.g) / (1 - a_i).
It is here that the peer is not exact: where a_i = 1 the scans hold nothing of what is behind, and the gradient of that
alpha lacks it.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import torch
from torch.autograd.function import once_differentiable

from vestcl import constants
from vestcl.bench.splat.scenes import Scene

#: log(1 - alpha) of alpha = 1: exp of it is 0 in float64, and a scan of it stays finite.
_LOG_OF_ZERO: Final = -800.0


Candidates = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
"""Step 2: n points, k x k pixels each: alphas [n, k, k], without meaning where there is no fragment; pixels [n, k, k]
int32; dx and dy [n, k], which lead from the point to the pixels' centres."""

Expand = Callable[..., Candidates]


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
    return alphas, torch.where(d2 < r2[:, :, None], places, height * width), dx, dy


def compiled_expand() -> Expand:
    """`expand` by torch.compile, five times as fast.

    Raises:
        RuntimeError: torch finds no C++ compiler, or can't use it.
    """
    compiled: Expand = torch.compile(expand, dynamic=True)
    compiled(*torch.ones(4, 3).unbind(), 2, 5, 7)
    return compiled


class Fragments(NamedTuple):
    """Steps 1 to 4: n points front to back with their candidates, and F fragments by pixel and front to back."""

    order: torch.Tensor
    """[n], of the points."""
    pixels: torch.Tensor
    """[n, k, k], of the candidates."""
    dx: torch.Tensor
    dy: torch.Tensor
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
    def weights(self) -> torch.Tensor:
        """[F], in the features' precision."""
        return (self.alphas * self.transmittances).to(self.dx.dtype)


def list_fragments(
    size: tuple[int, int],
    points_uv: torch.Tensor,
    z: torch.Tensor,
    radii: torch.Tensor,
    opacities: torch.Tensor,
    expanding: Expand = expand,
) -> Fragments:
    """Steps 1 to 4, on an image of ``size``, for one cloud of N > 0 finite points: points_uv [N, 2], the others [N]."""
    height, width = size
    u, v = points_uv.unbind(1)
    shown = (u > -radii) & (u < width + radii) & (v > -radii) & (v < height + radii) & (z >= constants.NEAR)
    order = shown.nonzero()[:, 0]
    bits = z[order].view(torch.int32 if z.dtype == torch.float32 else torch.int64)
    order = order[torch.sort(bits, stable=True).indices]
    k = math.ceil(2 * float(radii.detach().max()))  # an open interval of length 2 r holds at most so many pixel centres
    candidates, pixels, dx, dy = expanding(u[order], v[order], radii[order], opacities[order], k, *size)
    by_pixel, places = torch.sort(pixels.view(-1), stable=True)
    counts = torch.bincount(by_pixel, minlength=height * width)[: height * width]
    starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    places = places[: starts[-1]]
    alphas = candidates.view(-1)[places].double()
    logs = torch.log1p(-alphas).clamp(min=_LOG_OF_ZERO)
    scan = torch.cat([logs.new_zeros(1), logs.cumsum(0)])
    transmittances = (scan[:-1] - scan[starts[:-1]].repeat_interleave(starts.diff())).exp()
    return Fragments(order, pixels, dx, dy, places, order[places // k**2], starts, alphas, transmittances)


def splat(scene: Scene, expanding: Expand = expand) -> torch.Tensor:
    """The image [1, C, H, W] of ``scene``, of one cloud, differentiable as `vestcl.splat`'s.

    Args:
        scene: of one cloud.
        expanding: `expand`, or `compiled_expand`'s.
    """
    arrays = (scene.points_uv, scene.z, scene.radii, scene.opacities, scene.features)
    size = (scene.height, scene.width)
    image: torch.Tensor = _TorchSplat.apply(*(array[0] for array in arrays), size, expanding)
    return image.view(1, *size, -1).permute(0, 3, 1, 2)


class _TorchSplat(torch.autograd.Function):
    """Images [height * width, C]."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> torch.Tensor:
        points_uv, z, radii, opacities, features, size, expanding = arguments
        ctx.fragments = list_fragments(size, points_uv, z, radii, opacities, expanding)
        ctx.save_for_backward(radii, opacities, features)
        return _bag(features, ctx.fragments.points, ctx.fragments.starts, ctx.fragments.weights)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        radii, opacities, features = ctx.saved_tensors
        fragments = ctx.fragments
        grad_alphas = _grad_alphas(fragments, _products(fragments, features, grad_image))
        grads = _grad_geometry(fragments, grad_alphas, radii, opacities)
        return grads[0], None, grads[1], grads[2], _grad_features(fragments, grad_image, len(features)), None, None


def _bag(rows: torch.Tensor, taken: torch.Tensor, starts: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Row i: the sum of weights * rows[taken] from starts[i] to starts[i + 1]."""
    return torch.nn.functional.embedding_bag(
        taken, rows, starts, mode="sum", per_sample_weights=weights, include_last_offset=True
    )


def _products(fragments: Fragments, features: torch.Tensor, grad_image: torch.Tensor) -> torch.Tensor:
    """f.g of each fragment, [F]."""
    size, zeros = (len(grad_image), len(features)), features.new_zeros(len(fragments.points))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        pattern = torch.sparse_csr_tensor(fragments.starts, fragments.points, zeros, size, check_invariants=False)
    return torch.sparse.sampled_addmm(pattern, grad_image, features.T, beta=0.0).values()


def _grad_features(fragments: Fragments, grad_image: torch.Tensor, count: int) -> torch.Tensor:
    """Fragments of one point are neighbours among the candidates; those that are none weigh 0."""
    candidates = fragments.pixels.view(len(fragments.order), -1)
    weights = grad_image.new_zeros(candidates.numel())
    weights[fragments.places] = fragments.weights
    pixels = candidates.clamp(max=len(grad_image) - 1).view(-1)
    starts = torch.arange(0, candidates.numel() + 1, candidates.shape[1], dtype=torch.int32)
    grad = grad_image.new_zeros(count, grad_image.shape[1])
    return grad.index_copy_(0, fragments.order, _bag(grad_image, pixels, starts, weights))


def _grad_alphas(fragments: Fragments, products: torch.Tensor) -> torch.Tensor:
    """dL/da_i = T_i f_i.g - (sum over j behind i of w_j f_j.g) / (1 - a_i), [F]."""
    alphas, starts = fragments.alphas, fragments.starts
    shown = products.double()
    scan = torch.cumsum(alphas * fragments.transmittances * shown, 0)
    ends = scan[(starts[1:] - 1).clamp(min=0)].repeat_interleave(starts.diff())
    behind = ends.sub_(scan).div_(1 - alphas).masked_fill_(alphas == 1, 0)
    return shown.mul_(fragments.transmittances).sub_(behind).to(products.dtype)


def _grad_geometry(
    fragments: Fragments, grad_alphas: torch.Tensor, radii: torch.Tensor, opacities: torch.Tensor
) -> list[torch.Tensor]:
    """Gradients of points_uv [N, 2], radii [N] and opacities [N]."""
    order, dx, dy = fragments.order, fragments.dx, fragments.dy
    dense = grad_alphas.new_zeros(fragments.pixels.shape)
    dense.view(-1)[fragments.places] = grad_alphas
    across, down = dense.sum(1), dense.sum(2)
    r, slope = radii[order], 2 * opacities[order] / radii[order] ** 2
    d2 = (across * dx * dx).sum(1) + (down * dy * dy).sum(1)
    grads = (
        torch.stack([slope * (across * dx).sum(1), slope * (down * dy).sum(1)], 1),
        slope * d2 / r,
        across.sum(1) - d2 / r**2,
    )
    return [grad.new_zeros((len(radii), *grad.shape[1:])).index_copy_(0, order, grad) for grad in grads]

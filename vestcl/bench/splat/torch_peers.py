"""The best exact splatting that torch alone can do, as peers of vestcl.splat. One story, three ways to end it.

1. Points that reach the image, front to back: one sort of their depths' bits (a radix sort, parallel).
2. Every point's k x k candidate pixels, k = ceil(2 r): alpha, and pixel (height * width where there is no fragment).
3. One stable sort of the pixels, int32: fragments by pixel, front to back. Two small sorts take less than half the
   time of one by an int64 key (pixel, depth).
4. Transmittance: T = exp of a segmented scan of log(1 - alpha) in float64, as one global scan less its value at the
   pixel's start.
5. image = sum of w f: rows of features gathered, weighted, added ("autograd", "index_add"); or a sparse matrix times
   the features, by embedding_bag and sampled_addmm ("sparse").

"autograd" is the story as one writes it down, step 3 by one int64 key, differentiated by torch. The others have their
gradient by hand, and all there is to speed torch up: "index_add" gathers a cache-full at a time. Their backward is a
product f.g a fragment, a segmented scan from the back, and sums over the points' candidates:
    dL/da_i = T_i f_i.g - (sum over j behind i of w_j f_j.g) / (1 - a_i).
It is here that torch alone is not exact: where a_i = 1 the scans hold nothing of what is behind, and the gradient of
that alpha lacks it.
"""

import warnings
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import torch
from torch.autograd.function import once_differentiable

from vestcl import constants
from vestcl.bench.splat.scenes import Scene
from vestcl.bench.splat.torch_fragments import (
    Candidates,
    Fragments,
    expand,
    list_fragments,
    scan_transmittances,
    widest,
)

#: Fragments gathered at a time by "index_add": their features (C = 32) are 1 MiB, half of an L2 cache.
CHUNK: Final = 8192

#: The peers' names.
KINDS: Final = ("autograd", "index_add", "sparse")


# ---------------------------------------------------------------- step 5


class Ending(NamedTuple):
    """How features and pixels meet. Rows of images are pixels."""

    image: Callable[[Fragments, torch.Tensor], torch.Tensor]
    """(fragments, features [N, C]) -> image [height * width, C]."""
    products: Callable[[Fragments, torch.Tensor, torch.Tensor], torch.Tensor]
    """(fragments, features, grad_image [height * width, C]) -> f.g of each fragment, [F]."""
    grad_features: Callable[[Fragments, torch.Tensor, int], torch.Tensor]
    """(fragments, grad_image, N) -> [N, C]."""


def _add_rows(
    to: torch.Tensor, indices: torch.Tensor, rows: torch.Tensor, taken: torch.Tensor, weights: torch.Tensor
) -> torch.Tensor:
    """to[indices] += weights * rows[taken]."""
    room = rows.new_empty(CHUNK, rows.shape[1])
    for chunk in _chunks(len(weights)):
        part = torch.index_select(rows, 0, taken[chunk], out=room[: len(weights[chunk])])
        to.index_add_(0, indices[chunk], part.mul_(weights[chunk, None]))
    return to


def _index_add_image(fragments: Fragments, features: torch.Tensor) -> torch.Tensor:
    image = features.new_zeros(len(fragments.starts) - 1, features.shape[1])
    return _add_rows(image, fragments.pixels, features, fragments.points, fragments.weights)


def _index_add_products(fragments: Fragments, features: torch.Tensor, grad_image: torch.Tensor) -> torch.Tensor:
    products = features.new_empty(len(fragments.points))
    rooms = features.new_empty(2, CHUNK, features.shape[1])
    pixels = fragments.pixels
    for chunk in _chunks(len(products)):
        size = len(products[chunk])
        rows = torch.index_select(features, 0, fragments.points[chunk], out=rooms[0, :size])
        grads = torch.index_select(grad_image, 0, pixels[chunk], out=rooms[1, :size])
        torch.sum(rows.mul_(grads), 1, out=products[chunk])
    return products


def _index_add_features(fragments: Fragments, grad_image: torch.Tensor, count: int) -> torch.Tensor:
    grad = grad_image.new_zeros(count, grad_image.shape[1])
    return _add_rows(grad, fragments.points, grad_image, fragments.pixels, fragments.weights)


def _chunks(count: int) -> Iterator[slice]:
    return (slice(start, start + CHUNK) for start in range(0, count, CHUNK))


def _bag(rows: torch.Tensor, taken: torch.Tensor, starts: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Row i: the sum of weights * rows[taken] from starts[i] to starts[i + 1]."""
    return torch.nn.functional.embedding_bag(
        taken, rows, starts, mode="sum", per_sample_weights=weights, include_last_offset=True
    )


def _sparse_image(fragments: Fragments, features: torch.Tensor) -> torch.Tensor:
    return _bag(features, fragments.points, fragments.starts, fragments.weights)


def _sparse_products(fragments: Fragments, features: torch.Tensor, grad_image: torch.Tensor) -> torch.Tensor:
    size, zeros = (len(grad_image), len(features)), features.new_zeros(len(fragments.points))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        pattern = torch.sparse_csr_tensor(fragments.starts, fragments.points, zeros, size, check_invariants=False)
    return torch.sparse.sampled_addmm(pattern, grad_image, features.T, beta=0.0).values()


def _sparse_features(fragments: Fragments, grad_image: torch.Tensor, count: int) -> torch.Tensor:
    """Fragments of one point are neighbours among the candidates; those that are none weigh 0."""
    candidates = fragments.candidates.pixels.view(len(fragments.order), -1)
    weights = grad_image.new_zeros(candidates.numel())
    weights[fragments.places] = fragments.weights
    pixels = candidates.clamp(max=len(grad_image) - 1).view(-1)
    starts = torch.arange(0, candidates.numel() + 1, candidates.shape[1], dtype=torch.int32)
    grad = grad_image.new_zeros(count, grad_image.shape[1])
    return grad.index_copy_(0, fragments.order, _bag(grad_image, pixels, starts, weights))


ENDINGS: Final = {
    "index_add": Ending(_index_add_image, _index_add_products, _index_add_features),
    "sparse": Ending(_sparse_image, _sparse_products, _sparse_features),
}


# ---------------------------------------------------------------- the peer


class _TorchSplat(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        points_uv: torch.Tensor,
        z: torch.Tensor,
        radii: torch.Tensor,
        opacities: torch.Tensor,
        features: torch.Tensor,
        size: tuple[int, int],
        ending: Ending,
        expanding: Callable[..., Candidates],
    ) -> torch.Tensor:
        ctx.fragments = list_fragments(size, points_uv, z, radii, opacities, expanding)
        ctx.ending = ending
        ctx.save_for_backward(radii, opacities, features)
        return ending.image(ctx.fragments, features)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        radii, opacities, features = ctx.saved_tensors
        fragments, ending = ctx.fragments, ctx.ending
        products = ending.products(fragments, features, grad_image)
        grads = _grad_geometry(fragments, _grad_alphas(fragments, products), radii, opacities)
        grad_features = ending.grad_features(fragments, grad_image, len(features))
        return grads[0], None, grads[1], grads[2], grad_features, None, None, None


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
    order, (_, pixels, dx, dy) = fragments.order, fragments.candidates
    dense = grad_alphas.new_zeros(pixels.shape)
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


def splat(scene: Scene, kind: str, expanding: Callable[..., Candidates] = expand) -> torch.Tensor:
    """The image [1, C, H, W] of ``scene``, differentiable as `vestcl.splat`'s.

    Args:
        scene: of one cloud.
        kind: of `KINDS`, see the module.
        expanding: `expand`, or what `compiled_expand` made of it.
    """
    arrays = (scene.points_uv, scene.z, scene.radii, scene.opacities, scene.features)
    cloud, size = [array[0] for array in arrays], (scene.height, scene.width)
    if kind == "autograd":
        image = _splat_by_autograd(size, *cloud)
    else:
        image = _TorchSplat.apply(*cloud, size, ENDINGS[kind], expanding)
    return image.view(1, *size, -1).permute(0, 3, 1, 2)


def _splat_by_autograd(
    size: tuple[int, int],
    points_uv: torch.Tensor,
    z: torch.Tensor,
    radii: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
) -> torch.Tensor:
    """The whole story, differentiated by torch. The order is by z in float32."""
    height, width = size
    u, v = points_uv.unbind(1)
    k = widest(radii)
    candidates = expand(u, v, radii, opacities, k, height, width)
    is_fragment = (candidates.pixels < height * width) & (z >= constants.NEAR)[:, None, None]
    places = is_fragment.view(-1).nonzero()[:, 0]
    pixels, points = candidates.pixels.view(-1)[places].long(), places // k**2
    order = torch.sort(pixels << 32 | z.float().view(torch.int32)[points], stable=True).indices
    pixels, points = pixels[order], points[order]
    counts = torch.bincount(pixels, minlength=height * width)
    alphas = candidates.alphas.view(-1)[places[order]].double()
    transmittances = scan_transmittances(alphas, torch.cat([counts.new_zeros(1), counts.cumsum(0)]))
    weights = (alphas * transmittances).to(features.dtype)
    image = features.new_zeros(height * width, features.shape[1])
    return image.index_add(0, pixels, weights[:, None] * features[points])


def compiled_expand() -> Callable[..., Candidates]:
    """`expand` by torch.compile, five times as fast.

    Raises:
        RuntimeError: torch finds no C++ compiler, or can't use it.
    """
    compiled: Callable[..., Candidates] = torch.compile(expand, dynamic=True)
    compiled(*torch.ones(4, 3).unbind(), 2, 5, 7)
    return compiled

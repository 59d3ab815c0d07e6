"""Depth-sorted alpha splatting in plain torch: the specification that the OpenCL operator is tested against."""

from itertools import pairwise

import torch

from vestcl import constants


def splat(
    points_uv: torch.Tensor,
    z: torch.Tensor,
    radii: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
    height: int,
    width: int,
    backgrounds: torch.Tensor | None = None,
    min_transmittance: float = 0.0,
    *,
    cloud_starts: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Composite the points of each cloud front to back onto its image.

        d2 = |p - uv_i|^2,   a_i = o_i (1 - d2 / r_i^2)   at pixel centre p, for every point with d2 < r_i^2
        T_0 = 1,   w_i = a_i T_i,   T_(i+1) = T_i (1 - a_i)   in the order (z, index)
        image = sum_i w_i f_i + T_end b,   coverage = 1 - T_end

    Points with z < 0.1 m, with a radius <= 0 or with any number that is not finite (a feature counts) are skipped,
    and their gradients are zero.

    Args:
        points_uv: [B, N, 2] px, pixel centres at (column + 0.5, row + 0.5).
        z: [B, N] m, z-depth.
        radii: [B, N] px.
        opacities: [B, N] in [0, 1].
        features: [B, N, C].
        height: rows of the image.
        width: columns of the image.
        backgrounds: [B, C]; None is zero.
        min_transmittance: a pixel takes no more fragments once its T is below this; the gradient is that of the
            truncated sum. 0 never stops.
        cloud_starts: int64 [B + 1]; given, the clouds are packed one after another, the points' arguments are
            [P, 2], [P], [P], [P] and [P, C], and cloud b owns points cloud_starts[b]:cloud_starts[b + 1].

    Returns:
        image [B, C, H, W] and coverage [B, 1, H, W]; differentiable in all but z.

    Source: SPEC section 2; the footprint is 3D Moments' (CVPR 2022), without its limit on fragments per pixel.
    """
    if cloud_starts is None:
        clouds = list(zip(points_uv, z, radii, opacities, features, strict=True))
    else:
        spans = [slice(begin, end) for begin, end in pairwise(cloud_starts.tolist())]
        clouds = [(points_uv[s], z[s], radii[s], opacities[s], features[s]) for s in spans]
    channels = features.shape[-1]
    images, coverages = [features.new_zeros(0, channels, height, width)], [features.new_zeros(0, 1, height, width)]
    for b, cloud in enumerate(clouds):
        background = features.new_zeros(channels) if backgrounds is None else backgrounds[b]
        image, coverage = _splat_cloud(*cloud, height, width, background, min_transmittance)
        images.append(image[None])
        coverages.append(coverage[None])
    return torch.cat(images), torch.cat(coverages)


def _splat_cloud(
    uv: torch.Tensor,
    z: torch.Tensor,
    radii: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
    height: int,
    width: int,
    background: torch.Tensor,
    min_transmittance: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """One cloud [N, ...] -> image [C, H, W], coverage [1, H, W]."""
    front_to_back = _drawable_points(uv, z, radii, opacities, features)
    uv, radii, opacities, features = (a[front_to_back] for a in (uv, radii, opacities, features))

    point, x, y = fragments(uv.detach(), radii.detach(), height, width)
    d2 = (x + 0.5 - uv[point, 0]) ** 2 + (y + 0.5 - uv[point, 1]) ** 2
    alpha = opacities[point] * (1 - d2 / radii[point] ** 2)

    # Fragments of a pixel stay in the points' order: layer k holds every pixel's k-th fragment.
    pixel = y * width + x
    layer = rank_among_equals(pixel, height * width)
    layers = int(layer.max()) + 1 if len(layer) else 0
    alphas = alpha.new_zeros(layers, height * width).index_put((layer, pixel), alpha)
    if min_transmittance > 0:
        taken = (_transmittances(alphas.detach())[:-1] >= min_transmittance).cumprod(dim=0).bool()
        alphas = torch.where(taken, alphas, 0)
    transmittances = _transmittances(alphas)
    weights = (alphas * transmittances[:-1])[layer, pixel]

    image = features.new_zeros(height * width, features.shape[1])
    image = image.index_add(0, pixel, weights[:, None] * features[point])
    image = image + transmittances[-1][:, None] * background
    coverage = 1 - transmittances[-1]
    return image.T.reshape(-1, height, width), coverage.reshape(1, height, width)


def _drawable_points(
    uv: torch.Tensor, z: torch.Tensor, radii: torch.Tensor, opacities: torch.Tensor, features: torch.Tensor
) -> torch.Tensor:
    """Indices of the points that can make fragments, in the order (z, index)."""
    numbers = torch.cat([uv, z[:, None], radii[:, None], opacities[:, None], features], dim=1)
    drawable = numbers.isfinite().all(dim=1) & (z >= constants.NEAR) & (radii > 0)
    index = drawable.nonzero()[:, 0]
    return index[torch.sort(z.detach()[index], stable=True).indices]


def fragments(
    uv: torch.Tensor, radii: torch.Tensor, height: int, width: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Point, column and row of every (point, pixel) with d2 < r^2, ordered by point."""
    size = uv.new_tensor([width, height])
    low = torch.minimum((uv - radii[:, None] - 1).floor().clamp(min=0), size).long()
    high = torch.minimum((uv + radii[:, None] + 1).ceil().clamp(min=0), size).long()
    extent = high - low
    count = extent.prod(dim=1)
    point = torch.repeat_interleave(torch.arange(len(uv), device=uv.device), count)
    nth = torch.arange(len(point), device=uv.device) - (count.cumsum(0) - count)[point]
    x = low[point, 0] + nth % extent[point, 0]
    y = low[point, 1] + nth // extent[point, 0]
    d2 = (x + 0.5 - uv[point, 0]) ** 2 + (y + 0.5 - uv[point, 1]) ** 2
    inside = d2 < radii[point] ** 2
    return point[inside], x[inside], y[inside]


def rank_among_equals(values: torch.Tensor, bound: int) -> torch.Tensor:
    """For each entry the number of equal entries before it; values in [0, bound)."""
    order = torch.sort(values, stable=True).indices
    count = torch.bincount(values, minlength=bound)
    first = count.cumsum(0) - count
    rank = torch.empty_like(values)
    rank[order] = torch.arange(len(values), device=values.device) - first[values[order]]
    return rank


def _transmittances(alphas: torch.Tensor) -> torch.Tensor:
    """[K, pixels] -> [K + 1, pixels]: T before each layer and, last, T_end. Exact and differentiable at alpha = 1."""
    return torch.cat([alphas.new_ones(1, alphas.shape[1]), torch.cumprod(1 - alphas, dim=0)])

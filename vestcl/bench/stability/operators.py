"""The operators in plain torch, each intermediate result off by as much as float32's roundings; splats that divide.

Every operation of a kernel rounds its result by a factor 1 + d, |d| <= u = 2^-24, and those of its backward round its
gradients. `noisy_operators` do the same in float64: each intermediate result, and in the backward each gradient, is
multiplied by 1 + d with d uniform in [-g(n) u, g(n) u] for the n roundings since the one before. Of many roundings few
have the same sign, so that
    g(n) = min(n, 3 sqrt n),
Higham & Mary's probabilistic bound (SIAM J. Scientific Computing 41, 2019): d of root mean square 0.41 u, as uniformly
distributed roundings of uniform mantissas have it, exceed it with a probability below 1e-12. What cancels has been
rounded before, so that an error is as large as the problem's condition makes it. This is Monte Carlo arithmetic
(Parker, 1997). Sums over points in rigid_flow's backward are compensated in the kernel: their sum is rounded once.

Others' splats, in float32, are the same with another derivative of the transmittance T,
    dT_j/da_i = -T_j / (1 - a_i + epsilon),   j behind i,
where T_j = 0 if a_i = 1, so that the gradient lacks what is behind. "dividing": PyTorch3D's alpha compositor does this
(csrc/compositing/alpha_composite.cu, kEpsilon = 1e-9), and so does what is built on it, such as SynSin and 3D Moments.
"clamping" keeps alpha at 0.99 at most, which changes the image, and divides without an epsilon, as the rasteriser of 3D
Gaussian Splatting (SIGGRAPH 2023) and its descendants do.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Final

import torch
from torch.autograd.function import once_differentiable

from vestcl import constants, geometry
from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.splat import splat
from vestcl.ops.unproject import unproject
from vestcl.reference.splat import fragments, rank_among_equals

#: Half the distance from 1 to the next float32: the relative error of one rounding at most.
UNIT: Final = 2.0**-24

#: Of the probabilistic bound.
_DEVIATIONS: Final = 3.0

#: Roundings of a term in a sum over all pixels, whose partial sums are larger than its terms.
_SUM: Final = 16

#: What PyTorch3D adds to 1 - alpha before it divides, and the largest alpha of "clamping".
EPSILON: Final = 1e-9
CEILING: Final = 0.99

Round = Callable[[torch.Tensor, int], torch.Tensor]
"""A tensor after so many roundings."""


@dataclass(frozen=True)
class Operators:
    """The operators of a program: vestcl.ops, vestcl.reference, noisy ones and peers have the same signatures."""

    unproject: Callable[..., torch.Tensor] = unproject
    rigid_flow: Callable[..., torch.Tensor] = rigid_flow
    displace: Callable[..., tuple[torch.Tensor, torch.Tensor]] = displace
    splat: Callable[..., tuple[torch.Tensor, torch.Tensor]] = splat
    add: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] = torch.add
    """Of points and displacements."""


#: vestcl's own.
OPERATORS: Final = Operators()


def growth(roundings: float) -> float:
    """g(n): how many u so many roundings may add up to."""
    return min(roundings, _DEVIATIONS * math.sqrt(roundings))


def noisy_operators(generator: torch.Generator) -> Operators:
    """vestcl's in float64, off by as much as float32 may be; ``generator`` draws the noise."""

    def rounded(value: torch.Tensor, roundings: int) -> torch.Tensor:
        found: torch.Tensor = _Rounded.apply(value, UNIT * growth(roundings), generator)
        return found

    return Operators(
        partial(_unproject, rounded),
        partial(_rigid_flow, rounded),
        partial(_displace, rounded),
        partial(splat_by_layers, rounded=rounded),
        lambda one, other: rounded(one + other, 1),
    )


class _Rounded(torch.autograd.Function):
    """A value times 1 + d, and its gradient likewise."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor, largest: float, generator: torch.Generator) -> torch.Tensor:
        ctx.noise = largest, generator
        return value * _factors(value, *ctx.noise)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return grad * _factors(grad, *ctx.noise), None, None


def _factors(value: torch.Tensor, largest: float, generator: torch.Generator) -> torch.Tensor:
    return 1 + largest * (2 * torch.rand(value.shape, generator=generator, dtype=value.dtype) - 1)


def _unproject(rounded: Round, depth: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """z K^-1 (u, v, 1)."""
    height, width = depth.shape[2:]
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    centres = torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(1, -1, 3).to(K)
    rays = _product(rounded, torch.linalg.inv(K), centres)
    return rounded(depth.reshape(1, -1, 1) * rays, 1)


def _rigid_flow(
    rounded: Round, points_xyz: torch.Tensor, quaternion: torch.Tensor, translation: torch.Tensor
) -> torch.Tensor:
    """(R - I) x + t."""
    length = quaternion.norm(dim=1, keepdim=True).clamp(min=constants.QUATERNION_FLOOR)
    q = rounded(quaternion / length, 6)[0]
    p = rounded(q[:, None] * q, 2)
    rows = [
        (-p[2, 2] - p[3, 3], p[1, 2] - p[0, 3], p[1, 3] + p[0, 2]),
        (p[1, 2] + p[0, 3], -p[1, 1] - p[3, 3], p[2, 3] - p[0, 1]),
        (p[1, 3] - p[0, 2], p[2, 3] + p[0, 1], -p[1, 1] - p[2, 2]),
    ]
    matrix = rounded(2 * torch.stack([torch.stack(row) for row in rows]), 1)
    return rounded(_product(rounded, matrix[None], points_xyz) + translation[:, None], 1)


def _displace(
    rounded: Round,
    points_xyz: torch.Tensor,
    displacement_xyz: torch.Tensor,
    K: torch.Tensor,
    tgt_from_src: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """(a / c, b / c) and z, (a, b, c) = K (R (x + u) + t)."""
    moved = rounded(points_xyz + displacement_xyz, 1)
    M = K @ tgt_from_src[:, :3]
    abc = rounded(_product(rounded, M[:, :, :3], moved) + rounded(M[:, None, :, 3], 2), 1)
    z = rounded(_product(rounded, tgt_from_src[:, 2:3, :3], moved) + tgt_from_src[:, None, 2:3, 3], 1)
    return rounded(abc[..., :2] / abc[..., 2:], 2), z[..., 0]


def _product(rounded: Round, matrix: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """[1, M, 3] and [1, N, 3] -> [1, N, M], terms rounded by themselves: matrix 2, product 1, sums 3."""
    return rounded(matrix[:, None] * vectors[:, :, None], 6).sum(dim=-1)


# ---------------------------------------------------------------- splat


@dataclass(frozen=True)
class Layers:
    """The fragments of one cloud, the front ones first: slice k is every pixel's k-th fragment."""

    points: torch.Tensor
    """[F]."""
    pixels: torch.Tensor
    """[F], row * width + column."""
    slices: list[slice]
    centres: torch.Tensor
    """[F, 2] px, of the pixels."""


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
    ends = [0, *torch.bincount(ranks).cumsum(0).tolist()]
    centres = (torch.stack([x, y], dim=1)[by_rank] + 0.5).to(points_uv.dtype)
    return Layers(order[nearest[by_rank]], pixels[by_rank], [slice(*pair) for pair in pairwise(ends)], centres)


def splat_by_layers(
    points_uv: torch.Tensor,
    z: torch.Tensor,
    radii: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
    height: int,
    width: int,
    backgrounds: torch.Tensor,
    rounded: Round = lambda value, _: value,
    transmitted: Callable[[torch.Tensor], torch.Tensor] = lambda alphas: 1 - alphas,
    ceiling: float = 1.0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """`vestcl.splat` of one cloud, [1, N, ...]: T_(i+1) = T_i ``transmitted``(a_i), a_i <= ``ceiling``."""
    layers = list_layers(points_uv[0], z[0], radii[0], height, width)
    values = torch.cat([features[0], torch.ones_like(features[0, :, :1])], dim=1)  # the last channel is the coverage
    r, o, f = (rounded(of[layers.points], 2) for of in (radii[0], opacities[0], values))  # sums in the backward: 2
    d2 = rounded((layers.centres - points_uv[0][layers.points]).square(), 3).sum(dim=1)
    alphas = rounded(o * rounded(1 - rounded(d2 / r.square(), 5), 1), 1)
    alphas = alphas - (alphas - ceiling).clamp(min=0).detach()
    passed = rounded(transmitted(alphas), 1)
    weight, image = alphas.new_ones(height * width), values.new_zeros(height * width, values.shape[1])
    for part in layers.slices:
        at = (layers.pixels[part],)
        shown = rounded(rounded(weight[at] * alphas[part], 1)[:, None] * f[part], 1)
        image = image.index_put(at, rounded(image[at] + shown, 1))
        weight = weight.index_put(at, rounded(weight[at] * passed[part], 1))
    behind = rounded(torch.cat([backgrounds[0], backgrounds.new_zeros(1)]).expand_as(image), _SUM)
    planes = rounded(image + rounded(weight[:, None] * behind, 1), 1).T.reshape(1, -1, height, width)
    return planes[:, :-1], planes[:, -1:]


# ---------------------------------------------------------------- peers


def peers_of(program: str) -> Iterator[tuple[str, Operators]]:
    """By name, the peers of the operator that a program is about."""
    if program == "flow":
        yield "R x + t - x", Operators(rigid_flow=subtracting_flow)
        return
    for name, epsilon, ceiling in (("dividing", EPSILON, 1.0), ("clamping", 0.0, CEILING)):
        dividing = partial(splat_by_layers, transmitted=partial(_divided, epsilon=epsilon), ceiling=ceiling)
        yield name, Operators(splat=dividing)


def _divided(alphas: torch.Tensor, epsilon: float) -> torch.Tensor:
    """1 - a, with the derivative -(1 - a) / (1 - a + epsilon)."""
    passed = 1 - alphas.detach()
    return passed * (1 + (alphas.detach() - alphas) / (passed + epsilon))


def subtracting_flow(points_xyz: torch.Tensor, quaternion: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """`vestcl.rigid_flow` as R x + t - x."""
    return geometry.transform_points(geometry.compose_rigid(quaternion, translation), points_xyz) - points_xyz

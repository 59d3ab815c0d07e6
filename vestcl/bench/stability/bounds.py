"""How large an error of float32 may be: every operator in float64, with noise of the size that its roundings may reach.

A number that n roundings lead to, each by a factor 1 + d with |d| <= u = 2^-24, is off by at most n u times its
counterpart: the same number with every term's absolute value in place of the term. Cancellation makes the counterpart
larger than the number. Of many roundings few have the same sign, so that
    |error| <= g(n) u counterpart,   g(n) = min(n, 3 sqrt n).
3 sqrt n is Higham & Mary's probabilistic bound (SIAM J. Scientific Computing 41, 2019): d of root mean square 0.41 u,
as uniformly distributed roundings of uniform mantissas have it, exceed it with a probability below 1e-12.
Independent errors of many pixels or points add up as the root of the sum of squares.

Noise, uniform in [-g(n) u counterpart, g(n) u counterpart], is added to what each operator returns, forward and
backward, and float64 computes the program's end from that. A counterpart's gradient is the gradient's counterpart, so
most limits of the backward are autograd's. The bound is twice the largest of three runs' errors: the maximum over an
image differs less than that from draw to draw, and g itself is seven standard deviations.

Roundings, counted in the kernels:
    splat      11 a fragment: 8 of alpha = o - (o / r^2) ((x - u)^2 + (y - v)^2), in units of o; T (1 - a), a T, w f or
               its like, the sum. Off by o d, alpha changes 1 - a by no more than d, relatively: 1 - a >= o d2 / r^2.
               2 a pixel in the sum of a gradient: product and sum.
    rigid_flow 16: quaternion to unit length 6, matrix 3, product with the point 6, sum 1; the sums over the points in
               its backward are compensated, and leave 2.
    displace   8 forward: matrix 1, x + u 1, product and sum 5, division 1; backward as many again.
    unproject  8: inverse of K 1, ray 6, product 1.
    x + u      1.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import torch
from torch.autograd.function import once_differentiable

from vestcl import constants
from vestcl.bench.stability.cases import Case
from vestcl.bench.stability.layers import list_layers, scan
from vestcl.bench.stability.programs import OPERATORS, Errors, Operators, Outcome, evaluate, relative_errors

#: Half the distance from 1 to the next float32: the relative error of one rounding at most.
UNIT: Final = 2.0**-24

#: Of the probabilistic bound.
_DEVIATIONS: Final = 3.0

#: Runs with noise, and the bound in units of the worst of them.
_DRAWS: Final = 3
_SAFETY: Final = 2.0

#: Roundings, see the module.
_FRAGMENT, _PIXEL, _FLOW, _DISPLACE, _UNPROJECT = 11, 2, 16, 8, 8

Tensors = Sequence[torch.Tensor]

Limits = tuple[Tensors, Callable[[Tensors], Tensors]]
"""How far each output may be off, and from the outputs' gradients how far each input's gradient may be off."""


def bounds_of(case: Case, truth: Outcome) -> Errors:
    """The largest errors that roundings of float32 explain, array by array.

    Args:
        case: whose program ran.
        truth: its outcome in float64.
    """
    operators = noisy_operators(torch.Generator().manual_seed(case.seed))
    draws = [relative_errors(evaluate(case, operators, torch.float64), truth) for _ in range(_DRAWS)]
    return {
        kind: {name: _SAFETY * max(draw[kind][name] for draw in draws) for name in arrays}
        for kind, arrays in truth.items()
    }


def growth(roundings: float) -> float:
    """g(n): how many u so many roundings may add up to."""
    return min(roundings, _DEVIATIONS * math.sqrt(roundings))


def noisy_operators(generator: torch.Generator) -> Operators:
    """vestcl's in float64, off by as much as float32 may be; ``generator`` draws the noise."""

    def splat(*arguments: Any) -> Any:
        """splat(points_uv, z, radii, opacities, features, height, width, backgrounds) of one cloud."""
        *looks, height, width, backgrounds = arguments

        def operator(*inputs: torch.Tensor) -> Any:
            return OPERATORS.splat(*inputs[:5], height, width, inputs[5])

        return _Noisy.apply(operator, partial(_splat, (height, width)), generator, *looks, backgrounds)

    def noisy(operator: Callable[..., Any], limits: Callable[..., Limits]) -> Callable[..., Any]:
        return partial(_Noisy.apply, operator, limits, generator)

    return Operators(
        noisy(OPERATORS.unproject, _unproject),
        noisy(OPERATORS.rigid_flow, _rigid_flow),
        noisy(OPERATORS.displace, _displace),
        splat,
        noisy(OPERATORS.add, _add),
    )


class _Noisy(torch.autograd.Function):
    """An operator whose outputs and gradients are off by up to their limits."""

    @staticmethod
    def forward(ctx: Any, operator: Callable[..., Any], limits: Callable[..., Limits], *others: Any) -> Any:
        ctx.generator, *inputs = others
        ctx.leaves = [value.detach().requires_grad_(value.requires_grad) for value in inputs]
        with torch.enable_grad():
            outputs = operator(*ctx.leaves)
            ctx.outputs = outputs if isinstance(outputs, tuple) else (outputs,)
            of_outputs, ctx.limits = limits(*map(torch.detach, ctx.leaves))
        found = _with_noise([output.detach() for output in ctx.outputs], of_outputs, ctx.generator)
        return found if isinstance(outputs, tuple) else found[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        needed = [i for i, leaf in enumerate(ctx.leaves) if leaf.requires_grad]
        exact = torch.autograd.grad(ctx.outputs, [ctx.leaves[i] for i in needed], grads)
        limits = ctx.limits(grads)
        found = dict(zip(needed, _with_noise(exact, [limits[i] for i in needed], ctx.generator), strict=True))
        return None, None, None, *(found.get(i) for i in range(len(ctx.leaves)))


def _with_noise(values: Tensors, limits: Tensors, generator: torch.Generator) -> tuple[torch.Tensor, ...]:
    """``values``, each off by up to its limit."""
    draws = (torch.rand(limit.shape, generator=generator, dtype=limit.dtype) for limit in limits)
    return tuple(v + limit.detach() * (2 * draw - 1) for v, limit, draw in zip(values, limits, draws, strict=True))


def _add(points_xyz: torch.Tensor, displacement_xyz: torch.Tensor) -> Limits:
    return [UNIT * (points_xyz + displacement_xyz).abs()], lambda grads: [UNIT * grads[0].abs()] * 2


def _unproject(depth: torch.Tensor, K: torch.Tensor) -> Limits:
    """z K^-1 (u, v, 1)."""
    size = depth.abs().requires_grad_()
    height, width = depth.shape[2:]
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    centres = torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(1, -1, 3).to(K)
    points = UNIT * growth(_UNPROJECT) * size.reshape(1, -1, 1) * (centres @ torch.linalg.inv(K).abs().mT)
    return [points], lambda grads: [*_vjp([points], [size], grads), torch.zeros_like(K)]


def _rigid_flow(points_xyz: torch.Tensor, quaternion: torch.Tensor, translation: torch.Tensor) -> Limits:
    """(R - I) x + t."""
    length = max(quaternion.norm().item(), constants.QUATERNION_FLOOR)
    unit = (quaternion[0] / length).abs().requires_grad_()
    w, x, y, z = unit
    rows = [(y * y + z * z, x * y + w * z, x * z + w * y),
            (x * y + w * z, x * x + z * z, y * z + w * x),
            (x * z + w * y, y * z + w * x, x * x + y * y)]  # fmt: skip
    matrix = 2 * torch.stack([torch.stack(row) for row in rows])
    factor = UNIT * growth(_FLOW)

    def gradients(grads: Tensors) -> Tensors:
        """Sums over points: the result, and the root of its terms' squares."""
        grad, points = grads[0][0], points_xyz[0]
        grad_rotation = (grad.T @ points).abs() + (grad.square().T @ points.square()).sqrt()
        (along,) = torch.autograd.grad(matrix, unit, grad_rotation, retain_graph=True)
        grad_quaternion = (along + unit * (unit @ along)) / length
        grad_translation = grad.sum(dim=0).abs() + grad.square().sum(dim=0).sqrt()
        return [factor * of[None] for of in (grad.abs() @ matrix, grad_quaternion, grad_translation)]

    return [factor * (points_xyz.abs() @ matrix.T + translation.abs()[:, None])], gradients


def _displace(
    points_xyz: torch.Tensor, displacement_xyz: torch.Tensor, K: torch.Tensor, tgt_from_src: torch.Tensor
) -> Limits:
    """(a / c, b / c) and z, (a, b, c) = K (R (x + u) + t)."""
    M = K @ tgt_from_src[:, :3]
    size = (points_xyz.abs() + displacement_xyz.abs()).requires_grad_()
    abc = (points_xyz + displacement_xyz) @ M[:, :, :3].mT + M[:, None, :, 3]
    reach = size @ M[:, :, :3].abs().mT + M[:, None, :, 3].abs()
    uv, c = abc[..., :2] / abc[..., 2:], abc[..., 2:].abs()
    z = size @ tgt_from_src[:, 2, :3].abs()[..., None] + tgt_from_src[:, None, 2:3, 3].abs()
    counterparts = [(reach[..., :2] + uv.abs() * reach[..., 2:]) / c, z[..., 0]]

    def gradients(grads: Tensors) -> Tensors:
        (grad,) = _vjp(counterparts, [size], grads)
        limit = UNIT * growth(2 * _DISPLACE) * grad
        return [limit, limit, torch.zeros_like(K), torch.zeros_like(tgt_from_src)]

    return [UNIT * growth(_DISPLACE) * of for of in counterparts], gradients


def _splat(size: tuple[int, int], *inputs: torch.Tensor) -> Limits:
    """Of one cloud; alpha's errors are in units of o, not of alpha."""
    points_uv, z, radii, opacities, features, background = (value[0] for value in inputs)
    layers = list_layers(points_uv, z, radii, *size)
    points, pixels = layers.points, layers.pixels
    alphas = (opacities[points] * layers.shapes).requires_grad_()
    o = opacities[points].requires_grad_()
    before, after = scan(layers, opacities.new_ones(math.prod(size)), 1 - alphas, torch.mul)
    weights = (o * before)[:, None]
    image = (after[:, None] * background.abs()).index_add(0, pixels, weights * features.abs()[points])
    per_fragment = growth(_FRAGMENT * len(layers.slices) + _PIXEL)

    def root_by_point(values: torch.Tensor) -> torch.Tensor:
        sums = values.new_zeros(len(radii), *values.shape[1:])
        return sums.index_add_(0, points, values.square()).sqrt()

    def gradients(grads: Tensors) -> Tensors:
        g, h = grads[0][0].flatten(1).T.abs(), grads[1].flatten().abs()
        by_o, by_alphas = _vjp([image, after], [o, alphas], [g, h])
        grad_alphas = by_o - by_alphas  # T (f.g + A): its second term is negative in the derivative
        slope = 2 * o / radii[points].square() * grad_alphas
        found = (
            root_by_point(slope[:, None] * layers.offsets),
            torch.zeros_like(radii),
            root_by_point(slope * (1 - layers.shapes) * radii[points]),
            root_by_point(grad_alphas * layers.shapes),
            root_by_point(weights * g[pixels]),
            (after[:, None] * g).square().sum(dim=0).sqrt(),
        )
        roundings = per_fragment + growth(_PIXEL * int(torch.bincount(points, minlength=1).max()))
        return [UNIT * roundings * of[None] for of in found]

    counterparts = image.T.reshape(1, -1, *size), image.new_ones(1, 1, *size)
    return [UNIT * per_fragment * of for of in counterparts], gradients


def _vjp(outputs: Tensors, inputs: Tensors, grads: Tensors) -> Tensors:
    """Gradients of the inputs from the absolute values of the outputs' gradients."""
    return torch.autograd.grad(outputs, inputs, [grad.abs() for grad in grads])

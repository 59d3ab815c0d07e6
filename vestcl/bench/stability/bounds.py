"""How large an error of float32 may be: every operator in float64, with noise of the size that its roundings may reach.

A number that n roundings lead to, each by a factor 1 + d with |d| <= u = 2^-24, is off by at most n u times its
counterpart: the same number with every term's absolute value in place of the term. What cancels makes the counterpart
larger than the number. Of many roundings few point the same way, so that
    |error| <= g(n) u counterpart,   g(n) = min(n, 3 sqrt n).
3 sqrt n is Higham & Mary's probable bound (SIAM J. Scientific Computing 41, 2019): d of root mean square 0.41 u, as
uniformly distributed roundings of uniformly distributed mantissas have it, exceed it with a probability below 1e-12.
Sums over pixels and over points of errors that have nothing to do with each other add up as the root of squares.

Noise, uniform in [-g(n) u counterpart, g(n) u counterpart], is added to what each operator returns forward, and to what
it returns backward. What becomes of it until the program's end, float64 computes: how much splat makes of a point that
is off, how much of it cancels on the way to a depth's gradient. The bound is twice the largest of three runs' errors:
the maximum over an image differs less than that from draw to draw, and g alone is seven deviations.

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
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch.autograd.function import once_differentiable

from vestcl.bench.stability import counterparts
from vestcl.bench.stability.cases import Case
from vestcl.bench.stability.programs import OPERATORS, Operators, Outcome, evaluate, relative_error

#: Half the distance from 1 to the next float32: what one rounding changes at most, relatively.
UNIT: Final = 2.0**-24

#: Of the probable bound.
_DEVIATIONS: Final = 3.0

#: Runs with noise, and the bound in units of the worst of them.
_DRAWS: Final = 3
_SAFETY: Final = 2.0

#: Roundings, see the module.
_FRAGMENT, _PIXEL, _FLOW, _DISPLACE, _UNPROJECT = 11, 2, 16, 8, 8

Tensors = Sequence[torch.Tensor]


@dataclass(frozen=True)
class Bounds:
    """Largest relative errors, in the maximum norm, by output and by input."""

    outputs: dict[str, float]
    gradients: dict[str, float]


def bounds_of(case: Case, truth: Outcome) -> Bounds:
    """What float32 may be off by.

    Args:
        case: whose program ran.
        truth: what it computes in float64.
    """
    operators = noisy_operators(torch.Generator().manual_seed(case.seed))
    bounds = Bounds(dict.fromkeys(truth.outputs, 0.0), dict.fromkeys(truth.gradients, 0.0))
    for _ in range(_DRAWS):
        run = evaluate(case, operators, torch.float64)
        for kind in ("outputs", "gradients"):
            got, wanted, limits = (getattr(of, kind) for of in (run, truth, bounds))
            for name, limit in limits.items():
                limits[name] = max(limit, _SAFETY * relative_error(got[name], wanted[name]))
    return bounds


def growth(roundings: float) -> float:
    """g(n): how many u so many roundings may add up to."""
    return min(roundings, _DEVIATIONS * math.sqrt(roundings))


# ---------------------------------------------------------------- operators with noise


@dataclass(frozen=True)
class _Model:
    """An operator, and how far roundings may take what it returns: forward, and the gradients of its inputs."""

    operator: Callable[..., Any]
    forward: Callable[..., Tensors]
    """inputs -> a limit for each output."""
    backward: Callable[..., Tensors]
    """(gradients of the outputs, *inputs) -> a limit for each input."""
    generator: torch.Generator

    def noisy(self, values: Tensors, limits: Tensors) -> tuple[torch.Tensor, ...]:
        """``values``, each off by up to its limit."""
        draws = (torch.rand(limit.shape, generator=self.generator, dtype=limit.dtype) for limit in limits)
        return tuple(value + limit * (2 * draw - 1) for value, limit, draw in zip(values, limits, draws, strict=True))

    def __call__(self, *inputs: torch.Tensor) -> Any:
        outputs = _Noisy.apply(self, *inputs)
        return outputs[0] if len(outputs) == 1 else outputs


class _Noisy(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, model: _Model, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        ctx.model = model
        ctx.leaves = [value.detach().requires_grad_(value.requires_grad) for value in inputs]
        with torch.enable_grad():
            outputs = model.operator(*ctx.leaves)
        ctx.outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        return model.noisy([output.detach() for output in ctx.outputs], model.forward(*map(torch.detach, ctx.leaves)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        wanted = [i for i, leaf in enumerate(ctx.leaves) if leaf.requires_grad]
        exact = torch.autograd.grad(ctx.outputs, [ctx.leaves[i] for i in wanted], grads)
        limits = ctx.model.backward(grads, *map(torch.detach, ctx.leaves))
        found: list[torch.Tensor | None] = [None] * len(ctx.leaves)
        for i, grad in zip(wanted, ctx.model.noisy(exact, [limits[i] for i in wanted]), strict=True):
            found[i] = grad
        return None, *found


def noisy_operators(generator: torch.Generator) -> Operators:
    """vestcl's, in float64, off by as much as float32 may be.

    Args:
        generator: of the noise.
    """
    return Operators(
        _Model(OPERATORS.unproject, _unproject, _unproject_backward, generator),
        _Model(OPERATORS.rigid_flow, _rigid_flow, _rigid_flow_backward, generator),
        _Model(OPERATORS.displace, _displace, _displace_backward, generator),
        lambda *arguments: _noisy_splat(generator, *arguments),
        _Model(OPERATORS.add, lambda a, b: [UNIT * (a + b).abs()], lambda g, *_: [UNIT * g[0].abs()] * 2, generator),
    )


def _unproject(depth: torch.Tensor, K: torch.Tensor) -> Tensors:
    return [UNIT * growth(_UNPROJECT) * depth.abs().flatten()[None, :, None] * counterparts.rays(depth, K)]


def _unproject_backward(grads: Tensors, depth: torch.Tensor, K: torch.Tensor) -> Tensors:
    terms = (grads[0].abs() * counterparts.rays(depth, K)).sum(dim=-1)
    return [UNIT * growth(_UNPROJECT) * terms.reshape(depth.shape), torch.zeros_like(K)]


def _rigid_flow(points_xyz: torch.Tensor, quaternion: torch.Tensor, translation: torch.Tensor) -> Tensors:
    return [UNIT * growth(_FLOW) * counterparts.rigid_flow(points_xyz, quaternion, translation)]


def _rigid_flow_backward(
    grads: Tensors, points_xyz: torch.Tensor, quaternion: torch.Tensor, _: torch.Tensor
) -> Tensors:
    return [UNIT * growth(_FLOW) * of for of in counterparts.rigid_flow_backward(points_xyz, quaternion, grads[0])]


def _displace(*inputs: torch.Tensor) -> Tensors:
    return [UNIT * growth(_DISPLACE) * of for of in counterparts.displace(*inputs)]


def _displace_backward(grads: Tensors, *inputs: torch.Tensor) -> Tensors:
    limit = UNIT * growth(2 * _DISPLACE) * counterparts.displace_backward(grads[0], grads[1], *inputs)
    return [limit, limit, *map(torch.zeros_like, inputs[2:])]


def _noisy_splat(generator: torch.Generator, *arguments: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """splat(points_uv, z, radii, opacities, features, height, width, backgrounds) of one cloud."""
    points_uv, z, radii, opacities, features, height, width, backgrounds = arguments
    inputs = points_uv, z, radii, opacities, features, backgrounds
    terms = counterparts.SplatTerms.of([value.detach()[0] for value in inputs], (height, width))
    per_fragment = growth(_FRAGMENT * terms.most_layers + _PIXEL)

    def forward(*_: torch.Tensor) -> Tensors:
        return [UNIT * per_fragment * of for of in terms.outputs()]

    def backward(grads: Tensors, *_: torch.Tensor) -> Tensors:
        roundings = per_fragment + growth(_PIXEL * terms.most_pixels)
        return [UNIT * roundings * of for of in terms.gradients(grads[0], grads[1])]

    def operator(*values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return OPERATORS.splat(*values[:5], height, width, values[5])

    image, coverage = _Model(operator, forward, backward, generator)(*inputs)
    return image, coverage

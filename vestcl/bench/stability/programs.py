"""The programs of `vestcl bench stability`, on any operators of vestcl's names, and how far two results differ."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import torch

from vestcl.bench.stability.cases import Case, Inputs
from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.splat import splat
from vestcl.ops.unproject import unproject

Outcome = dict[str, Inputs]
"""What a program computes: "outputs" ("image" and "coverage", or "displacement_xyz") and "gradients" by input."""

Errors = dict[str, dict[str, float]]
"""A relative error for each array of an `Outcome`."""


@dataclass(frozen=True)
class Operators:
    """The operators of a program: vestcl.ops, vestcl.reference and the peers have the same signatures."""

    unproject: Callable[..., torch.Tensor] = unproject
    rigid_flow: Callable[..., torch.Tensor] = rigid_flow
    displace: Callable[..., tuple[torch.Tensor, torch.Tensor]] = displace
    splat: Callable[..., tuple[torch.Tensor, torch.Tensor]] = splat
    add: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] = torch.add
    """Of points and displacements."""


#: vestcl's own.
OPERATORS: Final = Operators()


def evaluate(case: Case, operators: Operators, dtype: torch.dtype) -> Outcome:
    """Run a case forward and backward.

    Args:
        case: whose inputs are rounded to ``dtype``.
        operators: that compute.
        dtype: float32 or float64.

    Returns:
        Outputs, and gradients of the sum of outputs times weights that are uniform in [-1, 1] and exact in float32.
    """
    inputs = {name: value.to(dtype) for name, value in case.inputs.items()}
    for name in case.differentiated:
        inputs[name].requires_grad_()
    outputs = _PROGRAMS[case.program](case, operators, inputs)
    generator = torch.Generator().manual_seed(case.seed)
    gradients = torch.autograd.grad(
        list(outputs.values()),
        [inputs[name] for name in case.differentiated],
        [(2 * torch.rand(of.shape, generator=generator).double() - 1).to(dtype) for of in outputs.values()],
        allow_unused=True,
        materialize_grads=True,
    )
    values = {name: output.detach() for name, output in outputs.items()}
    return {"outputs": values, "gradients": dict(zip(case.differentiated, gradients, strict=True))}


def relative_errors(got: Outcome, truth: Outcome) -> Errors:
    """`relative_error` array by array."""
    return {kind: {name: relative_error(got[kind][name], of) for name, of in truth[kind].items()} for kind in truth}


def relative_error(got: torch.Tensor, wanted: torch.Tensor) -> float:
    """max |got - wanted| / max |wanted| over a whole array: the maximum norm.

    Args:
        got: of any precision.
        wanted: of the same shape.

    Returns:
        The error; 0 where both are equal, infinity where only ``wanted`` is 0 or ``got`` is not finite.
    """
    difference = (got.double() - wanted.double()).abs().max().item() if got.numel() else 0.0
    if difference == 0:
        return 0.0
    scale = wanted.double().abs().max().item()
    return difference / scale if scale > 0 and difference < float("inf") else float("inf")


def _splat(case: Case, operators: Operators, inputs: Inputs) -> Inputs:
    looks = (inputs[name] for name in ("radii", "opacities", "features"))
    background = inputs["backgrounds"]
    image, coverage = operators.splat(inputs["points_uv"], inputs["z"], *looks, case.height, case.width, background)
    return {"image": image, "coverage": coverage}


def _view(case: Case, operators: Operators, inputs: Inputs) -> Inputs:
    """Unproject, move step by step, project, splat, in the order of the source depths."""
    points_xyz = operators.unproject(inputs["depth"], inputs["source_K"])
    steps = list(zip(inputs["quaternion"].split(1), inputs["translation"].split(1), strict=True))
    for quaternion, translation in steps[:-1]:
        points_xyz = operators.add(points_xyz, operators.rigid_flow(points_xyz, quaternion, translation))
    displacement_xyz = operators.rigid_flow(points_xyz, *steps[-1])
    points_uv, _ = operators.displace(points_xyz, displacement_xyz, inputs["K"], inputs["tgt_from_src"])
    return _splat(case, operators, inputs | {"points_uv": points_uv, "z": inputs["depth"].detach().reshape(1, -1)})


def _flow(case: Case, operators: Operators, inputs: Inputs) -> Inputs:
    return {"displacement_xyz": operators.rigid_flow(*(inputs[name] for name in case.differentiated))}


_PROGRAMS: Final[dict[str, Callable[[Case, Operators, Inputs], dict[str, Any]]]] = {
    "splat": _splat,
    "view": _view,
    "flow": _flow,
}

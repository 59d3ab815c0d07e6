"""How operators meet torch's autograd and compiler: second derivatives are true or refused, and nothing is traced.

An operator's backward passes its gradients through `differentiable_by` or `differentiable_once`. Without
``create_graph=True`` both return them unchanged. With it, the gradients are attached to everything that they depend on,
so that differentiating them gives the true derivative or an error, never zero or None in its place.
"""

import functools
import sys
from collections.abc import Callable, Sequence
from typing import Any, Final, ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")

Gradients = tuple[torch.Tensor | None, ...]
"""Gradients of all inputs of an operator; None where no gradient is needed."""

_NOT_TRACED: Final = "vestcl's operators run OpenCL kernels outside the graph: leave out fullgraph=True"


def untraced(function: Callable[P, R]) -> Callable[P, R]:
    """``function`` with a graph break around it: torch.compile runs it eagerly, with the eager result.

    This is torch.compiler.disable without its import of the compiler, which takes as long as importing torch: until
    the compiler is imported, nothing is compiled.
    """
    disabled: list[Callable[P, R]] = []

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if "torch._dynamo" not in sys.modules:
            return function(*args, **kwargs)
        if not disabled:
            disabled.append(_disable(function, call))
        return disabled[0](*args, **kwargs)

    _mark(call)
    return call


def _disable(function: Callable[P, R], call: Callable[P, R]) -> Callable[P, R]:
    """``function`` as torch.compiler.disable wraps it, and ``call``, which runs it, never compiled for a new shape."""
    from torch._dynamo.decorators import skip

    skip(call)
    return torch.compiler.disable(function)


def _mark(function: Callable[..., Any]) -> None:
    """Set what torch.compiler.disable sets: the compiler breaks the graph at ``function`` and reports why."""
    vars(function).update(_torchdynamo_disable=True, _torchdynamo_disable_msg=_NOT_TRACED)


_mark(_disable)


def differentiable_by(
    formula: Callable[..., Any], inputs: Sequence[torch.Tensor], grad_outputs: Sequence[torch.Tensor], grads: Gradients
) -> Gradients:
    """``grads``, whose derivatives of any order are those of the formula's gradients.

    Args:
        formula: computes in plain torch what the operator computes from ``inputs``.
        inputs: of the operator.
        grad_outputs: of the loss, for each output.
        grads: what the operator's kernels computed from all these, for each input.
    """
    if not torch.is_grad_enabled():
        return grads
    return _DifferentiableBy.apply(formula, grads, len(inputs), *inputs, *grad_outputs)


class _DifferentiableBy(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, formula: Callable[..., Any], grads: Gradients, count: int, *tensors: torch.Tensor
    ) -> Gradients:
        ctx.formula, ctx.count, ctx.needs_grad = formula, count, [grad is not None for grad in grads]
        ctx.save_for_backward(*tensors)
        return tuple(grad if grad is None else grad.clone() for grad in grads)  # two of them may be the same tensor

    @staticmethod
    @untraced
    def backward(ctx: Any, *grad_grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        again = torch.is_grad_enabled()
        with torch.enable_grad():
            # New tensors, for one tensor may have been passed twice.
            tensors = [
                t.view_as(t) if again and t.requires_grad else t.detach().requires_grad_() for t in ctx.saved_tensors
            ]
            inputs, grad_outputs = tensors[: ctx.count], tensors[ctx.count :]
            needed = [tensor for tensor, is_needed in zip(inputs, ctx.needs_grad, strict=True) if is_needed]
            grads = torch.autograd.grad(ctx.formula(*inputs), needed, grad_outputs, create_graph=True)
            upstream = [grad for grad, is_needed in zip(grad_grads, ctx.needs_grad, strict=True) if is_needed]
            second = torch.autograd.grad(grads, tensors, upstream, create_graph=again, allow_unused=True)
        return None, None, None, *second


def differentiable_once(operator: str, depends_on: Sequence[torch.Tensor | None], grads: Gradients) -> Gradients:
    """``grads``, of which any derivative is refused.

    Args:
        operator: its name, for the message.
        depends_on: tensors that lead to everything that the gradients depend on.
        grads: what the operator's kernels computed, for each input.
    """
    if not torch.is_grad_enabled():
        return grads
    return _DifferentiableOnce.apply(operator, grads, *depends_on)


class _DifferentiableOnce(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, operator: str, grads: Gradients, *_: torch.Tensor | None) -> Gradients:
        ctx.operator = operator
        return grads

    @staticmethod
    def backward(ctx: Any, *_: torch.Tensor) -> tuple[None, ...]:
        raise NotImplementedError(
            f"vestcl.{ctx.operator} has no second derivatives: leave out create_graph=True, detach its gradients, or "
            f"use vestcl.reference.{ctx.operator}, which is plain torch"
        )

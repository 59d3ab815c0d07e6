"""How close is close: one table by dtype, and the comparisons that use it.

Errors are relative, in the Euclidean norm over a whole array. The reference is always the reference implementation in
float64, on the very numbers that the operator got, so that an error is the operator's own.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch

#: float32: 16 roundings of 2^-23. float64: far above rounding, far below any mistake in a formula.
TOLERANCE: Final = {torch.float32: 2e-6, torch.float64: 1e-11}


def relative_error(got: torch.Tensor | np.ndarray, wanted: torch.Tensor) -> float:
    """|got - wanted| / |wanted|; zero if both are zero."""
    got, wanted = torch.as_tensor(got).detach().double(), wanted.detach().double()
    assert got.shape == wanted.shape, f"shape {list(got.shape)} instead of {list(wanted.shape)}"
    difference = float((got - wanted).norm())
    return difference / float(wanted.norm()) if difference else 0.0


def assert_close(got: torch.Tensor | np.ndarray, wanted: torch.Tensor, what: str = "output") -> None:
    """Within the tolerance of what ``got`` is computed in."""
    limit = TOLERANCE[torch.as_tensor(got).dtype]
    error = relative_error(got, wanted)
    assert error <= limit, f"{what}: relative error {error:.2e}, allowed {limit:.0e}"


def assert_like_reference(operator: Callable[..., Any], reference: Callable[..., Any], **arguments: Any) -> None:
    """Compare outputs, and gradients of a random linear loss for every argument that requires grad."""
    exact = {name: _as_double(value) for name, value in arguments.items()}
    got, wanted = _as_tuple(operator(**arguments)), _as_tuple(reference(**exact))
    weights = [torch.randn_like(output) for output in got]
    for i, (output, truth) in enumerate(zip(got, wanted, strict=True)):
        assert_close(output, truth, f"output {i}")
    asked = [name for name, value in arguments.items() if isinstance(value, torch.Tensor) and value.requires_grad]
    if asked:
        grads = torch.autograd.grad(got, [arguments[name] for name in asked], weights)
        truths = torch.autograd.grad(wanted, [exact[name] for name in asked], [w.double() for w in weights])
        for name, grad, truth in zip(asked, grads, truths, strict=True):
            assert_close(grad, truth, f"grad_{name}")


def _as_double(value: Any) -> Any:
    if isinstance(value, torch.Tensor) and value.is_floating_point():
        return value.detach().double().requires_grad_(value.requires_grad)
    return value


def _as_tuple(outputs: Any) -> tuple[torch.Tensor, ...]:
    return outputs if isinstance(outputs, tuple) else (outputs,)

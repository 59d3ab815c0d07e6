"""What every operator does with its arguments before a kernel sees them: check, convert, and split into work-items.

An operator opens with one `check_arguments`, which binds the letters of its shapes and refuses everything else::

    sizes = check(depth=(depth, "B 1 H W"), K=(K, "B 3 3"))
    output = np.empty((sizes["B"], sizes["H"] * sizes["W"], 3), as_array(depth).dtype)
"""

import functools
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
import torch
from torch.autograd import forward_ad

from vestcl import opencl

Array = TypeVar("Array", torch.Tensor, np.ndarray)
"""A torch tensor or a NumPy array; an operator answers in the kind that it was asked in."""

#: Ends the shape of an argument that may be None.
OPTIONAL: Final = " | None"

#: Points per work-item on a CPU: long enough that its start (about 0.1 us) does not show, short
#: enough that one frame (2e5 points) keeps 64 cores busy.
CPU_CHUNK: Final = 2048


def check_arguments(**arguments: tuple[Any, str]) -> dict[str, int]:
    """Check operator arguments against their shapes; the sizes that the letters denote.

    Args:
        **arguments: name = (value, shape), with the shape as words: a number is that size, a letter must mean the
            same size in all arguments (``depth=(depth, "B 1 H W")``). "| None" at the end lets None pass.

    Returns:
        letter -> size.

    Raises:
        ValueError: a value is not a dense float32 or float64 torch CPU tensor or NumPy array, is of another kind or
            dtype than the first one, does not fit its shape, or is differentiated as in `require_ordinary`.
    """
    first = next(iter(arguments))
    sizes: dict[str, int] = {}
    owners: dict[str, str] = {}
    for name, (value, shape) in arguments.items():
        if value is None and shape.endswith(OPTIONAL):
            continue
        _check_value(name, value)
        _check_same_kind(name, value, first, arguments[first][0])
        _check_shape(name, list(value.shape), shape.removesuffix(OPTIONAL).split(), sizes, owners)
    return sizes


def _check_value(name: str, value: Any) -> None:
    if not isinstance(value, torch.Tensor | np.ndarray):
        raise ValueError(f"`{name}` must be a torch tensor or a NumPy array, got {type(value).__name__}")
    if isinstance(value, torch.Tensor) and value.device.type != "cpu":
        raise ValueError(f"`{name}` must be on the CPU (OpenCL takes it from there), got device {value.device}")
    if isinstance(value, torch.Tensor) and value.layout != torch.strided:
        raise ValueError(f"`{name}` must be a dense tensor, got layout {value.layout}")
    if _dtype(value) not in ("float32", "float64"):
        raise ValueError(f"`{name}` must be float32 or float64, got {_dtype(value)}")
    require_ordinary(name, value)


def _check_same_kind(name: str, value: Any, first: str, leader: Any) -> None:
    if isinstance(value, torch.Tensor) != isinstance(leader, torch.Tensor):
        raise ValueError(f"`{name}` must be {_kind(leader)} as `{first}` is, got {_kind(value)}")
    if _dtype(value) != _dtype(leader):
        raise ValueError(f"`{name}` must be {_dtype(leader)} as `{first}` is, got {_dtype(value)}")


def _check_shape(name: str, got: list[int], words: list[str], sizes: dict[str, int], owners: dict[str, str]) -> None:
    """Compare one shape, and bind the letters that it is the first to use."""
    shape = f"[{', '.join(words)}]"
    if len(got) != len(words):
        raise ValueError(f"`{name}` must be {shape}, got {got}")
    for word, size in zip(words, got, strict=True):
        if word.isdigit():
            if size != int(word):
                raise ValueError(f"`{name}` must be {shape}, got {got}")
        elif size != sizes.setdefault(word, size):
            raise ValueError(f"`{name}` must be {shape} with {word} = {sizes[word]} as in `{owners[word]}`, got {got}")
        else:
            owners.setdefault(word, name)


def _dtype(value: torch.Tensor | np.ndarray) -> str:
    """The dtype's name; a byte order that is not the machine's is part of it."""
    return _name(value.dtype)


@functools.cache
def _name(dtype: torch.dtype | np.dtype[Any]) -> str:
    if isinstance(dtype, torch.dtype):
        return str(dtype).removeprefix("torch.")
    return dtype.name if dtype.isnative else dtype.str


def _kind(value: torch.Tensor | np.ndarray) -> str:
    return "a torch tensor" if isinstance(value, torch.Tensor) else "a NumPy array"


def check_starts(
    name: str, starts: torch.Tensor | np.ndarray, like: torch.Tensor | np.ndarray, total: int
) -> np.ndarray:
    """A ragged list's ``<name>_starts`` as a contiguous int64 array [n + 1].

    Args:
        name: the argument's name, for the messages.
        starts: object i owns the entries starts[i]:starts[i + 1].
        like: the argument whose kind (torch or NumPy) ``starts`` must have.
        total: number of entries.

    Raises:
        ValueError: not int64 [n + 1] on the CPU, of another kind than ``like``, or not rising from 0 to ``total``.
    """
    if not isinstance(starts, torch.Tensor if isinstance(like, torch.Tensor) else np.ndarray):
        raise ValueError(f"`{name}` must be {_kind(like)}, got {type(starts).__name__}")
    if isinstance(starts, torch.Tensor) and starts.device.type != "cpu":
        raise ValueError(f"`{name}` must be on the CPU, got device {starts.device}")
    if _dtype(starts) != "int64" or len(starts.shape) != 1 or starts.shape[0] < 1:
        raise ValueError(f"`{name}` must be int64 [B + 1], got {_dtype(starts)} {list(starts.shape)}")
    array = as_array(starts)
    if array[0] != 0 or array[-1] != total or (np.diff(array) < 0).any():
        raise ValueError(f"`{name}` must rise from 0 to {total}, got {array.tolist() if len(array) <= 16 else array}")
    return array


def require_ordinary(name: str, value: torch.Tensor | np.ndarray | None) -> None:
    """Refuse a tensor of a transform or a tracer, which kernels would not notice or could not read.

    Raises:
        ValueError: a transform of torch.func is active, ``value`` holds no numbers, or it carries a tangent of
            forward-mode derivatives.
    """
    if not isinstance(value, torch.Tensor):
        return
    if torch._C._are_functorch_transforms_active() or torch._C._is_tracing() or not _holds_numbers(value):
        raise ValueError(
            f"`{name}` must be used outside torch.func's transforms, vectorised Jacobians and tracing: pass a batch "
            f"instead of using vmap, use torch.autograd.grad instead of torch.func.grad, or take the operator of "
            f"vestcl.reference (plain torch)"
        )
    if forward_ad.unpack_dual(value).tangent is not None:
        raise ValueError(
            f"`{name}` must carry no forward-mode tangent (operators have reverse-mode gradients): use "
            f"torch.autograd.grad, or take the operator of vestcl.reference (plain torch)"
        )


def _holds_numbers(value: torch.Tensor) -> bool:
    """Whether there is memory on the CPU behind a tensor: wrappers of batches or of other tensors have none."""
    try:
        return value.untyped_storage().device.type == "cpu"
    except (NotImplementedError, RuntimeError):
        return False


def require_no_grad(name: str, value: torch.Tensor | np.ndarray | None) -> None:
    """Refuse an argument that expects a gradient which its operator does not compute.

    Raises:
        ValueError: gradients are recorded, and ``value`` asks for one.
    """
    if isinstance(value, torch.Tensor) and value.requires_grad and torch.is_grad_enabled():
        raise ValueError(f"`{name}` must not require grad (no gradient is computed for it); pass {name}.detach()")


def as_array(value: torch.Tensor | np.ndarray) -> np.ndarray:
    """``value`` as a C-contiguous, aligned NumPy array: the same memory wherever it is that already."""
    if isinstance(value, torch.Tensor):
        return value.detach().resolve_neg().contiguous().numpy()
    return np.require(value, requirements=("C", "A", "E"))


class WorkItems(NamedTuple):
    """How ``count`` equal items are divided: work-item i takes [i * chunk, min((i + 1) * chunk, count))."""

    chunk: np.int32
    items: int
    """Global size; on a GPU rounded up to whole groups, so the last ones may have nothing to do."""
    group: int
    """Local size."""


def work_items(session: opencl.Session, count: int) -> WorkItems:
    """Work-items for ``count`` independent items: a chunk each on a CPU, one each on a GPU.

    For kernels whose work-items compute independent results; a sum has its own split, the same on all devices.
    """
    if session.mapping == "tile":
        return WorkItems(np.int32(CPU_CHUNK), -(-count // CPU_CHUNK), 1)
    return WorkItems(np.int32(1), *opencl.grouped(session, count))

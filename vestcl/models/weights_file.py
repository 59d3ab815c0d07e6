"""State dicts from files: PyTorch's own and safetensors, neither of which runs code; and what is checked in them."""

import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

#: Parts of a parameter's name that wrappers add: `DistributedDataParallel` and similar, and `torch.compile`.
_WRAPPERS: Final = ("module", "_orig_mod")

#: Names that an error lists before it only counts them.
_NAMES_SHOWN: Final = 3


def read_state_dict(path: Path | str) -> dict[str, torch.Tensor]:
    """name -> tensor on the CPU, from ``*.safetensors`` or else what ``torch.save`` wrote; names as of `unwrapped`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is damaged, or holds anything but a flat dict of tensors.
    """
    path = Path(path)
    read = _read_safetensors if path.suffix == ".safetensors" else _read_torch
    state = read(path)
    flat = isinstance(state, dict) and all(isinstance(name, str) for name in state)
    if not flat or not all(isinstance(value, torch.Tensor) for value in state.values()):
        kinds = sorted({type(v).__name__ for v in state.values()}) if isinstance(state, dict) else type(state).__name__
        raise ValueError(f"`path` must hold a state dict (name -> tensor), got {kinds} in {path}")
    return unwrapped(state, path)


def unwrapped(state: Mapping[str, torch.Tensor], path: Path | str) -> dict[str, torch.Tensor]:
    """``state`` without what wrappers add to names: "module._orig_mod.conv1.weight" -> "conv1.weight".

    Args:
        state: name -> tensor. A wrapper's part may be anywhere in a name, as often as it was wrapped.
        path: the file that errors name.

    Raises:
        ValueError: two names become one.
    """
    names = {name: ".".join(part for part in name.split(".") if part not in _WRAPPERS) for name in state}
    found = {plain: state[name] for name, plain in names.items()}
    if len(found) < len(state):
        plain = next(plain for plain in found if list(names.values()).count(plain) > 1)
        twice = [name for name in names if names[name] == plain]
        raise ValueError(f"`path` must hold each weight once, got {' and '.join(twice)} in {path}")
    return found


def check_finite(state: Mapping[str, torch.Tensor], path: Path | str, argument: str = "path", remedy: str = "") -> None:
    """Refuse weights that are NaN or infinite in float32, which is what networks are loaded in.

    Args:
        state: name -> tensor; those that are not floating point are not looked at.
        path: the file that the error names.
        argument: the argument that the error names.
        remedy: the end of the error's message.

    Raises:
        ValueError: one of the numbers is not finite.
    """
    for name, tensor in state.items():
        if tensor.is_floating_point():
            numbers = tensor.detach().float()
            broken = int((~numbers.isfinite()).sum())
            if broken:
                kind = "NaN" if numbers.isnan().any() else "infinity"
                got = f"{kind} in {name} ({broken} of {tensor.numel()} numbers)"
                raise ValueError(f"`{argument}` must hold finite weights, got {got} of {path}{remedy}")


def misfit(state: Mapping[str, torch.Tensor], wanted: Mapping[str, torch.Tensor]) -> str | None:
    """Why ``state`` can't be loaded in place of ``wanted``, in one line; None where names and shapes are the same."""
    if missing := [name for name in wanted if name not in state]:
        return f"lacks {some_of(missing)}"
    if strange := [name for name in state if name not in wanted]:
        return f"has {some_of(strange)}"
    shapes = {name: (list(tensor.shape), list(state[name].shape)) for name, tensor in wanted.items()}
    wrong = [f"{name} is {got}, not {want}" for name, (want, got) in shapes.items() if want != got]
    return some_of(wrong) if wrong else None


def some_of(names: Sequence[str]) -> str:
    """The first few, and how many more."""
    rest = len(names) - _NAMES_SHOWN
    return "; ".join(names[:_NAMES_SHOWN]) + (f"; and {rest} more" if rest > 0 else "")


def _read_torch(path: Path) -> Any:
    with path.open("rb") as file:
        try:
            return torch.load(file, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, KeyError, ValueError) as error:
            reason = str(error).partition("\n")[0]
            raise ValueError(f"`path` must be a PyTorch file that holds only tensors, got {path} ({reason})") from error


def _read_safetensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        return load_file(path)
    except SafetensorError as error:
        raise ValueError(f"`path` must be a safetensors file of weights, got {path} ({error})") from error

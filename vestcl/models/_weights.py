"""State dicts from files: PyTorch's own and safetensors, neither of which runs code."""

import pickle
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file


def read_state_dict(path: Path | str) -> dict[str, torch.Tensor]:
    """name -> tensor on the CPU, from ``*.safetensors`` or else what ``torch.save`` wrote.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is damaged, or holds anything but a flat dict of tensors.
    """
    path = Path(path)
    read = _read_safetensors if path.suffix == ".safetensors" else _read_torch
    state = read(path)
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        kinds = sorted({type(v).__name__ for v in state.values()}) if isinstance(state, dict) else type(state).__name__
        raise ValueError(f"`path` must hold a state dict (name -> tensor), got {kinds} in {path}")
    return state


def _read_torch(path: Path) -> Any:
    with path.open("rb") as file:
        try:
            return torch.load(file, map_location="cpu", weights_only=True)
        except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, KeyError, ValueError) as error:
            reason = str(error).partition("\n")[0]
            raise ValueError(f"`path` must be a PyTorch file of tensors alone, got {path} ({reason})") from error


def _read_safetensors(path: Path) -> dict[str, torch.Tensor]:
    try:
        return load_file(path)
    except SafetensorError as error:
        raise ValueError(f"`path` must be a safetensors file of weights, got {path} ({error})") from error

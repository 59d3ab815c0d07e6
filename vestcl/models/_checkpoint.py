"""A model in one file: weights in safetensors, and in its metadata the whole configuration as JSON."""

import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from vestcl.io import atomic
from vestcl.models._weights import check_finite, unwrapped
from vestcl.models.config import ModelConfig

#: The metadata's entry that holds the configuration.
KEY: Final = "vestcl.config"


def write_checkpoint(path: Path | str, config: ModelConfig, state: Mapping[str, torch.Tensor]) -> None:
    """Write both to ``path``, which is the old file or the new one, never half of it.

    The file has the umask's rights; safetensors' own writer leaves it to its owner only.

    Raises:
        ValueError: the folder can't be made.
        OSError: the file can't be written.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in state.items()}
    atomic.write_bytes(path, save(tensors, metadata={KEY: json.dumps(dataclasses.asdict(config))}))


def read_checkpoint(path: Path | str) -> tuple[ModelConfig, dict[str, torch.Tensor]]:
    """What `write_checkpoint` wrote, names as of `unwrapped`; runs no code from the file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, no safetensors file, without a configuration that this version knows, or with weights
            that are not finite.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"no model at {path}")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no iterable by itself
    except SafetensorError as error:
        raise ValueError(f"`path` must be a safetensors file, got {path} ({error})") from error
    if KEY not in metadata:
        raise ValueError(f"`path` must hold a configuration (`Forecaster.save` writes one), got none in {path}")
    state = unwrapped(state, path)
    check_finite(state, path)
    try:
        return _built(ModelConfig, json.loads(metadata[KEY])), state
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"`path` must hold a configuration of this version, got {path} ({error})") from error


def _built(kind: Any, value: Any) -> Any:
    """``value``, as JSON gave it, as what the annotation ``kind`` says: dataclasses, None or one, and tuples."""
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        if value is None:
            return None
        (kind,) = (one for one in typing.get_args(kind) if one is not type(None))
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        kinds = typing.get_type_hints(kind)
        if not isinstance(value, dict) or (unknown := sorted(value.keys() - kinds.keys())):
            raise ValueError(f"{kind.__name__} has no {unknown if isinstance(value, dict) else value!r}")
        return kind(**{name: _built(kinds[name], part) for name, part in value.items()})
    return tuple(value) if isinstance(value, list) else value

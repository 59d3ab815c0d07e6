"""A model in one file: weights in safetensors; in its metadata, as JSON, its configuration and training clips."""

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
from vestcl.models.config import ModelConfig
from vestcl.models.weights_file import check_finite, unwrapped

#: The metadata's entry that holds the configuration, and the one that holds the clips that the model was trained on.
KEY: Final = "vestcl.config"
TRAINED_ON: Final = "vestcl.trained_on"

#: Bytes of the header's length at a safetensors file's start, and what the header is padded to.
_LENGTH: Final = 8

Frames = Mapping[str, tuple[int, int]]
"""By clip, the first and the last frame."""


def write_checkpoint(
    path: Path | str, config: ModelConfig, state: Mapping[str, torch.Tensor], trained_on: Frames | None = None
) -> None:
    """Write all to ``path``, which is the old file or the new one, never half of it; the same bytes each time.

    The file has the umask's rights; safetensors' own writer leaves it to its owner only.

    Args:
        path: the file.
        config: of the model.
        state: its weights.
        trained_on: the frames that training has shown it; None where that is not known.

    Raises:
        ValueError: the folder can't be made.
        OSError: the file can't be written.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in state.items()}
    metadata = {KEY: json.dumps(dataclasses.asdict(config))}
    if trained_on is not None:
        metadata[TRAINED_ON] = json.dumps(trained_on, sort_keys=True)
    atomic.write_bytes(path, _in_order(save(tensors, metadata=metadata)))


def read_trained_on(path: Path | str) -> dict[str, tuple[int, int]] | None:
    """By clip, the first and the last frame that training has shown the model; None where its file has no record.

    Raises:
        FileNotFoundError: no such file.
        ValueError: damaged, or no safetensors file.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"no model at {path}")
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(TRAINED_ON)
        return None if text is None else {name: (int(a), int(b)) for name, (a, b) in json.loads(text).items()}
    except (SafetensorError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"`path` must be a safetensors file of a model, got {path} ({error})") from error


def _in_order(content: bytes) -> bytes:
    """A safetensors file with its metadata sorted: they come in another order each time."""
    end = _LENGTH + int.from_bytes(content[:_LENGTH], "little")
    header = json.loads(content[_LENGTH:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % _LENGTH)
    return b"".join((len(text).to_bytes(_LENGTH, "little"), text, memoryview(content)[end:]))


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

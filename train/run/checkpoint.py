"""A run's state on disk, whole or not at all: whatever happens while one is written, the one before it stays.

    <out>/checkpoints/step-00001234/    `steps` updates are done
        model.safetensors               weights with their configuration: `Forecaster.load` reads it
        ema.safetensors                 their EMA, likewise, where there is one
        state.pt                        the rest, plain containers and tensors: read with ``weights_only=True``
        manifest.json                   format, and size and SHA-256 of each file

A checkpoint is written under a hidden name, flushed to the disk and then renamed, so that a folder ``step-*`` is
complete unless the disk itself lost something; sizes and hashes show it. The latest one is found by listing: there is
no pointer that could be wrong. One process writes to a run's folder, any number may read.
"""

import io
import json
import os
import pickle
import platform
import re
import secrets
import shutil
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from safetensors import SafetensorError

import vestcl
from train.run.hashes import known_sha256, sha256
from train.run.rng import restore_rng as restore_rng
from train.run.rng import rng_state
from vestcl.models.checkpoint import read_checkpoint, write_checkpoint
from vestcl.models.config import ModelConfig

#: Version of the layout above; other versions are not read.
FORMAT: Final = 1

_MODEL: Final = "model.safetensors"
_EMA: Final = "ema.safetensors"
_STATE: Final = "state.pt"
_MANIFEST: Final = "manifest.json"

_NAME: Final = re.compile(r"step-(\d{8,})")

#: What reading a checkpoint raises when a file is absent, torn or of another version's making.
_DAMAGE: Final = (
    OSError, ValueError, RuntimeError, LookupError, TypeError, AttributeError, EOFError, pickle.UnpicklingError,
)  # fmt: skip

_MB: Final = 1e6


class CheckpointError(RuntimeError):
    """A checkpoint could not be written, or none that is there can be read."""


def package_versions() -> dict[str, str]:
    """Versions of the packages that a run's numbers depend on."""
    return {
        "python": platform.python_version(), "torch": str(torch.__version__), "numpy": np.__version__,
        "vestcl": vestcl.__version__,
    }  # fmt: skip


@dataclass(frozen=True, eq=False)
class TrainingState:
    """All that a run needs to resume as if it had never stopped."""

    step: int
    """Updates done, in all stages; the data's position follows from it."""
    config: dict[str, Any]
    """The run's, from `train.settings.config.to_dict`."""
    model_config: ModelConfig
    model: Mapping[str, torch.Tensor]
    """Weights."""
    ema: Mapping[str, torch.Tensor] | None
    """Their EMA."""
    optimiser: dict[str, Any]
    """Its state dict, as are the scheduler's."""
    scheduler: dict[str, Any]
    rng: dict[str, Any] = field(default_factory=rng_state)
    versions: dict[str, str] = field(default_factory=package_versions)
    extra: dict[str, Any] = field(default_factory=dict)
    """Plain containers, numbers, strings and tensors of the caller's."""
    trained_on: dict[str, tuple[int, int]] = field(default_factory=dict)
    """By clip, the first and the last frame that was shown; the models' files have it, too."""
    recent: list[dict[str, float]] = field(default_factory=list)
    """`train.run.report.Reporter.recent`: the next row of log.jsonl is a mean over these updates, too."""


def list_checkpoints(out: Path | str) -> list[Path]:
    """Folders of the checkpoints of a run, newest first, damaged ones included; none where there is no run.

    Args:
        out: folder of the run.
    """
    folder = Path(out) / "checkpoints"
    found = [path for path in folder.iterdir() if _NAME.fullmatch(path.name)] if folder.is_dir() else []
    return sorted(found, key=_step, reverse=True)


def save(out: Path | str, state: TrainingState, keep: int = 3) -> Path:
    """Write ``state`` beneath ``out`` and remove all that is older than the newest ``keep`` intact checkpoints.

    Once the new one is there, nothing about the old ones is an error: what can't be removed is named in a warning.

    Args:
        out: folder of the run; made where it does not exist.
        state: of it. An intact checkpoint of the same step and the same weights is kept and not written again.
        keep: 2 or more, so that a damaged one has one before it.

    Returns:
        The checkpoint's folder.

    Raises:
        CheckpointError: it could not be written, or there is one of that step with other weights. All checkpoints that
            were there are there still.
        ValueError: ``keep`` is below 2, or ``state`` holds objects that are not plain.
    """
    if keep < 2:
        raise ValueError(f"`keep` must be 2 or more, got {keep}")
    folder = Path(out) / "checkpoints"
    path = folder / f"step-{state.step:08d}"
    rest = _packed(state)
    wanted = len(rest) + sum(t.nbytes for weights in (state.model, state.ema or {}) for t in weights.values())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(folder)
        temporary = folder / f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}"
        temporary.mkdir()
        try:
            _write(temporary, state, rest)
            _publish(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except (OSError, SafetensorError, ValueError) as error:
        raise CheckpointError(_not_written(path, wanted, error)) from error
    try:
        _prune(out, keep)
    except OSError as error:
        warnings.warn(f"old checkpoints in {folder} can't be removed: {error.strerror or error}", stacklevel=2)
    return path


def load_latest(out: Path | str) -> TrainingState | None:
    """The newest intact checkpoint; a warning names each damaged one that is newer, and what is wrong with it.

    Args:
        out: folder of the run.

    Returns:
        Its state, tensors on the CPU, or None where there is no checkpoint at all.

    Raises:
        CheckpointError: there are checkpoints, and all of them are damaged.
    """
    damaged = []
    for path in list_checkpoints(out):
        try:
            return _read(path)
        except _DAMAGE as error:  # noqa: PERF203 - one round, but for damage
            damaged.append(f"{path}: {str(error).splitlines()[0]}")
            warnings.warn(f"damaged checkpoint, the one before it is used: {damaged[-1]}", stacklevel=2)
    if damaged:
        raise CheckpointError("\n  ".join(["no checkpoint can be read:", *damaged]))
    return None


def _step(path: Path) -> int:
    return int(path.name.removeprefix("step-"))


def _packed(state: TrainingState) -> bytes:
    """All but the weights, as `torch.save` writes it; read back once, for a checkpoint that can't be read is none."""
    names = ("step", "config", "optimiser", "scheduler", "rng", "versions", "extra", "recent", "trained_on")
    file = io.BytesIO()
    torch.save({name: getattr(state, name) for name in names}, file)
    try:
        _unpacked(file)
    except pickle.UnpicklingError as error:
        reason = next((line.strip() for line in str(error).splitlines() if "Unsupported" in line), str(error))
        raise ValueError(f"`state` must hold plain containers, numbers, strings and tensors ({reason})") from error
    return file.getvalue()


def _unpacked(file: io.BytesIO) -> dict[str, Any]:
    file.seek(0)
    return torch.load(file, map_location="cpu", weights_only=True)


def _write(folder: Path, state: TrainingState, rest: bytes) -> None:
    """All files of a checkpoint, on the disk when this returns."""
    write_checkpoint(folder / _MODEL, state.model_config, state.model, state.trained_on)
    if state.ema is not None:
        write_checkpoint(folder / _EMA, state.model_config, state.ema, state.trained_on)
    (folder / _STATE).write_bytes(rest)
    files = {file.name: {"bytes": file.stat().st_size, "sha256": known_sha256(file)} for file in
             sorted(folder.iterdir())}  # fmt: skip
    (folder / _MANIFEST).write_text(json.dumps({"format": FORMAT, "files": files}, indent=1), encoding="utf-8")
    for path in (*folder.iterdir(), folder):
        _flush(path)


def _publish(temporary: Path, path: Path) -> None:
    """Give a complete checkpoint its name, unless it has been there before."""
    if path.exists():
        try:
            before = _verified(path)
        except _DAMAGE:
            _remove(path)
        else:
            if before[_MODEL] != _verified(temporary, known_sha256)[_MODEL]:
                raise ValueError("a checkpoint of that step with other weights is there; choose another `out`")
            return
    temporary.rename(path)
    _flush(path.parent)


def _prune(out: Path | str, keep: int) -> None:
    """Remove what is older than the newest ``keep`` intact checkpoints; hidden first, so that none is seen in part."""
    intact = 0
    for path in list_checkpoints(out):
        if intact >= keep:
            _remove(path)
            continue
        try:
            _verified(path, known_sha256)
        except _DAMAGE:
            continue
        intact += 1


def _remove_leftovers(folder: Path) -> None:
    """What a process left that was killed while it wrote or removed a checkpoint."""
    for path in folder.glob(".step-*"):
        _remove(path)


def _remove(path: Path) -> None:
    """Hidden first, so that it is not seen in part; where that fails, a warning: it costs disk space, not the run."""
    try:
        hidden = path
        if not path.name.startswith("."):
            hidden = path.with_name(f".{path.name}.{secrets.token_hex(4)}.old")
            path.rename(hidden)
        if hidden.is_dir():
            shutil.rmtree(hidden)
        else:
            hidden.unlink()
    except OSError as error:
        warnings.warn(f"old checkpoint {path} can't be removed: {error.strerror or error}", stacklevel=2)


def _read(path: Path) -> TrainingState:
    files = _verified(path)
    rest = _unpacked(io.BytesIO((path / _STATE).read_bytes()))
    model_config, model = read_checkpoint(path / _MODEL)
    ema = read_checkpoint(path / _EMA)[1] if _EMA in files else None
    return TrainingState(model_config=model_config, model=model, ema=ema, **rest)


def _verified(path: Path, digest: Callable[[Path], str] = sha256) -> dict[str, Any]:
    """The manifest's files, checked by size and hash.

    Raises:
        OSError, ValueError, KeyError, TypeError, AttributeError: they are not.
    """
    manifest = json.loads((path / _MANIFEST).read_text(encoding="utf-8"))
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ValueError(f"{_MANIFEST} must be of format {FORMAT}, got {str(manifest)[:50]!r}")
    if absent := {_MODEL, _STATE} - manifest["files"].keys():
        raise ValueError(f"{_MANIFEST} must list {' and '.join(sorted(absent))}")
    for name, wanted in manifest["files"].items():
        size = (path / name).stat().st_size
        if size != wanted["bytes"]:
            raise ValueError(f"{name} must have {wanted['bytes']} bytes, got {size}")
        if digest(path / name) != wanted["sha256"]:
            raise ValueError(f"{name} is not what was written: its SHA-256 differs")
    return dict(manifest["files"])


def _flush(path: Path) -> None:
    """To the disk: a file's content, or a folder's names."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _not_written(path: Path, wanted: int, error: Exception) -> str:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    there = next(folder for folder in path.absolute().parents if folder.is_dir())
    free = shutil.disk_usage(there).free
    sizes = f"it takes {wanted / _MB:.1f} MB, {free / _MB:.1f} MB are free"
    return f"checkpoint {path} could not be written: {reason} ({sizes}); those before it are kept"

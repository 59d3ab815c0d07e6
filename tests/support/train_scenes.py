"""A small street, prepared, and a small network to train on it: here, or in processes that die when they are asked to.

As a script it is `train.fit` that knows the small network: ``python tests/support/train_scenes.py run.yaml
[--resume]``.
"""

import os
import signal
import sys
from pathlib import Path
from typing import Any, Final

import pytest
import torch
import yaml
from forecaster_scenes import SMALL, TINY
from processes import Process

from train import fit
from train.run import checkpoint
from train.run.report import Reporter
from train.settings.config import Config, from_dict
from vestcl.data import Street, street_clip
from vestcl.models import config
from vestcl.prepare.clip import prepare_clip

HEIGHT, WIDTH = 48, 160

MODELS: Final = {**config.CONFIGS, "small": SMALL, "small-painting": TINY}

#: When a process gets a signal: see `_die_at`. In the environment for those that torchrun starts.
MOMENT: Final = "VESTCL_TEST_MOMENT"

#: A run of two stages, 4 + 4 steps, a checkpoint every second one.
SETTINGS: Final[dict[str, Any]] = {
    "name": "small",
    "model": "small",
    "data": {"crop": [24, 64], "horizons": [0.5, 0.5], "right": 0.5, "colour": 0.2},
    "stages": [
        {"name": "ego", "steps": 4, "batch": 2, "train": ["encoder", "ego_motion", "refine"], "learning_rate": 1e-3},
        {"name": "all", "steps": 4, "batch": 2, "learning_rate": 1e-3, "warm_up": 1},
    ],
    "loss": {"perceptual": {"kind": "none"}, "ssim": 0.2, "pose": {"rotation": 1.0, "translation": 0.05}},
    "optimiser": {"ema": 0.9},
    "run": {"checkpoint_every": 2, "log_every": 1, "image_every": 0, "threads": 1, "keep": 9},
}


def prepare_street(folder: Path, frames: int = 5, height: int = HEIGHT, width: int = WIDTH, seed: int = 3) -> Path:
    """A street's first frames, prepared."""
    prepare_clip(street_clip(Street.generate(seed), frames, height, width), folder / f"street-{seed}")
    return folder


def street(factory: pytest.TempPathFactory) -> Path:
    """The same street for all modules of a session."""
    folder = factory.getbasetemp() / "street"
    return folder if folder.exists() else prepare_street(folder)


def settings(cache: Path, out: Path, **changes: Any) -> dict[str, Any]:
    """`SETTINGS` on a cache; mappings among the changes are merged into what is there."""
    merged = {**SETTINGS, "out": str(out), "data": {**SETTINGS["data"], "train": [str(cache)]}}
    for name, value in changes.items():
        merged[name] = {**merged[name], **value} if isinstance(value, dict) else value
    return merged


def configured(cache: Path, out: Path, **changes: Any) -> Config:
    return from_dict(settings(cache, out, **changes))


def write_yaml(path: Path, cache: Path, out: Path, **changes: Any) -> Path:
    path.write_text(yaml.safe_dump(settings(cache, out, **changes)))
    return path


# ---------------------------------------------------------------- processes


class Processes:
    """Runs of the command, one after the other."""

    def __init__(self, folder: Path) -> None:
        self._log, self.output = folder / "output.txt", ""

    def train(self, *arguments: str, moment: str = "") -> int:
        """`python -m train.fit` with these arguments, and a signal at that moment; what it prints is ``output``."""
        self._log.unlink(missing_ok=True)
        process = Process(self._log, main, list(arguments), environment={MOMENT: moment})
        status, self.output = process.wait(), process.output
        return status


def main(arguments: list[str]) -> None:
    """`train.fit` with the small networks, and with a signal where the environment says so."""
    config.CONFIGS = MODELS  # type: ignore[misc]
    if os.environ.get(MOMENT):
        _die_at(*os.environ[MOMENT].split())
    sys.exit(fit.main(arguments))


def _die_at(name: str, what: str, step: str, rank: str = "0") -> None:
    """The signal ``name`` at ``step``: after its update ("update"), while its checkpoint is written ("write"), when all
    of that is on the disk ("publish"), or when it has its name ("prune")."""
    wanted, number = int(step), getattr(signal, name)
    if os.environ.get("RANK", "0") != rank or os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") != "0":
        return
    if what == "update":
        _at_update(wanted, number)
    else:
        attribute = {"write": "write_checkpoint", "publish": "_publish", "prune": "_prune"}[what]
        _at_checkpoint(attribute, wanted, number)


def _at_update(wanted: int, number: int) -> None:
    updated = Reporter.updated

    def dying(self: Reporter, step: int, *arguments: Any) -> None:
        updated(self, step, *arguments)
        if step == wanted:
            os.kill(os.getpid(), number)

    Reporter.updated = dying  # type: ignore[assignment, method-assign]


def _at_checkpoint(attribute: str, wanted: int, number: int) -> None:
    save, original, step = checkpoint.save, getattr(checkpoint, attribute), [0]

    def saving(out: Path | str, state: checkpoint.TrainingState, keep: int = 3) -> Path:
        step[0] = state.step
        return save(out, state, keep)

    def dying(*arguments: Any) -> None:
        if attribute == "write_checkpoint":  # one of two files is there
            original(*arguments)
        if step[0] == wanted:
            os.kill(os.getpid(), number)
        if attribute != "write_checkpoint":
            original(*arguments)

    checkpoint.save = saving
    setattr(checkpoint, attribute, dying)


# ---------------------------------------------------------------- what a run left


def weights(out: Path, name: str = "model") -> dict[str, torch.Tensor]:
    """Of the last checkpoint: "model" or "ema"."""
    state = checkpoint.load_latest(out)
    assert state is not None
    return dict(getattr(state, name))


def steps(out: Path) -> list[int]:
    """Of the checkpoints, newest first."""
    return [int(path.name.removeprefix("step-")) for path in checkpoint.list_checkpoints(out)]


if __name__ == "__main__":
    main(sys.argv[1:])

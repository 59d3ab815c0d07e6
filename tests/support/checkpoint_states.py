"""Small states of a run that checkpoints are tested on."""

from pathlib import Path
from typing import Any

import torch
from forecaster_scenes import TINY

from train.run.checkpoint import TrainingState, list_checkpoints
from train.settings.config import Config, from_dict, to_dict

SETTINGS: dict[str, Any] = {
    "name": "tiny",
    "out": "runs/tiny",
    "data": {"train": ["streets"]},
    "loss": {"perceptual": {"kind": "none"}},
    "stages": [{"name": "first", "steps": 10}, {"name": "second", "steps": 20, "data": {"flip": False}}],
}


def configured(**changes: Any) -> Config:
    return from_dict({**SETTINGS, **changes})


def state_of(step: int, seed: int = 0, **fields: Any) -> TrainingState:
    """Small, with other numbers for another step or seed."""
    generator = torch.Generator().manual_seed(1000 * seed + step)
    weights = {name: torch.randn(50, 3, generator=generator) for name in ("a.weight", "b.weight")}
    ema = {name: tensor / 2 for name, tensor in weights.items()}
    moments = {
        "state": {0: {"exp_avg": weights["a.weight"] * 3, "step": torch.tensor(float(step))}},
        "param_groups": [],
    }
    fields = {"trained_on": {"street 3": (0, step)}, **fields}
    return TrainingState(step, to_dict(configured()), TINY, weights, ema, moments, {"last_epoch": step}, **fields)


def steps(out: Path) -> list[int]:
    return [int(path.name.removeprefix("step-")) for path in list_checkpoints(out)]

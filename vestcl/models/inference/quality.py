"""How good a forecast by a network has to be: three points on the curve of run time against error.

    exact      float32; skips what changes nothing but rounding
    balanced   the knees that cost at most 0.1 dB of PSNR: what was measured to stand stands, two blocks correct the
               motion of what does not, details are refined at half the size
    fast       beyond them: details at a quarter of it, things move as they were measured to

`vestcl bench pareto` measures the curve; docs/time_against_error has it, and the points chosen.
"""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, get_args

import torch

from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.effort import Effort
from vestcl.models.inference.fast import FastForecaster, accelerate, computes_bfloat16, keep_freed_memory
from vestcl.models.inference.skipping import Skip

Quality = Literal["exact", "balanced", "fast"]

#: The levels, best first.
LEVELS: Final[tuple[Quality, ...]] = get_args(Quality)

#: Of `vestcl forecast`: what it loses can't be seen.
USUAL: Final[Quality] = "balanced"

#: The most that a level may lose against "exact" in PSNR to the true next frame, dB, mean over streets.
LOSS: Final[dict[Quality, float]] = {"exact": 0.0, "balanced": 0.1, "fast": 0.5}


class Settings(NamedTuple):
    """What a level sets of a `Forecaster`."""

    skip: Skip
    effort: Effort
    autocast: str | None
    """The name of torch's type that encoder and refinement compute in; None is the parameters' own."""


_SETTINGS: Final[dict[Quality, Settings]] = {
    "exact": Settings(Skip(), Effort(), None),
    "balanced": Settings(
        Skip(margin=16, still=True), Effort(min_transmittance=0.01, blocks=2, paint_scale=0.5), "bfloat16"
    ),
    "fast": Settings(
        Skip(margin=16, still=True), Effort(min_transmittance=0.03, blocks=0, paint_scale=0.25), "bfloat16"
    ),
}


def settings(quality: Quality) -> Settings:
    """What ``quality`` sets.

    Args:
        quality: one of `LEVELS`.

    Returns:
        Switches, effort and precision, as `Forecaster` has them.

    Raises:
        ValueError: another word.
    """
    if quality not in LEVELS:
        raise ValueError(f"`quality` must be one of {', '.join(LEVELS)}, got {quality!r}")
    return _SETTINGS[quality]


def about(quality: Quality) -> dict[str, Any]:
    """What a file tells of it: {"quality": ..., "skip": {...}, "effort": {...}, "autocast": name or None}.

    Raises:
        ValueError: another word.
    """
    skip, effort, autocast = settings(quality)
    return {"quality": quality, "skip": asdict(skip), "effort": asdict(effort), "autocast": autocast}


def apply(model: Forecaster, quality: Quality) -> Forecaster:
    """Let ``model`` forecast at ``quality`` from now on; its weights stay as they are.

    bfloat16 is for processors that compute in it: elsewhere it costs time, and float32 stays. Where the network paints
    anew (`RefineConfig.base` "none"), refinement stays at full size.

    Args:
        model: a trained network.
        quality: one of `LEVELS`.

    Returns:
        ``model``.

    Raises:
        ValueError: another word.
    """
    skip, effort, autocast = settings(quality)
    if model.config.refine.base == "none":
        effort = replace(effort, paint_scale=1.0)
    model.skip, model.effort = skip, effort
    model.autocast = getattr(torch, autocast) if autocast and computes_bfloat16() else None
    return model


def load(name_or_path: str | Path, quality: Quality) -> FastForecaster:
    """A trained network as commands use it: at ``quality``, laid out for inference; the process keeps what it frees.

    Args:
        name_or_path: see `vestcl.models.forecaster.Forecaster.from_pretrained`.
        quality: one of `LEVELS`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such model, a damaged file, or another word.
    """
    keep_freed_memory()
    model = apply(Forecaster.from_pretrained(name_or_path), quality)
    return accelerate(model, "float32" if model.autocast is None else "bfloat16")

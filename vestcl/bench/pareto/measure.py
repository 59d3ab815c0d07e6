"""Settings of a forecaster timed in turns on the same streets, their images compared with two truths; the best ones."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import numpy as np
import torch

from vestcl.bench.common import timing as _timing
from vestcl.bench.common.timing import Spread
from vestcl.bench.pareto.knobs import EXACT, Setting, options_of
from vestcl.bench.pareto.scenes import Scene, double, shrunk
from vestcl.evaluation import metrics
from vestcl.forecasting.network.input import NetworkInput
from vestcl.models.forecaster import Forecaster, Mode
from vestcl.models.inference.resolution import enlarged
from vestcl.models.steps.memory import EncodedFrames

Images = list[torch.Tensor]
"""[1, 3, H, W] in [0, 1], a street each."""

#: dB of PSNR that half the time may cost at a knee: a difference that is hard to see in a direct comparison.
PRICE: Final = 0.25


@dataclass(frozen=True)
class Point:
    """One setting, measured."""

    value: str
    """Of the knob, or a description of several."""
    seconds: Spread
    """Of one forecast step, mean over the streets."""
    rms: Spread
    """Over streets: root of the mean squared difference from the float64, nothing-skipped image, of 1."""
    psnr: Spread
    """Over streets, dB, against the frame that really follows."""
    ms_ssim: Spread
    """The same; NaN in images too small for it."""
    loss: float
    """Mean over streets of the default's PSNR less this one's, dB."""
    worst: float
    """The largest of these."""


@dataclass(eq=False)
class Bench:
    """A network and the streets that it forecasts."""

    model: Forecaster
    scenes: Sequence[Scene]
    runs: int
    references: Images = field(default_factory=list)
    """In float64, nothing skipped."""
    memories: dict[Any, EncodedFrames] = field(default_factory=dict)
    """What the network remembers of t - 1, by all that its features depend on."""

    def __post_init__(self) -> None:
        exact = copy.deepcopy(self.model).double()
        exact.options = exact.options.without_skips()
        self.references = [step(exact, double(scene.given)).clamp(0, 1) for scene in self.scenes]


def step(model: Forecaster, given: NetworkInput, steps: int = 1, mode: Mode | None = None) -> torch.Tensor:
    """The frame at t + ``steps`` as the source camera sees it, [1, 3, H, W]."""
    prior = given.prior if model.config.start == "prior" else None
    with torch.no_grad():
        known = {"mode": mode, "prior": prior, "own": given.own, "shown": (steps,)}
        done = model.forecast(given.frame_prev, given.frame_cur, given.K, steps, **known)  # type: ignore[arg-type]
    return done[-1].views[0].image


def measure(bench: Bench, settings: Mapping[str, Setting]) -> list[Point]:
    """Each setting's time and error; the exact one is the first of the points, whether it is in ``settings`` or not.

    A run is a step on every street, one after the other, each with t - 1 remembered as in a drive. Settings are timed
    in turns; a run's time is that of a step, the mean over the streets.

    Args:
        bench: the network and the streets.
        settings: by name.
    """
    if EXACT not in settings.values():
        settings = {"exact": EXACT, **settings}
    images: dict[str, Images] = {}
    tasks = {name: _task(bench, setting, partial(images.__setitem__, name)) for name, setting in settings.items()}
    seconds = _timing.interleave(tasks, 0.0, bench.runs)
    psnr = {name: _compared(bench, metrics.psnr, images[name]) for name in settings}
    names = sorted(settings, key=lambda name: settings[name] != EXACT)
    points = []
    for name in names:
        losses = [before - after for before, after in zip(psnr[names[0]], psnr[name], strict=True)]
        pairs = zip(images[name], bench.references, strict=True)
        rms = [float((image.double() - exact).square().mean().sqrt()) for image, exact in pairs]
        large = min(bench.scenes[0].size) >= metrics.MS_SSIM_SIDE
        ms_ssim = _compared(bench, metrics.ms_ssim, images[name]) if large else [float("nan")] * len(psnr[name])
        errors, psnrs, ms_ssims = (Spread.of(np.array(values)) for values in (rms, psnr[name], ms_ssim))
        time, loss = Spread.of(seconds[name] / len(bench.scenes)), sum(losses) / len(losses)
        points.append(Point(name, time, errors, psnrs, ms_ssims, loss, max(losses)))
    return points


def _task(bench: Bench, setting: Setting, keep: Callable[[Images], None]) -> Callable[[], object]:
    inputs = [shrunk(scene.given, setting.get("size", 1.0)) for scene in bench.scenes]
    memories = [_memory(bench, setting, index, given) for index, given in enumerate(inputs)]

    def task() -> None:
        bench.model.options = options_of(setting)
        done = []
        for scene, given, memory in zip(bench.scenes, inputs, memories, strict=True):
            bench.model.memory = memory.copy()
            done.append(enlarged(step(bench.model, given), *scene.size).clamp(0, 1))
        keep(done)

    return task


def _memory(bench: Bench, setting: Setting, index: int, given: NetworkInput) -> EncodedFrames:
    """The model's memory when it has seen the frame at t - 1."""
    key = index, options_of(setting).of_encoder, setting.get("size"), setting.get("seen")
    if key not in bench.memories:
        bench.model.memory = EncodedFrames()
        bench.model.options = options_of(setting)
        with torch.no_grad():
            bench.model.encode(given.frame_prev)
        bench.memories[key] = bench.model.memory
    return bench.memories[key]


def _compared(bench: Bench, metric: Callable[..., torch.Tensor], images: Images, step: int = 1) -> list[float]:
    """``metric`` of t + ``step`` against the frame that really follows, a number a street."""
    truths = (scene.truth[step - 1 : step] for scene in bench.scenes)
    pairs = zip(images, truths, strict=True)
    return [float(metric(metrics.quantise(image), metrics.quantise(truth))) for image, truth in pairs]


def recursions(bench: Bench, horizons: Sequence[int]) -> list[tuple[Mode, int, Spread, Spread]]:
    """Both ways to forecast several steps, timed in turns.

    Returns:
        For each of ``horizons`` and modes ("compose" repeats the first step's motion, "feedback" sees each forecast
        frame): mode, steps, seconds of the whole forecast with the preprocessing of forecast frames, and PSNR over
        streets, dB.
    """
    images: dict[tuple[Mode, int], Images] = {}
    modes: tuple[Mode, ...] = ("compose", "feedback")
    keys = {f"{mode}, t+{steps}": (mode, steps) for steps in horizons for mode in modes}

    def run(key: tuple[Mode, int]) -> None:
        images[key] = []
        for scene in bench.scenes:
            bench.model.memory = EncodedFrames()
            images[key].append(step(bench.model, scene.given, key[1], key[0]).clamp(0, 1))

    bench.model.options = options_of(EXACT)
    seconds = _timing.interleave({name: partial(run, key) for name, key in keys.items()}, 0.0, bench.runs)
    psnr = {key: _compared(bench, metrics.psnr, images[key], key[1]) for key in keys.values()}
    return [
        (*key, Spread.of(seconds[name] / len(bench.scenes)), Spread.of(np.array(psnr[key])))
        for name, key in keys.items()
    ]


def front(points: Sequence[Point]) -> list[Point]:
    """The Pareto front of time and loss, fastest last."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.loss, p.seconds.median)):
        if not best or point.seconds.median < best[-1].seconds.median:
            best.append(point)
    return best


def knee(points: Sequence[Point]) -> Point:
    """argmin loss + PRICE log2(seconds): where the curve's tangent is PRICE dB for half the time.

    Args:
        points: one or more, the default first; others count if they are faster than it beyond the noise: if quartiles
            of the times don't overlap.

    Raises:
        ValueError: no points.
    """
    if not points:
        raise ValueError("`points` must be one or more, got none")
    default, *others = points
    points = [default, *(point for point in others if point.seconds.high < default.seconds.low)]
    return min(points, key=lambda point: point.loss + PRICE * math.log2(point.seconds.median))

"""Settings of a forecaster timed in turns on the same streets, and their pictures held against two truths."""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl.bench.common import timing as _timing
from vestcl.bench.common.timing import Spread
from vestcl.bench.pareto.front import Point, spread
from vestcl.bench.pareto.knobs import EXACT, Setting
from vestcl.bench.pareto.scenes import Scene, double, full, shrunk
from vestcl.evaluation import metrics
from vestcl.forecasting.network.input import NetworkInput
from vestcl.models.forecaster import Forecaster, Mode
from vestcl.models.inference.skipping import NOTHING
from vestcl.models.steps.memory import EncodedFrames

Tell = Callable[[str], None]


@dataclass(eq=False)
class Bench:
    """A network and the streets that it forecasts."""

    model: Forecaster
    scenes: Sequence[Scene]
    runs: int
    references: list[torch.Tensor] = field(default_factory=list)
    """[1, 3, H, W] float64 of each street: computed in float64, nothing skipped."""
    memories: dict[Any, EncodedFrames] = field(default_factory=dict)
    """What the network remembers of t - 1, by all that its features depend on."""

    def __post_init__(self) -> None:
        exact = copy.deepcopy(self.model).double()
        exact.skip = NOTHING
        self.references = [step(exact, double(scene.given)).clamp(0, 1) for scene in self.scenes]


def step(model: Forecaster, given: NetworkInput, steps: int = 1, mode: Mode | None = None) -> torch.Tensor:
    """The frame at t + ``steps`` as the source camera sees it, [1, 3, H, W]."""
    prior = given.prior if model.config.start == "prior" else None
    with torch.no_grad():
        known = {"mode": mode, "prior": prior, "own": given.own, "shown": (steps,)}
        done = model.forecast(given.frame_prev, given.frame_cur, given.K, steps, **known)  # type: ignore[arg-type]
    return done[-1].views[0].image


@contextmanager
def as_set(model: Forecaster, setting: Setting) -> Iterator[None]:
    """``model`` with the switches of ``setting`` but for its size."""
    before = model.skip, model.effort, model.autocast
    autocast = torch.bfloat16 if setting.autocast else None
    model.skip, model.effort, model.autocast = setting.skip, setting.effort, autocast
    try:
        yield
    finally:
        model.skip, model.effort, model.autocast = before


def measure(bench: Bench, settings: Mapping[str, Setting], tell: Tell = lambda _: None) -> list[Point]:
    """Each setting's time and error; the exact one is the first of the points, whether it was asked for or not.

    A run is a step on every street, one after the other, each with t - 1 remembered as in a drive. Settings take turns
    from run to run; a run's time is that of a step, the mean over the streets.

    Args:
        bench: what forecasts what.
        settings: by name.
        tell: called with a setting's name before each of its runs.
    """
    if EXACT not in settings.values():
        settings = {"exact": EXACT, **settings}
    images: dict[str, list[torch.Tensor]] = {}
    tasks = {name: _task(bench, name, setting, images, tell) for name, setting in settings.items()}
    seconds = _timing.interleave(tasks, 0.0, bench.runs)
    exact = next(name for name, setting in settings.items() if setting == EXACT)
    known = [_psnr(bench, images[exact]), *(_psnr(bench, images[name]) for name in settings)]
    return [
        _point(bench, name, settings[name], images[name], seconds[name] / len(bench.scenes), known[0], psnr)
        for name, psnr in sorted(zip(settings, known[1:], strict=True), key=lambda pair: pair[0] != exact)
    ]


def _task(
    bench: Bench, name: str, setting: Setting, images: dict[str, list[torch.Tensor]], tell: Tell
) -> Callable[[], object]:
    inputs = [shrunk(scene.given, setting.size) for scene in bench.scenes]
    memories = [_memory(bench, setting, index, given) for index, given in enumerate(inputs)]

    def task() -> None:
        tell(name)
        with as_set(bench.model, setting):
            done = []
            for scene, given, memory in zip(bench.scenes, inputs, memories, strict=True):
                bench.model.memory = memory.copy()
                done.append(full(step(bench.model, given), scene.size))
        images[name] = done

    return task


def _memory(bench: Bench, setting: Setting, index: int, given: NetworkInput) -> EncodedFrames:
    """The model's memory when it has seen the frame at t - 1."""
    key = setting.skip, setting.autocast, setting.size, index
    if key not in bench.memories:
        bench.model.memory = EncodedFrames()
        with as_set(bench.model, setting), torch.no_grad():
            bench.model.encode(given.frame_prev)
        bench.memories[key] = bench.model.memory
    return bench.memories[key]


def _psnr(bench: Bench, images: Sequence[torch.Tensor]) -> list[float]:
    """Of t + 1, dB, a number a street."""
    pairs = zip(images, bench.scenes, strict=True)
    return [float(metrics.psnr(metrics.quantise(image), metrics.quantise(s.truth[:1]))) for image, s in pairs]


def _point(
    bench: Bench,
    name: str,
    setting: Setting,
    images: Sequence[torch.Tensor],
    seconds: NDArray[np.float64],
    exact: Sequence[float],
    psnr: Sequence[float],
) -> Point:
    rms = [float((i.double() - r).square().mean().sqrt()) for i, r in zip(images, bench.references, strict=True)]
    losses = [before - after for before, after in zip(exact, psnr, strict=True)]
    alike = [_ms_ssim(image, scene) for image, scene in zip(images, bench.scenes, strict=True)]
    of_images = spread(rms), spread(psnr), spread(alike)
    return Point(name, setting.plain(), Spread.of(seconds), *of_images, sum(losses) / len(losses), max(losses))


def _ms_ssim(image: torch.Tensor, scene: Scene) -> float:
    if min(scene.size) < metrics.MS_SSIM_SIDE:
        return float("nan")
    return float(metrics.ms_ssim(metrics.quantise(image), metrics.quantise(scene.truth[:1])))


# ---------------------------------------------------------------- several steps


@dataclass(frozen=True)
class Recursion:
    """One way to forecast t + k."""

    mode: str
    """"compose" repeats the first step's motion; "feedback" sees each forecast frame."""
    steps: int
    seconds: Spread
    """Of the whole forecast, with what is perceived of forecast frames."""
    psnr: Spread
    """Over streets, dB, of t + k against the frame that really follows."""


def recursions(bench: Bench, horizons: Sequence[int], tell: Tell = lambda _: None) -> list[Recursion]:
    """Both modes at each of ``horizons``, timed in turns."""
    images: dict[str, list[torch.Tensor]] = {}
    modes: tuple[Mode, ...] = ("compose", "feedback")
    asked = {f"{mode}, t+{steps}": (mode, steps) for steps in horizons for mode in modes}

    def run(name: str) -> None:
        tell(name)
        mode, steps = asked[name]
        images[name] = []
        for scene in bench.scenes:
            bench.model.memory = EncodedFrames()
            images[name].append(step(bench.model, scene.given, steps, mode).clamp(0, 1))

    seconds = _timing.interleave({name: partial(run, name) for name in asked}, 0.0, bench.runs)
    return [
        Recursion(mode, steps, Spread.of(seconds[name] / len(bench.scenes)), spread([
            float(metrics.psnr(metrics.quantise(image), metrics.quantise(scene.truth[steps - 1 : steps])))
            for image, scene in zip(images[name], bench.scenes, strict=True)
        ]))
        for name, (mode, steps) in asked.items()
    ]  # fmt: skip

"""`vestcl bench pareto`: what each knob of a forecast saves in time and costs in error, and the best together."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.options import Options
from vestcl.bench.common.table import Section
from vestcl.bench.pareto.knobs import EXACT, Setting, combinations, describe, knobs, setting_of
from vestcl.bench.pareto.measure import Bench, knee, measure, recursions
from vestcl.bench.pareto.plots import STEPS, combined_section, knob_section, steps_section
from vestcl.bench.pareto.scenes import scene
from vestcl.models import shipped
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference import quality
from vestcl.models.inference.fast import accelerate

#: Horizons at which the two ways to forecast several steps are compared.
HORIZONS: Final = (1, 3, 5)

#: Knobs that are in no combination: each value of "skipping" is exact.
NOT_COMBINED: Final = ("skipping",)


@dataclass(frozen=True)
class ParetoBench(Options):
    """Vary every knob of a forecast: time against error, on procedural streets that no network was trained on."""

    model: str = "vest-s"
    """A trained network: a name that ships with vestcl, a file or a checkpoint's folder."""
    seeds: tuple[int, ...] = (1100, 1101, 1102, 1103)
    """Streets; PSNR is their mean, times are a step's on one of them."""
    height: int = 256
    """Pixels."""
    width: int = 832
    """Pixels."""
    runs: int = 5
    """Of each setting, after two that don't count."""
    accelerated: bool = True
    """The network as `vestcl.models.inference.fast.accelerate` lays it out."""
    combine: bool = True
    """Combine the knobs' knees, too."""
    splatter: bool = True
    """Without effect: what it measured, the kernels do not have."""
    recursion: bool = True
    """Compare the two ways to forecast several steps, too."""


def main(config: ParetoBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size or number that is not positive, no street, or no such model.
        DeviceError: no such device.
    """
    _results.check_positive(config, "height", "width", "runs", "threads")
    if not config.seeds:
        raise ValueError("`seeds` must be one or more streets, got none")
    shipped.find_model(config.model)
    with _timing.recycling_allocator():
        _results.run("pareto", config, partial(_measure, config), partial(_total, config))


def _total(config: ParetoBench, seconds: float, tasks: int) -> float:
    """Of all knobs' settings by that of the first knob's, without combinations, whose number is not known yet."""
    settings = sum(len(knob.values) for knob in knobs(Forecaster.from_pretrained(config.model)))
    steps = 2 * sum(HORIZONS) if config.recursion else 0
    return seconds / tasks * (settings + steps)


def _measure(config: ParetoBench, _: opencl.Session, console: Console) -> Iterator[Section]:
    model, best = Forecaster.from_pretrained(config.model), list[list[Setting]]()
    with console.status("streets, and the exact forecast in float64"):
        steps = max(HORIZONS) if config.recursion else 1
        scenes = [scene(seed, config.height, config.width, steps) for seed in config.seeds]
        bench = Bench(model, scenes, config.runs)
    bench.model = accelerate(model) if config.accelerated else model
    for knob in knobs(model):
        with console.status(knob.name):
            points = measure(bench, knob.values)
        if knob.name not in NOT_COMBINED and knob.values[knee(points).value] != EXACT:
            best.append([EXACT, knob.values[knee(points).value]])
        yield knob_section(knob.name, knob.about, points)
    if config.combine:
        with console.status("combinations"):
            named = {level: setting_of(quality.settings(level)) for level in quality.LEVELS}
            points = measure(bench, {describe(one): one for one in (*combinations(best), *named.values())})
        yield combined_section(points, {level: describe(setting) for level, setting in named.items()})
    if config.recursion:
        with console.status(STEPS):
            yield steps_section(recursions(bench, HORIZONS))

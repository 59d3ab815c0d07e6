"""`vestcl bench pareto`: what each knob of a forecast saves in time and costs in error, and the best together."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.options import Options
from vestcl.bench.common.table import Measurement, Section
from vestcl.bench.pareto import plots
from vestcl.bench.pareto.knobs import EXACT, Setting, combinations, describe, knobs, setting_of
from vestcl.bench.pareto.measure import PRICE, Bench, Point, front, knee, measure, recursions
from vestcl.bench.pareto.scenes import scene
from vestcl.models import shipped
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference import quality
from vestcl.models.inference.fast import accelerate

#: Horizons at which the two ways to forecast several steps are compared.
HORIZONS: Final = (1, 3, 5)

#: Knobs that are in no combination: each value of "skipping" is exact.
NOT_COMBINED: Final = ("skipping",)

_NOTES: Final = (
    "time: ms/step, median and quartiles; t - 1 is remembered. x: the exact one's time over it.",
    "rms: difference from the float64 image with nothing skipped, of 1. PSNR, MS-SSIM: against the frame that follows.",
    "loss: mean and largest over streets of PSNR below the exact one's, dB.",
)


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
        results = _results.run("pareto", config, partial(_measure, config))
    if config.plots is not None:
        for number, result in enumerate(results):
            plots.draw(result.details, config.plots, f"{number} " if len(results) > 1 else "")


def _measure(config: ParetoBench, _: opencl.Session, console: Console) -> Iterator[Section]:
    model, details = Forecaster.from_pretrained(config.model), dict[str, Any]()
    with console.status("streets, and the exact forecast in float64"):
        steps = max(HORIZONS) if config.recursion else 1
        scenes = [scene(seed, config.height, config.width, steps) for seed in config.seeds]
        bench = Bench(model, scenes, config.runs)
    bench.model = accelerate(model) if config.accelerated else model
    yield Section("", [], details={"price": PRICE, "model": shipped.about_model(config.model)})
    with _timing.watching_others() as others:
        best: list[list[Setting]] = []
        for knob in knobs(model):
            with console.status(knob.name):
                points = measure(bench, knob.values)
            default, bend = points[0].value, knee(points).value
            details[knob.name] = {"about": knob.about, "default": default, "knee": bend, "points": points}
            if knob.name not in NOT_COMBINED and knob.values[bend] != EXACT:
                best.append([EXACT, knob.values[bend]])
            rows = _rows(points, {default: "default", bend: "knee"}, f"{knob.name} ")
            yield Section(f"{knob.name}: {knob.about}", rows, _NOTES, {"knobs": details})
        if config.combine:
            with console.status("combinations"):
                yield _combined(bench, best)
        if config.recursion:
            with console.status("several steps"):
                yield _several_steps(bench)
    yield Section("", [], details={"others' cores": others.cores})


def _combined(bench: Bench, choices: Sequence[Sequence[Setting]]) -> Section:
    """Every combination of the knobs' defaults and knees, and the named qualities, against the exact forecast."""
    named = {level: setting_of(quality.settings(level)) for level in quality.LEVELS}
    settings = {describe(setting): setting for setting in (*combinations(choices), *named.values())}
    points = measure(bench, settings)
    best = [point.value for point in front(points)]
    qualities = {level: describe(setting) for level, setting in named.items()}
    marks: dict[str, str] = dict.fromkeys(best, "front")
    marks |= {value: f"{marks.get(value, '')} {level}".strip() for level, value in qualities.items()}
    rows = _rows(points, marks, "combination ", only_marked=True)
    found = {"points": points, "best": best, "knee": knee(points).value, "qualities": qualities}
    return Section(f"best of {len(points)} combinations", rows, _NOTES, {"front": found})


def _several_steps(bench: Bench) -> Section:
    found, rows = recursions(bench, HORIZONS), list[Measurement]()
    for each in found:
        name = f"{each['mode']} to t+{each['steps']}"
        rows += [Measurement(name, "time", each["seconds"], "s", name=f"{name}, time")]
        rows += [Measurement(name, "PSNR", each["psnr"], "dB", ".2f", f"{name}, PSNR", "higher")]
    notes = ("compose repeats the first motion; feedback sees each forecast frame, and encodes it.",)
    return Section("several steps", rows, notes, {"recursion": found})


def _rows(
    points: Sequence[Point], marks: Mapping[str, str], prefix: str, only_marked: bool = False
) -> list[Measurement]:
    """Of each point a row of the table, and its figures in JSON; the exact point is the first."""
    rows = []
    for point in points:
        name, exact = f"{prefix}{point.value}", points[0].seconds.median
        has_ms_ssim = point.ms_ssim.median == point.ms_ssim.median
        own = [
            Measurement(point.value, "time", point.seconds, "s", name=f"{name}, time"),
            Measurement(point.value, "x", exact / point.seconds.median, digits=".2f"),
            Measurement(point.value, "rms", point.rms, digits=".1e", name=f"{name}, rms"),
            Measurement(point.value, "PSNR", point.psnr, "dB", ".2f", f"{name}, PSNR", "higher"),
            Measurement(point.value, "MS-SSIM", point.ms_ssim, "1", ".4f", f"{name}, MS-SSIM" * has_ms_ssim, "higher"),
            Measurement(point.value, "loss", point.loss, "dB", ".3f"),
            Measurement(point.value, "largest", point.worst, "dB", ".3f"),
            Measurement(point.value, "is", marks.get(point.value, "")),
        ]
        hidden = only_marked and point.value not in marks
        rows += [replace(measurement, column="") for measurement in own] if hidden else own
    return rows

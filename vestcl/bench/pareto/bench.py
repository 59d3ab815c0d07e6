"""`vestcl bench pareto`: what each knob of a forecast saves in time and costs in error, and the best together."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.results import Results
from vestcl.bench.pareto import plots as _pareto_plots
from vestcl.bench.pareto import report as _pareto_report
from vestcl.bench.pareto import splatter as _pareto_splatter
from vestcl.bench.pareto.front import PRICE, front, knee
from vestcl.bench.pareto.knobs import EXACT, Knob, Setting, combinations, describe, knobs
from vestcl.bench.pareto.measure import Bench, measure, recursions
from vestcl.bench.pareto.scenes import scene
from vestcl.cli.progress import ProgressBar
from vestcl.models.inference import pretrained, quality
from vestcl.models.inference.fast import accelerate

#: Horizons that the two ways of going on from t + 1 are compared at.
HORIZONS: Final = (1, 3, 5)

#: Knobs that are in no combination: of "skipping" each value is exact, and "image size" is another knob's again.
ALONE: Final = ("skipping",)

Tell = Callable[[str], None]


@dataclass(frozen=True)
class ParetoBench:
    """Turn every knob of a forecast: time against error, on procedural streets that no network was trained on."""

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
    """Turn the splatter's own knobs, too."""
    recursion: bool = True
    """Compare the two ways to forecast several steps, too."""
    threads: int = 2
    """Of torch."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices`, a part of its name, or "all": every one that works."""
    json: Path | None = None
    """File for the results."""
    markdown: Path | None = None
    """File for the tables."""
    plots: Path | None = None
    """Folder for plots (PNG): one a knob, and the front of all."""


def main(config: ParetoBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size or number that is not positive, no street, or no such model.
        DeviceError: no such device.
    """
    for name in ("height", "width", "runs", "threads"):
        if getattr(config, name) < 1:
            raise ValueError(f"`{name}` must be 1 or more, got {getattr(config, name)}")
    if not config.seeds:
        raise ValueError("`seeds` must be one or more streets, got none")
    pretrained.find_model(config.model)
    console = _results.console()
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with (
        ProgressBar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar,
        _timing.torch_threads(config.threads),
        _timing.recycling_allocator(),
    ):
        task = bar.add_task("")

        def tell(what: str) -> None:
            bar.update(task, description=what)

        results = _results.measure_each(config.device, partial(_measure_device, config, tell), console)
    _results.show(results, console)
    _results.save(results, config.json, config.markdown)
    if config.plots is not None:
        for path in _pareto_plots.draw(results, config.plots):
            console.print(str(path), soft_wrap=True, highlight=False)


def _measure_device(config: ParetoBench, tell: Tell, session: opencl.Session) -> Results:
    steps = max(HORIZONS) if config.recursion else 1
    model = pretrained.load_model(config.model)
    scenes = []
    for seed in config.seeds:
        tell(f"street {seed}")
        scenes.append(scene(seed, config.height, config.width, steps))
    tell("exact, in float64")
    bench = Bench(model, scenes, config.runs)
    bench.model = accelerate(model) if config.accelerated else model
    details: dict[str, Any] = {"price": PRICE, "model": pretrained.about_model(config.model)}
    with _timing.watching_others() as others:
        details["knobs"] = {knob.name: _turn(bench, knob, tell) for knob in knobs(model)}
        if config.combine:
            details["front"] = _combine(bench, details["knobs"], tell)
        if config.recursion:
            details["recursion"] = recursions(bench, HORIZONS, partial(_told, tell, "recursion"))
        if config.splatter:
            bench.memories.clear()
            device = None if config.device == _results.ALL else config.device
            sizes = config.height, config.width, device or session.info.index, config.runs
            details["splatter"] = _pareto_splatter.measure(*sizes, partial(_told, tell, "splatter"))
    details["others' cores"] = others.cores
    details = _results.plain(details)
    machine, chosen = _results.describe(session), _results.settings(config)
    return Results("pareto", machine, chosen, _pareto_report.measures(details), _pareto_report.grids(details), details)


def _told(tell: Tell, where: str, what: str) -> None:
    tell(f"{where}: {what}")


def _turn(bench: Bench, knob: Knob, tell: Tell) -> dict[str, Any]:
    points = measure(bench, dict(knob.values), partial(_told, tell, knob.name))
    return {"about": knob.about, "default": points[0].value, "knee": knee(points).value, "points": points}


def _combine(bench: Bench, turned: Mapping[str, Mapping[str, Any]], tell: Tell) -> dict[str, Any]:
    """Every combination of the knobs' defaults and knees, and the named qualities, beside the exact forecast."""
    choices = []
    for name, knob in turned.items():
        best = next(point for point in knob["points"] if point.value == knob["knee"])
        if name not in ALONE and best.setting:
            choices.append([EXACT, Setting.of(best.setting)])
    named = {level: Setting(*quality.settings(level)) for level in quality.LEVELS}
    settings = {describe(setting): setting for setting in (*combinations(choices), *named.values())}
    points = measure(bench, settings, partial(_told, tell, f"{len(settings)} combinations"))
    best = front(points)
    return {
        "points": points,
        "best": [point.value for point in best],
        "knee": knee(points).value,
        "qualities": {level: describe(setting) for level, setting in named.items()},
    }

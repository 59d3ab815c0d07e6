"""What `vestcl forecast` does: open a clip, forecast it, compare it with the truth, write and report the results."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vestcl import opencl
from vestcl.cli import checks, commands, horizon
from vestcl.cli.clip import open_clip
from vestcl.cli.progress import ProgressBar, progress_bar
from vestcl.cli.setup import Setup, load, work_width
from vestcl.clock import Clock
from vestcl.constants import WORK_WIDTH
from vestcl.data.sample import Clip
from vestcl.evaluation import compare
from vestcl.evaluation.compare import Comparison
from vestcl.forecasting import files as forecast_files
from vestcl.forecasting import page
from vestcl.forecasting.network.later_frames import LaterFrames
from vestcl.forecasting.result import Forecast, SkippedWork, View
from vestcl.forecasting.sheets import forecast_sheet
from vestcl.forecasting.views import parse_views
from vestcl.models import shipped
from vestcl.models.inference import quality
from vestcl.models.inference.processor import keep_freed_memory

#: Steps in a table of scores, so that it fits 80 letters; forecast.json has all.
STEPS_SHOWN: Final = 5

#: Default of ``learned``.
DEFAULT_LEARNED: Final = "tested"


@dataclass
class _Stages:
    """The bar on the terminal, and the clock of what is done outside of the forecast."""

    bar: ProgressBar
    clock: Clock = field(default_factory=Clock)

    def __post_init__(self) -> None:
        self.task = self.bar.add_task("", total=1.0)

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Callable[[float], None]]:
        """Times the block; yields the function that takes the share done."""
        self.show(name, 0.0)
        with self.clock.time(name):
            yield lambda share: self.show(name, share)

    def show(self, name: str, share: float) -> None:
        """Draw the bar again. Where the share falls, other work begins, whose time left is estimated from then on."""
        if share < self.bar.tasks[0].completed:
            self.bar.reset(self.task, total=1.0)
        self.bar.update(self.task, description=name, completed=share)


def run(options: commands.Forecast) -> None:
    """Do what the options ask for: a single forecast, or those of whole drives.

    Raises:
        ValueError: an option out of range, or a file that is missing or malformed; the message names it.
        DeviceError: no such OpenCL device.
    """
    checks.check_forecast(options)
    keep_freed_memory()
    if options.every is None:
        _run_single(options)
        return
    from vestcl.cli import drive

    drive.run(options)


def _run_single(options: commands.Forecast) -> None:
    (text,) = options.input
    console = Console()
    bar = progress_bar(console)
    with opencl.use(options.device), bar:
        stages = _Stages(bar)
        with stages.stage("open the clip"):
            setup, size = load(options), (options.height, options.width)
            clip = open_clip(text, options, size, horizon.street_frames(options, text), setup.estimators)
            steps = horizon.steps_of(options, clip.interval, clip.name)
            index = horizon.current_frame(clip, options, steps)
            views = parse_views(options.view or ("source",), clip[index])
            checks.check_memory(steps, clip, len(views))
        forecast = _forecast(clip, index, steps, options, views, stages, setup)
        stages.clock.seconds |= forecast.seconds
        comparisons, rival = list[Comparison](), None
        if options.compare:
            with stages.stage("compare") as report:
                scored = clip, index, views, setup.trunk
                how = setup.st_lpips, options.score_size
                comparisons = compare.compare(forecast, *scored, report, *how)
                if setup.model is not None:
                    rival = _forecast(clip, index, steps, options, views, stages, setup.by_geometry)
                    rivals = compare.compare(rival, *scored, None, *how)
                    comparisons = [_with_rival(*pair, rival.method) for pair in zip(comparisons, rivals, strict=True)]
        with stages.stage(forecast_files.WRITING) as report:
            details = _details(options, clip, index, forecast, comparisons, setup.later)
            timed = dataclasses.replace(forecast, seconds=dict(stages.clock.seconds))
            write = functools.partial(forecast_files.write_forecast, exr=options.exr, gif=options.gif, report=report)
            write(options.out, timed, clip, index, views, details)
            truths = {each.view: each.truth for each in comparisons}
            page.write_page(options.out, forecast, clip, index, views, truths=truths, scores=details.scores)
    if line := horizon.horizon_line(options, clip, steps):
        console.print(Text(line), soft_wrap=True)
    for comparison in comparisons:
        console.print(_score_table(comparison, setup.later))
        if rival is not None and (line := where_another_is_better(comparison, forecast.method, rival.method)):
            console.print(Text(line), soft_wrap=True)
    _print_end(console, forecast_files.read_forecast(options.out))


def _forecast(
    clip: Clip,
    index: int,
    steps: int,
    options: commands.Forecast,
    views: list[View],
    stages: _Stages,
    setup: Setup,
) -> Forecast:
    """By the network, or without one the geometric forecast."""
    stages.show("forecast", 0.0)
    asked = clip, index, steps, views
    width = work_width(options)
    how: dict[str, Any] = {} if width == WORK_WIDTH else {"work_width": width}
    how |= {} if setup.inpaint is None else {"inpaint": setup.inpaint}
    model, later = setup.model, setup.later
    if model is None or later is None:
        from vestcl.forecasting import geometric

        how |= {} if options.memory is None else {"memory": options.memory}
        return geometric.forecast_clip(*asked, progress=stages.show, **how)
    from vestcl.forecasting.network import forecast as network

    how["mode"] = later.mode
    if options.learned is not None:
        how["learned"] = options.learned
    if later.perceive is not None:
        how["perceive"] = later.perceive
    return network.forecast_clip(*asked, model, progress=stages.show, **how)


def _with_rival(comparison: Comparison, rival: Comparison, method: str) -> Comparison:
    """The comparison with another's forecast as an additional method, right after its own."""
    own = compare.FORECAST
    images = {own: comparison.images[own], method: rival.images[own], **comparison.images}
    scores = {own: comparison.scores[own], method: rival.scores[own], **comparison.scores}
    return dataclasses.replace(comparison, images=images, scores=scores)


def where_another_is_better(comparison: Comparison, method: str, other: str) -> str | None:
    """A line on the steps where ``other``, one of the methods, has the higher PSNR; None where it has at none.

    Args:
        comparison: of one view.
        method: what the forecast is called.
        other: the method.
    """
    pairs = [
        (own["psnr"], theirs["psnr"])
        for own, theirs in zip(comparison.scores[compare.FORECAST], comparison.scores[other], strict=True)
    ]
    better = [step for step, (own, theirs) in enumerate(pairs, start=1) if theirs - own >= compare.LEAST_PSNR]
    if not better:
        return None
    steps = ", ".join(f"t+{step} ({pairs[step - 1][1]:.2f} against {pairs[step - 1][0]:.2f} dB)" for step in better)
    return f"view {comparison.view}: {other} scored better than {method} in PSNR at {steps}"


def _details(
    options: commands.Forecast,
    clip: Clip,
    index: int,
    forecast: Forecast,
    comparisons: list[Comparison],
    later: LaterFrames | None,
) -> forecast_files.Details:
    """What forecast.json contains, and a sheet per view: next to the truth where it is known."""
    what = f"{clip.name}, {forecast.method} forecast from frame {clip[index].name}, view "
    compared = {each.view: each for each in comparisons}
    sheets = {
        name: compare.comparison_sheet(compared[name], what + name)
        if name in compared
        else forecast_sheet([frame[name] for frame in forecast.frames], what + name)
        for name in forecast.frames[0]
    }
    scores = {name: comparison.scores for name, comparison in compared.items()} if options.compare else None
    unused = ("every", "frames", "quiet", "verbose")  # of whole drives, and of the terminal
    settings = {name: value for name, value in dataclasses.asdict(options).items() if name not in unused}
    settings |= {"input": options.input[0], "steps": len(forecast.frames)}
    if options.model is not None and later is not None:
        chosen = {**later.settings, **quality.about(options.quality or quality.USUAL)}
        chosen["learned"] = options.learned or DEFAULT_LEARNED
        settings |= chosen | shipped.about_model(options.model)
    return forecast_files.Details(settings["input"], settings, scores, sheets)


def _score_table(comparison: Comparison, later: LaterFrames | None) -> Table:
    """A block of rows per metric, a row per method, a column per step: the first, the last and some between."""
    count = len(comparison.truth)
    shown = sorted({round(1 + (count - 1) * part / (STEPS_SHOWN - 1)) for part in range(STEPS_SHOWN)})
    note = "; oracle: the right camera's own past" if comparison.stereo else ""
    mode = "" if later is None else f"; mode {later}"
    title = f"view {comparison.view}, mean over {count}{mode}{note}"
    table = Table(box=box.SIMPLE, title=title, title_justify="left", pad_edge=False)
    table.add_column("")  # long names wrap, so that figures are never cut
    for heading in (*(f"t+{step}" for step in shown), "mean"):
        table.add_column(heading, justify="right", no_wrap=True)
    known = comparison.scores[compare.FORECAST][0]
    for metric in (metric for metric in compare.METRICS if metric in known):
        name, digits = compare.METRICS[metric]
        table.add_row(name)
        for method, steps in comparison.scores.items():
            values = [step[metric] for step in steps]
            chosen = (*(values[step - 1] for step in shown), sum(values) / count)
            table.add_row(f"  {method}", *(f"{value:{digits}}" for value in chosen))
        table.add_section()
    return table


def _print_end(console: Console, saved: forecast_files.SavedForecast) -> None:
    file = saved.about["settings"].get("model_file")
    mode = saved.about["settings"].get("mode")
    timed = [saved.about["method"], *([file] if file else []), *([f"mode {mode}"] if mode else [])]
    console.print(Text(f"forecast: {', '.join(timed)}"), soft_wrap=True)
    seconds: dict[str, float] = saved.about["seconds"]
    table = Table("stage", box=box.SIMPLE)
    table.add_column("seconds", justify="right")
    for name, value in (seconds | {"all": sum(seconds.values())}).items():
        table.add_row(name, f"{value:.2f}")
    console.print(table)
    for switch, one in saved.about.get("skipped", {}).items():
        if one["skipped"]:
            console.print(
                Text(f"skipped, {switch}: {SkippedWork(*(one[name] for name in SkippedWork._fields))}"), soft_wrap=True
            )
    for part, one in saved.about.get("learned", {}).items():
        console.print(
            Text(f"learned part {'used' if one['used'] else 'left out'}, {part}: {one['why']}"), soft_wrap=True
        )
    for note in saved.about.get("notes", []):
        console.print(Text(f"note: {note}"), soft_wrap=True)
    for view in saved.about["views"].values():
        for path in _paths(view):
            console.print(Text(str(saved.folder / path)), soft_wrap=True)
    for name in (forecast_files.JSON, page.VIDEO, page.PAGE):
        console.print(Text(str(saved.folder / name)), soft_wrap=True)


def _paths(view: dict[str, Any]) -> Iterator[Path]:
    """The images as first ... last, then the single files."""
    for kind in ("image", "exr"):
        files = [Path(frame[kind]) for frame in view["frames"] if kind in frame]
        if files:
            yield files[0] if len(files) == 1 else files[0].with_name(f"{files[0].name} ... {files[-1].name}")
    yield from (Path(view[kind]) for kind in ("video", "gif", "sheet") if kind in view)

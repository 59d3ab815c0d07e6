"""What `vestcl forecast --every N` does: forecast each N-th frame of clips, score it, and make one video of all."""

import dataclasses
import statistics
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vestcl import interrupt, opencl
from vestcl._version import __version__
from vestcl.cli import checks, commands, horizon
from vestcl.cli.clip import open_clip
from vestcl.cli.progress import progress_bar
from vestcl.cli.setup import Setup, load, work_width
from vestcl.data.open import clips_in
from vestcl.data.street import input as street_input
from vestcl.evaluation.compare import FORECAST, METRICS
from vestcl.evaluation.drive import files
from vestcl.evaluation.drive.files import DriveFolder
from vestcl.evaluation.drive.frame import DriveFrames, ForecastFrame, score_rows
from vestcl.evaluation.drive.plan import Drive, keep_decoded
from vestcl.evaluation.drive.plan import drive as planned
from vestcl.evaluation.scores import GEOMETRIC
from vestcl.forecasting.geometric.forecast import forecast_frames as forecast_geometric
from vestcl.forecasting.geometric.memory import MEMORY
from vestcl.forecasting.views import parse_views
from vestcl.models import shipped
from vestcl.models.inference import quality
from vestcl.scene.perception import Perception

#: Frames of a street if no number is given.
STREET_FRAMES: Final = 30

#: Options that the results do not depend on.
_FREE: Final = (
    "out",
    "threads",
    "quiet",
    "verbose",
    "device",
    "exr",
    "gif",
    "input",
    "steps",
    "seconds",
    "model",
    "quality",
)

#: Steps in the table of scores, so that it fits 80 columns; scores.csv has all.
_SHOWN: Final = 4


def run(options: commands.Forecast) -> None:
    """Do what the options ask for.

    Raises:
        ValueError: an option out of range, an input that is no clip, clips that are all too short, a file that is
            missing or malformed, or an output folder with a drive of other options.
        DeviceError: no such OpenCL device.
    """
    assert options.every is not None
    console = Console()
    with opencl.use(options.device):
        with progress_bar(console) as bar:
            bar.add_task("open the clips", total=None)
            setup = load(options)
            drives = _planned(options, setup, console)
            folder = DriveFolder(options.out, _request(options, drives))
        for each in drives:
            if line := horizon.horizon_line(options, each.clip, each.steps):
                console.print(Text(line), soft_wrap=True)
        made, seconds = _forecast_all(options, drives, setup, folder, console)
        with progress_bar(console) as bar:
            bar.add_task("write the video", total=None)
            folder.finish(drives, _about(drives, made, seconds))
    _print_end(console, folder, drives, made, seconds)


def _inputs(options: commands.Forecast) -> Iterator[str]:
    """An input per clip: streets by seed, a folder of clips by clip."""
    for text in options.input:
        streets = street_input.parse(text)
        if streets is not None and streets.seeds is not None:
            yield from streets.each()
        else:
            checks.check_input(text)
            yield from map(str, clips_in(text))


def _planned(options: commands.Forecast, setup: Setup, console: Console) -> list[Drive]:
    """The clips that have a frame to forecast; the others are reported.

    Raises:
        ValueError: none has one, or an input is no clip.
    """
    assert options.every is not None
    drives, short = list[Drive](), list[str]()
    texts = list(_inputs(options))
    if options.frames is not None and (other := [text for text in texts if checks.one_street(text) is None]):
        raise ValueError(f"`frames` is of streets, got {options.frames} for {other[0]}")
    for text in texts:
        size, frames = (options.height, options.width), options.frames or STREET_FRAMES
        clip = open_clip(text, options, size, frames, setup.estimators)
        steps = horizon.steps_of(options, clip.interval, clip.name)
        views = parse_views(options.view or ("source",), clip[0])
        checks.check_memory(steps, clip, len(views))
        one = planned(clip, text, len(drives) + 1, steps, options.every, options.frame)
        if one.indices:
            drives.append(one)
        else:
            first = "" if options.frame is None else f" from frame {options.frame} on"
            short.append(f"{text}: has no frame{first} with one before it and {steps} after it, got {len(clip)} frames")
    if not drives:
        raise ValueError(short[0])
    for line in short:
        console.print(Text(f"left out: {line}"), soft_wrap=True)
    return drives


def _request(options: commands.Forecast, drives: list[Drive]) -> dict[str, Any]:
    """All that the results depend on, by the names of the options."""
    asked = {name: value for name, value in dataclasses.asdict(options).items() if name not in _FREE}
    steps = [each.steps for each in drives]
    return {
        "vestcl": __version__,
        "clips": [_identity(each) for each in drives],
        "steps": steps[0] if len(set(steps)) == 1 else steps,
        **asked,
        "view": list(options.view or ("source",)),
        "model": None if options.model is None else shipped.about_model(options.model),
        "quality": None if options.model is None else options.quality or quality.USUAL,
        "work_width": work_width(options) or 0,
    }


def _identity(drive: Drive) -> str:
    """A clip in words: an input that has changed is another clip."""
    clip, path = drive.clip, Path(drive.text)
    size = f", {path.stat().st_size:,} bytes" if path.is_file() else ""
    rate = "" if clip.fps is None else f" at {clip.fps:g} Hz"
    text = path.absolute() if path.exists() else drive.text  # of another working directory it is another clip
    return f"{text} ({len(clip)} frames of {clip[0].height} x {clip[0].width} px{rate}{size})"


def _forecast_all(
    options: commands.Forecast, drives: list[Drive], setup: Setup, folder: DriveFolder, console: Console
) -> tuple[int, float]:
    """Forecast the frames that are not there yet; how many, and in how many seconds."""
    missing = [[index for index in each.indices if not folder.has(each, index)] for each in drives]
    total, kept = sum(len(each.indices) for each in drives), 0
    kept = total - sum(map(len, missing))
    made, start = 0, time.perf_counter()

    def stopped() -> str:
        done = kept + made
        return f"stopped; {done} of {total} frames are forecast, and the same command continues"

    with interrupt.summary(stopped), progress_bar(console, counted=True) as bar:
        task = bar.add_task("frames", total=total, completed=kept)
        for each, indices in zip(drives, missing, strict=True):
            bar.update(task, description=Text(each.clip.name[:20]).plain)
            for _ in _forecast_drive(options, each, indices, setup, folder):
                made += 1
                bar.advance(task)
    return made, time.perf_counter() - start


def _forecast_drive(
    options: commands.Forecast, drive: Drive, indices: list[int], setup: Setup, folder: DriveFolder
) -> Iterator[int]:
    """Forecast frames of one clip in rising order, and keep each; yields it then."""
    if not indices:
        return
    keep_decoded(drive)
    perception = Perception(drive.clip, inpaint=setup.inpaint, work_width=work_width(options))
    frames = DriveFrames(
        drive.clip,
        perception,
        _methods(options, setup),
        baselines=options.compare,
        trunk=setup.trunk,
        st_lpips=setup.st_lpips,
        size=options.score_size,
    )
    begin = drive.clip[0].timestamp
    for index in indices:
        sample = drive.clip[index]
        views = parse_views(options.view or ("source",), sample)
        records, picture = frames.forecast(index, drive.steps, views)
        seconds = None if sample.timestamp is None or begin is None else sample.timestamp - begin
        folder.add(drive, index, score_rows(records, seconds), picture)
        yield index


def _methods(options: commands.Forecast, setup: Setup) -> Mapping[str, ForecastFrame]:
    """The forecast, and with ``compare`` next to a network's the geometric one."""
    memory = MEMORY if options.memory is None else options.memory

    def by_geometry(perception: Perception, index: int, steps: int, views: Any) -> Any:
        return forecast_geometric(perception, index, steps, views, memory=memory)

    if setup.model is None or setup.later is None:
        return {FORECAST: by_geometry}
    from vestcl.forecasting.network import forecast as network

    model, later = setup.model, setup.later
    learned = options.learned or "tested"

    def by_network(perception: Perception, index: int, steps: int, views: Any) -> Any:
        how: dict[str, Any] = {"mode": later.mode, "perceive": later.perceive, "learned": learned}
        return network.forecast_frames(perception, model, index, steps, views, **how)

    return {FORECAST: by_network, **({GEOMETRIC: by_geometry} if options.compare else {})}


def _about(drives: list[Drive], made: int, seconds: float) -> dict[str, Any]:
    clips = {each.folder: {"name": each.clip.name, "frames": list(each.indices)} for each in drives}
    return {"forecast": clips, "last_run": {"frames": made, "seconds": round(seconds, 3)}}


def _print_end(console: Console, folder: DriveFolder, drives: list[Drive], made: int, seconds: float) -> None:
    for metric in ("psnr", "ms_ssim"):
        if (table := _score_table(folder, drives, metric)) is not None:
            console.print(table)
    total = sum(len(each.indices) for each in drives)
    each = f", {seconds / made:.2f} s per frame" if made else ""
    kept = f"; {total - made} kept from an earlier run" if made < total else ""
    console.print(f"{made} frame{'s' * (made != 1)} forecast{each}{kept}", highlight=False)
    for name in (files.VIDEO, files.SCORES, files.JSON):
        console.print(Text(str(folder.folder / name)), soft_wrap=True)


def _score_table(folder: DriveFolder, drives: list[Drive], metric: str) -> Table | None:
    """Means over the frames, a row per clip, view and method; None where nothing is scored."""
    most = max(each.steps for each in drives)
    shown = sorted({round(1 + (most - 1) * part / (_SHOWN - 1)) for part in range(_SHOWN)})
    name, digits = METRICS[metric]
    table = Table(box=box.SIMPLE, title=f"{name}, mean over the frames", title_justify="left", pad_edge=False)
    table.add_column("", overflow="fold")
    for heading in ("frames", *(f"t+{step}" for step in shown)):
        table.add_column(heading, justify="right", no_wrap=True)
    for each in drives:
        values: dict[str, dict[int, list[float]]] = {}
        for row in folder.rows(each):
            if row[metric]:
                by_step = values.setdefault(f"{row['view']}, {row['method']}", {})
                by_step.setdefault(int(row["step"]), []).append(float(row[metric]))
        if values and len(drives) > 1:
            table.add_row(each.clip.name)
        for method, by_step in values.items():
            cells = (f"{statistics.fmean(by_step[k]):{digits}}" if k in by_step else "" for k in shown)
            table.add_row(method, str(len(by_step[1])), *cells)
        table.add_section()
    return table if table.row_count else None

"""`vestcl bench forecast`: forecasts beside what then happened, on recorded clips and on procedural streets.

Seeds of `HELD_OUT` are for this bench: no test and no training may use them.
"""

import dataclasses
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vestcl import peer, runtime
from vestcl.bench import _forecast_tables as tables
from vestcl.bench import _forecast_truth as known
from vestcl.bench import _forecast_windows as windows
from vestcl.bench import _results
from vestcl.bench._forecast_truth import Facts
from vestcl.data import Street
from vestcl.data.open import open_sequence
from vestcl.data.sample import Clip
from vestcl.forecast import View
from vestcl.forecast_checks import check_input
from vestcl.geometric import Perception
from vestcl.io.atomic import write_bytes
from vestcl.models.trunks import Trunk, load_trunk
from vestcl.models.voxel_flow import VoxelFlowNetwork
from vestcl.perceptual import StLpips
from vestcl.progress import Bar
from vestcl.scoring import SOURCE, Record, Truth
from vestcl.st_lpips import Option as StLpipsOption
from vestcl.views import parse_views

#: Streets that nothing is tuned, trained or tested on: what "street:" stands for.
HELD_OUT: Final = range(1000, 1020)

#: Columns where the tables don't go to a terminal, whose own number counts there: three horizons of five metrics.
WIDTH: Final = 170

#: Steps that tables show where none are chosen.
HORIZONS: Final = (1, 3, 5)

_STREETS: Final = re.compile(r"street:(?:(\d{1,18})(?:-(\d{1,18}))?)?")


@dataclass(frozen=True)
class ForecastBench:
    """Forecast every window of clips and score it against the frames that follow."""

    inputs: tyro.conf.Positional[tuple[str, ...]]
    """Clips, as `vestcl forecast` opens them, or procedural streets: street:SEED, street:FIRST-LAST, or street: for
    the twenty that are held out."""
    steps: int = 5
    """Frames to forecast in each window."""
    horizons: tuple[int, ...] = ()
    """Steps that tables show; files have all. Without it 1, 3 and 5, as far as STEPS goes."""
    every: int = 1
    """Take every such window."""
    first: int = 1
    """The first window's current frame t, from 0; a frame stands before it."""
    last: int | None = None
    """The last window's; without it the last one that has STEPS frames after it."""
    height: int = 256
    """Pixels of what is scored; forecasts are made at the clip's own size."""
    width: int = 832
    """Pixels."""
    views: tuple[Literal["source", "right"], ...] = ("source", "right")
    """Cameras to be judged from; right only where a clip has one."""
    squeeze: Path | None = None
    """SqueezeNet 1.0 weights, for the distance in its features."""
    st_lpips: StLpipsOption = None
    """Measure ST-LPIPS, by the weights FILE or those inside an installed stlpips-pytorch."""
    peer: Path | None = None
    """Weights of the learned 2D baseline (`python -m train.peer` writes peer.safetensors)."""
    pool: bool = False
    """One table over all inputs instead of one for each."""
    street_size: tuple[int, int] = (256, 832)
    """Height and width of streets, pixels."""
    street_frames: int = 8
    """Frames of each street."""
    samples: int = 2
    """Streets' colour is the mean over samples x samples rays a pixel."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name."""
    out: Path | None = None
    """JSON file for the scores of every window, and their means."""
    markdown: Path | None = None
    """File for the tables as Markdown."""

    OUTPUT_FILES: ClassVar[tuple[str, ...]] = ("out",)

    @property
    def shown(self) -> tuple[int, ...]:
        """Steps that tables show."""
        return self.horizons or tuple(k for k in HORIZONS if k <= self.steps)


@dataclass(frozen=True)
class Networks:
    """Whose weights were given."""

    squeeze: Trunk | None = None
    """SqueezeNet 1.0."""
    st_lpips: StLpips | None = None
    peer: VoxelFlowNetwork | None = None
    """That forecasts as a baseline."""


@dataclass
class _Group:
    """Clips whose windows share a table."""

    name: str
    clips: list[Clip]
    records: list[Record] = field(default_factory=list)
    facts: list[Facts] = field(default_factory=list)


def main(config: ForecastBench) -> None:
    """Forecast, score, print and write.

    Raises:
        ValueError: a number out of range, an input that is no clip or has too few frames.
        DeviceError: no such device.
    """
    _check(config)
    console = _results.console(WIDTH)
    with runtime.use(config.device) as session:
        machine = _results.describe(session)
        networks = _networks(config)
        groups = _groups(config)
        _run(groups, config, networks, console)
    grids = [grid for group in groups for grid in _grids(group, config.shown)]
    for grid in grids:
        console.print(tables.to_rich(grid))
    if networks.squeeze is None:
        console.print("without --squeeze there is no squeeze distance", highlight=False)
    if networks.st_lpips is None:
        console.print("without --st-lpips there is no ST-LPIPS", highlight=False)
    if networks.peer is not None:
        console.print(f"{peer.METHOD}: {peer.ABOUT}", highlight=False, soft_wrap=True)
    console.print(f"{machine['device']}, {machine['cores']} cores", highlight=False, soft_wrap=True)
    _write(config, machine, groups, grids, console)


def _check(config: ForecastBench) -> None:
    for name in ("steps", "every", "first", "height", "width", "street_frames", "samples"):
        if getattr(config, name) < 1:
            raise ValueError(f"`{name}` must be 1 or more, got {getattr(config, name)}")
    if not config.inputs:
        raise ValueError("`inputs` must be one or more clips, got none")
    if not all(1 <= k <= config.steps for k in config.horizons):
        raise ValueError(f"`horizons` must be steps, 1 ... {config.steps}, got {config.horizons}")
    if not config.views or len(set(config.views)) < len(config.views):
        raise ValueError(f"`views` must be one or more cameras, each once, got {config.views}")


def _networks(config: ForecastBench) -> Networks:
    return Networks(
        None if config.squeeze is None else load_trunk("squeezenet1_0", config.squeeze),
        None if config.st_lpips is None else StLpips.load(config.st_lpips),
        None if config.peer is None else VoxelFlowNetwork.load(config.peer),
    )


# ---------------------------------------------------------------- clips and windows


def _groups(config: ForecastBench) -> list[_Group]:
    opened = [(text, clips_of(text, config)) for text in config.inputs]
    if config.pool:
        return [_Group(", ".join(config.inputs), [clip for _, clips in opened for clip in clips])]
    return [_Group(text, clips) for text, clips in opened]


def clips_of(text: str, config: ForecastBench) -> list[Clip]:
    """The clips that one input stands for.

    Args:
        text: "street:", "street:SEED", "street:FIRST-LAST", or what `vestcl.data.open.open_sequence` opens.
        config: how streets are made.

    Raises:
        ValueError: no clip, or one without a single window.
    """
    streets = _STREETS.fullmatch(text)
    if streets is None:
        check_input(text)
        clips = [open_sequence(text)]
    else:
        first, last = streets[1], streets[2] or streets[1]
        seeds = HELD_OUT if first is None else range(int(first), int(last) + 1)
        made = (Street.generate(seed) for seed in seeds)
        clips = [street.clip(config.street_frames, *config.street_size, samples=config.samples) for street in made]
    if not clips:
        raise ValueError(f"`inputs` must have streets from a lower to a higher seed, got {text}")
    for clip in clips:
        if not windows_of(clip, config):
            wanted = f"{config.first + config.steps + 1} frames and a window from `first` to `last` without a gap"
            raise ValueError(f"{text}: must have {wanted}, got {len(clip)} frames, {config.first} and {config.last}")
    return clips


def windows_of(clip: Clip, config: ForecastBench) -> list[int]:
    """The current frame t of every window: one frame stands before it and ``steps`` follow, an interval apart.

    Args:
        clip: of any length.
        config: ``first``, ``last``, ``every`` and ``steps``.
    """
    end = len(clip) - 1 - config.steps
    chosen = range(config.first, (end if config.last is None else min(config.last, end)) + 1, config.every)
    return [index for index in chosen if clip.is_whole(index, config.steps)]


def _run(groups: Sequence[_Group], config: ForecastBench, networks: Networks, console: Console) -> None:
    """Fill the groups."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bar = Bar(*columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal)
    with bar:
        total = sum(len(windows_of(clip, config)) for group in groups for clip in group.clips)
        task = bar.add_task("windows", total=total)
        for group in groups:
            for clip in group.clips:
                bar.update(task, description=clip.name)
                for records, facts in run_clip(clip, config, networks):
                    group.records += records
                    group.facts += facts
                    bar.advance(task)


def run_clip(
    clip: Clip, config: ForecastBench, networks: Networks = Networks()
) -> Iterator[tuple[list[Record], list[Facts]]]:
    """Every window of a clip, in order; each shares what it sees with the next.

    Args:
        clip: at its own size.
        config: which windows, views and steps.
        networks: that score, and the baseline.

    Returns:
        A window's records, and its facts if there are any.

    Raises:
        ValueError: as `vestcl.geometric.forecast_frames`.
    """
    views = views_of(clip, config)
    perception = Perception(clip)
    truth = Truth(clip, (config.height, config.width), networks.squeeze, st_lpips=networks.st_lpips)
    for index in windows_of(clip, config):
        truth.forget(index - 1)
        motion = known.true_motion(clip, index, config.steps)
        predictions, forecast = windows.predict(perception, truth, index, config.steps, views, motion, networks.peer)
        values = {} if motion is None else known.ego_errors(forecast, motion)
        if known.shot(clip[index]) is not None:
            values |= known.motion_errors(forecast, clip, index, SOURCE) if SOURCE in config.views else {}
            values |= known.splatter_alone(clip, index)
        facts = [Facts(clip.name, clip[index].name, index, values)] if values else []
        yield windows.score(truth, index, views, predictions, forecast), facts


def views_of(clip: Clip, config: ForecastBench) -> list[View]:
    """The wanted cameras that the clip has.

    Raises:
        ValueError: it has none of them.
    """
    there = [name for name in config.views if name != "right" or clip[0].right is not None]
    if not there:
        raise ValueError(f"`views` must have a camera of {clip.name}, which has no right one")
    return parse_views(there, clip)


# ---------------------------------------------------------------- tables and files


def _grids(group: _Group, horizons: Sequence[int]) -> list[tables.Grid]:
    return [
        *tables.picture_grids(group.name, group.records, horizons),
        *tables.fact_grids(group.name, group.facts, horizons),
    ]


def _write(
    config: ForecastBench, machine: dict[str, str], groups: Sequence[_Group], grids: Sequence[tables.Grid],
    console: Console,
) -> None:  # fmt: skip
    if config.out is not None:
        settings = {k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(config).items()}
        _results.write_json(
            config.out, {"machine": machine, "config": settings, "inputs": [_told(group) for group in groups]}
        )
        _results.tell_written(console, config.out)
    if config.markdown is not None:
        write_bytes(config.markdown, "\n".join(map(tables.to_markdown, grids)).encode())
        _results.tell_written(console, config.markdown)


def _told(group: _Group) -> dict[str, Any]:
    """A group as the JSON file holds it."""
    told = {
        "input": group.name,
        **tables.summary(group.records, group.facts),
        "windows": [dataclasses.asdict(record) for record in group.records],
        "window_facts": [dataclasses.asdict(facts) for facts in group.facts],
    }
    checked: dict[str, Any] = tables.finite(told)
    return checked

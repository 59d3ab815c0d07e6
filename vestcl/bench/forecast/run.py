"""Which windows `vestcl bench forecast` measures, and the run over them."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vestcl.bench.forecast import truth as known
from vestcl.bench.forecast import windows
from vestcl.bench.forecast.config import HELD_OUT, ForecastBench
from vestcl.bench.forecast.kept import SUFFIX, Kept, Window
from vestcl.bench.forecast.truth import Facts
from vestcl.bench.forecast.windows_list import Listed, read_list
from vestcl.cli.checks import check_input
from vestcl.cli.clip import load_estimators, with_estimates
from vestcl.cli.progress import ProgressBar
from vestcl.data.open import open_sequence
from vestcl.data.sample import Clip
from vestcl.data.street import input as street_input
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.regions import error_shares
from vestcl.evaluation.scores import SOURCE, Record, Truth
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.forecasting.geometric import Perception
from vestcl.forecasting.result import View
from vestcl.forecasting.views import parse_views
from vestcl.models.forecaster import Forecaster
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

#: Streets of one input: their frames are made in memory.
MOST_STREETS: Final = 1000

#: Options that choose windows or tables: a window's scores don't depend on them.
_OF_TABLES: Final = ("inputs", "windows", "every", "first", "last", "horizons", "pool", "out", "markdown")


@dataclass(frozen=True)
class Networks:
    """Whose weights were given."""

    squeeze: Trunk | None = None
    """SqueezeNet 1.0."""
    st_lpips: StLpips | None = None
    peer: VoxelFlowNetwork | None = None
    """That forecasts as a baseline."""
    models: Mapping[str, Forecaster] = field(default_factory=dict)
    """That forecast, by the name of their row."""


@dataclass
class Group:
    """Clips whose windows share tables."""

    name: str
    clips: list[tuple[Clip, list[int]]]
    """Each with the current frames t of its windows."""
    use: str = ""
    """ "tuned" or "checked", by the list of windows."""
    records: list[Record] = field(default_factory=list)
    facts: list[Facts] = field(default_factory=list)


def groups_of(config: ForecastBench) -> list[Group]:
    """The inputs with their windows; with ``config.pool`` one group.

    Raises:
        ValueError: as `clips_of`; a clip that the list of windows lacks.
    """
    listed = None if config.windows is None else read_list(config.windows)
    groups, estimators = [], load_estimators(config.depth_model, config.mask_model)
    for text in config.inputs:
        clips = [with_estimates(clip, estimators) for clip in clips_of(text, config)]
        chosen = [(clip, chosen_windows(clip, config, listed)) for clip in clips]
        use = "" if listed is None else listed[clips[0].name].use
        groups.append(Group(text, chosen, use))
    if not config.pool:
        return groups
    return [Group(", ".join(config.inputs), [clip for group in groups for clip in group.clips])]


def clips_of(text: str, config: ForecastBench) -> list[Clip]:
    """The clips that one input stands for.

    Args:
        text: "street:", "street:SEED", "street:FIRST-LAST", or what `vestcl.data.open.open_sequence` opens.
        config: how streets are made.

    Raises:
        ValueError: no clip.
    """
    streets = street_input.parse(text)
    if streets is None:
        check_input(text)
        return [open_sequence(text)]
    seeds = HELD_OUT if streets.seeds is None else streets.seeds
    if len(seeds) > MOST_STREETS:
        raise ValueError(f"`inputs` must have {MOST_STREETS:,} streets or fewer, got {text}")
    about, size = streets.driven, config.street_size
    return [
        street_input.clip(seed, about, config.street_frames, size, config.samples, about.drawn(seed).named())
        for seed in seeds
    ]


def chosen_windows(clip: Clip, config: ForecastBench, listed: Mapping[str, Listed] | None = None) -> list[int]:
    """The windows of a clip that are measured.

    Args:
        clip: of any length.
        config: ``first``, ``last``, ``every`` and ``steps``.
        listed: the list of windows by clip; None takes those of ``config``.

    Raises:
        ValueError: none, a clip that is not listed, or a listed window without true frames.
    """
    there = windows_of(clip, config)
    if listed is None:
        if not there:
            wanted = f"{config.first + config.steps + 1} frames and a window from `first` to `last` without a gap"
            got = f"{len(clip)} frames, {config.first} and {config.last}"
            raise ValueError(f"{clip.name}: must have {wanted}, got {got}")
        return there
    if clip.name not in listed:
        raise ValueError(f"{config.windows}: has no windows of {clip.name}, only of {', '.join(listed)}")
    missing = sorted(set(listed[clip.name].frames) - set(there))
    if missing:
        wanted = f"frames with one before and {config.steps} after without a gap"
        raise ValueError(f"{config.windows}: {clip.name} must have {wanted}, got {missing}")
    return list(listed[clip.name].frames)


def windows_of(clip: Clip, config: ForecastBench) -> list[int]:
    """The current frame t of every window: one frame is before it and ``steps`` follow, an interval apart.

    Args:
        clip: of any length.
        config: ``first``, ``last``, ``every`` and ``steps``.
    """
    end = len(clip) - 1 - config.steps
    chosen = range(config.first, (end if config.last is None else min(config.last, end)) + 1, config.every)
    return [index for index in chosen if clip.is_whole(index, config.steps)]


def kept_windows(config: ForecastBench) -> Kept:
    """What an earlier, stopped run with the same settings and code has measured, beside ``config.out``.

    Raises:
        ValueError: the file can't be read.
    """
    settings = {name: value for name, value in dataclasses.asdict(config).items() if name not in _OF_TABLES}
    return Kept(None if config.out is None else config.out.with_name(config.out.name + SUFFIX), settings)


def run(groups: Sequence[Group], config: ForecastBench, networks: Networks, kept: Kept, console: Console) -> None:
    """Measure all windows that are not kept yet, and fill the groups.

    Raises:
        ValueError: as the readers and forecasts; a window can't be kept.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bar = ProgressBar(*columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal)
    with bar:
        task = bar.add_task("windows", total=sum(len(chosen) for group in groups for _, chosen in group.clips))
        for group in groups:
            for clip, chosen in group.clips:
                bar.update(task, description=clip.name)
                missing = [index for index in chosen if kept.get(clip.name, index) is None]
                bar.advance(task, len(chosen) - len(missing))
                for index, measured in zip(missing, run_clip(clip, missing, config, networks), strict=True):
                    kept.add(clip.name, index, measured)
                    bar.advance(task)
                for window in (kept.get(clip.name, index) for index in chosen):
                    records, facts = window or ([], [])
                    group.records += records
                    group.facts += facts


def run_clip(
    clip: Clip, indices: Sequence[int], config: ForecastBench, networks: Networks = Networks()
) -> Iterator[Window]:
    """Windows of a clip, in order; each shares what it sees with the next.

    Args:
        clip: at its own size.
        indices: the current frames t, ascending.
        config: which views and steps.
        networks: that score, and that forecast.

    Yields:
        A window's records, and its facts.

    Raises:
        ValueError: as `vestcl.forecasting.geometric.forecast_frames`.
    """
    views = views_of(clip, config)
    perception = Perception(clip)
    truth = Truth(clip, (config.height, config.width), networks.squeeze, st_lpips=networks.st_lpips)
    for index in indices:
        truth.forget(index - 1)
        motion = known.true_motion(clip, index, config.steps)
        asked = perception, truth, index, config.steps, views, motion
        predictions, forecast = windows.predict(*asked, networks.peer, networks.models)
        values = error_shares(truth, forecast, index, views[0])
        values |= {} if motion is None else known.ego_errors(forecast, motion)
        if known.shot(clip[index]) is not None:
            values |= known.motion_errors(forecast, clip, index, SOURCE) if SOURCE in config.views else {}
            values |= known.splatter_alone(clip, index)
        yield (
            windows.score(truth, index, views, predictions, forecast),
            [Facts(clip.name, clip[index].name, index, values)],
        )


def views_of(clip: Clip, config: ForecastBench) -> list[View]:
    """The wanted cameras that the clip has.

    Raises:
        ValueError: it has none of them.
    """
    there = [name for name in config.views if name != "right" or clip[0].right is not None]
    if not there:
        raise ValueError(f"`views` must have a camera of {clip.name}, which has no right one")
    return parse_views(there, clip)

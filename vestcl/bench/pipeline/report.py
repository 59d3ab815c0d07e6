"""What `vestcl bench pipeline` found, as tables, measures and a plot."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from vestcl.bench.common import stacked_bars as _stacked
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.results import X_COPY, Measure
from vestcl.bench.common.stacked_bars import Bar
from vestcl.bench.common.timing import Spread
from vestcl.bench.pipeline.measure import (
    ALL,
    COPY,
    INPAINT,
    MOST_COST,
    MOST_LOSS,
    NONE,
    OF_PEER,
    PEER,
    SAVED,
    SceneTimes,
)
from vestcl.bench.pipeline.traffic import EVERYTHING
from vestcl.evaluation.tables import Grid
from vestcl.models.inference.skipping import Count
from vestcl.models.inference.stage_times import REST, STAGES


@dataclass(frozen=True)
class Verdict:
    """A target and what became of it."""

    what: str
    wanted: str
    got: str
    reached: bool
    quiet: bool
    """Whether the machine was: with other work on it, a target that is missed proves nothing."""

    @property
    def word(self) -> str:
        """For tables."""
        return "reached" if self.reached else "missed" if self.quiet else "can't tell"


def verdicts(scenes: Sequence[SceneTimes]) -> list[Verdict]:
    """Every target that the scenes have figures for."""
    return [verdict for scene in scenes for verdict in _verdicts(scene)]


def _verdicts(scene: SceneTimes) -> Iterator[Verdict]:
    quiet, saved = _timing.is_quiet(scene.others_cores), scene.saved_share[ALL].median
    if scene.name in OF_PEER and scene.of_peer is not None:
        ratio, most = scene.of_peer.median, OF_PEER[scene.name]
        yield Verdict(f"{scene.name}: step / {PEER}", f"<= {most:g}", f"{ratio:.2f}", ratio <= most, quiet)
    if scene.name in SAVED:
        least = SAVED[scene.name]
        yield Verdict(f"{scene.name}: skipping saves", f">= {least:.0%}", f"{saved:.0%}", saved >= least, quiet)
    if scene.name == EVERYTHING:
        what = f"{scene.name}: skipping costs"
        yield Verdict(what, f"<= {MOST_COST:.0%}", f"{-saved:.1%}", -saved <= MOST_COST, quiet)
    if scene.pictures.loss is not None:
        loss, what = scene.pictures.loss, f"{scene.name}: dB PSNR lost"
        yield Verdict(what, f"<= {MOST_LOSS:g}", f"{loss:.3f}", loss <= MOST_LOSS, quiet=True)


# ---------------------------------------------------------------- tables


def grids(scenes: Sequence[SceneTimes], size: str) -> list[Grid]:
    """Tables of all scenes: times and counters, stages, pictures, targets.

    Args:
        scenes: what was measured.
        size: of the pictures, for titles.
    """
    found = [_scene_grid(scene, size) for scene in scenes]
    found.append(_stage_grid(scenes))
    found.append(_picture_grid(scenes))
    found.append(_splatter_grid(scenes))
    rows = tuple((one.what, one.wanted, one.got, one.word) for one in verdicts(scenes))
    return [*found, Grid("targets", ("", "wanted", "got", ""), rows)]


def _scene_grid(scene: SceneTimes, size: str) -> Grid:
    rows = []
    for name, spread in scene.seconds.items():
        saved, share = scene.saved.get(name), scene.saved_share.get(name)
        count = scene.counts.get(name.removesuffix(" alone"))
        rows.append((
            name,
            ms(spread),
            "" if saved is None else f"{saved.median * 1e3:+.1f}",
            "" if share is None else f"{share.median:+.1%}",
            "" if count is None else counted(count),
        ))  # fmt: skip
    runs = scene.seconds[NONE].runs
    notes = [
        f"{INPAINT}: a new frame's background, before the step. {COPY}: of both frames' layers.",
        f"{runs} rounds.",
    ]
    if scene.of_peer is not None:
        notes.append(f"The step with all skipped takes {scene.of_peer.median:.2f} of {PEER}'s time.")
    notes.append(f"The step with all skipped takes {scene.of_copy.median:.0f} copies of both frames' layers.")
    if not _timing.is_quiet(scene.others_cores):
        notes.append(f"Other processes kept {scene.others_cores:.1f} cores busy meanwhile: measure again.")
    title = f"forecast step, {scene.name} ({scene.foreground:.0%} foreground), {size}"
    return Grid(title, ("", "ms (quartiles)", "saved, ms", "saved", "skipped"), tuple(rows), tuple(notes))


def _stage_grid(scenes: Sequence[SceneTimes]) -> Grid:
    columns = [(scene, variant) for scene in scenes for variant in (NONE, ALL)]
    rows = [
        (stage, *(f"{scene.stages[variant][stage].median * 1e3:.1f}" for scene, variant in columns))
        for stage in (*STAGES.values(), REST)
    ]
    heading = ("", *(f"{scene.name}, {'nothing' if variant == NONE else 'all'}" for scene, variant in columns))
    return Grid("stages with nothing and with all skipped, ms", heading, tuple(rows), ("Medians.",))


def _picture_grid(scenes: Sequence[SceneTimes]) -> Grid:
    rows = []
    for scene in scenes:
        pictures = scene.pictures
        known = (pictures.against_nothing, pictures.truth_nothing, pictures.truth_all, pictures.loss)
        rows.append((scene.name, *("" if value is None else f"{value:.2f}" for value in known)))
    heading = ("", f"{ALL} against {NONE}", f"{NONE} against truth", f"{ALL} against truth", "lost")
    return Grid("pictures, dB PSNR", heading, tuple(rows), ("Means over the drives' steps; inf: the same.",))


def _splatter_grid(scenes: Sequence[SceneTimes]) -> Grid:
    rows = [(what, *(counted(scene.splatter[what]) for scene in scenes)) for what in scenes[0].splatter]
    notes = ("Of the drives' last steps, with all skipped. It can't be switched off.",)
    return Grid("what the splatter leaves out", ("", *(scene.name for scene in scenes)), tuple(rows), notes)


def ms(spread: Spread) -> str:
    """Median and quartiles of seconds, as milliseconds."""
    digits = 0 if spread.median >= 0.1 else 1 if spread.median >= 0.01 else 2
    median, low, high = (f"{value * 1e3:.{digits}f}" for value in (spread.median, spread.low, spread.high))
    return f"{median} ({low}-{high})"


def counted(count: Count) -> str:
    """ "73 % of 1,277,952 px"."""
    share = count.skipped / count.of if count.of else 0.0
    return f"{share:.0%} of {count.of:,} {count.unit}"


# ---------------------------------------------------------------- measures


def measures(scenes: Sequence[SceneTimes]) -> list[Measure]:
    """For JSON and `vestcl bench compare`."""
    return [measure for scene in scenes for measure in _measures(scene)]


def _measures(scene: SceneTimes) -> Iterator[Measure]:
    for name, spread in scene.seconds.items():
        yield Measure.of(f"{scene.name}: {name}", "s", spread)
    for variant in (NONE, ALL):
        for stage, spread in scene.stages[variant].items():
            yield Measure.of(f"{scene.name}: {variant}: {stage}", "s", spread)
    for name, spread in scene.saved_share.items():
        yield Measure.of(f"{scene.name}: {name}: saved", "1", spread, "higher")
    yield Measure.of(f"{scene.name}: {ALL}{X_COPY}", "1", scene.of_copy)
    if scene.of_peer is not None:
        yield Measure.of(f"{scene.name}: {ALL}, x {PEER}", "1", scene.of_peer)
    if scene.pictures.loss is not None and scene.pictures.truth_all is not None:
        loss, truth = scene.pictures.loss, scene.pictures.truth_all
        yield Measure(f"{scene.name}: lost", "dB", loss, loss, loss)
        yield Measure(f"{scene.name}: {ALL} against truth", "dB", truth, truth, truth, "higher")


# ---------------------------------------------------------------- plot


def plot(path: Path, title: str, scenes: Sequence[SceneTimes]) -> Path:
    """Stacked bars of stages, nothing skipped above all skipped, DMVFN below, scene by scene.

    Args:
        path: of the PNG; it is replaced whole.
        title: above the axes.
        scenes: one or more.

    Returns:
        ``path``.

    Raises:
        ValueError: the folder can't be made.
    """
    return _stacked.stacked_bars(path, title, "ms a forecast step", list(_bars(scenes)), 1e3)


def _bars(scenes: Sequence[SceneTimes]) -> Iterator[Bar]:
    for scene in scenes:
        for variant in (NONE, ALL):
            parts = {stage: spread.median for stage, spread in scene.stages[variant].items()}
            yield Bar(scene.name, f"{scene.name}, {variant}", parts, scene.seconds[variant])
        if PEER in scene.seconds:
            parts = {PEER: scene.seconds[PEER].median}
            yield Bar(scene.name, f"{scene.name}, {PEER}", parts, scene.seconds[PEER])

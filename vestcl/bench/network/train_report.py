"""What `vestcl bench train-step` found, as tables, measures and a plot."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from vestcl.bench.common import stacked_bars as _stacked
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.results import Measure
from vestcl.bench.common.stacked_bars import Bar
from vestcl.bench.network.train_measure import (
    ADAM,
    BACKWARD,
    EVERYTHING_LEARNS,
    FORWARD,
    OURS,
    TWIN,
    StepTimes,
    TwinTimes,
)
from vestcl.bench.pipeline.report import ms
from vestcl.evaluation.tables import Grid
from vestcl.models.inference.stage_times import REST, STAGES


def grids(steps: Sequence[StepTimes], twin: TwinTimes | None, size: str, twin_size: str) -> list[Grid]:
    """Tables: variants, stages, and torch's splat.

    Args:
        steps: by variant, the one in which everything learns first.
        twin: None where it did not run.
        size: of the batch, for titles.
        twin_size: of the small one.
    """
    found = [_variant_grid(steps, size), _stage_grid(steps)]
    return found if twin is None else [*found, _twin_grid(twin, twin_size)]


def _variant_grid(steps: Sequence[StepTimes], size: str) -> Grid:
    rows = []
    for step in steps:
        saved = "" if step.name == EVERYTHING_LEARNS else f"{step.saved_share.median:+.1%}"
        parts = (ms(step.parts[name]) for name in (FORWARD, BACKWARD, ADAM))
        share = step.opencl.median / step.whole.median
        rows.append((step.name, f"{step.parameters:,}", ms(step.whole), saved, *parts, f"{share:.1%}"))
    heading = ("", "parameters", "step, ms (quartiles)", "saved", FORWARD, BACKWARD, ADAM, "OpenCL's share")
    notes = [f"{steps[0].whole.runs} rounds. OpenCL's share of a step is a part of {FORWARD} and {BACKWARD}."]
    if not _timing.is_quiet(steps[0].others_cores):
        notes.append(f"Other processes kept {steps[0].others_cores:.1f} cores busy meanwhile: measure again.")
    return Grid(f"training step, {size}", heading, tuple(rows), tuple(notes))


def _stage_grid(steps: Sequence[StepTimes]) -> Grid:
    columns = [spreads for step in steps for spreads in (step.forward, step.backward)]
    rows = [
        (stage, *(f"{spreads[stage].median * 1e3:.1f}" for spreads in columns)) for stage in (*STAGES.values(), REST)
    ]
    heading = ("", *(f"{step.name}, {way}" for step in steps for way in (FORWARD, BACKWARD)))
    notes = (
        "Medians. A stage's backward begins with the gradient of its first result and lasts until an earlier stage's.",
    )
    return Grid("stages, ms", heading, tuple(rows), notes)


def _twin_grid(twin: TwinTimes, size: str) -> Grid:
    rows = tuple((f"splat by {name}", ms(twin.whole[name]), ms(twin.splat[name])) for name in (OURS, TWIN))
    ratio = twin.splat[TWIN].median / twin.splat[OURS].median
    notes = (
        f"The stage takes {ratio:.1f} times as long in torch.",
        f"Gradients of the weights differ by {twin.gradient_difference:.0e} of the largest.",
    )
    heading = ("", "step, ms (quartiles)", "displace and splat, forward and backward")
    return Grid(f"training step with torch's splat, {size}, batch 1", heading, rows, notes)


def measures(steps: Sequence[StepTimes], twin: TwinTimes | None) -> list[Measure]:
    """For JSON and `vestcl bench compare`."""
    found = [measure for step in steps for measure in _measures(step)]
    if twin is not None:
        for name in (OURS, TWIN):
            found.append(Measure.of(f"small step, splat by {name}", "s", twin.whole[name]))
            found.append(Measure.of(f"small step, splat by {name}: splat", "s", twin.splat[name]))
        worst = twin.gradient_difference
        found.append(Measure("small step: gradients' difference", "1", worst, worst, worst))
    return found


def _measures(step: StepTimes) -> Iterator[Measure]:
    yield Measure.of(step.name, "s", step.whole)
    for part, spread in step.parts.items():
        yield Measure.of(f"{step.name}: {part}", "s", spread)
    for way, spreads in ((FORWARD, step.forward), (BACKWARD, step.backward)):
        for stage, spread in spreads.items():
            yield Measure.of(f"{step.name}: {way}: {stage}", "s", spread)
    yield Measure.of(f"{step.name}: OpenCL", "s", step.opencl)
    if step.name != EVERYTHING_LEARNS:
        yield Measure.of(f"{step.name}: saved", "1", step.saved_share, "higher")


def plot(path: Path, title: str, steps: Sequence[StepTimes]) -> Path:
    """Stacked bars of stages, forward above backward, variant by variant.

    Args:
        path: of the PNG; it is replaced whole.
        title: above the axes.
        steps: one or more.

    Returns:
        ``path``.

    Raises:
        ValueError: no steps, or the folder can't be made.
    """
    bars = [
        Bar(step.name, f"{step.name}, {way}", {name: spread.median for name, spread in stages.items()}, step.parts[way])
        for step in steps
        for way, stages in ((FORWARD, step.forward), (BACKWARD, step.backward))
    ]
    return _stacked.stacked_bars(path, title, "ms a step", bars, 1e3)

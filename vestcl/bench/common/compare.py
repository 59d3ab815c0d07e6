"""`vestcl bench compare A.json B.json`: what changed between two runs of a benchmark, and whether noise can do it.

A measure has changed where the ranges between its quartiles don't overlap. Where it is a time with a ratio to a copy of
the same bytes beside it, that ratio must have changed in the same direction, too: else it is the machine that changed.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import tyro
from rich.text import Text

from vestcl.bench.common import results as _results
from vestcl.bench.common.results import X_COPY, Measure, Results
from vestcl.bench.splat import report as _report
from vestcl.evaluation.tables import Grid, to_markdown
from vestcl.io import atomic

Verdict = Literal["better", "worse", "noise", "machine"]

#: Settings that say where results go, and nothing about what is measured; and what always differs.
_OUTPUTS: Final = ("json", "markdown", "plots", "trace")
_DATE: Final = "date"

#: Unit of a measure -> how tables show it, and the factor to that.
_SHOWN: Final = {"s": ("ms", 1e3), "B": ("MB", 1e-6), "1": ("", 1.0)}


@dataclass(frozen=True)
class CompareBench:
    """Compare two runs of a benchmark by their JSON files."""

    before: tyro.conf.Positional[Path]
    """File of the first run."""
    after: tyro.conf.Positional[Path]
    """File of the second run."""
    fail_above: float | None = None
    """End with exit code 1 if a measure got worse by more than this, percent, beyond the noise."""
    markdown: Path | None = None
    """File for the tables."""


@dataclass(frozen=True)
class Change:
    """One measure of both runs."""

    before: Measure
    after: Measure
    percent: float
    """100 (after / before - 1) of the medians; NaN where there is none."""
    verdict: Verdict
    """ "noise": the quartiles' ranges overlap. "machine": they don't, but the ratio to the copy is the same."""

    @property
    def loss(self) -> float:
        """By how many percent it got worse; negative where better, NaN where unknown."""
        return self.percent if self.after.better == "lower" else -self.percent


def main(config: CompareBench) -> int:
    """Print all changes.

    Returns:
        1 if a measure got worse by more than ``fail_above``, beyond the noise, else 0.

    Raises:
        ValueError: a file that can't be read, files of different benchmarks or without a device in common, or a limit
            that is negative.
    """
    if config.fail_above is not None and not config.fail_above >= 0:
        raise ValueError(f"`fail_above` must be 0 or more, got {config.fail_above}")
    console = _results.console()
    grids, failed = [], []
    for before, after in pairs(_results.load(config.before), _results.load(config.after)):
        for warning in warnings(before, after):
            console.print(Text(f"warning: {warning}", "yellow"), soft_wrap=True)
        changes = compare(before.measures, after.measures)
        grids.append(_grid(before, after, changes))
        console.print(_report.screen(grids[-1]))
        failed += [change for change in changes if _fails(change, config.fail_above)]
    if config.markdown is not None:
        atomic.write_bytes(config.markdown, "\n".join(map(to_markdown, grids)).encode())
    for change in failed:
        told = f"{change.after.name}: worse by {change.loss:.1f} %, more than {config.fail_above:g} %"
        console.print(Text(told, "red"), soft_wrap=True)
    return 1 if failed else 0


def pairs(before: Sequence[Results], after: Sequence[Results]) -> list[tuple[Results, Results]]:
    """Results of the same devices; where each run has one device, they are compared even if it is another one.

    Raises:
        ValueError: results of different benchmarks, or no device in common.
    """
    benches = list(dict.fromkeys(result.bench for result in (*before, *after)))
    if len(benches) != 1:
        raise ValueError(f"`before` and `after` must be of the same benchmark, got {' and '.join(benches) or 'none'}")
    if len(before) == len(after) == 1:
        return [(before[0], after[0])]
    found = [(one, two) for one in before for two in after if one.machine.get("device") == two.machine.get("device")]
    if not found:
        devices = (", ".join(str(result.machine.get("device")) for result in run) for run in (before, after))
        raise ValueError(f"`before` and `after` must have a device in common, got {' and '.join(devices)}")
    return found


def warnings(before: Results, after: Results) -> Iterator[str]:
    """What else differs: device, versions, settings; and measures that one run alone has."""
    ignored = {"machine": (_DATE,), "config": _OUTPUTS}
    for field, names in ignored.items():
        one, two = getattr(before, field), getattr(after, field)
        for name in dict.fromkeys((*one, *two)):
            if name not in names and one.get(name) != two.get(name):
                yield f"{name} differs: {one.get(name)} before, {two.get(name)} after"
    names_of = [{measure.name for measure in result.measures} for result in (before, after)]
    for when, alone in (("before", names_of[0] - names_of[1]), ("after", names_of[1] - names_of[0])):
        if alone:
            yield f"only {when}: {', '.join(sorted(alone))}"


def compare(before: Sequence[Measure], after: Sequence[Measure]) -> list[Change]:
    """Every measure that both have, in the order of ``before``.

    Raises:
        ValueError: a measure in different units.
    """
    one, two = ({measure.name: measure for measure in measures} for measures in (before, after))
    moved = {name: _moved(one[name], two[name]) for name in one if name in two}
    return [_change(one[name], two[name], moved[name], moved.get(name + X_COPY)) for name in moved]


def _change(before: Measure, after: Measure, moved: int, of_copy: int | None) -> Change:
    """``moved``: -1, 0 or 1; ``of_copy``: the same of its ratio to the copy, where there is one."""
    if before.unit != after.unit:
        raise ValueError(f"`after` must have {before.name} in {before.unit!r}, got {after.unit!r}")
    percent = 100 * (after.median / before.median - 1) if before.median else math.nan
    if not moved:
        return Change(before, after, percent, "noise")
    if of_copy is not None and of_copy != moved:
        return Change(before, after, percent, "machine")
    return Change(before, after, percent, "better" if (moved < 0) == (after.better == "lower") else "worse")


def _moved(before: Measure, after: Measure) -> int:
    """1 where the second range is above the first, -1 where below, 0 where they overlap or one is unknown."""
    return int(after.low > before.high) - int(after.high < before.low)


def _fails(change: Change, limit: float | None) -> bool:
    """From 0 to something is no percentage, and still worse."""
    return limit is not None and change.verdict == "worse" and not change.loss <= limit


def _grid(before: Results, after: Results, changes: Sequence[Change]) -> Grid:
    rows = []
    for change in changes:
        unit, factor = _SHOWN.get(change.after.unit, (change.after.unit, 1.0))
        ranges = (_range(measure, factor) for measure in (change.before, change.after))
        rows.append((change.after.name, unit, *ranges, f"{change.percent:+.1f}", change.verdict))
    names = (result.machine.get("device", "unknown device") for result in (before, after))
    dates = " -> ".join(result.machine.get(_DATE, "?") for result in (before, after))
    title = f"vestcl bench {after.bench}, {' -> '.join(dict.fromkeys(names))}, {dates}"
    notes = (
        "noise: the ranges between the quartiles overlap. machine: they don't, but the ratio to the copy stays, so the",
        "machine is slower or faster, not vestcl.",
    )
    return Grid(title, ("", "unit", "before (quartiles)", "after (quartiles)", "change, %", ""), tuple(rows), notes)


def _range(measure: Measure, factor: float) -> str:
    median, low, high = (f"{value * factor:.4g}" for value in (measure.median, measure.low, measure.high))
    return median if low == high else f"{median} ({low}-{high})"

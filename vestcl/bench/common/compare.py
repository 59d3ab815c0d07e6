"""`vestcl bench compare A.json B.json`: what changed between two runs of a benchmark, and whether noise can do it.

A measure has changed where the ranges between its quartiles don't overlap. Where it is a time with a ratio to a copy of
the same bytes next to it, that ratio must have changed in the same direction, too: else it is the machine that changed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
import tyro
from rich.text import Text

from vestcl.bench.common import results as _results
from vestcl.bench.common.results import X_COPY, Results
from vestcl.bench.common.table import SHOWN, show_grid
from vestcl.evaluation.tables import Grid, to_markdown
from vestcl.io import atomic

#: Settings that say where results go, and nothing about what is measured; and what always differs.
_IGNORED: Final = {"machine": ("date",), "config": ("json", "markdown", "plots", "trace")}

#: Units that tables show as others.
_UNITS: Final = {"s": "ms", "B": "MB", "1": ""}


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
    grids, failed = list[Grid](), list[str]()
    for before, after in pairs(_results.load(config.before), _results.load(config.after)):
        for warning in warnings(before, after):
            console.print(Text(f"warning: {warning}", "yellow"), soft_wrap=True)
        changes = compare(before.figures, after.figures)
        grids.append(_grid(before, after, changes))
        show_grid(grids[-1], console)
        if config.fail_above is not None:
            # From 0 to something is no percentage, and still worse.
            above = changes[(changes["verdict"] == "worse") & ~(changes["loss"] <= config.fail_above)]
            failed += [
                f"{name}: worse by {loss:.1f} %, more than {config.fail_above:g} %"
                for name, loss in zip(above["name"], above["loss"], strict=True)
            ]
    if config.markdown is not None:
        atomic.write_bytes(config.markdown, "\n".join(map(to_markdown, grids)).encode())
    for line in failed:
        console.print(Text(line, "red"), soft_wrap=True)
    return 1 if failed else 0


def pairs(before: Sequence[Results], after: Sequence[Results]) -> list[tuple[Results, Results]]:
    """Results of the same devices; where each run has one device, they are compared even if it is another one.

    Raises:
        ValueError: results of different benchmarks, or no device in common.
    """
    benches = list(dict.fromkeys(result.bench for result in (*before, *after)))
    if len(benches) != 1:
        raise ValueError(f"`before` and `after` must be of the same benchmark, got {' and '.join(benches) or 'none'}")
    alike = len(before) == len(after) == 1
    found = [(one, two) for one in before for two in after if alike or _device(one) == _device(two)]
    if not found:
        devices = (", ".join(map(_device, run)) for run in (before, after))
        raise ValueError(f"`before` and `after` must have a device in common, got {' and '.join(devices)}")
    return found


def _device(result: Results) -> str:
    return result.machine.get("device", "unknown device")


def warnings(before: Results, after: Results) -> Iterator[str]:
    """What else differs: device, versions, settings; and measures that only one run has."""
    for field, ignored in _IGNORED.items():
        one, two = getattr(before, field), getattr(after, field)
        for name in dict.fromkeys((*one, *two)):
            if name not in ignored and one.get(name) != two.get(name):
                yield f"{name} differs: {one.get(name)} before, {two.get(name)} after"
    names_of = [{*result.figures["name"]} for result in (before, after)]
    for when, names in (("before", names_of[0] - names_of[1]), ("after", names_of[1] - names_of[0])):
        if names:
            yield f"only {when}: {', '.join(sorted(names))}"


def compare(before: pd.DataFrame, after: pd.DataFrame) -> pd.DataFrame:
    """Every figure that both have, in the order of ``before``, a row each.

    Args:
        before: figures of the first run: "name", "unit", "better", "median", "low", "high".
        after: of the second one.

    Returns:
        "name", "unit"; "median", "low" and "high" of both, as "median_before" and so on; "percent",
        100 (after / before - 1) of the medians, NaN where there is none; "loss", the percent by which it got worse; and
        "verdict": "noise" where the quartiles' ranges overlap; "machine" where they don't, but the ratio to the copy
        did not change; "better" or "worse".

    Raises:
        ValueError: a figure in different units.
    """
    both = pd.merge(before, after, on="name", suffixes=("_before", ""))
    for one in both[both["unit"] != both["unit_before"]].itertuples():
        raise ValueError(f"`after` must have {one.name} in {one.unit_before!r}, got {one.unit!r}")
    moved = (both["low"] > both["high_before"]).astype(int) - (both["high"] < both["low_before"]).astype(int)
    of_copy = (both["name"] + X_COPY).map(dict(zip(both["name"], moved, strict=True))).fillna(moved)
    less = both["better"] == "lower"
    percent = 100 * (both["median"] / both["median_before"].replace(0, np.nan) - 1)
    known = [moved == 0, of_copy != moved, (moved < 0) == less]
    verdict = np.select(known, ["noise", "machine", "better"], "worse")
    both = both.rename(columns={name: f"{name}_after" for name in ("median", "low", "high")})
    return both.assign(percent=percent, loss=percent.where(less, -percent), verdict=verdict)


def _grid(before: Results, after: Results, changes: pd.DataFrame) -> Grid:
    rows = []
    for change in changes.to_dict("records"):
        ranges = (_range(change, when) for when in ("before", "after"))
        unit = _UNITS.get(change["unit"], change["unit"])
        rows.append((change["name"], change["verdict"], f"{change['percent']:+.1f}", unit, *ranges))
    names = map(_device, (before, after))
    dates = " -> ".join(result.machine.get("date", "?") for result in (before, after))
    title = f"vestcl bench {after.bench}, {' -> '.join(dict.fromkeys(names))}, {dates}"
    notes = (
        "noise: the ranges between the quartiles overlap.",
        "machine: they don't, but the ratio to the copy stays: the machine is slower or faster, not vestcl.",
    )
    return Grid(title, ("", "", "change, %", "unit", "before (quartiles)", "after (quartiles)"), tuple(rows), notes)


def _range(change: dict[str, float], when: str) -> str:
    factor = SHOWN.get(str(change["unit"]), 1.0)
    median, low, high = (f"{change[f'{part}_{when}'] * factor:.4g}" for part in ("median", "low", "high"))
    return median if low == high else f"{median} ({low}-{high})"

"""Means over windows, and tables of them for a terminal and as Markdown."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from vestcl.evaluation import metrics
from vestcl.evaluation.scores import RIGHT, Record

#: As wide as a first column gets on the screen before its text is wrapped, and columns around a cell there.
_LABEL: Final = 38
_AROUND: Final = 2

Means = dict[str, list[float]]
"""By metric, a number per step."""


class Metric(NamedTuple):
    """How tables show a metric."""

    label: str
    digits: str
    """As many as distinguish methods."""
    better: int
    """+1 where more is better, -1 where less is."""
    note: str = ""


#: Metrics in the order of tables.
METRICS: Final = {
    "psnr": Metric("PSNR", ".2f", +1, "PSNR in dB."),
    "ssim": Metric("SSIM", ".3f", +1),
    "ms_ssim": Metric("MS-SSIM", ".3f", +1),
    "lpips": Metric("LPIPS", ".3f", -1, "LPIPS: AlexNet, v0.1; 0 = equal."),
    "st_lpips": Metric("ST-LPIPS", ".3f", -1, "ST-LPIPS: shift-tolerant AlexNet; 0 = equal. It is not LPIPS."),
    "squeeze": Metric("squeeze", ".3f", -1, "squeeze: distance in SqueezeNet's features, 0 = equal. It is not LPIPS."),
    "psnr_seen": Metric(
        "PSNR*", ".2f", +1, "PSNR*: over the pixels that the geometric forecast covers by half or more."
    ),
    "rotation_deg": Metric("rotation", ".3f", -1, "rotation: error of the camera's rotation since t, degrees."),
    "translation_percent": Metric(
        "translation", ".2f", -1, "translation: error of the camera's translation since t, % of its length."
    ),
}


@dataclass(frozen=True)
class Grid:
    """A table of text, the first column to the left and the others to the right."""

    title: str
    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def means(of_windows: Sequence[Means]) -> Means:
    """Mean over windows, by metric and step; windows where a number is undefined (NaN) don't count.

    Args:
        of_windows: of windows with the same steps.

    Returns:
        The means; NaN where no window has a number.
    """
    return {name: _mean([window[name] for window in of_windows if name in window]) for name in _names(of_windows)}


def running_mean(by_horizon: Means) -> Means:
    """`vestcl.evaluation.metrics.running_mean` of each metric."""
    return {name: metrics.running_mean(torch.tensor(of)).tolist() for name, of in by_horizon.items()}


def summarise(records: Sequence[Record]) -> dict[str, Any]:
    """By view and method: windows, mean seconds, means by horizon, and running (the mean up to the horizon).

    Args:
        records: of all windows.
    """
    views: dict[str, Any] = {}
    for (view, method), own in by_method(records).items():
        found = means([record.scores for record in own])
        views.setdefault(view, {})[method] = {
            "windows": len(own),
            "seconds": float(np.mean([record.seconds for record in own])),
            "by_horizon": found,
            "running_mean": running_mean(found),
        }
    return views


def picture_grids(name: str, records: Sequence[Record], horizons: Sequence[int], running: bool = False) -> list[Grid]:
    """A table per view: a row per method, for each metric a column per horizon.

    Args:
        name: what the windows are of.
        records: of all windows.
        horizons: the steps to show, from 1; those that a view does not have are left out.
        running: show means from t+1 to the horizon instead of its own.
    """
    grids = []
    for view, of_view in by_view(records).items():
        steps = steps_of(of_view, horizons)
        shown = [metric for metric in METRICS if any(metric in record.scores for record in of_view)]
        rows: list[tuple[str, ...]] = []
        for (_, method), own in by_method(of_view).items():
            found = means([record.scores for record in own])
            found = running_mean(found) if running else found
            cells = [number(found[m][k - own[0].first], METRICS[m].digits) for m in shown for k in steps]
            rows.append((method, *cells, number(float(np.mean([record.seconds for record in own])), ".2f")))
        heading = ("", *(f"{METRICS[metric].label} {horizon(k)}" for metric in shown for k in steps), "s")
        count = len({(record.clip, record.index) for record in of_view})
        up_to = ", and over t+1 to the horizon" if running else ""
        title = f"{name}, view {view}, mean over {count} window{'s' * (count != 1)}{up_to}"
        grids.append(Grid(title, heading, tuple(rows), _notes(view, shown)))
    return grids


def steps_of(records: Sequence[Record], horizons: Sequence[int]) -> list[int]:
    """Which of t (0) and of the ``horizons`` the records of one view have."""
    first, count = records[0].first, len(next(iter(records[0].scores.values())))
    return [k for k in dict.fromkeys((0, *horizons)) if first <= k < first + count]


def horizon(step: int) -> str:
    """ "t+3", or "t"."""
    return f"t+{step}" if step else "t"


def to_rich(grid: Grid) -> RenderableType:
    """For the terminal; a heading's last word is below the others. A table that is too wide comes in parts below each
    other, each with the first column: no cell is cut."""
    return _Fitted(grid)


class _Fitted:
    """A table as wide as the console."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(self._grid.title, "bold")
        for columns in self._parts(options.max_width):
            yield self._table(columns)
        yield from (Text(f"  {note}", "dim") for note in self._grid.notes)
        yield ""

    def _parts(self, width: int) -> Iterator[list[int]]:
        """The columns after the first, as many at a time as there is space for, and one at least."""
        left = min(self._width(0), _LABEL) + _AROUND
        part, used = list[int](), left
        for column in range(1, len(self._grid.heading)):
            needed = self._width(column) + _AROUND
            if part and used + needed > width:
                yield part
                part, used = [], left
            part, used = [*part, column], used + needed
        yield part

    def _width(self, column: int) -> int:
        words = [*_stacked(self._grid.heading[column]).splitlines(), *(row[column] for row in self._grid.rows)]
        return max(map(cell_len, words), default=0)

    def _table(self, columns: Sequence[int]) -> Table:
        table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
        table.add_column(self._grid.heading[0], max_width=_LABEL)
        for column in columns:
            table.add_column(_stacked(self._grid.heading[column]), justify="right", no_wrap=True)
        for row in self._grid.rows:
            table.add_row(row[0], *(row[column] for column in columns))
        return table


def _stacked(heading: str) -> str:
    return "\n".join(heading.rsplit(" ", 1))


def to_markdown(grid: Grid) -> str:
    """A paragraph with the title, the table, and a paragraph with the notes."""
    lines = [f"**{grid.title}**", "", _pipes(grid.heading), _pipes(["---", *["---:"] * (len(grid.heading) - 1)])]
    lines += [_pipes(row) for row in grid.rows]
    return "\n".join(lines) + "\n" + "".join(f"\n{note.replace('*', chr(92) + '*')}\n" for note in grid.notes)


def finite(value: Any) -> Any:
    """``value`` with None for every number that JSON has no word for (NaN, infinity)."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def by_view(records: Iterable[Record]) -> dict[str, list[Record]]:
    """In the order of their first records."""
    grouped: dict[str, list[Record]] = {}
    for record in records:
        grouped.setdefault(record.view, []).append(record)
    return grouped


def by_method(records: Iterable[Record]) -> dict[tuple[str, str], list[Record]]:
    """By view and method, in the order of their first records."""
    grouped: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        grouped.setdefault((record.view, record.method), []).append(record)
    return grouped


def number(value: float, digits: str) -> str:
    """As a table shows it; "-" where there is none."""
    return "-" if math.isnan(value) else f"{value:{digits}}"


def _notes(view: str, shown: Sequence[str]) -> tuple[str, ...]:
    notes = ["s: seconds per window, on this machine.", *(METRICS[m].note for m in shown if METRICS[m].note)]
    if view == RIGHT:
        notes.append("Forecasts see the source camera only; an oracle sees what the right camera saw before.")
    return tuple(notes)


def _names(of_windows: Sequence[Means]) -> list[str]:
    return list(dict.fromkeys(name for window in of_windows for name in window))


def _mean(rows: Sequence[Sequence[float]]) -> list[float]:
    return [float(value) for value in torch.tensor(rows, dtype=torch.float64).nanmean(dim=0)]


def _pipes(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"

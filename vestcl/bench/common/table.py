"""The long table of a benchmark, a row per measurement, and all that is pivoted from it: tables, figures, plots.

    rows = [
        Measurement("forward", "ms", spread, "s", name="splat forward"),   # a figure, for `vestcl bench compare`
        Measurement("forward", "target", "<= 4 reached"),                  # a text
    ]
    section = Section("splat", rows)
    show_grid(section.grid(), console)   # rows by columns; below each other where a table is too wide

A bench yields `Section`s, which `vestcl.bench.common.results.run` prints, plots and saves.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

import pandas as pd  # type: ignore[import-untyped]
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vestcl.bench.common.timing import Spread, is_quiet
from vestcl.evaluation.tables import Grid

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Better = Literal["lower", "higher"]

#: Unit -> factor to what tables show: milliseconds, megabytes.
SHOWN: Final = {"s": 1e3, "B": 1e-6}

#: What a cell may end with, and its colour on the screen.
_VERDICTS: Final = {"reached": "green", "missed": "red", "can't tell": "yellow", "better": "green", "worse": "red"}

#: End of a note where other processes disturbed what a table shows.
AGAIN: Final = "measure again"

#: Columns of the screen around a cell.
_AROUND: Final = 2

#: As long as a heading gets in one line.
_HEADING: Final = 8

#: As wide as a first column gets before its text is wrapped.
_LABEL: Final = 38


@dataclass(frozen=True)
class Measurement:
    """One row of the long table, and one cell of a printed table."""

    row: str
    column: str
    """Of the printed table; "" leaves it out of there."""
    value: Spread | float | str
    """A text is shown as it is, and is no figure."""
    unit: str = "1"
    """ "s", "B", "dB", "1" (a ratio, a relative error), ..."""
    digits: str = ""
    """Format of the median; without it three digits or so, and the quartiles."""
    name: str = ""
    """Of a figure that `vestcl bench compare` compares, unique in a benchmark's results; "" for others."""
    better: Better = "lower"

    @property
    def spread(self) -> Spread:
        """Median and quartiles; NaN for a text."""
        if isinstance(self.value, Spread):
            return self.value
        value = float("nan") if isinstance(self.value, str) else float(self.value)
        return Spread(value, value, value, 1)

    @property
    def text(self) -> str:
        """For a cell; "-" where there is no number."""
        if isinstance(self.value, str):
            return self.value
        spread, factor = self.spread, SHOWN.get(self.unit, 1.0)
        if spread.median != spread.median:
            return "-"
        return f"{spread.median * factor:{self.digits}}" if self.digits else quartiles(spread, factor)


def quartiles(spread: Spread, factor: float = 1.0) -> str:
    """ "12.3 (12.1-12.6)"."""
    median, low, high = (value * factor for value in (spread.median, spread.low, spread.high))
    digits = 0 if median >= 100 else 1 if median >= 10 else 2
    return f"{median:.{digits}f} ({low:.{digits}f}-{high:.{digits}f})"


@dataclass(frozen=True)
class Section:
    """What one part of a bench found."""

    title: str
    rows: Sequence[Measurement]
    notes: tuple[str, ...] = ()
    plots: Mapping[str, Callable[[pd.DataFrame, str], "Figure"]] = field(default_factory=dict)
    """By the name of the file: what draws the long table below a title."""

    @property
    def frame(self) -> pd.DataFrame:
        """The long table: table, row, column, text, name, unit, better, median, low, high, runs."""
        kept = ("row", "column", "text", "name", "unit", "better")
        rows = [{name: getattr(one, name) for name in kept} | vars(one.spread) for one in self.rows]
        return pd.DataFrame([{"table": self.title} | row for row in rows])

    def grid(self) -> Grid:
        """Rows by columns, both in the order of their first cells; empty where there is none.

        Raises:
            ValueError: two measurements in one cell.
        """
        frame = self.frame[self.frame["column"] != ""]
        wide = frame.pivot(index="row", columns="column", values="text")
        wide = wide.reindex(index=frame["row"].unique(), columns=frame["column"].unique()).fillna("")
        rows = tuple((str(label), *map(str, cells)) for label, cells in zip(wide.index, wide.to_numpy(), strict=True))
        return Grid(self.title, ("", *map(str, wide.columns)), rows, self.notes)


def verdict(reached: bool, timed: bool = True) -> str:
    """What became of a target; a busy machine proves no target of times missed."""
    return "reached" if reached else "missed" if not timed or is_quiet() else "can't tell"


def show_grid(grid: Grid, console: Console) -> None:
    """Print a table; where it is too wide, its columns go on below, behind the same first column."""
    console.print(Text(grid.title, "bold"))
    for part in fitting(grid, console.width):
        table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
        for index, heading in enumerate(part.heading):
            table.add_column(Text(_stacked(heading)), justify="right" if index else "left", no_wrap=bool(index))
        for row in part.rows:
            table.add_row(*map(_coloured, row))
        console.print(table)
    for note in grid.notes:
        console.print(Text(f"  {note}", "red" if note.endswith(AGAIN) else "dim"))
    console.print()


def fitting(grid: Grid, width: int) -> Iterator[Grid]:
    """``grid`` in parts that fit ``width`` columns, each with the first column."""
    cells = [(*_stacked(heading).split("\n"), *of) for heading, *of in zip(grid.heading, *grid.rows, strict=True)]
    sizes = [max(map(len, column)) + _AROUND for column in cells]
    start, count, label = 1, len(sizes), min(sizes[0], _LABEL) + 1
    while start < count:
        end, room = start + 1, width - label - sizes[start]
        while end < count and sizes[end] <= room:
            room -= sizes[end]
            end += 1
        heading, *rows = ((row[0], *row[start:end]) for row in (grid.heading, *grid.rows))
        yield Grid(grid.title, heading, tuple(row for row in rows if start == 1 or any(row[1:])), grid.notes)
        start = end


def _stacked(heading: str) -> str:
    """The last word of a long heading goes below the others."""
    return "\n".join(heading.rsplit(" ", 1)) if len(heading) > _HEADING else heading


def _coloured(cell: str) -> Text:
    text = Text(cell)
    for word, colour in _VERDICTS.items():
        text.highlight_regex(f"{word}$", colour)
    return text

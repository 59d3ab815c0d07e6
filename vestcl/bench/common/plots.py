"""Plots of the benchmarks: medians with their quartiles, as curves and as bars. matplotlib is imported late."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from vestcl.bench.common.timing import Spread
from vestcl.io import atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Inches and dots an inch: 1,200 px wide, so that letters are legible at half the size.
_SIZE: Final = (8.0, 5.0)
_DOTS: Final = 150

#: Inches of a plot of bars: around them, and what each of them adds.
_AROUND: Final = 1.2
_BAR: Final = 0.28

#: Room to the right of the longest bar for its number, as a factor of the axis's length.
_ROOM: Final = 1.18

#: Points of a title: a device's name fits on a line.
TITLE: Final = 10


@dataclass(frozen=True)
class Curve:
    """Measurements over a quantity that varies."""

    name: str
    x: Sequence[float]
    y: Sequence[Spread]
    scale: float = 1.0
    """Factor to the axis's unit."""
    dashed: bool = False
    """For yardsticks and peers."""


def curves(path: Path, title: str, x_label: str, y_label: str, lines: Sequence[Curve]) -> Path:
    """Draw ``lines`` on logarithmic axes, each median with the band between its quartiles.

    Args:
        path: of the PNG; it is replaced whole.
        title: above the axes.
        x_label: with its unit.
        y_label: with its unit.
        lines: one or more, of positive numbers.

    Returns:
        ``path``.

    Raises:
        ValueError: no lines, or the folder can't be made.
    """
    if not lines:
        raise ValueError("`lines` must be one or more, got none")
    figure = blank(_SIZE[1])
    axes = figure.subplots()
    for line in lines:
        low, median, high = line.scale * np.array([[one.low, one.median, one.high] for one in line.y]).T
        (drawn,) = axes.plot(line.x, median, "o--" if line.dashed else "o-", label=line.name, markersize=5)
        axes.fill_between(line.x, low, high, alpha=0.2, color=drawn.get_color(), linewidth=0)
    ticks = sorted({x for line in lines for x in line.x})
    axes.set(xscale="log", yscale="log", xlabel=x_label, ylabel=y_label)
    axes.set_xticks(ticks, [f"{x:,}" if float(x).is_integer() else f"{x:g}" for x in ticks])
    axes.minorticks_off()
    return _finish(figure, path, title)


def bars(path: Path, title: str, frame: pd.DataFrame, stacked: bool = False) -> Path:
    """Draw the milliseconds of a long table as bars below each other, medians with their quartiles and numbers.

    Args:
        path: of the PNG; it is replaced whole.
        title: above the axes.
        frame: of `vestcl.bench.common.table.long_table`, in seconds. A place a row, a colour a column.
        stacked: instead a place a column, with the rows as its parts from left to right, and the number of all.

    Returns:
        ``path``.

    Raises:
        ValueError: no bars, or the folder can't be made.
    """
    from matplotlib.container import BarContainer

    if frame.empty:
        raise ValueError("`frame` must have one or more rows, got none")
    place, colour = ("column", "row") if stacked else ("row", "column")
    low, median, high = (
        1e3 * frame.pivot(index=place, columns=colour, values=part).loc[frame[place].unique(), frame[colour].unique()]
        for part in ("low", "median", "high")
    )
    figure = blank(_AROUND + _BAR * max(len(median) if stacked else median.size, 4))
    axes = figure.subplots()
    around = None if stacked else [[median[name] - low[name], high[name] - median[name]] for name in median]
    median.plot.barh(ax=axes, stacked=stacked, logx=not stacked, xerr=around, width=0.8, legend=False)
    drawn = [container for container in axes.containers if isinstance(container, BarContainer)]
    if stacked:
        wholes = median.sum(axis=1)
        axes.bar_label(drawn[-1], [f"{whole:.3g}" for whole in wholes], fontsize=7, padding=3)
        axes.set_xlim(0, _ROOM * wholes.max())
    else:
        for container in drawn:
            axes.bar_label(container, fmt="%.3g", fontsize=7, padding=3)
        axes.margins(x=_ROOM - 1)
    axes.invert_yaxis()
    axes.set(xlabel="ms", ylabel="")
    return _finish(figure, path, title)


def file_name(title: str) -> str:
    """``title`` as a file's name: letters and digits, and dashes between."""
    words = "".join(letter.lower() if letter.isalnum() else " " for letter in title).split()
    return f"{'-'.join(words)}.png"


def blank(height: float, width: float = _SIZE[0]) -> "Figure":
    """An empty figure, inches."""
    from matplotlib.figure import Figure  # its canvas is Agg's: no window, no state

    return Figure(figsize=(width, height), dpi=_DOTS, layout="constrained")


def write(figure: "Figure", path: Path) -> Path:
    """``figure`` as a PNG, which is replaced whole; ``path``.

    Raises:
        ValueError: the folder can't be made.
    """
    content = io.BytesIO()
    figure.savefig(content, format="png")
    atomic.write_bytes(path, content.getvalue())
    return path


def _finish(figure: "Figure", path: Path, title: str) -> Path:
    """With the legend below the axes: a search for a free place inside them is slow, and may find none."""
    (axes,) = figure.axes
    axes.set_title(title, fontsize=TITLE)
    axes.grid(alpha=0.3, linewidth=0.5)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    return write(figure, path)

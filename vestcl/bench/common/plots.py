"""Plots of long tables: milliseconds as bars, and curves. matplotlib is imported late."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from vestcl.io import atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Inches and dots an inch: 1,200 px wide, so that letters are legible at half the size.
_SIZE: Final = (8.0, 5.0)
_DOTS: Final = 150

#: Inches of a plot of bars: around them, and what each of them adds.
_AROUND: Final = 1.2
_BAR: Final = 0.28

#: Room next to bars and points for numbers and names, as a share of the axis.
_ROOM: Final = 0.18

#: Points of a title: a device's name fits on a line.
_TITLE: Final = 10

#: An axis of positive numbers is logarithmic where the largest is more than so many times the smallest.
_LOGARITHMIC: Final = 30


@dataclass(frozen=True)
class Curve:
    """Points of one colour."""

    name: str
    """For the legend; "" for none."""
    x: Sequence[float]
    y: Sequence[float]
    style: str = "o-"
    labels: Sequence[str] = ()
    """Next to the points."""
    x_range: tuple[Sequence[float], Sequence[float]] | None = None
    """Quartiles of ``x``."""


def curves(title: str, x_label: str, panels: Mapping[str, Sequence[Curve]]) -> "Figure":
    """Curves, an axes for each of ``panels``, by the label of y."""
    figure = _blank(_SIZE[1])
    for (label, lines), axes in zip(panels.items(), np.ravel(figure.subplots(1, len(panels))), strict=True):
        for line in lines:
            _draw(axes, line)
        for axis in ("x", "y"):
            numbers = [number for line in lines for number in getattr(line, axis)]
            if min(numbers) > 0 and max(numbers) > _LOGARITHMIC * min(numbers):
                getattr(axes, f"set_{axis}scale")("log")
        axes.set(xlabel=x_label, ylabel=label)
        axes.margins(_ROOM)
    return _finish(figure, title)


def _draw(axes: "Axes", line: Curve) -> None:
    x = np.asarray(line.x)
    around = None if line.x_range is None else [x - line.x_range[0], line.x_range[1] - x]
    axes.errorbar(x, line.y, xerr=around, fmt=line.style, label=line.name or None, elinewidth=0.7, fillstyle="none")
    for label, *place in zip(line.labels, line.x, line.y, strict=False):
        axes.annotate(label, (place[0], place[1]), (5, 5), textcoords="offset points", fontsize=8)


def bars(frame: pd.DataFrame, title: str, columns: Sequence[str] = (), stacked: bool = False) -> "Figure":
    """Milliseconds as bars below each other, medians with their quartiles and numbers.

    Args:
        frame: `vestcl.bench.common.table.Section.frame`, in seconds. A place a row, a colour a column.
        title: above the axes.
        columns: those that are drawn; none are all.
        stacked: instead a place a column, with the rows as its parts from left to right, and the number of all.
    """
    from matplotlib.container import BarContainer

    frame = frame[frame["column"].isin(columns) if columns else frame["column"] != ""]
    place, colour = ("column", "row") if stacked else ("row", "column")
    low, median, high = (
        1e3 * frame.pivot(index=place, columns=colour, values=part).loc[frame[place].unique(), frame[colour].unique()]
        for part in ("low", "median", "high")
    )
    figure = _blank(_AROUND + _BAR * max(len(median) if stacked else median.size, 4))
    axes = figure.subplots()
    around = None if stacked else [[median[name] - low[name], high[name] - median[name]] for name in median]
    median.plot.barh(ax=axes, stacked=stacked, logx=not stacked, xerr=around, width=0.8, legend=False)
    drawn = [container for container in axes.containers if isinstance(container, BarContainer)]
    if stacked:
        wholes = median.sum(axis=1)
        axes.bar_label(drawn[-1], [f"{whole:.3g}" for whole in wholes], fontsize=7, padding=3)
        axes.set_xlim(0, (1 + _ROOM) * wholes.max())
    else:
        for container in drawn:
            axes.bar_label(container, fmt="%.3g", fontsize=7, padding=3)
        axes.margins(x=_ROOM)
    axes.invert_yaxis()
    axes.set(xlabel="ms", ylabel="")
    return _finish(figure, title)


def file_name(title: str) -> str:
    """``title`` as a file's name: letters and digits, and dashes between."""
    words = "".join(letter.lower() if letter.isalnum() else " " for letter in title).split()
    return f"{'-'.join(words)}.png"


def write(figure: "Figure", path: Path) -> None:
    """Write ``figure`` as a PNG, which is replaced whole.

    Raises:
        ValueError: the folder can't be made.
    """
    content = io.BytesIO()
    figure.savefig(content, format="png")
    atomic.write_bytes(path, content.getvalue())


def _blank(height: float) -> "Figure":
    from matplotlib.figure import Figure  # its canvas is Agg's: no window, no state

    return Figure(figsize=(_SIZE[0], height), dpi=_DOTS, layout="constrained")


def _finish(figure: "Figure", title: str) -> "Figure":
    """With the legend below the axes: a search for a free place inside them is slow, and may find none."""
    figure.suptitle(title, fontsize=_TITLE)
    for axes in figure.axes:
        axes.grid(alpha=0.3, linewidth=0.5)
    handles, labels = figure.axes[-1].get_legend_handles_labels()
    if labels:
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    return figure

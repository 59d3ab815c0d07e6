"""Plots of the benchmarks: medians with their quartiles, as curves and as bars. matplotlib is imported late."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from vestcl.bench.common.timing import Spread
from vestcl.io import atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Inches and dots an inch: 1,200 px wide, so that letters are legible at half the size.
_SIZE: Final = (8.0, 5.0)
_DOTS: Final = 150

#: Inches that each bar adds to a figure's height.
_BAR: Final = 0.28

#: Of the band between quartiles: it must show where bands overlap.
_BAND: Final = 0.2

#: Room to the right of the longest bar for its number, as a factor of the axis's length.
_ROOM: Final = 1.18

#: Points of a title: a device's name fits on a line.
TITLE: Final = 10

#: As many names as fit beside each other.
_LEGEND_COLUMNS: Final = 3

_MARKERS: Final = "osD^vPX<>"


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


def curves(
    path: Path, title: str, x_label: str, y_label: str, lines: Sequence[Curve], ticks: Sequence[float] | None = None
) -> Path:
    """Draw ``lines`` on logarithmic axes, each median with the band between its quartiles.

    Args:
        path: of the PNG; it is replaced whole.
        title: above the axes.
        x_label: with its unit.
        y_label: with its unit.
        lines: one or more, of positive numbers.
        ticks: where the x axis has its numbers; None: everywhere that a curve has a point.

    Returns:
        ``path``.

    Raises:
        ValueError: no lines, or the folder can't be made.
    """
    if not lines:
        raise ValueError("`lines` must be one or more, got none")
    figure = blank(_SIZE[1])
    axes = figure.subplots()
    for number, line in enumerate(lines):
        median, low, high = ([getattr(y, name) * line.scale for y in line.y] for name in ("median", "low", "high"))
        style, marker = "--" if line.dashed else "-", _MARKERS[number % len(_MARKERS)]
        drawn = axes.plot(line.x, median, label=line.name, markersize=5, linestyle=style, marker=marker)[0]
        axes.fill_between(line.x, low, high, alpha=_BAND, color=drawn.get_color(), linewidth=0)
    axes.set_title(title, fontsize=TITLE)
    axes.set(xlabel=x_label, ylabel=y_label, xscale="log", yscale="log")
    _label_ticks(axes, sorted({x for line in lines for x in line.x}) if ticks is None else ticks)
    axes.grid(alpha=0.3, which="both", linewidth=0.5)
    _legend(figure)
    return write(figure, path)


def bars(
    path: Path,
    title: str,
    x_label: str,
    groups: Mapping[str, Mapping[str, Spread]],
    scale: float = 1.0,
    log: bool = False,
) -> Path:
    """Draw medians as bars, a line from quartile to quartile on each; below each other, the first on top.

    Args:
        path: of the PNG; it is replaced whole.
        title: above the axes.
        x_label: with its unit.
        groups: bars by colour's name and bar's name. Bars of one name stand together.
        scale: factor to the axis's unit.
        log: the axis is logarithmic, for positive numbers that differ by orders of magnitude.

    Returns:
        ``path``.

    Raises:
        ValueError: no bars, or the folder can't be made.
    """
    names = list(dict.fromkeys(name for group in groups.values() for name in group))
    if not names:
        raise ValueError("`groups` must have one or more bars, got none")
    thick = 0.8 / len(groups)
    figure = blank(1.2 + _BAR * max(len(names) * len(groups), 4))
    axes = figure.subplots()
    for number, (label, group) in enumerate(groups.items()):
        places = [names.index(name) + (number - (len(groups) - 1) / 2) * thick for name in group]
        low, median, high = ([getattr(s, name) * scale for s in group.values()] for name in ("low", "median", "high"))
        around = [np.subtract(median, low), np.subtract(high, median)]
        axes.barh(places, median, thick, xerr=around, label=label, error_kw={"elinewidth": 1})
        for place, value, end in zip(places, median, high, strict=True):
            axes.annotate(_short(value), (end, place), (3, 0), textcoords="offset points", va="center", size=7)
    axes.set_title(title, fontsize=TITLE)
    axes.set(xlabel=x_label, yticks=range(len(names)), yticklabels=names)
    ends = [spread.high * scale for group in groups.values() for spread in group.values()]
    if log:
        axes.set_xscale("log")
        lowest, _ = axes.get_xlim()
        axes.set_xlim(right=max(ends) * (max(ends) / lowest) ** (_ROOM - 1))
        axes.xaxis.set_major_formatter(_number)
    else:
        axes.set_xlim(0, max(ends) * _ROOM)
    axes.invert_yaxis()
    axes.grid(axis="x", alpha=0.3, linewidth=0.5)
    if len(groups) > 1:
        _legend(figure)
    return write(figure, path)


def file_name(title: str) -> str:
    """``title`` as a file's name: letters and digits, and dashes between."""
    words = "".join(letter.lower() if letter.isalnum() else " " for letter in title).split()
    return f"{'-'.join(words)}.png"


def blank(height: float, width: float = _SIZE[0]) -> "Figure":
    """An empty figure, inches."""
    from matplotlib.figure import Figure  # its canvas is Agg's: no window, no state

    return Figure(figsize=(width, height), dpi=_DOTS, layout="constrained")


def _legend(figure: "Figure") -> None:
    """Below the axes: a search for a free place inside them is slow, and may find none."""
    figure.legend(loc="outside lower center", ncols=_LEGEND_COLUMNS, fontsize=8)


def _label_ticks(axes: "Axes", ticks: Sequence[float]) -> None:
    from matplotlib.ticker import NullFormatter, NullLocator, StrMethodFormatter

    axes.set_xticks(list(ticks))
    axes.xaxis.set_major_formatter(_number)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(_number)
    low, high = axes.get_ylim()
    if high < low * 10:  # a decade has one number on its axis, or none: let the smaller ones be seen
        axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:,.3g}"))
    else:
        axes.yaxis.set_minor_formatter(NullFormatter())


def _short(value: float) -> str:
    """A bar's number: three digits, or all of a whole one."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _number(value: float, _: float) -> str:
    """A tick's label: whole numbers with all their digits."""
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:g}"


def write(figure: "Figure", path: Path) -> Path:
    """``figure`` as a PNG, which is replaced whole; ``path``.

    Raises:
        ValueError: the folder can't be made.
    """
    content = io.BytesIO()
    figure.savefig(content, format="png")
    atomic.write_bytes(path, content.getvalue())
    return path

"""Bars in parts: where time goes, one variant below the other. matplotlib is imported late."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from vestcl.bench.common.plots import TITLE, blank, write
from vestcl.bench.common.timing import Spread

#: Inches: a plot's width, its height beside the bars, and what each bar adds.
_WIDTH: Final = 9.0
_AROUND: Final = 1.5
_BAR: Final = 0.34

#: Room to the right of the longest bar for its number, a factor.
_ROOM: Final = 1.18

#: Between two groups, of a bar's place.
_GAP: Final = 0.5


@dataclass(frozen=True)
class Bar:
    """One bar."""

    group: str
    """Bars of one group stand together."""
    name: str
    parts: dict[str, float]
    """From left to right."""
    whole: Spread
    """Its median is told beside the bar, and its quartiles drawn."""


def stacked_bars(path: Path, title: str, x_label: str, bars: Sequence[Bar], scale: float = 1.0) -> Path:
    """Draw bars below each other, the first on top.

    Args:
        path: of the PNG; it is replaced whole.
        title: above the axes.
        x_label: with its unit.
        bars: one or more.
        scale: factor to the axis's unit.

    Returns:
        ``path``.

    Raises:
        ValueError: no bars, or the folder can't be made.
    """
    if not bars:
        raise ValueError("`bars` must be one or more, got none")
    from matplotlib import colormaps

    figure = blank(_AROUND + _BAR * len(bars), _WIDTH)
    axes = figure.subplots()
    changes = [one.group != other.group for one, other in itertools.pairwise(bars)]
    places = np.arange(len(bars)) + _GAP * np.cumsum([0, *changes])
    starts, colours = np.zeros(len(bars)), colormaps["tab10"]
    for number, kind in enumerate(dict.fromkeys(part for bar in bars for part in bar.parts)):
        lengths = np.array([scale * bar.parts.get(kind, 0.0) for bar in bars])
        axes.barh(places, lengths, left=starts, label=kind, color=colours(number % colours.N), height=0.8)
        starts += lengths
    for place, bar in zip(places, bars, strict=True):
        low, median, high = (scale * value for value in (bar.whole.low, bar.whole.median, bar.whole.high))
        axes.plot([low, high], [place, place], color="black", linewidth=1)
        axes.annotate(f"{median:.3g}", (high, place), (4, 0), textcoords="offset points", va="center", size=8)
    axes.set_title(title, fontsize=TITLE)
    axes.set(xlabel=x_label, yticks=places, yticklabels=[bar.name for bar in bars])
    axes.set_xlim(0, _ROOM * scale * max(bar.whole.high for bar in bars))
    axes.invert_yaxis()
    axes.grid(axis="x", alpha=0.3, linewidth=0.5)
    figure.legend(fontsize=8, ncols=8, loc="outside lower center")
    return write(figure, path)

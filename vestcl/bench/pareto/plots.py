"""Figures of `vestcl bench pareto`: time to the right, error upwards, from its JSON. matplotlib is imported late.

`knob_figure`, `front_figure` and `recursion_figure` are what notebook 04 draws with, too.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from vestcl.bench.common.plots import blank, file_name, write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Inches of a figure of two axes: its height and width.
_SIZE: Final = (4.2, 10.0)

#: Next to and above the points, as a share of the axes: for their names.
_MARGINS: Final = (0.15, 0.12)

Points = Sequence[Mapping[str, Any]]


def draw(details: Mapping[str, Any], folder: Path, prefix: str = "") -> None:
    """Write a PNG a knob, one of the front, and one of several steps.

    Args:
        details: of one device's results.
        folder: made where it does not exist.
        prefix: of the files' names.

    Raises:
        ValueError: the folder can't be made.
    """
    figures = {name: knob_figure(name, knob) for name, knob in details["knobs"].items()}
    for name, figure in (("front", front_figure), ("recursion", recursion_figure)):
        figures |= {name: figure(details[name])} if name in details else {}
    for name, drawn in figures.items():
        write(drawn, folder / file_name(f"{prefix}{name}"))


def knob_figure(name: str, knob: Mapping[str, Any]) -> "Figure":
    """Error against float64, and PSNR drop against the true next frame, over time; of ``details["knobs"]``."""
    figure, points = blank(*_SIZE), knob["points"]
    left, right = figure.subplots(1, 2)
    for axes, key, label in ((left, "rms", "rms difference from float64"), (right, "loss", "PSNR drop, dB")):
        _plot(axes, points, key, "o", names=[point["value"] for point in points])
        for kind, style in (("default", "s"), ("knee", "D")):
            _plot(axes, [point for point in points if point["value"] == knob[kind]], key, style, kind)
        axes.set(ylabel=label)
    left.set_yscale("log")
    right.legend(fontsize=8)
    figure.suptitle(f"{name}: {knob['about']}")
    return figure


def front_figure(together: Mapping[str, Any]) -> "Figure":
    """All combinations, the Pareto front joined by a line, and the named qualities; of ``details["front"]``."""
    figure, points = blank(*_SIZE), together["points"]
    axes, levels = figure.subplots(), {value: level for level, value in together["qualities"].items()}
    front = [point for point in points if point["value"] in together["best"]]
    _plot(axes, points, "loss", "o", names=[levels.get(point["value"], "") for point in points])
    _plot(axes, sorted(front, key=lambda point: float(point["loss"])), "loss", "o-", "Pareto front")
    axes.set(ylabel="PSNR drop, dB", title="Knobs together: time against error")
    axes.legend(fontsize=8)
    return figure


def recursion_figure(rows: Points) -> "Figure":
    """PSNR over time of both ways to forecast several steps; of ``details["recursion"]``."""
    figure = blank(*_SIZE)
    axes = figure.subplots()
    for mode in dict.fromkeys(row["mode"] for row in rows):
        own = [row for row in rows if row["mode"] == mode]
        _plot(axes, own, "psnr", "o-", mode, [f"t+{row['steps']}" for row in own])
    axes.set(xlabel="ms, all steps", ylabel="PSNR, dB", title="Several steps")
    axes.legend(fontsize=8)
    return figure


def _plot(axes: "Axes", points: Points, key: str, style: str, label: str = "", names: Sequence[str] = ()) -> None:
    """Medians over time, with a bar from quartile to quartile of time, and names next to them."""
    low, x, high = (np.array([1e3 * point["seconds"][part] for point in points]) for part in ("low", "median", "high"))
    y = [point[key]["median"] if isinstance(point[key], Mapping) else point[key] for point in points]
    around, size = [x - low, high - x], 5 if names or "-" in style else 12
    axes.errorbar(x, y, xerr=around, fmt=style, label=label or None, elinewidth=0.7, fillstyle="none", markersize=size)
    for name, *place in zip(names, x, y, strict=False):
        axes.annotate(name, (place[0], place[1]), (5, 5), textcoords="offset points", fontsize=8)
    axes.margins(*_MARGINS)
    axes.set(xlabel="ms/step")
    axes.grid(alpha=0.3, linewidth=0.5)

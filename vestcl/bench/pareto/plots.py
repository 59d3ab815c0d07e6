"""Figures of `vestcl bench pareto`: time to the right, error upwards, from its JSON. matplotlib is imported late.

`knob_figure`, `front_figure` and `recursion_figure` are what notebook 04 draws with, too.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

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
    if "front" in details:
        figures["front"] = front_figure(details["front"])
    if "recursion" in details:
        figures["recursion"] = recursion_figure(details["recursion"])
    for name, figure in figures.items():
        write(figure, folder / file_name(f"{prefix}{name}"))


def knob_figure(name: str, knob: Mapping[str, Any]) -> "Figure":
    """Error against float64, and PSNR drop against the true next frame, over time.

    Args:
        name: of the knob.
        knob: of the results' ``details["knobs"]``.
    """
    figure = blank(*_SIZE)
    left, right = figure.subplots(1, 2)
    names = {point["value"]: point["value"] for point in knob["points"]}
    for axes, key, label in ((left, "rms", "rms difference from float64"), (right, "loss", "PSNR drop, dB")):
        _scatter(axes, knob["points"], key, label, names)
        for kind, marker in (("default", "s"), ("knee", "o")):
            x, y = _places([point for point in knob["points"] if point["value"] == knob[kind]], key)
            axes.scatter(x, y, s=150, marker=marker, facecolors="none", edgecolors="C3", label=kind, zorder=3)
    left.set_yscale("log")
    right.legend(fontsize=8)
    figure.suptitle(f"{name}: {knob['about']}")
    return figure


def front_figure(together: Mapping[str, Any]) -> "Figure":
    """All combinations, the Pareto front joined by a line, and the named qualities.

    Args:
        together: the results' ``details["front"]``.
    """
    figure = blank(*_SIZE)
    axes = figure.subplots()
    points = together["points"]
    _scatter(axes, points, "loss", "PSNR drop, dB", {value: level for level, value in together["qualities"].items()})
    front = sorted((p for p in points if p["value"] in together["best"]), key=lambda p: float(p["seconds"]["median"]))
    axes.plot(*_places(front, "loss"), linewidth=1, label="Pareto front")
    axes.set_title("Knobs together: time against error")
    axes.legend(fontsize=8)
    return figure


def recursion_figure(rows: Points) -> "Figure":
    """PSNR over time of both ways to forecast several steps.

    Args:
        rows: the results' ``details["recursion"]``.
    """
    figure = blank(*_SIZE)
    axes = figure.subplots()
    for mode in dict.fromkeys(row["mode"] for row in rows):
        own = [{**row, "value": row["steps"]} for row in rows if row["mode"] == mode]
        _scatter(axes, own, "psnr", "PSNR, dB", {row["steps"]: f"t+{row['steps']}" for row in own})
        axes.plot(*_places(own, "psnr"), label=mode)
    axes.set(xlabel="ms, all steps", title="Several steps")
    axes.legend(fontsize=8)
    return figure


def _places(points: Points, key: str) -> tuple[list[float], list[float]]:
    """Milliseconds and medians of ``key``."""
    values = [point[key]["median"] if isinstance(point[key], Mapping) else point[key] for point in points]
    return [point["seconds"]["median"] * 1e3 for point in points], values


def _scatter(axes: "Axes", points: Points, key: str, label: str, names: Mapping[Any, str]) -> None:
    """Medians, with a bar from quartile to quartile of time, and names by value."""
    x, y = _places(points, key)
    low, high = ([point["seconds"][end] * 1e3 for point in points] for end in ("low", "high"))
    around = [[m - end for m, end in zip(x, low, strict=True)], [end - m for m, end in zip(x, high, strict=True)]]
    axes.errorbar(x, y, xerr=around, elinewidth=0.7, linestyle="none", marker="o", markersize=4)
    for point, ms, value in zip(points, x, y, strict=True):
        axes.annotate(names.get(point["value"], ""), (ms, value), (5, 5), textcoords="offset points", fontsize=8)
    axes.margins(*_MARGINS)
    axes.set(xlabel="ms/step", ylabel=label)
    axes.grid(alpha=0.3, linewidth=0.5)

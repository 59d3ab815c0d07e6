"""Figures of `vestcl bench pareto`: time to the right, error upwards, from what is in its JSON. matplotlib comes late.

`knob_figure` and `front_figure` are what notebook 04 draws with, too.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vestcl.bench.common.plots import blank, file_name, write
from vestcl.bench.common.results import Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Inches of a figure of two axes: its height and width.
_SIZE: Final = (4.2, 10.0)

_COLOUR: Final = "#30638e"
_MARKED: Final = "#d1495b"

#: Beside and above the points, as a share of the axes: names stand there.
_ROOM: Final = (0.15, 0.12)


def draw(results: Sequence[Results], folder: Path) -> list[Path]:
    """A PNG a knob and one of the front, for each device; what was written.

    Raises:
        ValueError: the folder can't be made.
    """
    written = []
    for number, result in enumerate(results):
        prefix = f"{number} " if len(results) > 1 else ""
        for name, knob in result.details["knobs"].items():
            written.append(write(knob_figure(name, knob), folder / file_name(f"{prefix}{name}")))
        if "front" in result.details:
            written.append(write(front_figure(result.details["front"]), folder / file_name(f"{prefix}front")))
        if "splatter" in result.details:
            figure = splatter_figure(result.details["splatter"])
            written.append(write(figure, folder / file_name(f"{prefix}splatter")))
        if "recursion" in result.details:
            figure = recursion_figure(result.details["recursion"])
            written.append(write(figure, folder / file_name(f"{prefix}recursion")))
    return written


def knob_figure(name: str, knob: Mapping[str, Any]) -> "Figure":
    """Error against float64, and PSNR lost against the true next frame, over time.

    Args:
        name: of the knob.
        knob: of the results' ``details["knobs"]``.
    """
    figure = blank(*_SIZE)
    left, right = figure.subplots(1, 2)
    points = knob["points"]
    for axes, key, label in ((left, "rms", "rms difference from float64"), (right, "loss", "PSNR lost, dB")):
        _scatter(axes, points, key, line=True)
        for kind, marker, size in (("default", "s", 90), ("knee", "o", 170)):
            _mark(axes, [point for point in points if point["value"] == knob[kind]], key, kind, marker, size)
        _name(axes, points, key)
        axes.set(xlabel="ms a step", ylabel=label)
        axes.grid(alpha=0.3, linewidth=0.5)
    left.set_yscale("log")
    right.legend(fontsize=8)
    figure.suptitle(f"{name}: {knob['about']}")
    return figure


def front_figure(together: Mapping[str, Any]) -> "Figure":
    """All combinations, those that no other one beats joined by a line, and the named qualities.

    Args:
        together: the results' ``details["front"]``.
    """
    figure = blank(*_SIZE)
    axes = figure.subplots()
    points = together["points"]
    _scatter(axes, points, "loss", line=False)
    best = sorted(
        (point for point in points if point["value"] in together["best"]), key=lambda point: point["seconds"]["median"]
    )
    axes.plot(
        [point["seconds"]["median"] * 1e3 for point in best], [point["loss"] for point in best], color=_COLOUR,
        linewidth=1, label="no other one is better in both",
    )  # fmt: skip
    for level, value in together["qualities"].items():
        chosen = [point for point in points if point["value"] == value]
        for point in chosen:
            place = point["seconds"]["median"] * 1e3, point["loss"]
            axes.scatter(*place, s=120, facecolors="none", edgecolors=_MARKED, linewidths=2, zorder=3)
            axes.annotate(level, place, (8, 8), textcoords="offset points", color=_MARKED, weight="bold")
    axes.set(xlabel="ms a step", ylabel="PSNR lost, dB", title="Knobs together: time against error")
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.legend(fontsize=8)
    return figure


def splatter_figure(knobs: Mapping[str, Sequence[Mapping[str, Any]]]) -> "Figure":
    """Error over time of the splatter's own knobs, those values that have a time.

    Args:
        knobs: the results' ``details["splatter"]``.
    """
    figure = blank(*_SIZE)
    titles = {"fragments": "fragments kept a pixel (torch's compositing)", "tile": "side of a tile, px"}
    for axes, (name, title) in zip(figure.subplots(1, len(titles)), titles.items(), strict=True):
        points = [{**choice, "rms": choice["error"]} for choice in knobs[name]]
        _scatter(axes, points, "rms", line=False)
        _mark(axes, [point for point in points if point["default"]], "rms", "default", "s", 90)
        _name(axes, points, "rms")
        axes.set(xlabel="ms", ylabel="rms difference from float64, of rms", title=title, yscale="log")
        axes.grid(alpha=0.3, linewidth=0.5)
        axes.legend(fontsize=8)
    return figure


def recursion_figure(rows: Sequence[Mapping[str, Any]]) -> "Figure":
    """PSNR over time of both ways to forecast several steps.

    Args:
        rows: the results' ``details["recursion"]``.
    """
    figure = blank(*_SIZE)
    axes = figure.subplots()
    axes.margins(*_ROOM)
    for mode in dict.fromkeys(row["mode"] for row in rows):
        own = [row for row in rows if row["mode"] == mode]
        places = [(row["seconds"]["median"] * 1e3, row["psnr"]["median"]) for row in own]
        axes.plot(*zip(*places, strict=True), marker="o", label=mode)
        for row, place in zip(own, places, strict=True):
            axes.annotate(f"t+{row['steps']}", place, (6, 4), textcoords="offset points", fontsize=8)
    axes.set(xlabel="ms, all steps", ylabel="PSNR, dB", title="Several steps")
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.legend(fontsize=8)
    return figure


def _value(point: Mapping[str, Any], key: str) -> float:
    value = point[key]
    return float(value["median"] if isinstance(value, Mapping) else value)


def _scatter(axes: "Axes", points: Sequence[Mapping[str, Any]], key: str, line: bool) -> None:
    """Medians, with a bar from quartile to quartile of time."""
    median, low, high = ([point["seconds"][part] * 1e3 for point in points] for part in ("median", "low", "high"))
    around = [
        [middle - end for middle, end in zip(median, low, strict=True)],
        [end - middle for middle, end in zip(median, high, strict=True)],
    ]
    y = [_value(point, key) for point in points]
    style = "-" if line else "none"
    axes.margins(*_ROOM)
    axes.errorbar(
        median, y, xerr=around, color=_COLOUR, elinewidth=0.7, linestyle=style, linewidth=1, marker="o", markersize=4
    )


def _mark(axes: "Axes", points: Sequence[Mapping[str, Any]], key: str, label: str, marker: str, size: float) -> None:
    x, y = [point["seconds"]["median"] * 1e3 for point in points], [_value(point, key) for point in points]
    axes.scatter(
        x, y, s=size, marker=marker, facecolors="none", edgecolors=_MARKED, linewidths=1.5, label=label, zorder=3
    )


def _name(axes: "Axes", points: Sequence[Mapping[str, Any]], key: str) -> None:
    for point in points:
        place = point["seconds"]["median"] * 1e3, _value(point, key)
        axes.annotate(point["value"], place, (5, 5), textcoords="offset points", fontsize=8)

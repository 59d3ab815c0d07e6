"""Each splat kernel beside the roofs of its device: `python -m vestcl.bench.splat.roofline --plots DIR`."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import tyro

from vestcl import opencl
from vestcl.bench.common import plots as _plots
from vestcl.bench.common import results as _results
from vestcl.bench.common.results import Measure, Results
from vestcl.bench.splat import report as _report
from vestcl.bench.splat.roofs import Roofline, roofline
from vestcl.bench.splat.scenes import street
from vestcl.evaluation.tables import Grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Inches of the plot, two panels side by side: its height and width.
_SIZE: Final = (4.5, 11.0)

#: Columns of the tables where they don't go to a terminal, whose own number counts there.
_WIDTH: Final = 160


@dataclass(frozen=True)
class RooflineBench:
    """How near each splat kernel comes to what its device can do."""

    height: int = 256
    """Pixels."""
    width: int = 832
    """Pixels."""
    channels: int = 32
    """Of the features."""
    radii: tuple[float, ...] = (1.0, 2.0)
    """Pixels; each is a scene of its own."""
    calls: int = 30
    """Profiled calls of forward + backward."""
    seed: int = 0
    """Of the street, opacities and features."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name; "all": every one that works."""
    json: Path | None = None
    """File for the results."""
    markdown: Path | None = None
    """File for the tables."""
    plots: Path | None = None
    """Folder for plots (PNG)."""


def title_of(result: Roofline) -> str:
    """Which scene."""
    facts = result.facts
    return f"Roofline, {facts.height}x{facts.width}, C = {facts.channels}, radius {facts.radius:g} px"


def grid(result: Roofline) -> Grid:
    """A row a kernel, the roofs below."""
    rows = []
    for point in result.points:
        speeds = point.moved_bytes / point.time.median / 1e9, point.flops / point.time.median / 1e9
        work = f"{point.moved_bytes / 1e6:.1f}", f"{point.flops / 1e6:.1f}", f"{point.flops / point.moved_bytes:.2f}"
        share = f"{point.share.median:.0%} ({point.share.low:.0%}-{point.share.high:.0%})"
        cells = f"{point.time.median * 1e3:.3f}", *work, f"{speeds[0]:.1f}", f"{speeds[1]:.1f}", point.bound, share
        rows.append((point.name, str(point.launches), *cells))
    least = sum(point.share.median * point.time.median for point in result.points)
    blank = ("",) * 6
    rows.append(("all kernels", "", f"{result.kernels * 1e3:.3f}", *blank, f"{least / result.kernels:.0%}"))
    rows.append(("no kernel running", "", f"{result.between * 1e3:.3f}", *blank, ""))
    roofs = f"roofs: {result.bandwidth.median / 1e9:.1f} GB/s copied, {result.peak.median / 1e9:.0f} Gflop/s"
    heading = "", "launches", "ms", "MB", "Mflop", "flop/byte", "GB/s", "Gflop/s", "bound by", "of the roof"
    return Grid(title_of(result), heading, tuple(rows), (roofs, *_report.busy(result.others_cores)))


def measures(result: Roofline) -> list[Measure]:
    """The roofs, and each kernel's share."""
    radius = f", radius {result.facts.radius:g}"
    shares = [Measure.of(f"roofline {point.name}{radius}", "1", point.share, "higher") for point in result.points]
    roofs = [("bandwidth", "B/s", result.bandwidth), ("peak", "flop/s", result.peak)]
    return [*(Measure.of(f"roofline {name}{radius}", unit, roof, "higher") for name, unit, roof in roofs), *shares]


def plot(path: Path, result: Roofline) -> Path:
    """Draw the roofs and the kernels that compute, on logarithmic axes; beside them every kernel's share as a bar.

    Args:
        path: of the PNG; it is replaced whole.
        result: from `roofline`.

    Returns:
        ``path``.

    Raises:
        ValueError: the folder can't be made.
    """
    figure = _plots.blank(*_SIZE)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_roofs(left, result)
    shares = [point.share for point in result.points]
    around = [[s.median - s.low for s in shares], [s.high - s.median for s in shares]]
    right.barh([point.name for point in result.points], [s.median for s in shares], xerr=around, color="C0")
    right.axvline(1, color="black", linewidth=1)
    right.invert_yaxis()
    right.set(xlabel="share of the roof", xlim=(0, max(1.05, *(s.high for s in shares))))
    right.grid(axis="x", alpha=0.3, linewidth=0.5)
    figure.suptitle(title_of(result), fontsize=_plots.TITLE)
    return _plots.write(figure, path)


def _draw_roofs(axes: "Axes", result: Roofline) -> None:
    ridge = result.peak.median / result.bandwidth.median
    computing = [point for point in result.points if point.flops]
    places = [point.flops / point.moved_bytes for point in computing]
    x = np.geomspace(min([*places, ridge]) / 4, max([*places, ridge]) * 4, 200)
    roof = np.minimum(x * result.bandwidth.median, result.peak.median) / 1e9
    roofs = f"{result.bandwidth.median / 1e9:.0f} GB/s, {result.peak.median / 1e9:.0f} Gflop/s"
    axes.plot(x, roof, color="black", label=roofs)
    for number, (point, place) in enumerate(zip(computing, places, strict=True)):
        reached = point.flops / point.time.median / 1e9
        axes.plot(place, reached, "o", color=f"C{number}", label=f"{point.name}, {point.share.median:.0%}")
        axes.plot([place, place], [reached, reached / point.share.median], ":", color=f"C{number}")
    axes.set(xscale="log", yscale="log", xlabel="flops for each byte that must move", ylabel="Gflop/s")
    axes.grid(alpha=0.3, which="both", linewidth=0.5)
    axes.legend(fontsize=8)


# ---------------------------------------------------------------- command


def main(config: RooflineBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size, radius or number of calls that is not positive.
        DeviceError: no such device.
    """
    _results.check_positive(config, "height", "width", "channels", "calls")
    if not config.radii or min(config.radii) <= 0:
        raise ValueError(f"`radii` must be one or more positive numbers, got {config.radii}")
    console = _results.console(_WIDTH)
    results = _results.measure_each(config.device, partial(_measure_device, config), console)
    _results.show(results, console)
    _results.save(results, config.json, config.markdown)
    _results.tell_written(console, config.json, config.markdown, config.plots)


def _measure_device(config: RooflineBench, session: opencl.Session) -> Results:
    found = []
    for radius in config.radii:
        scene = street(config.height, config.width, config.channels, radius, config.seed)
        found.append(roofline(scene, config.calls))
        if config.plots is not None:
            plot(config.plots / _plots.file_name(f"{session.info.name} {title_of(found[-1])}"), found[-1])
    details: dict[str, Any] = {"rooflines": _results.plain(found)}
    figures = [measure for result in found for measure in measures(result)]
    grids = [grid(result) for result in found]
    return Results("roofline", _results.describe(session), _results.settings(config), figures, grids, details)


if __name__ == "__main__":
    main(tyro.cli(RooflineBench))

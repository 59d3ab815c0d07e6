"""Images of a model card: the curves of a run, and contact sheets small enough for a repository."""

import io
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

from vestcl.io.atomic import write_bytes
from vestcl.io.images import read_pixels, write_pixels

#: Rows of a log.
Rows = Sequence[dict[str, Any]]

#: Largest sheet, bytes.
SHEET_BYTES: Final = 300_000

#: Rows that a smoothed curve takes the mean of: this share of a stage's, so that stages of any length show their trend.
SMOOTHED: Final = 0.05

#: Panels: title, unit of the axis, and the log's columns with the factor that brings them to that unit.
PANELS: Final[tuple[tuple[str, str, dict[str, float]], ...]] = (
    ("loss", "weighted sum", {"loss": 1}),
    ("image terms, before their weights", "", {"l1": 1, "ssim": 1, "perceptual": 1}),
    ("rotation error at the target's time", "degrees", {"rotation": 180 / np.pi}),
    ("translation error at the target's time", "m", {"translation": 1}),
)

#: What a step's seconds are split into.
PARTS: Final = ("splatting", "data", "networks")

#: Qualities that a sheet is tried with before it is made smaller, and the factor of that: below 70 letters smear.
_QUALITIES: Final = (90, 80, 70)
_SHRINK: Final = 0.85

#: Space below and above the curves of a panel, a factor: even a curve of one value needs some.
_MARGIN: Final = 1.15

#: The step time's axis ends above this share of rows: rare steps take many times as long, next to others' work.
_TYPICAL: Final = 0.97

_DOTS: Final = 100
_INCHES: Final = (14.0, 8.0)


def draw_curves(path: Path, rows: Rows) -> None:
    """Losses, errors of the camera's motion, step time and learning rate by step; stages are shaded in turn.

    Args:
        path: of the PNG.
        rows: of the run's log, from `train.run.report.read_log`, one or more.
    """
    figure = Figure(figsize=_INCHES, dpi=_DOTS, layout="constrained")
    axes = figure.subplots(3, 2).ravel()
    for axis, (title, unit, columns) in zip(axes, PANELS, strict=False):
        for name, factor in columns.items():
            _curve(axis, rows, name, factor, len(columns) > 1)
        axis.set(title=title, ylabel=unit)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(loc="center left", fontsize=8)
    _times(axes[len(PANELS)], rows)
    _curve(axes[-1], rows, "learning_rate", 1, False)
    axes[-1].set(title="learning rate", xlabel="step")
    for axis in axes:
        axis.set_xlim(0, rows[-1]["step"])
        _shade(axis, rows)
    content = io.BytesIO()
    figure.savefig(content, format="png")
    write_bytes(path, content.getvalue())


def write_sheet(path: Path, source: Path, limit: int = SHEET_BYTES) -> None:
    """An image as a JPEG of at most ``limit`` bytes: first of lower quality, then smaller.

    Args:
        path: of the JPEG.
        source: the image.
        limit: bytes, 10,000 or more.

    Raises:
        ValueError: no such image, or a ``limit`` that none would keep.
    """
    if limit < 10_000:
        raise ValueError(f"`limit` must be 10000 or more, got {limit}")
    pixels = read_pixels(source)
    while True:
        for quality in _QUALITIES:
            write_pixels(path, pixels, quality)
            if path.stat().st_size <= limit:
                return
        height, width = pixels.shape[:2]
        size = max(round(width * _SHRINK), 1), max(round(height * _SHRINK), 1)
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def smoothed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """y_i = mean of x_j, |j - i| <= n, with n = SMOOTHED / 2 of all; at both ends over what there is.

    Args:
        values: [N] of one stage, finite.

    Returns:
        [N].
    """
    half = round(SMOOTHED / 2 * len(values))
    sums = np.concatenate([[0.0], np.cumsum(values)])
    first = np.maximum(np.arange(len(values)) - half, 0)
    last = np.minimum(np.arange(len(values)) + half + 1, len(values))
    mean: NDArray[np.float64] = (sums[last] - sums[first]) / (last - first)
    return mean


def stages_of(rows: Rows) -> list[tuple[str, int, int]]:
    """(name, first step, last step) of each stage that the log has, in turn; a stage begins where the one before ends.

    Args:
        rows: of the log.
    """
    found, begin = list[tuple[str, int, int]](), 0
    for name, group in groupby(rows, lambda row: row["stage"]):
        end = max(int(row["step"]) for row in group)
        found.append((str(name), begin, end))
        begin = end
    return found


def _curve(axis: Axes, rows: Rows, name: str, factor: float, labelled: bool) -> None:
    """Each row faintly, the smoothed curve on it; one line per stage, for stages differ in what they show."""
    colour, label = None, name if labelled else None
    for stage, _, _ in stages_of(rows):
        own = [row for row in rows if row["stage"] == stage and row.get(name)]
        if not own:
            continue
        steps, values = (np.array([row[key] for row in own], np.float64) for key in ("step", name))
        (line,) = axis.plot(steps, smoothed(factor * values), color=colour, label=label, linewidth=1.6)
        colour, label = line.get_color(), None
        if name != "learning_rate":
            axis.plot(steps, factor * values, color=colour, alpha=0.25, linewidth=0.7)
    low, high = axis.dataLim.intervaly
    if 0 < low <= high < np.inf:
        axis.set_ylim(low / _MARGIN, high * _MARGIN)  # before the scale, which else looks for limits of its own
        axis.set_yscale("log")
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_minor_locator(NullLocator())
        axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))


def _times(axis: Axes, rows: Rows) -> None:
    """Seconds per step, one part on the other."""
    steps = np.array([row["step"] for row in rows])
    below = np.zeros(len(rows))
    sums = {part: np.array([row.get(f"s_{part}") or 0.0 for row in rows]) for part in PARTS}
    total = sum(float(seconds.sum()) for seconds in sums.values())
    for part, seconds in sums.items():
        share = seconds.sum() / total if total else 0
        axis.fill_between(steps, below, below + seconds, label=f"{part}, {share:.0%}", linewidth=0)
        below = below + seconds
    top = _MARGIN * float(np.quantile(below, _TYPICAL)) or 1.0
    axis.set(title="seconds per step, and shares of all rows", ylabel="s", xlabel="step", ylim=(0, top))
    axis.legend(loc="center left", fontsize=8)


def _shade(axis: Axes, rows: Rows) -> None:
    """Every other stage grey, with its name at the top."""
    for number, (name, begin, end) in enumerate(stages_of(rows)):
        if number % 2:
            axis.axvspan(begin, end, color="0.92", zorder=-1)
        axis.text(begin, 0.98, f" {name}", transform=axis.get_xaxis_transform(), va="top", fontsize=8)

"""Means over windows, and the tables of `vestcl bench forecast` for a terminal and as Markdown."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from vestcl import metrics
from vestcl.bench._forecast_truth import Facts
from vestcl.bench._forecast_windows import METRICS, SOURCE, Record

Means = dict[str, list[float]]
"""By metric, a number a step."""

#: Metric -> its column, and the digits that tell methods apart.
_COLUMNS: Final = {
    "psnr": ("PSNR", ".2f"),
    "ssim": ("SSIM", ".3f"),
    "ms_ssim": ("MS-SSIM", ".3f"),
    "squeeze": ("squeeze", ".3f"),
    "psnr_seen": ("PSNR*", ".2f"),
}

#: The same for what is known beside pictures.
_FACTS: Final = {
    "rotation_deg": ("camera's turn, error in degrees", ".3f"),
    "translation_percent": ("camera's path, error in %", ".2f"),
    "motion_m": ("3D motion, mean error in m", ".4f"),
    "moving_m": ("3D motion of what moves by itself, m", ".4f"),
    "motion_known": ("share of pixels with a 3D motion", ".3f"),
    "splatted_db": ("splatted, all true, PSNR in dB", ".2f"),
    "warped_db": ("warped back, all true, PSNR in dB", ".2f"),
    "splatter_loss_db": ("lost by splatting, dB", ".2f"),
    "seen": ("share of pixels seen in both frames", ".3f"),
}


@dataclass(frozen=True)
class Grid:
    """A table of text, the first column to the left and the others to the right."""

    title: str
    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def means(of_windows: Sequence[Means]) -> Means:
    """Mean over windows, by metric and step; windows where a number is undefined (NaN) don't count.

    Args:
        of_windows: of windows with the same steps.

    Returns:
        The means; NaN where no window has a number.
    """
    return {name: _mean([window[name] for window in of_windows if name in window]) for name in _names(of_windows)}


def summary(records: Sequence[Record], facts: Sequence[Facts]) -> dict[str, Any]:
    """All means, as the JSON file holds them: by horizon, and running (the mean up to the horizon).

    Args:
        records: of all windows.
        facts: of all windows.
    """
    views: dict[str, Any] = {}
    for (view, method), own in _by_method(records).items():
        found = means([record.scores for record in own])
        views.setdefault(view, {})[method] = {
            "windows": len(own),
            "seconds": float(np.mean([record.seconds for record in own])),
            "by_horizon": found,
            "running_mean": {name: metrics.running_mean(torch.tensor(of)).tolist() for name, of in found.items()},
        }
    return {"views": views, "facts": means([fact.values for fact in facts])}


def picture_grids(name: str, records: Sequence[Record], horizons: Sequence[int]) -> list[Grid]:
    """A table a view: a row a method, for each metric a column a horizon.

    Args:
        name: what the windows are of.
        records: of all windows.
        horizons: the steps to show, from 1.
    """
    by_method = _by_method(records)
    grids = []
    for view in dict.fromkeys(record.view for record in records):
        rows: list[tuple[str, ...]] = []
        shown: list[str] = []
        for method, own in ((method, own) for (of, method), own in by_method.items() if of == view):
            found = means([record.scores for record in own])
            shown = [metric for metric in METRICS if metric in found]
            cells = [_text(found[metric][k - 1], _COLUMNS[metric][1]) for metric in shown for k in horizons]
            rows.append((method, *cells, _text(float(np.mean([record.seconds for record in own])), ".2f")))
        heading = ("", *(f"{_COLUMNS[metric][0]} t+{k}" for metric in shown for k in horizons), "s")
        count = len({(record.clip, record.index) for record in records})
        title = f"{name}, view {view}, mean over {count} window{'s' * (count != 1)}"
        grids.append(Grid(title, heading, tuple(rows), _notes(view, shown)))
    return grids


def fact_grids(name: str, facts: Sequence[Facts], horizons: Sequence[int]) -> list[Grid]:
    """A table of what is known beside pictures, if anything is.

    Args:
        name: what the windows are of.
        facts: of all windows.
        horizons: the steps to show, from 1.
    """
    found = means([fact.values for fact in facts])
    if not found:
        return []
    rows = []
    for metric, (label, digits) in _FACTS.items():
        if metric in found:
            by_step = found[metric]
            rows.append((label, *(_text(by_step[k - 1], digits) if k <= len(by_step) else "" for k in horizons)))
    title = f"{name}, geometric forecast beside true motion, mean over {len(facts)} window{'s' * (len(facts) != 1)}"
    return [Grid(title, ("", *(f"t+{k}" for k in horizons)), tuple(rows))]


def to_rich(grid: Grid) -> RenderableType:
    """For the terminal; a heading's last word stands below the others."""
    table = Table(box=box.SIMPLE, padding=(0, 1, 0, 0))
    for index, heading in enumerate(grid.heading):
        stacked = "\n".join(heading.rsplit(" ", 1))
        table.add_column(stacked, justify="right" if index else "left", no_wrap=bool(index))
    for row in grid.rows:
        table.add_row(*row)
    return Group(Text(grid.title, "bold"), table, *(Text(f"  {note}", "dim") for note in grid.notes), "")


def to_markdown(grid: Grid) -> str:
    """A paragraph with the title, the table, and a paragraph with the notes."""
    lines = [f"**{grid.title}**", "", _pipes(grid.heading), _pipes(["---", *["---:"] * (len(grid.heading) - 1)])]
    lines += [_pipes(row) for row in grid.rows]
    return "\n".join(lines) + "\n" + "".join(f"\n{note.replace('*', chr(92) + '*')}\n" for note in grid.notes)


def finite(value: Any) -> Any:
    """``value`` with None for every number that JSON has no word for (NaN, infinity)."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _notes(view: str, shown: Sequence[str]) -> tuple[str, ...]:
    notes = ["s: seconds a window, on this machine. PSNR in dB."]
    if "psnr_seen" in shown:
        notes.append("PSNR*: over the pixels that the geometric forecast covers by half or more.")
    if "squeeze" in shown:
        notes.append("squeeze: distance in SqueezeNet's features, 0 = equal. It is not LPIPS.")
    if view != SOURCE:
        notes.append(f"Forecasts see the source camera alone; the oracle sees what the {view} camera saw before.")
    return tuple(notes)


def _by_method(records: Sequence[Record]) -> dict[tuple[str, str], list[Record]]:
    grouped: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        grouped.setdefault((record.view, record.method), []).append(record)
    return grouped


def _names(of_windows: Sequence[Means]) -> list[str]:
    return list(dict.fromkeys(name for window in of_windows for name in window))


def _mean(rows: Sequence[Sequence[float]]) -> list[float]:
    return [float(value) for value in torch.tensor(rows, dtype=torch.float64).nanmean(dim=0)]


def _text(value: float, digits: str) -> str:
    return "-" if math.isnan(value) else f"{value:{digits}}"


def _pipes(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"

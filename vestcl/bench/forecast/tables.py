"""What `vestcl bench forecast` tells of all windows: means for its JSON file, and a table of facts beside pictures."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from vestcl.bench.forecast.truth import Facts
from vestcl.evaluation.regions import REGIONS
from vestcl.evaluation.scores import Record
from vestcl.evaluation.statistics import interval_grid
from vestcl.evaluation.tables import (
    METRICS,
    Grid,
    by_method,
    by_view,
    finite,
    horizon,
    means,
    number,
    picture_grids,
    steps_of,
    summarise,
    to_markdown,
    to_rich,
)

__all__ = [
    "Grid",
    "fact_grids",
    "finite",
    "interval_grids",
    "means",
    "overviews",
    "picture_grids",
    "summary",
    "titled",
    "to_markdown",
    "to_rich",
]

#: Metrics of overviews and intervals.
_HEADLINE: Final = ("psnr", "ms_ssim", "st_lpips", "squeeze")

#: What is known beside pictures -> its row, and the digits that tell forecasts apart.
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
    **{f"error_in_{name}": (f"share of squared error, {name}", ".3f") for name in REGIONS},
    **{f"area_of_{name}": (f"share of pixels, {name}", ".3f") for name in REGIONS},
}


def summary(records: Sequence[Record], facts: Sequence[Facts]) -> dict[str, Any]:
    """All means, as the JSON file holds them: by horizon, and running (the mean up to the horizon).

    Args:
        records: of all windows.
        facts: of all windows.
    """
    return {"views": summarise(records), "facts": means([fact.values for fact in facts])}


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
            rows.append((label, *(number(by_step[k - 1], digits) if k <= len(by_step) else "" for k in horizons)))
    title = f"{name}, geometric forecast beside true motion, mean over {len(facts)} window{'s' * (len(facts) != 1)}"
    return [Grid(title, ("", *(f"t+{k}" for k in horizons)), tuple(rows))]


def interval_grids(name: str, records: Sequence[Record], horizons: Sequence[int]) -> list[Grid]:
    """A table a view of means and their 95 % intervals over clips; none where there is one clip only."""
    if len({record.clip for record in records}) < 2:
        return []
    return [
        interval_grid(f"{name}, view {view}, mean and 95 % interval", own, horizons, _headline(own))
        for view, own in by_view(records).items()
    ]


def overviews(by_input: Mapping[str, Sequence[Record]], horizons: Sequence[int]) -> list[Grid]:
    """A table a view over all inputs: a row an input and method.

    Args:
        by_input: records by the input's title.
        horizons: the steps to show, from 1.
    """
    records = [record for own in by_input.values() for record in own]
    grids = []
    for view, of_view in by_view(records).items():
        steps, shown, rows = steps_of(of_view, horizons), _headline(of_view), list[tuple[str, ...]]()
        for name, of_input in by_input.items():
            for (_, method), own in by_method([record for record in of_input if record.view == view]).items():
                found = means([record.scores for record in own])
                cells = [number(found[m][k - own[0].first], METRICS[m].digits) for m in shown for k in steps]
                rows.append((f"{name}: {method}", str(len(own)), *cells))
        heading = ("", "windows", *(f"{METRICS[m].label} {horizon(k)}" for m in shown for k in steps))
        grids.append(Grid(f"all inputs, view {view}", heading, tuple(rows)))
    return grids


def titled(name: str, use: str) -> str:
    """ "kitti_clip (tuned)"; without a list of windows only the name."""
    return f"{name} ({use})" if use else name


def _headline(records: Sequence[Record]) -> list[str]:
    return [metric for metric in _HEADLINE if all(metric in record.scores for record in records)]

"""What `vestcl bench forecast` tells of all windows: means for its JSON file, and a table of facts beside pictures."""

from collections.abc import Sequence
from typing import Any, Final

from vestcl.bench._forecast_truth import Facts
from vestcl.scoring import Grid, Record, finite, means, number, picture_grids, summarise, to_markdown, to_rich

__all__ = ["Grid", "fact_grids", "finite", "means", "picture_grids", "summary", "to_markdown", "to_rich"]

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

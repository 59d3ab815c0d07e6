"""Scores of geometric forecasts, without a refinement and with one: ``python -m train.refinement_scores MODEL CACHE``.

The forecasts are those that `train.forecasts` kept, of any clips; images are 8 bits, as files are.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from train.command import ERRORS, failed
from train.forecasts import Entry, unpack
from vestcl import interrupt
from vestcl.cli import command_line
from vestcl.evaluation import metrics
from vestcl.evaluation.perceptual import StLpips, squeeze_distance
from vestcl.evaluation.trunks.trunks import load_trunk
from vestcl.models.forecaster import Forecaster

#: (image, truth), [1, 3, H, W] each -> [1].
Score = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]

#: Rows of the table.
METHODS: Final = ("geometric", "refined")


@dataclass(frozen=True)
class RefinementScores:
    """Score a refinement of geometric forecasts."""

    model: tyro.conf.Positional[str]
    """Its file or name, as `vestcl forecast --model` takes it."""
    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of one clip or of many that `train.forecasts` filled: a table for each."""
    st_lpips: Path | None = None
    """ST-LPIPS's weights, alex_shift_tolerant.pth."""
    squeeze: Path | None = None
    """SqueezeNet 1.0's weights."""


def scores_of(options: RefinementScores) -> dict[str, Score]:
    """By name; MS-SSIM is single-scale SSIM where an image is too small for it."""
    scores: dict[str, Score] = {"PSNR": metrics.psnr, "MS-SSIM": _similarity}
    if options.st_lpips is not None:
        scores["ST-LPIPS"] = StLpips.load(options.st_lpips)
    if options.squeeze is not None:
        scores["squeeze"] = partial(squeeze_distance, trunk=load_trunk("squeezenet1_0", options.squeeze))
    return scores


def _similarity(image: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    whole = min(image.shape[2:]) >= metrics.MS_SSIM_SIDE
    return metrics.ms_ssim(image, truth) if whole else metrics.ssim(image, truth)


def measure(model: Forecaster, entry: Entry, scores: Mapping[str, Score]) -> dict[tuple[str, str], float]:
    """(method, score) -> value, of one frame."""
    planes, truth = (torch.from_numpy(part)[None] for part in (entry.planes, entry.target))
    refined = planes[:, :3] + model.retouch(planes)
    images = dict(zip(METHODS, map(metrics.quantise, (planes[:, :3], refined)), strict=True))
    return {
        (method, name): float(score(image, truth)) for method, image in images.items() for name, score in scores.items()
    }


def table_of(model: Forecaster, folder: Path, scores: Mapping[str, Score]) -> Table:
    """Means over a folder's windows, per horizon.

    Raises:
        ValueError: no windows there.
    """
    files = sorted([*folder.glob("*.npz"), *folder.glob("*/*.npz")])
    if not files:
        raise ValueError(f"{folder}: has no windows of `train.forecasts`")
    found: dict[int, list[dict[tuple[str, str], float]]] = {}
    for file in files:
        for entry in unpack(file).entries:
            found.setdefault(entry.ahead, []).append(measure(model, entry, scores))
    table = Table("", *(f"{name} t+{k}" for name in scores for k in sorted(found)), box=box.SIMPLE)
    for method in METHODS:
        cells = [(name, np.mean([one[method, name] for one in found[k]])) for name in scores for k in sorted(found)]
        table.add_row(method, *(f"{value:.2f}" if name == "PSNR" else f"{value:.4f}" for name, value in cells))
    table.title = f"{folder}: {len(files)} windows"
    return table


@interrupt.command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command; its exit status."""
    options = command_line.parsed(RefinementScores, "python -m train.refinement_scores", __doc__, arguments)
    try:
        model, scores, console = Forecaster.from_pretrained(options.model), scores_of(options), Console(width=200)
        if not model.refine.of_forecast:
            raise ValueError(
                f"{options.model}: its refinement is not of geometric forecasts; `train.refinement` makes one"
            )
        with torch.inference_mode():
            for folder in options.folders:
                console.print(table_of(model, folder, scores))
    except ERRORS as error:
        return failed(error)
    return 0


if __name__ == "__main__":
    sys.exit(main())

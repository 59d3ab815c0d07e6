"""Contact sheets of the best, the median and the worst window: truth, geometric forecast, model, their errors."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from train.evaluation.inputs import label_of, plain
from train.evaluation.protocols import Source
from train.evaluation.setup import Setup
from train.evaluation.windows import forecast, perceptions_of, prepared, views_of
from vestcl.evaluation.scores import GEOMETRIC, Record, Truth
from vestcl.evaluation.statistics import extremes
from vestcl.evaluation.tables import METRICS
from vestcl.io import contact_sheet as sheet
from vestcl.io.contact_sheet import Cell, Picture
from vestcl.io.images import write_pixels


def write_sheets(
    out: Path,
    sources: Sequence[Source],
    setup: Setup,
    records: Sequence[Record],
    metric: str,
    shown: Sequence[int],
) -> list[Path]:
    """Forecast the three windows once more, and write sheet_best.png, sheet_median.png and sheet_worst.png.

    Args:
        out: folder.
        sources: of the records' clips.
        setup: as the records were made.
        records: of one view and method, which are judged.
        metric: by which windows are ranked, at the last of ``shown``.
        shown: horizons, a row each.

    Returns:
        The files.

    Raises:
        ValueError: no window has a number.
    """
    by_name = {source.name: source for source in sources}
    paths = []
    for word, record in extremes(records, metric, shown[-1]).items():
        value = record.scores[metric][shown[-1] - record.first]
        rank = f"{word} of {len(records)} by {METRICS[metric].label} at t+{shown[-1]} of {record.method}"
        title = (
            f"{record.clip}, from frame {record.frame}, view {record.view}: {value:{METRICS[metric].digits}}, {rank}"
        )
        path = out / f"sheet_{word}.png"
        write_pixels(path, window_sheet(by_name[record.clip], setup, record, shown, title))
        paths.append(path)
    return paths


def window_sheet(source: Source, setup: Setup, record: Record, shown: Sequence[int], title: str) -> Picture:
    """A row per horizon: the truth, the geometric forecast, the record's method, and both errors |a - b| (mean over
    RGB).

    Args:
        source: of the record's clip.
        setup: as the record was made.
        record: which window, view and method.
        shown: horizons.
        title: a line above all.

    Returns:
        [H, W, 3] uint8.
    """
    clip = prepared(source.opens(), setup)
    truth, view = Truth(clip, setup.size), next(v for v in views_of(clip, setup) if v.name == record.view)
    made = forecast(perceptions_of(clip, setup)[label_of(record.method)], record.index, [view], setup)
    methods = list(dict.fromkeys((GEOMETRIC, plain(record.method))))
    rows = []
    for step in shown:
        wanted = truth.full(view, record.index + step)
        images = {name: made[name].forecast.frames[step - 1][view.name].image for name in methods if name in made}
        row = [Cell(sheet.rgb(wanted), f"t+{step}  truth")]
        row += [Cell(sheet.rgb(image), f"{name}, {_psnr(image, wanted):.1f} dB") for name, image in images.items()]
        row += [Cell(sheet.heat(_error(image, wanted)), f"error of {name}") for name, image in images.items()]
        rows.append(row)
    return sheet.sheet(rows, title=title, bar=("error: 0", f"{sheet.WORST_ERROR} of the range and more"))


def _error(image: NDArray[np.float32], wanted: NDArray[np.float32]) -> NDArray[np.float32]:
    error: NDArray[np.float32] = np.abs(image - wanted).mean(axis=0, keepdims=True)
    return error


def _psnr(image: NDArray[np.float32], wanted: NDArray[np.float32]) -> float:
    square = float(np.square(image - wanted).mean())
    return float("inf") if square == 0 else -10 * float(np.log10(square))

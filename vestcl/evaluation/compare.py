"""A forecast compared with what then happened, and with forecasts that need neither depth nor weights."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from vestcl.data.sample import Clip, RightCamera
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.scores import FLOW, ORACLE, OTHER_CAMERA, REPEAT, Timed, Truth, predictions, score
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.forecasting.result import Forecast, View
from vestcl.forecasting.views import seen_by
from vestcl.io import contact_sheet as sheet
from vestcl.io.contact_sheet import Cell, Picture

__all__ = [
    "FLOW",
    "FORECAST",
    "METRICS",
    "ORACLE",
    "OTHER_CAMERA",
    "REPEAT",
    "Comparison",
    "compare",
    "comparison_sheet",
]

Images = list[NDArray[np.float32]]
"""[3, H, W] RGB in [0, 1], a step each."""

Value = TypeVar("Value")

Scores = dict[str, list[dict[str, float]]]
"""method -> step -> metric -> number."""

#: The forecast, the first method of every comparison.
FORECAST: Final = "forecast"

#: dB of PSNR from which on one forecast counts as better than another: what tables show.
LEAST_PSNR: Final = 0.01

#: Metric -> how tables call it, with the digits that distinguish methods.
METRICS: Final = {
    "psnr": ("PSNR, dB", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "ms_ssim": ("MS-SSIM", ".4f"),
    "st_lpips": ("ST-LPIPS", ".4f"),
    "squeeze": ("squeeze distance", ".4f"),
}


@dataclass(frozen=True, eq=False)
class Comparison:
    """One view's forecast, truth and baselines, as many steps as the truth is known for."""

    view: str
    images: Mapping[str, Images]
    """By method."""
    truth: Images
    scores: Scores
    stereo: bool
    """Whether the truth is the right camera's. `ORACLE` is then optical flow of its own past, which no other method has
    seen."""


def compare(
    forecast: Forecast,
    clip: Clip,
    index: int,
    views: Sequence[View],
    trunk: Trunk | None = None,
    report: Callable[[float], None] | None = None,
    st_lpips: StLpips | None = None,
    size: tuple[int, int] | None = None,
) -> list[Comparison]:
    """Score every view that a camera of the rig really saw, step by step as long as the clip has a frame at that time.

    Baselines and scores are those of `vestcl.evaluation`, as `vestcl bench forecast` and `train.evaluate` have them.

    Args:
        forecast: frames at t+1, ... with every view.
        clip: with true frames after t.
        index: of the frame t in ``clip``, 1 or more.
        views: the cameras; those from which no image was taken are skipped.
        trunk: SqueezeNet 1.0, for the squeeze distance (`vestcl.evaluation.perceptual.squeeze_distance`).
        report: is given the share of the steps that are done, 0 to 1.
        st_lpips: for ST-LPIPS (`vestcl.evaluation.perceptual.StLpips`).
        size: (height, width) px that images are resized to and scored at; None is the clip's.

    Returns:
        A comparison for each view that has a truth.

    Raises:
        ValueError: no frame before or after t, no view with a truth, or images of another size than the truth.

    Source: SPEC section 10.
    """
    if not 1 <= index < len(clip) - 1:
        raise ValueError(f"`index` must have a frame before and after it, 1 ... {len(clip) - 2}, got {index}")
    if not clip.after(index, 1):
        after = clip.positions[index + 1] - clip.positions[index]
        raise ValueError(
            f"`index` must have a frame one interval after it; after {index} there is none for {after:.3g}"
        )
    known = [view for view in views if seen_by(view, clip[index]) is not None]
    if not known:
        raise ValueError('`views` must have one with a truth to compare with: "source", or "right" of a stereo clip')
    later = clip.after(index, len(forecast.frames))
    forecast = dataclasses.replace(forecast, frames=forecast.frames[: len(later)])
    truth = Truth(clip, size or (clip[0].height, clip[0].width), trunk, st_lpips=st_lpips)
    made = predictions(truth, index, len(later), known, {FORECAST: Timed(forecast, 0.0)})
    records = score(truth, index, known, made, forecast, later=later, report=report)
    scores: dict[str, Scores] = {}
    for record in records:
        shown = {metric: values for metric, values in record.scores.items() if metric in METRICS}
        steps = [{metric: values[step] for metric, values in shown.items()} for step in range(len(later))]
        scores.setdefault(record.view, {})[record.method] = steps
    return [
        Comparison(
            view.name,
            _forecast_first({method: list(of.pictures) for method, of in made[view.name].items()}),
            [truth.full(view, at) for at in later],
            _forecast_first(scores[view.name]),
            isinstance(seen_by(view, clip[index]), RightCamera),
        )
        for view in known
    ]


def comparison_sheet(comparison: Comparison, title: str = "") -> Picture:
    """A row per step: the forecast, the truth, the forecast's error |a - b| (mean over RGB), and the baselines.

    Args:
        comparison: of one view.
        title: a line above all.

    Returns:
        [H, W, 3] uint8.
    """
    rows = []
    for step, truth in enumerate(comparison.truth):

        def cell(method: str, step: int = step) -> Cell:
            psnr = comparison.scores[method][step]["psnr"]
            return Cell(sheet.rgb(comparison.images[method][step]), f"t+{step + 1}  {method}, {psnr:.1f} dB")

        error = np.abs(comparison.images[FORECAST][step] - truth).mean(axis=0, keepdims=True)
        shown = [cell(FORECAST), Cell(sheet.rgb(truth), f"t+{step + 1}  truth"), Cell(sheet.heat(error), "error")]
        rows.append([*shown, *(cell(method) for method in comparison.images if method != FORECAST)])
    note = "; all but the oracle see the left camera's frames only" if comparison.stereo else ""
    scale = ("error of the forecast: 0", f"{sheet.WORST_ERROR} of the range and more")
    return sheet.sheet(rows, title=f"{title}{note}", bar=scale)


def _forecast_first(by_method: Mapping[str, Value]) -> dict[str, Value]:
    return {FORECAST: by_method[FORECAST], **by_method}

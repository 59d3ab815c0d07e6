"""A forecast beside what then happened, and beside forecasts that need neither depth nor weights."""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl import baselines, metrics, sheet
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.forecast import Forecast, View
from vestcl.models.trunks import Trunk
from vestcl.perceptual import StLpips, squeeze_distance
from vestcl.sheet import Cell, Picture
from vestcl.views import seen_by

Images = list[NDArray[np.float32]]
"""[3, H, W] RGB in [0, 1], a step each."""

Scores = dict[str, list[dict[str, float]]]
"""method -> step -> metric -> number."""

#: The methods of every comparison, the forecast first.
FORECAST: Final = "forecast"
REPEAT: Final = "repeat last"
FLOW: Final = "optical flow"

#: Metric -> how tables call it, with the digits that tell methods apart.
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
    """Whether the truth is the right camera's."""


def compare(
    forecast: Forecast,
    clip: Clip,
    index: int,
    views: Sequence[View],
    trunk: Trunk | None = None,
    report: Callable[[float], None] | None = None,
    st_lpips: StLpips | None = None,
) -> list[Comparison]:
    """Score every view that a camera of the rig really saw, step by step as long as the clip has a frame at that time.

    The baselines get the two last frames of the camera that they are held against: for the right camera its own, which
    the forecast has never seen. That makes them a bar to pass, not a rival of equal means.

    Args:
        forecast: frames at t+1, ... with every view.
        clip: with true frames after t.
        index: of the frame t in ``clip``, 1 or more.
        views: the cameras; those that nobody looked from are passed over.
        trunk: SqueezeNet 1.0, for the squeeze distance (`vestcl.perceptual.squeeze_distance`).
        report: told the share of the views that are done, 0 to 1.
        st_lpips: for ST-LPIPS (`vestcl.perceptual.StLpips`).

    Returns:
        A comparison for each view that has a truth.

    Raises:
        ValueError: no frame before or after t, no view with a truth, or pictures of another size than the truth.

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
    comparisons = []
    for done, view in enumerate(known, start=1):
        comparisons.append(_compare_view(forecast, clip, index, view, _Networks(trunk, st_lpips)))
        if report is not None:
            report(done / len(known))
    return comparisons


def comparison_sheet(comparison: Comparison, title: str = "") -> Picture:
    """A row a step: the forecast, the truth, the forecast's error |a - b| (mean over RGB), and the baselines.

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
    note = "; the baselines see the right camera's own past frames, the forecast does not" if comparison.stereo else ""
    scale = ("error of the forecast: 0", f"{sheet.WORST_ERROR} of the range and more")
    return sheet.sheet(rows, title=f"{title}{note}", bar=scale)


class _Networks(NamedTuple):
    """That images are compared by, as far as their weights are known."""

    squeeze: Trunk | None
    st_lpips: StLpips | None


def _compare_view(forecast: Forecast, clip: Clip, index: int, view: View, networks: _Networks) -> Comparison:
    later = clip.after(index, len(forecast.frames))
    steps = len(later)
    previous, current, *truth = (_read(view, clip[at]) for at in (index - 1, index, *later))
    images = {FORECAST: [frame[view.name].image for frame in forecast.frames[:steps]]}
    flow = functools.partial(baselines.flow_extrapolation, elapsed=clip.elapsed(index))
    for name, forecaster in ((REPEAT, baselines.repeat_last), (FLOW, flow)):
        images[name] = list(forecaster(_batch(previous), _batch(current), steps)[0].numpy())
    scores = {
        method: [_scores(image, wanted, networks) for image, wanted in zip(of_method, truth, strict=True)]
        for method, of_method in images.items()
    }
    return Comparison(view.name, images, truth, scores, isinstance(seen_by(view, clip[index]), RightCamera))


def _read(view: View, sample: Sample) -> NDArray[np.float32]:
    camera = seen_by(view, sample)
    if camera is None:
        raise ValueError(f"sample {sample.name} has no picture from view {view.name}, as its neighbours have")
    return camera.read_image()


def _scores(image: NDArray[np.float32], truth: NDArray[np.float32], networks: _Networks) -> dict[str, float]:
    """All metrics that the size allows."""
    pair = metrics.quantise(_batch(image)), metrics.quantise(_batch(truth))
    side = min(truth.shape[1:])
    scores = {"psnr": metrics.psnr(*pair)}
    if side >= metrics.WINDOW:
        scores["ssim"] = metrics.ssim(*pair)
    if side >= metrics.MS_SSIM_SIDE:
        scores["ms_ssim"] = metrics.ms_ssim(*pair)
    with torch.no_grad():
        if networks.st_lpips is not None:
            scores["st_lpips"] = networks.st_lpips(*pair)
        if networks.squeeze is not None:
            scores["squeeze"] = squeeze_distance(*pair, networks.squeeze)
    return {name: float(score) for name, score in scores.items()}


def _batch(image: NDArray[np.float32]) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(image))[None]

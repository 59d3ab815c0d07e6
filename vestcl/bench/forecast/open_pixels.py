"""What a forecast shows where frames t and t-1 cover nothing, for several numbers of remembered frames."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from rich import box
from rich.table import Table

from vestcl.data.sample import Clip
from vestcl.evaluation import metrics
from vestcl.evaluation.perceptual import StLpips
from vestcl.forecasting.geometric.forecast import forecast_frames
from vestcl.forecasting.geometric.render import HOLE
from vestcl.forecasting.result import View
from vestcl.forecasting.views import parse_views
from vestcl.scene.perception import Perception

#: The steps that are scored.
STEPS: Final = (1, 3, 5)


@dataclass(frozen=True)
class OpenScore:
    """One frame of a forecast with some memory."""

    clip: str
    index: int
    step: int
    view: str
    memory: int
    """Frames before t-1 that were remembered."""
    open: float
    """Share of the image that t and t-1 don't cover."""
    filled: float
    """Share of the open pixels that the memory covers."""
    psnr: float
    """dB, over the open pixels."""
    st_lpips: float | None
    """Of the true image with the open pixels' colours from the forecast."""
    whole: float
    """PSNR of the whole image, dB."""


def windows_of(clip: Clip, count: int, memory: Sequence[int]) -> list[int]:
    """``count`` current frames spread over the clip, each with the frames that are remembered and forecast.

    Raises:
        ValueError: the clip is too short.
    """
    first, last = max(memory) + 1, len(clip) - 1 - max(STEPS)
    if last < max(first, 1):
        raise ValueError(f"{clip.name}: must have {max(first, 1) + max(STEPS) + 1} frames or more, got {len(clip)}")
    return sorted({round(index) for index in np.linspace(max(first, 1), last, count)})


def measure(clip: Clip, indices: Sequence[int], memory: Sequence[int], distance: StLpips | None) -> Iterator[OpenScore]:
    """Scores of all windows, steps and cameras of a clip, and of each number of remembered frames.

    Args:
        clip: at the size that is scored.
        indices: the current frames t, ascending.
        memory: numbers of frames.
        distance: ST-LPIPS, if its weights are there.
    """
    perception = Perception(clip)
    views = parse_views(("source", "right") if clip[0].right is not None else ("source",), clip)
    for index in indices:
        forecasts = {
            count: forecast_frames(perception, index, max(STEPS), views, memory=count)
            for count in sorted({0, *memory}, reverse=True)
        }
        for step in STEPS:
            for view in views:
                shown = {count: forecast.frames[step - 1][view.name] for count, forecast in forecasts.items()}
                open_pixels, truth = shown[0].coverage <= HOLE, _truth(clip, index + step, view)
                for count in memory:
                    place = clip.name, index, step, view.name, count
                    filled = (shown[count].coverage > HOLE)[open_pixels]
                    yield _score(place, shown[count].image, truth, open_pixels, filled, distance)


def _truth(clip: Clip, index: int, view: View) -> NDArray[np.float32]:
    sample = clip[index]
    if view.name == "source" or sample.right is None:
        return sample.read_image()
    return sample.right.read_as(sample.K if view.K is None else view.K, sample.height, sample.width)


def _score(
    place: tuple[str, int, int, str, int],
    image: NDArray[np.float32],
    truth: NDArray[np.float32],
    where: NDArray[np.bool_],
    filled: NDArray[np.bool_],
    distance: StLpips | None,
) -> OpenScore:
    made, wanted, mask = (torch.from_numpy(np.ascontiguousarray(each))[None] for each in (image, truth, where))
    in_place = None
    if distance is not None:
        with torch.inference_mode():
            in_place = float(distance(torch.where(mask, made, wanted), wanted))
    over_open = float(metrics.psnr(made, wanted, mask)) if where.any() else float("nan")
    share = float(filled.mean()) if where.any() else 0.0
    return OpenScore(*place, float(where.mean()), share, over_open, in_place, float(metrics.psnr(made, wanted)))


def table_of(scores: Sequence[OpenScore], title: str) -> Table:
    """A row for each number of remembered frames: means over windows, steps and cameras."""
    table = Table(box=box.SIMPLE, title=title)
    for heading in ("remembered frames", "open pixels filled", "PSNR, open", "ST-LPIPS, open", "delta PSNR, image"):
        table.add_column(heading, justify="right")
    rows = {count: [one for one in scores if one.memory == count] for count in sorted({one.memory for one in scores})}
    without = np.mean([one.whole for one in next(iter(rows.values()))])
    for count, those in rows.items():
        share = np.average([one.filled for one in those], weights=[one.open + 1e-9 for one in those])
        distances = [one.st_lpips for one in those if one.st_lpips is not None]
        near = f"{np.mean(distances):.4f}" if distances else "-"
        psnr, gain = np.nanmean([one.psnr for one in those]), np.mean([one.whole for one in those]) - without
        table.add_row(str(count), f"{share:.0%}", f"{psnr:.2f} dB", near, f"{gain:+.3f} dB")
    return table

"""What a forecast shows where frames t and t-1 cover nothing, for several numbers of remembered frames."""

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
import torch

from vestcl.bench.common.table import Measurement, Section
from vestcl.data.sample import Clip
from vestcl.evaluation import metrics
from vestcl.evaluation.perceptual import StLpips
from vestcl.forecasting.geometric.forecast import forecast_frames
from vestcl.forecasting.geometric.render import HOLE
from vestcl.forecasting.views import parse_views, seen_by
from vestcl.scene.perception import Perception

#: The steps that are scored.
STEPS: Final = (1, 3, 5)


def windows_of(clip: Clip, count: int, memory: Sequence[int]) -> list[int]:
    """``count`` current frames spread over the clip, each with the frames that are remembered and forecast.

    Raises:
        ValueError: the clip is too short.
    """
    first, last = max(1, max(memory) + 1), len(clip) - 1 - max(STEPS)
    if last < first:
        raise ValueError(f"{clip.name}: must have {first + max(STEPS) + 1} frames or more, got {len(clip)}")
    return sorted({round(index) for index in np.linspace(first, last, count)})


def measure(
    clip: Clip, indices: Sequence[int], memory: Sequence[int], distance: StLpips | None
) -> Iterator[dict[str, Any]]:
    """Scores of all windows, steps and cameras of a clip, and of each number of remembered frames.

    Args:
        clip: at the size that is scored.
        indices: the current frames t, ascending.
        memory: numbers of frames.
        distance: ST-LPIPS, if its weights are there.

    Yields:
        "clip", "index", "step", "view", "memory", "open" (share of the image that t and t-1 don't cover), "filled"
        (share of these pixels that the memory covers), "psnr" (dB, over them), "st_lpips" (of the true image with
        these pixels from the forecast, or None) and "whole" (PSNR of the whole image, dB).
    """
    perception = Perception(clip)
    views = parse_views(("source", "right") if clip[0].right is not None else ("source",), clip)
    for index in indices:
        forecasts = {
            count: forecast_frames(perception, index, max(STEPS), views, memory=count)
            for count in sorted({0, *memory}, reverse=True)
        }
        for step, view in ((step, view) for step in STEPS for view in views):
            shown = {count: forecast.frames[step - 1][view.name] for count, forecast in forecasts.items()}
            camera = seen_by(view, clip[index + step])
            assert camera is not None
            truth, uncovered = torch.from_numpy(camera.read_image())[None], shown[0].coverage <= HOLE
            mask = torch.from_numpy(uncovered)[None]
            for count in memory:
                made = torch.from_numpy(np.ascontiguousarray(shown[count].image))[None]
                in_place = None
                if distance is not None:
                    with torch.inference_mode():
                        in_place = float(distance(torch.where(mask, made, truth), truth))
                yield {
                    "clip": clip.name, "index": index, "step": step, "view": view.name, "memory": count,
                    "open": float(uncovered.mean()),
                    "filled": float((shown[count].coverage > HOLE)[uncovered].mean()) if uncovered.any() else 0.0,
                    "psnr": float(metrics.psnr(made, truth, mask)) if uncovered.any() else float("nan"),
                    "st_lpips": in_place,
                    "whole": float(metrics.psnr(made, truth)),
                }  # fmt: skip


def section(scores: Sequence[dict[str, Any]], title: str) -> Section:
    """A row for each number of remembered frames: means over windows, steps and cameras."""
    frame, rows = pd.DataFrame(scores), list[Measurement]()
    without = frame[frame.memory == frame.memory.min()].whole.mean()
    for count, own in frame.groupby("memory"):
        share = 100 * np.average(own.filled, weights=own.open + 1e-9)
        near = float(own.st_lpips.astype(float).mean())
        rows += [
            Measurement(str(count), "open pixels filled, %", share, digits=".0f"),
            Measurement(str(count), "PSNR, open, dB", own.psnr.mean(), digits=".2f"),
            Measurement(str(count), "ST-LPIPS, open", near, digits=".4f"),
            Measurement(str(count), "delta PSNR, image, dB", own.whole.mean() - without, digits="+.3f"),
        ]
    return Section(f"{title}, by remembered frames", rows)

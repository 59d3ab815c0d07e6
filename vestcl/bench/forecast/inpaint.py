"""`vestcl bench inpaint`: the background by each method, against the street without its foreground.

With clips: what forecasts show where no pixel of frames t and t-1 is, with and without a memory.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from vestcl import opencl
from vestcl.bench.common.estimate import announced
from vestcl.bench.common.options import JsonOption
from vestcl.bench.common.results import console as make_console
from vestcl.bench.common.results import describe, plain, write_json
from vestcl.bench.common.table import Measurement, Section, show_grid
from vestcl.constants import SKY_DEPTH
from vestcl.data import Street, intrinsics
from vestcl.data.open import open_sequence
from vestcl.data.sample import Clip
from vestcl.data.street.raycast import STREET_SKY_DEPTH as STREET_SKY
from vestcl.evaluation import metrics
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.st_lpips import Option as StLpipsOption
from vestcl.forecasting.geometric.forecast import forecast_frames
from vestcl.forecasting.geometric.render import HOLE
from vestcl.forecasting.views import parse_views, seen_by
from vestcl.io.labels import background
from vestcl.scene.inpainting.inpaint import DEFAULT, inpaint_background
from vestcl.scene.inpainting.inpainters import METHODS
from vestcl.scene.perception import Perception

#: Seeds of the streets, which nothing is trained on.
FIRST_SEED: Final = 2000

#: The steps of clips that are scored.
STEPS: Final = (1, 3, 5)

#: A depth is right within that share.
_RIGHT: Final = 0.1

#: Score -> its column, the factor to that, and digits.
_COLUMNS: Final = {
    "psnr": ("PSNR, dB", 1, ".2f"),
    "depth_median": ("depth, median error, %", 100, ".1f"),
    "depth_right": ("depth within 10 %, %", 100, ".0f"),
    "seconds": ("time, s", 1, ".2f"),
}


@dataclass(frozen=True)
class InpaintBench(JsonOption):
    """Fill in behind the foreground of procedural streets, and compare with what is there."""

    streets: int = 20
    """How many."""
    height: int = 256
    """Pixels."""
    width: int = 832
    """Pixels."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Names, or lama:PATH."""
    clips: tuple[str, ...] = ()
    """Forecast these clips instead, at the size above, and score the pixels that frames t and t-1 leave open."""
    memory: tuple[int, ...] = (0, 2, 3, 5, 10)
    """Numbers of remembered frames to compare on clips."""
    windows: int = 6
    """Windows of each clip, spread over it."""
    st_lpips: StLpipsOption = None
    """Measure ST-LPIPS on clips, by the weights FILE or those inside an installed stlpips-pytorch."""
    device: str | None = None
    """OpenCL device that renders."""

    def __post_init__(self) -> None:
        if self.streets < 1:
            raise ValueError(f"`streets` must be 1 or more, got {self.streets}")
        if self.windows < 1:
            raise ValueError(f"`windows` must be 1 or more, got {self.windows}")
        if not self.memory or min(self.memory) < 0:
            raise ValueError(f"`memory` must be one or more numbers of frames, 0 or more each, got {self.memory}")


def main(config: InpaintBench) -> None:
    """Measure and print the tables."""
    console = make_console()
    with opencl.use(config.device) as session:
        content = {"machine": describe(session)} | (_on_clips if config.clips else _on_streets)(config, console)
    if config.json is not None:
        write_json(config.json, plain(content))


def _on_streets(config: InpaintBench, console: Console) -> dict[str, Any]:
    scores: dict[str, list[dict[str, float]]] = {method: [] for method in config.methods}
    seeds = announced(range(FIRST_SEED, FIRST_SEED + config.streets), console, "streets")
    for seed in track(seeds, "streets", config.streets, console=console, transient=True):
        frame = street(seed, config.height, config.width)
        for method in config.methods:
            scores[method].append(score(method, *frame))
    means = {method: pd.DataFrame(of).mean().to_dict() for method, of in scores.items()}
    rows = [
        Measurement(f"{method} (default)" if method == DEFAULT else method, column, mean[name] * factor, digits=digits)
        for method, mean in sorted(means.items(), key=lambda item: -item[1]["psnr"])
        for name, (column, factor, digits) in _COLUMNS.items()
    ]
    title = f"behind the foreground of {config.streets} streets, {config.height} x {config.width}, by method"
    show_grid(Section(title, rows).grid(), console)
    return {"streets": config.streets, "means": means, "scores": scores}


def _on_clips(config: InpaintBench, console: Console) -> dict[str, Any]:
    distance = None if config.st_lpips is None else StLpips.load(config.st_lpips)
    scores = list[dict[str, Any]]()
    for name in config.clips:
        clip = open_sequence(name).resized(config.height, config.width)
        indices = windows_of(clip, config.windows, config.memory)
        found = list(measure_open(clip, indices, config.memory, distance))
        show_grid(open_section(found, f"{clip.name}, {len(indices)} windows").grid(), console)
        scores += found
    return {"scores": scores}


def street(seed: int, height: int, width: int) -> tuple[NDArray[Any], ...]:
    """Image, depth, mask, and the true background's image and depth."""
    scene, K = Street.generate(seed), intrinsics(height, width)
    camera, t = np.linalg.inv(scene.camera_pose(1.0)), 1.0
    shown = scene.render(camera, K, height, width, t, samples=2)
    truth = scene.render(camera, K, height, width, t, samples=2, foreground=False)
    depths = (np.where(frame.depth[0] >= STREET_SKY, np.float32(SKY_DEPTH), frame.depth[0]) for frame in (shown, truth))
    depth, true_depth = depths
    return shown.colour[0], depth, background(shown.labels[0]), truth.colour[0], true_depth


def score(
    method: str,
    image: NDArray[np.float32],
    depth: NDArray[np.float32],
    mask: NDArray[np.bool_],
    true_image: NDArray[np.float32],
    true_depth: NDArray[np.float32],
) -> dict[str, float]:
    """PSNR dB of the colour, median and share within 10 % of the depth, where M = 0; seconds."""
    start = time.perf_counter()
    filled, filled_depth = inpaint_background(image, depth, mask, method=method)
    seconds, hidden = time.perf_counter() - start, ~mask[0]
    error = np.square(filled - true_image)[:, hidden].mean()
    off = np.abs(filled_depth / true_depth - 1)[0][hidden]
    return {
        "psnr": float(-10 * np.log10(max(error, 1e-12))),
        "depth_median": float(np.median(off)),
        "depth_right": float((off < _RIGHT).mean()),
        "seconds": seconds,
    }


def windows_of(clip: Clip, count: int, memory: Sequence[int]) -> list[int]:
    """``count`` current frames spread over the clip, each with the frames that are remembered and forecast.

    Raises:
        ValueError: the clip is too short.
    """
    first, last = max(1, max(memory) + 1), len(clip) - 1 - max(STEPS)
    if last < first:
        raise ValueError(f"{clip.name}: must have {first + max(STEPS) + 1} frames or more, got {len(clip)}")
    return sorted({round(index) for index in np.linspace(first, last, count)})


def measure_open(
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


def open_section(scores: Sequence[dict[str, Any]], title: str) -> Section:
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

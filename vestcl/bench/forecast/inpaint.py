"""`vestcl bench inpaint`: the background by each method, against the street without its foreground.

With clips: what forecasts show where no pixel of frames t and t-1 is, with and without a memory.
"""

import time
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from vestcl import opencl
from vestcl.bench.common.options import JsonOption
from vestcl.bench.common.results import console as make_console
from vestcl.bench.common.results import describe, plain, write_json
from vestcl.bench.common.table import Measurement, Section, show_grid
from vestcl.bench.forecast import open_pixels
from vestcl.constants import SKY_DEPTH
from vestcl.data import Street, intrinsics
from vestcl.data.open import open_sequence
from vestcl.data.street.raycast import STREET_SKY_DEPTH as STREET_SKY
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.st_lpips import Option as StLpipsOption
from vestcl.io.labels import background
from vestcl.scene.inpainting.inpaint import DEFAULT, inpaint_background
from vestcl.scene.inpainting.inpainters import METHODS

#: Seeds of the streets, which nothing is trained on.
FIRST_SEED: Final = 2000

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
        content = {"about": describe(session)} | (_on_clips if config.clips else _on_streets)(config, console)
    if config.json is not None:
        write_json(config.json, plain(content))


def _on_streets(config: InpaintBench, console: Console) -> dict[str, Any]:
    scores: dict[str, list[dict[str, float]]] = {method: [] for method in config.methods}
    for seed in track(range(FIRST_SEED, FIRST_SEED + config.streets), "streets", console=console, transient=True):
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
        indices = open_pixels.windows_of(clip, config.windows, config.memory)
        found = list(open_pixels.measure(clip, indices, config.memory, distance))
        show_grid(open_pixels.section(found, f"{clip.name}, {len(indices)} windows").grid(), console)
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

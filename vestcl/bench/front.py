"""`vestcl bench front`: time of the whole chain against error on recorded drives, by method and working width."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
import torch
import tyro
from rich.progress import track

from vestcl.bench.common import plots
from vestcl.bench.common.estimate import announced
from vestcl.bench.common.options import JsonOption
from vestcl.bench.common.results import console, describe, plain, settings, write_json
from vestcl.bench.common.table import Measurement, Section, show_grid
from vestcl.bench.common.timing import Spread
from vestcl.constants import LEVELS, WORK_WIDTH
from vestcl.data.resize import resize_image
from vestcl.data.sample import Clip
from vestcl.evaluation import metrics
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.st_lpips import Option as StLpipsOption
from vestcl.forecasting import api, baselines
from vestcl.forecasting.geometric import Perception
from vestcl.forecasting.result import View

#: Frames before the current one that a recording has shown already.
_BEFORE: Final = 5

#: What rows of the geometric forecast are called.
_GEOMETRIC, _OWN, _REPEAT = "geometric", "own width", "repeat"

Images = list[np.ndarray[Any, np.dtype[np.float32]]]


@dataclass(frozen=True)
class FrontBench(JsonOption):
    """Time each method from a new frame to its shown forecast, and score it against the frames that follow.

    Earlier frames were perceived before, as in `vestcl.live`. Reading the new frame counts, writing files does not.
    """

    inputs: tyro.conf.Positional[tuple[str, ...]]
    """Clips, as `vestcl forecast` opens them, or procedural streets: street:SEED."""
    work_widths: tuple[int, ...] = (0, WORK_WIDTH, 800, 640, 480, 320)
    """Pixels, of the geometric forecast; 0: the clip's own width."""
    model: tuple[str, ...] = ()
    """Networks, as `vestcl forecast --model`, at the default width and each preset."""
    windows: int = 3
    """Of each clip, spread over it."""
    steps: int = 5
    """Frames that are forecast; scores are means over them."""
    height: int = 256
    """Pixels of what is scored."""
    width: int = 832
    """Pixels."""
    st_lpips: StLpipsOption = None
    """Measure ST-LPIPS, by the weights FILE or those inside an installed stlpips-pytorch."""
    plots: Path | None = None
    """Folder for the plot (PNG)."""

    def __post_init__(self) -> None:
        if not self.inputs or min(self.windows, self.steps) < 1 or min(self.work_widths, default=-1) < 0:
            raise ValueError(
                "`inputs` must be one or more, --windows and --steps 1 or more and --work-widths 0 or more, "
                f"got {len(self.inputs)} inputs, {self.windows}, {self.steps} and {self.work_widths}"
            )


def main(config: FrontBench) -> None:
    """Measure; print and plot means over clips."""
    distance = None if config.st_lpips is None else StLpips.load(config.st_lpips)
    tasks, records = [task for text in config.inputs for task in _tasks(text, config)], list[dict[str, Any]]()
    for task in track(announced(tasks, console(), "forecasts"), "front", len(tasks), transient=True):
        seconds, cpu, images = task.make(task.current)
        scores = _scores(images, task.clip, task.current, config, distance)
        row = {"clip": task.text, "index": task.current, "method": task.method, "s": seconds, "cpu_s": cpu}
        records.append(row | scores)
    frame = pd.DataFrame(records)
    show_grid(section(frame).grid(), console())
    if config.plots is not None:
        plots.write(figure(frame), config.plots / "front.png")
    if config.json is not None:
        write_json(config.json, plain({"machine": describe(), "config": settings(config), "records": records}))


Method = Callable[[int], tuple[float, float, Images]]
"""Frame t -> seconds, CPU seconds and images [3, H, W] at t+1, t+2 ..."""


class _Task(NamedTuple):
    """A forecast to be timed."""

    text: str
    clip: Clip
    current: int
    method: str
    make: Method


def _tasks(text: str, config: FrontBench) -> Iterator[_Task]:
    """Of one input, the slowest method first, which the estimate of the time goes by."""
    clip = api.open(text)
    last = len(clip) - 1 - config.steps
    if last < _BEFORE:
        raise ValueError(f"{text}: must have {_BEFORE + config.steps + 1} frames or more, got {len(clip)}")
    methods = _methods(config, clip)
    middles = (np.arange(config.windows) + 0.5) / config.windows
    for index in sorted({round(_BEFORE + share * (last - _BEFORE)) for share in middles}):
        yield from (_Task(text, clip, index, name, make) for name, make in methods.items())


def _methods(config: FrontBench, clip: Clip) -> dict[str, Method]:
    """By the names of rows."""

    def baseline(make: Callable[..., torch.Tensor]) -> Method:
        def timed(index: int) -> tuple[float, float, Images]:
            before = torch.from_numpy(clip[index - 1].read_image())[None]
            start, cpu = time.perf_counter(), time.process_time()
            found = make(before, torch.from_numpy(clip[index].read_image())[None], config.steps)
            taken = time.perf_counter() - start, time.process_time() - cpu
            return *taken, list(found[0].numpy())

        return timed

    def chain(width: int, model: str | None = None, quality: Any = "balanced") -> Method:
        make, views = api.forecaster(model, quality), [View("source", np.eye(4))]

        def timed(index: int) -> tuple[float, float, Images]:
            perception = Perception(clip, work_width=width or None)
            make(perception, index - 1, 1, views)
            start, cpu = time.perf_counter(), time.process_time()
            forecast = make(perception, index, config.steps, views)
            taken = time.perf_counter() - start, time.process_time() - cpu
            return *taken, [frame["source"].image for frame in forecast.frames]

        return timed

    widths = {f"{_GEOMETRIC}, {f'{width} px' if width else _OWN}": chain(width) for width in config.work_widths}
    networks = {f"{model}, {level}": chain(WORK_WIDTH, model, level) for model in config.model for level in LEVELS}
    flat = {"optical flow": baselines.flow_extrapolation, _REPEAT: baselines.repeat_last}
    return widths | networks | {name: baseline(make) for name, make in flat.items()}


def _scores(
    images: Images, clip: Clip, index: int, config: FrontBench, distance: StLpips | None
) -> dict[str, list[float]]:
    """By metric, at each step, of 8-bit images at the size that is scored."""
    found: dict[str, list[float]] = {"psnr": [], "ms_ssim": [], "st_lpips": []}
    for step, image in enumerate(images, 1):
        made, truth = (
            metrics.quantise(torch.from_numpy(resize_image(each, config.height, config.width))[None])
            for each in (image, clip[index + step].read_image())
        )
        found["psnr"].append(float(metrics.psnr(made, truth)))
        found["ms_ssim"].append(float(metrics.ms_ssim(made, truth)))
        if distance is not None:
            with torch.inference_mode():
                found["st_lpips"].append(float(distance(made, truth)))
    return found


def section(frame: pd.DataFrame) -> Section:
    """A row per method: time, and means over clips of the first step's and of all steps' scores."""
    return Section("from a new frame to its forecast, means over clips", list(_rows(means(frame))))


def means(frame: pd.DataFrame) -> pd.DataFrame:
    """A row per method, each clip counts alike: "s" and "cpu_s" are spreads, the scores numbers."""
    rows = []
    for method, own in frame.groupby("method", sort=False):
        row: dict[str, Any] = {"method": method, "s": Spread.of(own.s), "cpu_s": Spread.of(own.cpu_s)}
        for metric in ("psnr", "ms_ssim", "st_lpips"):
            clips = own[own[metric].map(len) > 0].groupby("clip")[metric]
            row[f"{metric}, t+1"] = clips.apply(lambda of: np.mean([steps[0] for steps in of])).mean()
            row[metric] = clips.apply(lambda of: np.mean(np.concatenate(list(of)))).mean()
        rows.append(row)
    return pd.DataFrame(rows).set_index("method")


def _rows(found: pd.DataFrame) -> Iterator[Measurement]:
    for method, row in found.iterrows():
        yield Measurement(method, "ms (quartiles)", row["s"], "s", name=f"{method}: time")
        yield Measurement(method, "CPU, ms", row["cpu_s"], "s", ".0f", name=f"{method}: CPU")
        for column, name, digits in (
            ("psnr, t+1", "PSNR, t+1", ".2f"), ("psnr", "PSNR", ".2f"), ("ms_ssim", "MS-SSIM", ".4f"),
            ("st_lpips", "ST-LPIPS", ".4f"),
        ):  # fmt: skip
            if np.isfinite(row[column]):
                better: Any = "lower" if column == "st_lpips" else "higher"
                yield Measurement(method, name, row[column], digits=digits, name=f"{method}: {name}", better=better)


def figure(frame: pd.DataFrame) -> Any:
    """Seconds against each metric, means over steps and clips; repeating takes no time, and is left out."""
    found, panels = means(frame).drop(index=_REPEAT, errors="ignore"), dict[str, list[plots.Curve]]()
    for metric, label in {"psnr": "PSNR, dB", "ms_ssim": "MS-SSIM", "st_lpips": "ST-LPIPS"}.items():
        if not np.isfinite(found[metric]).all():
            continue
        panels[label] = []
        for group in dict.fromkeys(name.partition(",")[0] for name in found.index):
            own = found[[name.partition(",")[0] == group for name in found.index]]
            labels = [name.partition(", ")[2] or name for name in own.index]
            seconds = [max(spread.median, 1e-3) for spread in own.s]
            panels[label].append(plots.Curve(group, seconds, list(own[metric]), labels=labels))
    return plots.curves("means over clips and steps", "s from a new frame to its forecast", panels)

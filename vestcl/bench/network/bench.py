"""`vestcl bench network`: one forecast stage by stage, one training step, and the memory that they take."""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import torch
from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.estimate import announced
from vestcl.bench.common.options import Options
from vestcl.bench.common.plots import bars
from vestcl.bench.common.table import Measurement, Section, verdict
from vestcl.bench.common.timing import Spread
from vestcl.bench.network.train_step import ADAM, BACKWARD, FORWARD, OPENCL, Trainer, batch_of, made
from vestcl.bench.pipeline.traffic import LEAST_FRAMES, TRAFFIC, Window, drive
from vestcl.models import ModelConfig, configuration
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.stage_times import REST, watching
from vestcl.scene.layers import build_layers

#: (model, height, width) -> seconds that a forecast and a training step may take on two cores, and GB of memory.
TARGETS: Final[dict[tuple[str, int, int], dict[str, float]]] = {
    ("vest-s", 256, 832): {"forward": 2.0, "training step": 8.0},
    ("vest-paper", 256, 832): {"memory": 24.0},
}

#: Stages of a `Forecaster`, as the table names them where it is not by `stage_times.STAGES`.
_NAMES: Final = {
    "EMF": "camera motion (EMF)",
    "OMF": "object motion (OMF)",
    "splat": "displace and splat",
    OPENCL: "all OpenCL, both ways",
}


@dataclass(frozen=True)
class NetworkBench(Options):
    """Time the network on two frames of a street, with true depth and labels."""

    model: str = "vest-s"
    """A configuration: "vest-paper", "vest-s+joint", ..."""
    height: int = 256
    """Pixels."""
    width: int = 832
    """Pixels."""
    runs: int = 5
    """Of the forecast, and of the training step."""
    training: bool = True
    """Also one training step."""
    batch: int = 1
    """Of the training step."""
    seed: int = 0
    """Of the street and the weights."""


def main(config: NetworkBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size or number that is not positive, or a model that isn't known.
        DeviceError: no such device.
    """
    _results.check_positive(config, "height", "width", "runs", "threads", "batch")
    _results.run("network", config, partial(_sections, config, configuration(config.model)))


def _sections(
    config: NetworkBench, model_config: ModelConfig, _: opencl.Session, console: Console
) -> Iterator[Section]:
    """Memory only grows, so the training step comes last."""
    model = made(model_config, config.seed)
    model.options = dataclasses.replace(model.options, seen=False)  # the frames are the same ones in all runs
    window = drive(TRAFFIC, config.height, config.width, LEAST_FRAMES, config.seed).windows[0]
    with _timing.watching_others():
        calls = announced(range(1 + config.runs), console, "forecasts")
        runs = [forecast(model.eval(), window) for _run in calls]
    yield section(config, "forecast", Spread.of_each(runs[1:]))
    if config.training:
        trainer = Trainer(model.train(), (), batch_of(config, config.height, config.width, config.batch))
        with _timing.watching_others():
            for _run in announced(range(1 + config.runs), console, "training steps"):
                trainer.step()
        seconds = [
            {
                **run["stages"],
                "all of forward": run["parts"][FORWARD],
                **{name: run["parts"][name] for name in (BACKWARD, ADAM)},
                **run[OPENCL],
                "training step": sum(run["parts"].values()),
            }
            for run in trainer.runs[1:]
        ]
        yield section(config, f"training, batch {config.batch}", Spread.of_each(seconds))


def forecast(model: Forecaster, window: Window) -> dict[str, float]:
    """Seconds of one forecast: inpainting of both frames, stages, and all of the network."""
    planes = [[plane[0].numpy() for plane in (of.image, of.depth, of.mask)] for of in window.frames]
    prior = window.given.prior if model.config.start == "prior" else None
    with watching() as watch, torch.no_grad():
        with watch.time("inpaint"):
            for image, depth, mask in planes:
                build_layers(image, depth, np.asarray(mask) > 0)
        with watch.time("forward"):
            model(*window.frames, window.given.K, prior=prior)
    return dict(watch.seconds)


def section(config: NetworkBench, title: str, seconds: Mapping[str, Spread]) -> Section:
    """Stages with their targets; memory is the most that was taken so far."""
    targets, rows = TARGETS.get((config.model, config.height, config.width), {}), list[Measurement]()
    for key, spread in seconds.items():
        name = _NAMES.get(key, key)
        if key == REST:
            continue
        rows.append(Measurement(name, "ms (quartiles)", spread, "s", name=f"{title}: {name}"))
        if key in targets:
            word = verdict(spread.median <= targets[key])
            rows.append(Measurement(name, "target", f"<= {targets[key] * 1e3:.0f} {word}"))
    memory = _timing.peak_gigabytes()
    rows.append(Measurement("peak memory", "GB", memory, "GB", ".2f", f"{title}: peak memory"))
    if "memory" in targets:
        word = verdict(memory <= targets["memory"], timed=False)
        rows.append(Measurement("peak memory", "target", f"<= {targets['memory']:g} {word}"))
    size = f"{config.height}x{config.width}, {config.threads} threads"
    return Section(
        f"{config.model}, {title}, {size}", rows, (), {f"network {title}": partial(bars, columns=("ms (quartiles)",))}
    )

"""`vestcl bench pipeline`: a complete forecast step in empty streets and full ones, and what skipping saves of it."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, Literal

import torch
from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import plots as _plots
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.results import Results
from vestcl.bench.network.bench import peak_gigabytes
from vestcl.bench.pipeline import report as _pipeline_report
from vestcl.bench.pipeline.measure import SceneTimes, measure_scene
from vestcl.bench.pipeline.traffic import EMPTY, EVERYTHING, JAM, LEAST_FRAMES, TRAFFIC, drive
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference import pretrained, quality
from vestcl.models.inference.fast import accelerate
from vestcl.models.networks import voxel_flow
from vestcl.opencl import trace

#: Of a street whose traffic is ordinary, and that no network was trained on.
SEED: Final = 1100


@dataclass(frozen=True)
class PipelineBench:
    """Time a forecast step, with depth and masks given, in an empty road, in traffic and in a jam."""

    model: str = "vest-s"
    """A trained network: a name that ships with vestcl, a file or a checkpoint's folder."""
    scenes: tuple[Literal["empty road", "traffic", "jam", "everything"], ...] = (EMPTY, TRAFFIC, JAM, EVERYTHING)
    """"everything" needs all of a step: there skipping can but cost."""
    height: int = 256
    """Pixels, a multiple of 16."""
    width: int = 832
    """Pixels, a multiple of 16."""
    frames: int = 8
    """Of a drive, which the step slides over."""
    seed: int = SEED
    """Of the street."""
    seconds: float = 60.0
    """About how long each scene takes."""
    quality: Literal["exact", "balanced", "fast"] = "balanced"
    """Of the forecast, with everything skipped and with nothing alike: see `vestcl.models.inference.quality`."""
    precision: Literal["float32", "bfloat16"] | None = None
    """That encoder and refinement compute in; None is the quality's, where the processor has it."""
    accelerated: bool = True
    """The network as `vestcl.models.inference.fast.accelerate` lays it out."""
    peers: bool = True
    """Beside DMVFN's network on the same frames, too."""
    threads: int = 2
    """Of torch."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices`, a part of its name, or "all": every one that works."""
    json: Path | None = None
    """File for the results."""
    markdown: Path | None = None
    """File for the tables."""
    plots: Path | None = None
    """Folder for plots (PNG)."""
    trace: Path | None = None
    """File for a trace of stages and kernels, which ui.perfetto.dev opens; times are a bit longer meanwhile."""


def main(config: PipelineBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size, number or time that is too small, a size that is no multiple of 16, or no such model.
        DeviceError: no such device.
    """
    _check(config)
    console = _results.console()
    model = load(config)
    with trace.record(config.trace), _timing.torch_threads(config.threads):
        results = _results.measure_each(config.device, partial(_measure_device, config, model, console), console)
    _results.save(results, config.json, config.markdown)
    _results.tell_written(console, config.json, config.markdown, config.trace, config.plots)


def load(config: PipelineBench) -> Forecaster:
    """The network as it is to run.

    Raises:
        ValueError: no such model.
    """
    model = quality.apply(pretrained.load_model(config.model), config.quality)
    if config.precision is not None:
        model.autocast = torch.bfloat16 if config.precision == "bfloat16" else None
    if not config.accelerated:
        return model
    return accelerate(model, "float32" if model.autocast is None else "bfloat16")


def _check(config: PipelineBench) -> None:
    _results.check_positive(config, "height", "width", "seconds", "threads")
    for name in ("height", "width"):
        if getattr(config, name) % voxel_flow.MULTIPLE:
            raise ValueError(f"`{name}` must be a multiple of {voxel_flow.MULTIPLE} px, got {getattr(config, name)}")
    if config.frames < LEAST_FRAMES:
        raise ValueError(f"`frames` must be {LEAST_FRAMES} or more, got {config.frames}")
    if not config.scenes:
        raise ValueError("`scenes` must be one or more, got none")


def _measure_device(config: PipelineBench, model: Forecaster, console: Console, session: opencl.Session) -> Results:
    """All scenes on one device, printed as they come."""
    machine = _results.describe(session)
    _results.show_machine(machine, console)
    scenes = [_measure(config, model, console, name) for name in dict.fromkeys(config.scenes)]
    grids = _pipeline_report.grids(scenes, f"{model.config.name}, {config.height}x{config.width}")
    _results.show([Results("pipeline", {}, {}, [], grids, {})], console)
    if config.plots is not None:
        title = f"forecast step, {config.height}x{config.width}, {machine['device']}"
        _pipeline_report.plot(config.plots / _plots.file_name(f"pipeline {machine['device']}"), title, scenes)
    details = _results.plain({
        "skip": model.skip,
        "effort": model.effort,
        "autocast": None if model.autocast is None else str(model.autocast),
        "scenes": {scene.name: scene for scene in scenes},
        "counts": {
            scene.name: {key: count._asdict() for key, count in (scene.counts | scene.splatter).items()}
            for scene in scenes
        },
        "targets": _pipeline_report.verdicts(scenes),
        "peak_gigabytes": peak_gigabytes(),
    })  # fmt: skip
    measures = _pipeline_report.measures(scenes)
    return Results("pipeline", machine, _results.settings(config), measures, grids, details)


def _measure(config: PipelineBench, model: Forecaster, console: Console, name: str) -> SceneTimes:
    with console.status(name), trace.stage(name):
        scene = drive(name, config.height, config.width, config.frames, config.seed)
        return measure_scene(model, scene, config.seconds, config.threads, config.peers)

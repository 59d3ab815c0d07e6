"""`vestcl bench train-step`: a training step by stage, what gradients cost that nobody asks for, and torch's splat."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import torch
from rich.console import Console
from torch import nn

from vestcl import opencl
from vestcl.bench.common import plots as _plots
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.results import Results
from vestcl.bench.network import train_report as _train_report
from vestcl.bench.network.bench import peak_gigabytes
from vestcl.bench.network.train_measure import Batch, StepTimes, TwinTimes, measure_steps, measure_twin, stacked
from vestcl.bench.pipeline.bench import SEED
from vestcl.bench.pipeline.traffic import LEAST_FRAMES, TRAFFIC, drive
from vestcl.evaluation.tables import Grid
from vestcl.models import ModelConfig, configuration
from vestcl.models.forecaster import Forecaster
from vestcl.opencl import trace

#: Deviation of the last layers' weights of object motion, metres: as it is made it changes nothing, and would not run
#: where it does not learn.
_STIRRED: Final = 1e-5

#: (height, width) at which torch's splat takes part in a step: it is thousands of times slower at full size.
TWIN_SIZE: Final = (32, 112)


@dataclass(frozen=True)
class TrainStepBench:
    """Time a training step, forward, backward and Adam, on streets with true depth and labels."""

    model: str = "vest-s"
    """A configuration: "vest-paper", "vest-s+joint", ...; its weights are random."""
    height: int = 128
    """Pixels."""
    width: int = 416
    """Pixels."""
    batch: int = 4
    """Windows of one drive a step."""
    seed: int = SEED
    """Of the street and the weights."""
    seconds: float = 40.0
    """About how long the measurement takes."""
    twin: bool = True
    """A small step with torch's splat in place of OpenCL's, too."""
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


def main(config: TrainStepBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size, number or time that is not positive, or a model that isn't known.
        DeviceError: no such device.
    """
    _results.check_positive(config, "height", "width", "batch", "seconds", "threads")
    model_config = configuration(config.model)
    console = _results.console()
    with trace.record(config.trace), _timing.torch_threads(config.threads):
        results = _results.measure_each(config.device, partial(_measure_device, config, model_config, console), console)
    _results.save(results, config.json, config.markdown)
    _results.tell_written(console, config.json, config.markdown, config.trace, config.plots)


def _measure_device(
    config: TrainStepBench, model_config: ModelConfig, console: Console, session: opencl.Session
) -> Results:
    """Everything on one device."""
    machine = _results.describe(session)
    _results.show_machine(machine, console)
    model = made(model_config, config.seed)
    with console.status("training steps"):
        steps = measure_steps(model, _batch(config, config.height, config.width, config.batch), config.seconds)
    twin = None
    if config.twin:
        with console.status("a step with torch's splat"):
            twin = measure_twin(model, _batch(config, *TWIN_SIZE, 1), config.seconds / 4)
    size = f"{config.model}, {config.height}x{config.width}, batch {config.batch}"
    grids = _train_report.grids(steps, twin, size, "x".join(map(str, TWIN_SIZE)))
    _results.show([Results("train-step", {}, {}, [], grids, {})], console)
    if config.plots is not None:
        path = config.plots / _plots.file_name(f"train step {machine['device']}")
        _train_report.plot(path, f"training step, {size}, {machine['device']}", steps)
    return _result(config, machine, steps, twin, grids)


def _result(
    config: TrainStepBench,
    machine: dict[str, str],
    steps: Sequence[StepTimes],
    twin: TwinTimes | None,
    grids: list[Grid],
) -> Results:
    details = {"steps": steps, "twin": twin, "twin_size": TWIN_SIZE, "peak_gigabytes": peak_gigabytes()}
    measures = _train_report.measures(steps, twin)
    return Results("train-step", machine, _results.settings(config), measures, grids, dict(_results.plain(details)))


def made(config: ModelConfig, seed: int) -> Forecaster:
    """A network as at the start of a training, but with object motion that does something."""
    torch.manual_seed(seed)
    model = Forecaster(config)
    for block in () if model.object_motion is None else model.object_motion.blocks:
        for parameter in block.get_submodule("out").parameters():
            nn.init.normal_(parameter, std=_STIRRED)
    return model.train()


def _batch(config: TrainStepBench, height: int, width: int, count: int) -> Batch:
    return stacked(drive(TRAFFIC, height, width, max(LEAST_FRAMES, count + 2), config.seed).windows[:count])

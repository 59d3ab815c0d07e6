"""`vestcl bench train-step`: a training step by stage, and what gradients cost that nobody asks for."""

import copy
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import torch
from rich.console import Console
from torch import nn

from vestcl import opencl
from vestcl.bench.common import results, timing
from vestcl.bench.common.options import Options
from vestcl.bench.common.plots import bars
from vestcl.bench.common.table import Measurement, Section
from vestcl.bench.common.timing import Spread
from vestcl.bench.pipeline.bench import SEED
from vestcl.bench.pipeline.traffic import LEAST_FRAMES, TRAFFIC, Window, drive
from vestcl.forecasting.network.input import NetworkInput
from vestcl.models import ModelConfig, configuration
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.stage_times import watching, with_rest
from vestcl.models.networks.layers import joined
from vestcl.opencl import trace

Batch = tuple[NetworkInput, torch.Tensor]
"""What one step learns from: its input, and the frames at t + 1 [B, 3, H, W]."""

#: Variant -> networks that are frozen, by their attributes of `Forecaster`. Autograd records nothing that leads only to
#: frozen ones, and OpenCL's backward computes no gradient that nobody asks for.
FROZEN: Final[dict[str, tuple[str, ...]]] = {
    "everything learns": (),
    "encoder frozen": ("encoder",),
    "refinement alone learns": ("encoder", "ego_motion", "object_motion"),
}

EVERYTHING_LEARNS: Final = next(iter(FROZEN))

#: Parts of a step.
FORWARD, BACKWARD, ADAM = "forward", "backward", "Adam"

#: All of unproject, rigid flow, displace and splat, forward and backward; a part of the others.
OPENCL: Final = "OpenCL"

#: Of Adam (SPEC section 7).
LEARNING_RATE: Final = 1e-4

#: Deviation of the last layers' weights of object motion, metres: as it is made it changes nothing, and would not run
#: where it does not learn.
_STIRRED: Final = 1e-5


@dataclass(frozen=True)
class TrainStepBench(Options):
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
    """Without effect: a step with torch's splat is no longer measured."""


def main(config: TrainStepBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size, number or time that is not positive, or a model that isn't known.
        DeviceError: no such device.
    """
    results.check_positive(config, "height", "width", "batch", "seconds", "threads")
    results.run("train-step", config, partial(_sections, config, configuration(config.model)))


def _sections(
    config: TrainStepBench, model_config: ModelConfig, _: opencl.Session, console: Console
) -> Iterator[Section]:
    """Variants and their stages, on one device; times are seconds a step, in turns."""
    model, batch = made(model_config, config.seed).train(), batch_of(config, config.height, config.width, config.batch)
    trainers = {name: Trainer(model, frozen, batch) for name, frozen in FROZEN.items()}
    with console.status("training steps"), timing.recycling_allocator():
        times = timing.interleave({name: trainer.step for name, trainer in trainers.items()}, config.seconds)
    rows, stages = list[Measurement](), list[Measurement]()
    for name, trainer in trainers.items():
        runs, whole = trainer.runs[-len(times[name]) :], Spread.of(times[name])
        parts, opencl_time = (Spread.of_each([run[kind] for run in runs]) for kind in ("parts", OPENCL))
        rows.append(Measurement(name, "parameters", f"{trainer.parameters:,}"))
        rows.append(Measurement(name, "step, ms (quartiles)", whole, "s", name=name))
        if name != EVERYTHING_LEARNS:
            saved = Spread.of(1 - times[name] / times[EVERYTHING_LEARNS])
            rows.append(Measurement(name, "saved", saved, "1", "+.1%", f"{name}: saved", "higher"))
        for part, spread in parts.items():
            rows.append(Measurement(name, f"{part}, ms", spread, "s", name=f"{name}: {part}"))
        rows.append(Measurement(name, "OpenCL, ms", opencl_time[OPENCL], "s", ".1f", f"{name}: OpenCL"))
        for stage, spread in Spread.of_each([run["stages"] for run in runs]).items():
            stages.append(Measurement(stage, name, spread, "s", ".1f", f"{name}: {FORWARD}: {stage}"))
    size = f"{config.model}, {config.height}x{config.width}, batch {config.batch}"
    note = f"{whole.runs} rounds. OpenCL's share of a step is a part of {FORWARD} and {BACKWARD}."
    yield Section(f"training step, {size}", rows, (note,))
    yield Section("stages of forward, ms", stages, ("Medians.",), {"train step": partial(bars, stacked=True)})


def made(config: ModelConfig, seed: int) -> Forecaster:
    """A network as at the start of a training, but with object motion that has an effect."""
    torch.manual_seed(seed)
    model = Forecaster(config)
    for block in () if model.object_motion is None else model.object_motion.blocks:
        for parameter in block.get_submodule("out").parameters():
            nn.init.normal_(parameter, std=_STIRRED)
    return model


def batch_of(config: Any, height: int, width: int, count: int) -> Batch:
    """``count`` windows of one drive of ``config.seed``."""
    return stacked(drive(TRAFFIC, height, width, max(LEAST_FRAMES, count + 2), config.seed).windows[:count])


def stacked(windows: Sequence[Window]) -> Batch:
    """Windows of a street, one or more, of one size, each with its truth, as one batch."""
    truths = [window.truth for window in windows if window.truth is not None]
    assert len(truths) == len(windows) > 0
    return joined([window.given for window in windows]), torch.cat(truths)


class Trainer:
    """One variant's steps."""

    def __init__(self, model: Forecaster, frozen: Sequence[str], batch: Batch) -> None:
        self.model, self._batch = copy.deepcopy(model), batch
        for name in frozen:
            network = getattr(self.model, name)
            if network is not None:
                network.requires_grad_(False)
        learning = [parameter for parameter in self.model.parameters() if parameter.requires_grad]
        self.parameters = sum(parameter.numel() for parameter in learning)
        self._adam = torch.optim.Adam(learning, LEARNING_RATE)
        self.runs: list[dict[str, dict[str, float]]] = []

    def step(self) -> None:
        """Forward, L1, backward, Adam."""
        session, busy = opencl.current(), opencl.current().seconds
        start = time.perf_counter()
        with trace.stage(FORWARD), watching() as watch:
            loss = self.loss()
        forward = time.perf_counter()
        with trace.stage(BACKWARD):
            loss.backward()
        end = time.perf_counter()
        with trace.stage(ADAM):
            self._adam.step()
        parts = {FORWARD: forward - start, BACKWARD: end - forward, ADAM: time.perf_counter() - end}
        stages = with_rest(watch.seconds, parts[FORWARD])
        self.runs.append({"parts": parts, "stages": stages, OPENCL: {OPENCL: session.seconds - busy}})

    def loss(self) -> torch.Tensor:
        """Mean |image - truth|, with all gradients cleared."""
        self._adam.zero_grad(set_to_none=True)
        given, truth = self._batch
        prior = given.prior if self.model.config.start == "prior" else None
        step = self.model(given.frame_prev, given.frame_cur, given.K, prior=prior)
        return nn.functional.l1_loss(step.views[0].image, truth)

"""`vestcl bench train-step`: a training step by stage, what gradients cost that nobody asks for, and torch's splat."""

import copy
import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import torch
from rich.console import Console
from torch import nn

from vestcl import opencl
from vestcl.bench.common import results, timing
from vestcl.bench.common.options import Options
from vestcl.bench.common.table import Measurement, Section, busy
from vestcl.bench.common.timing import Spread, peak_gigabytes
from vestcl.bench.network.bench import LEARNING_RATE, made
from vestcl.bench.pipeline.bench import SEED
from vestcl.bench.pipeline.splatter import by_reference
from vestcl.bench.pipeline.traffic import LEAST_FRAMES, TRAFFIC, Window, drive
from vestcl.forecasting.network.input import NetworkInput
from vestcl.models import ModelConfig, configuration
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.stage_times import REST, watching, with_rest
from vestcl.models.networks.layers import joined, tensors_in
from vestcl.opencl import trace

Record = dict[str, Any]

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

#: A small step's splat: ours, and the torch reference's.
OURS, TWIN = "OpenCL", "torch"

#: (height, width) at which torch's splat takes part in a step: it is thousands of times slower at full size.
TWIN_SIZE: Final = (32, 112)


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
    """A small step with torch's splat in place of OpenCL's, too."""


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
    """Everything on one device: variants, stages, and torch's splat."""
    model = made(model_config, config.seed).train()
    with console.status("training steps"):
        steps = measure_steps(model, _batch(config, config.height, config.width, config.batch), config.seconds)
    size = f"{config.model}, {config.height}x{config.width}, batch {config.batch}"
    notes = (
        f"{steps[0]['whole'].runs} rounds. OpenCL's share of a step is a part of {FORWARD} and {BACKWARD}.",
        *busy(steps[0]["others_cores"]),
    )
    rows = [row for step in steps for row in _variant_rows(step)]
    yield Section(f"training step, {size}", rows, notes, {"steps": steps, "twin": None, "twin_size": TWIN_SIZE})
    note = "Medians. A stage's backward lasts from the gradient of its first result to that of an earlier stage's."
    rows = [
        Measurement(stage, f"{step['name']}, {way}", spread, "s", ".1f", f"{step['name']}: {way}: {stage}")
        for step in steps
        for way in (FORWARD, BACKWARD)
        for stage, spread in step[way].items()
    ]
    yield Section("stages, ms", rows, (note,), stacked=True)
    if config.twin:
        with console.status("a step with torch's splat"):
            twin = measure_reference(model, _batch(config, *TWIN_SIZE, 1), config.seconds / 4)
        yield _reference_section(twin)
    yield Section("", [], details={"peak_gigabytes": peak_gigabytes()})


def _batch(config: TrainStepBench, height: int, width: int, count: int) -> Batch:
    return stacked(drive(TRAFFIC, height, width, max(LEAST_FRAMES, count + 2), config.seed).windows[:count])


def _variant_rows(step: Record) -> Iterator[Measurement]:
    name = step["name"]
    yield Measurement(name, "parameters", f"{step['parameters']:,}")
    yield Measurement(name, "step, ms (quartiles)", step["whole"], "s", name=name)
    if name != EVERYTHING_LEARNS:
        yield Measurement(name, "saved", step["saved_share"], "1", "+.1%", f"{name}: saved", "higher")
    for part in (FORWARD, BACKWARD, ADAM):
        yield Measurement(name, f"{part}, ms", step["parts"][part], "s", name=f"{name}: {part}")
    yield Measurement(name, "", step["opencl"], "s", name=f"{name}: OpenCL")
    yield Measurement(name, "OpenCL's share", f"{step['opencl'].median / step['whole'].median:.1%}")


def _reference_section(twin: Record) -> Section:
    ratio, worst = twin["splat"][TWIN].median / twin["splat"][OURS].median, twin["gradient_difference"]
    rows = [Measurement("", "", worst, name="small step: gradients' difference")]
    for by in (OURS, TWIN):
        row, name = f"splat by {by}", f"small step, splat by {by}"
        rows.append(Measurement(row, "step, ms (quartiles)", twin["whole"][by], "s", name=name))
        rows.append(Measurement(row, "splat, both passes, ms", twin["splat"][by], "s", name=f"{name}: splat"))
    notes = (
        f"The stage takes {ratio:.1f} times as long in torch.",
        f"Gradients of the weights differ by {worst:.0e} of the largest.",
    )
    size = "x".join(map(str, TWIN_SIZE))
    return Section(f"training step with torch's splat, {size}, batch 1", rows, notes, {"twin": twin})


# ---------------------------------------------------------------- measurements


def stacked(windows: Sequence[Window]) -> Batch:
    """Windows of a street, one or more, of one size, each with its truth, as one batch."""
    truths = [window.truth for window in windows if window.truth is not None]
    assert len(truths) == len(windows) > 0
    return joined([window.given for window in windows]), torch.cat(truths)


class BackwardWatch:
    """Seconds of the backward pass by stage.

    On a CPU autograd runs the last operation's gradient first. So a stage's backward begins when the gradient of one of
    its results is there, and lasts until that of an earlier stage's result is. What comes before the first is the
    loss's; rigid flow, between EMF and OMF, counts as OMF's.
    """

    def __init__(self) -> None:
        self._began: list[tuple[float, str]] = []

    def seen(self, name: str, result: Any) -> None:
        """Watch for the gradients of a stage's results; for `vestcl.models.inference.stage_times.watching`."""
        for tensor in tensors_in(result):
            if tensor.requires_grad:
                tensor.register_hook(lambda _: self._began.append((time.perf_counter(), name)))

    def backward(self, loss: torch.Tensor) -> dict[str, float]:
        """loss.backward(); seconds by stage, and of the loss as REST."""
        self._began = [(time.perf_counter(), REST)]
        loss.backward()
        began, seconds = [*self._began, (time.perf_counter(), REST)], dict[str, float]()
        for (start, name), (end, _) in itertools.pairwise(began):
            seconds[name] = seconds.get(name, 0.0) + end - start
        return seconds


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
        self._adam, self._backward = torch.optim.Adam(learning, LEARNING_RATE), BackwardWatch()
        self.runs: list[dict[str, dict[str, float]]] = []

    def step(self) -> None:
        """Forward, L1, backward, Adam."""
        session, busy = opencl.current(), opencl.current().seconds
        start = time.perf_counter()
        with trace.stage(FORWARD), watching(self._backward.seen) as watch:
            loss = self.loss()
        forward = time.perf_counter()
        with trace.stage(BACKWARD):
            backward = self._backward.backward(loss)
        end = time.perf_counter()
        with trace.stage(ADAM):
            self._adam.step()
        parts = {FORWARD: forward - start, BACKWARD: end - forward, ADAM: time.perf_counter() - end}
        stages, back = with_rest(watch.seconds, parts[FORWARD]), with_rest(backward, parts[BACKWARD])
        self.runs.append({"parts": parts, FORWARD: stages, BACKWARD: back, "opencl": {"": session.seconds - busy}})

    def loss(self) -> torch.Tensor:
        """Mean |image - truth|, with all gradients cleared."""
        self._adam.zero_grad(set_to_none=True)
        given, truth = self._batch
        prior = given.prior if self.model.config.start == "prior" else None
        step = self.model(given.frame_prev, given.frame_cur, given.K, prior=prior)
        return nn.functional.l1_loss(step.views[0].image, truth)


def measure_steps(model: Forecaster, batch: Batch, seconds: float) -> list[Record]:
    """Every variant of FROZEN, in turns; times are seconds a step.

    Args:
        model: in training mode; it stays as it is.
        batch: that all learn from.
        seconds: about how long it takes.

    Returns:
        Of each "name", "whole", "parts" by FORWARD, BACKWARD and ADAM, FORWARD and BACKWARD by stage, "opencl" (forward
        and backward, a part of the others), "saved_share" of the step in which everything learns, round by round,
        "parameters" that learn, "others_cores".
    """
    trainers = {name: Trainer(model, frozen, batch) for name, frozen in FROZEN.items()}
    with timing.recycling_allocator(), timing.watching_others() as others:
        times = timing.interleave({name: trainer.step for name, trainer in trainers.items()}, seconds)
    found = []
    for name, trainer in trainers.items():
        runs = trainer.runs[-len(times[name]) :]
        kinds: Record = {kind: Spread.of_each([run[kind] for run in runs]) for kind in ("parts", FORWARD, BACKWARD)}
        kinds |= Spread.of_each([{"opencl": run["opencl"][""]} for run in runs])
        saved = Spread.of(1 - times[name] / times[EVERYTHING_LEARNS])
        about = {"saved_share": saved, "parameters": trainer.parameters, "others_cores": others.cores}
        found.append({"name": name, "whole": Spread.of(times[name]), **kinds, **about})
    return found


def measure_reference(model: Forecaster, batch: Batch, seconds: float) -> Record:
    """A step with OpenCL's splat and one with the torch reference's, in turns; all else is the same.

    Args:
        model: in training mode; it stays as it is.
        batch: small: the reference takes every fragment through torch's indexing.
        seconds: about how long it takes.

    Returns:
        By OURS and TWIN "whole" and "splat", seconds of the step and of forward and backward of that stage;
        "gradient_difference", the largest of a parameter as a share of the largest gradient of that parameter.
    """
    trainers = {OURS: Trainer(model, (), batch), TWIN: Trainer(model, (), batch)}
    difference = _gradient_difference(trainers[OURS], trainers[TWIN])

    def with_reference() -> None:
        with by_reference():
            trainers[TWIN].step()

    with timing.recycling_allocator():
        times = timing.interleave({OURS: trainers[OURS].step, TWIN: with_reference}, seconds)
    splat = {
        name: Spread.of(
            np.array([run[FORWARD]["splat"] + run[BACKWARD]["splat"] for run in trainer.runs[-len(times[name]) :]])
        )
        for name, trainer in trainers.items()
    }
    whole = {name: Spread.of(found) for name, found in times.items()}
    return {"whole": whole, "splat": splat, "gradient_difference": difference}


def _gradient_difference(ours: Trainer, theirs: Trainer) -> float:
    ours.loss().backward()
    with by_reference():
        theirs.loss().backward()
    worst = 0.0
    for one, other in zip(ours.model.parameters(), theirs.model.parameters(), strict=True):
        if one.grad is not None and other.grad is not None and other.grad.any():
            worst = max(worst, ((one.grad - other.grad).abs().max() / other.grad.abs().max()).item())
    return worst

"""Training steps in turns: everything learns, or a part is frozen; and a small one whose splat is plain torch's."""

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import nn

from vestcl import opencl
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.timing import Spread
from vestcl.bench.network.backward import BackwardWatch
from vestcl.bench.network.bench import LEARNING_RATE
from vestcl.bench.pipeline.splatter import by_twin
from vestcl.bench.pipeline.traffic import Window
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.stage_times import watching, with_rest
from vestcl.models.networks.layers import joined
from vestcl.models.steps.prior import MotionPrior
from vestcl.opencl import trace
from vestcl.scene.layers import LayerBatch

#: Variant -> networks that are frozen, by their attributes of `Forecaster`. Autograd records nothing that leads to a
#: frozen one alone, and OpenCL's backward computes no gradient that nobody asks for.
FROZEN: Final[dict[str, tuple[str, ...]]] = {
    "everything learns": (),
    "encoder frozen": ("encoder",),
    "refinement alone learns": ("encoder", "ego_motion", "object_motion"),
}

EVERYTHING_LEARNS: Final = next(iter(FROZEN))

#: Parts of a step.
FORWARD, BACKWARD, ADAM = "forward", "backward", "Adam"

#: A small step's splat: ours, and the plain torch twin's.
OURS, TWIN = "OpenCL", "torch"


class Batch(NamedTuple):
    """What one step learns from."""

    frame_prev: LayerBatch
    frame_cur: LayerBatch
    K: torch.Tensor
    """[B, 3, 3] px."""
    prior: MotionPrior
    truth: torch.Tensor
    """[B, 3, H, W], the frame at t + 1."""


def stacked(windows: Sequence[Window]) -> Batch:
    """Windows of a street as one batch.

    Args:
        windows: one or more, of one size, each with its truth.
    """
    truths = [window.truth for window in windows if window.truth is not None]
    assert len(truths) == len(windows) > 0
    given = joined([window.given for window in windows])
    return Batch(given.frame_prev, given.frame_cur, given.K, given.prior, torch.cat(truths))


@dataclass(frozen=True)
class StepTimes:
    """One variant's figures, s a step."""

    name: str
    whole: Spread
    parts: dict[str, Spread]
    """By FORWARD, BACKWARD and ADAM."""
    forward: dict[str, Spread]
    """By stage."""
    backward: dict[str, Spread]
    """By stage."""
    opencl: Spread
    """Time in OpenCL, forward and backward, a part of the others."""
    saved_share: Spread
    """Of the step in which everything learns, round by round."""
    parameters: int
    """That learn."""
    others_cores: float | None


@dataclass(frozen=True)
class TwinTimes:
    """A small step of batch 1, with each splat."""

    whole: dict[str, Spread]
    splat: dict[str, Spread]
    """Forward and backward of that stage alone."""
    gradient_difference: float
    """Largest difference of a parameter's gradient as a share of the largest gradient of that parameter."""


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
        stages = with_rest(watch.seconds, parts[FORWARD])
        device = {"": session.seconds - busy}
        back = with_rest(backward, parts[BACKWARD])
        self.runs.append({"parts": parts, FORWARD: stages, BACKWARD: back, "opencl": device})

    def loss(self) -> torch.Tensor:
        """Mean |image - truth|, with all gradients cleared."""
        self._adam.zero_grad(set_to_none=True)
        batch = self._batch
        prior = batch.prior if self.model.config.start == "prior" else None
        step = self.model(batch.frame_prev, batch.frame_cur, batch.K, prior=prior)
        return nn.functional.l1_loss(step.views[0].image, batch.truth)

    def spreads(self, what: str, count: int) -> dict[str, Spread]:
        """Of the last ``count`` runs."""
        runs = [run[what] for run in self.runs[-count:]]
        return {name: Spread.of(np.array([run[name] for run in runs])) for name in runs[0]}


def measure_steps(model: Forecaster, batch: Batch, seconds: float) -> list[StepTimes]:
    """Every variant of FROZEN, in turns.

    Args:
        model: in training mode; it stays as it is.
        batch: that all learn from.
        seconds: about how long it takes.
    """
    trainers = {name: Trainer(model, frozen, batch) for name, frozen in FROZEN.items()}
    with _timing.recycling_allocator(), _timing.watching_others() as others:
        times = _timing.interleave({name: trainer.step for name, trainer in trainers.items()}, seconds)
    base, found = times[EVERYTHING_LEARNS], []
    for name, trainer in trainers.items():
        count, whole = len(base), times[name]
        parts, forward, backward, opencl = (
            trainer.spreads(what, count) for what in ("parts", FORWARD, BACKWARD, "opencl")
        )
        saved = Spread.of(1 - whole / base)
        found.append(
            StepTimes(
                name,
                Spread.of(whole),
                parts,
                forward,
                backward,
                opencl[""],
                saved,
                trainer.parameters,
                others.cores,
            )
        )
    return found


def measure_twin(model: Forecaster, batch: Batch, seconds: float) -> TwinTimes:
    """A step with OpenCL's splat and one with the torch twin's, in turns; all else is the same.

    Args:
        model: in training mode; it stays as it is.
        batch: small: the twin takes every fragment through torch's indexing.
        seconds: about how long it takes.
    """
    ours, twins = Trainer(model, (), batch), Trainer(model, (), batch)
    difference = _gradient_difference(ours, twins)

    def with_twin() -> None:
        with by_twin():
            twins.step()

    with _timing.recycling_allocator():
        times = _timing.interleave({OURS: ours.step, TWIN: with_twin}, seconds)
    splat = {
        name: Spread.of(
            np.array([run[FORWARD]["splat"] + run[BACKWARD]["splat"] for run in trainer.runs[-len(times[name]) :]])
        )
        for name, trainer in ((OURS, ours), (TWIN, twins))
    }
    return TwinTimes({name: Spread.of(found) for name, found in times.items()}, splat, difference)


def _gradient_difference(ours: Trainer, twins: Trainer) -> float:
    ours.loss().backward()
    with by_twin():
        twins.loss().backward()
    worst = 0.0
    for one, other in zip(ours.model.parameters(), twins.model.parameters(), strict=True):
        if one.grad is not None and other.grad is not None and other.grad.any():
            worst = max(worst, ((one.grad - other.grad).abs().max() / other.grad.abs().max()).item())
    return worst

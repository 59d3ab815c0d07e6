"""`vestcl bench network`: one forecast stage by stage, one training step, and the memory that they take."""

import contextlib
import dataclasses
import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from rich import box
from rich.console import Console
from rich.table import Table
from torch import nn

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.timing import Spread
from vestcl.data import Frame, Street, intrinsics
from vestcl.data.street.raycast import STREET_SKY_DEPTH
from vestcl.io.labels import background
from vestcl.models import ModelConfig, configuration
from vestcl.models.forecaster import Forecaster, Step
from vestcl.models.steps.prior import MotionPrior, nothing_moves
from vestcl.scene import layers
from vestcl.scene.layers import LayerBatch

#: Seconds from frame to frame: KITTI's cameras give ten a second.
INTERVAL: Final = 0.1

#: (model, height, width) -> seconds that a forecast and a training step may take on two cores, and GB of memory.
TARGETS: Final[dict[tuple[str, int, int], dict[str, float]]] = {
    ("vest-s", 256, 832): {"forward": 2.0, "training step": 8.0},
    ("vest-paper", 256, 832): {"memory": 24.0},
}

#: Runs before anything counts: they compile the kernels and fill the memory pools.
WARM_UP: Final = 1

#: Stage: unproject, rigid flow, displace and splat, forward and backward; a part of the others.
OPENCL: Final = "all OpenCL, both ways"

#: Of Adam (SPEC section 7).
LEARNING_RATE: Final = 1e-4


@dataclass(frozen=True)
class NetworkBench:
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
    threads: int = 2
    """Of torch."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name."""
    json: Path | None = None
    """File for the results."""


@dataclass(frozen=True)
class Timing:
    """One part of the work, in seconds a run: wall time, and the CPU time of all threads."""

    name: str
    wall: Spread
    cpu: Spread


@dataclass(frozen=True)
class Part:
    """A forecast or a training step, its stages first and the whole last."""

    title: str
    timings: list[Timing]
    peak_gigabytes: float
    """The most memory that the process has taken so far."""
    others_cores: float | None
    """That other processes kept busy meanwhile."""


@dataclass
class Stopwatch:
    """Seconds of named stages, summed up over one run."""

    wall: dict[str, float] = field(default_factory=dict)
    cpu: dict[str, float] = field(default_factory=dict)

    @contextlib.contextmanager
    def time(self, name: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.wall[name] = self.wall.get(name, 0.0) + time.perf_counter() - wall
        self.cpu[name] = self.cpu.get(name, 0.0) + time.process_time() - cpu


#: Deviation of the last layers' weights of object motion: next to nothing, metres.
_STIRRED: Final = 1e-5


class TimedForecaster(Forecaster):
    """A `Forecaster` that tells its stages' times."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(config)
        self.watch = Stopwatch()

    def encode(self, *arguments: Any) -> Any:
        with self.watch.time("encode"):
            return super().encode(*arguments)

    def move_camera(self, *arguments: Any) -> Any:
        with self.watch.time("camera motion (EMF)"):
            return super().move_camera(*arguments)

    def move_objects(self, *arguments: Any) -> Any:
        with self.watch.time("object motion (OMF)"):
            return super().move_objects(*arguments)

    def lift(self, *arguments: Any) -> Any:
        with self.watch.time("lift"):
            return super().lift(*arguments)

    def splat(self, *arguments: Any) -> Any:
        with self.watch.time("displace and splat"):
            return super().splat(*arguments)

    def paint(self, *arguments: Any) -> Any:
        with self.watch.time("refine"):
            return super().paint(*arguments)


def main(config: NetworkBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size or number that is not positive, or a model that isn't known.
        DeviceError: no such device.
    """
    _results.check_positive(config, "height", "width", "runs", "threads", "batch")
    model_config = configuration(config.model)
    console = _results.console()
    with opencl.use(config.device) as session, _timing.torch_threads(config.threads):
        machine = _results.describe(session)
        for name, value in machine.items():
            console.print(f"{name}: {value}", soft_wrap=True, highlight=False)
        torch.manual_seed(config.seed)
        model = _in_use(TimedForecaster(model_config))
        frames, K = street_frames(config.height, config.width, config.seed)
        parts = list(_parts(config, console, model, frames, torch.from_numpy(K)[None].float()))
    if config.json is not None:
        settings = dataclasses.asdict(config) | {"json": str(config.json)}
        results = {"machine": machine, "config": settings, "parts": [dataclasses.asdict(part) for part in parts]}
        _results.write_json(config.json, results)
        _results.tell_written(console, config.json)


def street_frames(height: int, width: int, seed: int, count: int = 3) -> tuple[list[Frame], np.ndarray]:
    """Frames at t - 1, t, t + 1, ... of a street, and K [3, 3] px."""
    street, K = Street.generate(seed), intrinsics(height, width)
    times = [index * INTERVAL for index in range(count)]
    poses = (np.linalg.inv(street.camera_pose(t)) for t in times)
    return [street.render(pose, K, height, width, t) for pose, t in zip(poses, times, strict=True)], K


def street_layers(frame: Frame) -> LayerBatch:
    """Layers [1, ...] of a street's frame, from its true depth and labels."""
    sky = frame.depth[0] >= STREET_SKY_DEPTH
    return layers.batch([layers.build_layers(frame.colour[0], frame.depth[0], background(frame.labels[0]), sky=sky)])


def _in_use(model: TimedForecaster) -> TimedForecaster:
    """With object motion that does something, and frames encoded each time: they are the same ones in all runs."""
    model.skip = dataclasses.replace(model.skip, seen=False)
    for block in () if model.object_motion is None else model.object_motion.blocks:
        for parameter in block.get_submodule("out").parameters():
            nn.init.normal_(parameter, std=_STIRRED)
    return model


def prior_of(model: Forecaster, frame: LayerBatch) -> MotionPrior | None:
    """What a model starts from, as if nothing had moved: what it costs does not depend on it."""
    return nothing_moves(frame.image) if model.config.start == "prior" else None


def _parts(
    config: NetworkBench, console: Console, model: TimedForecaster, frames: Sequence[Frame], K: torch.Tensor
) -> Iterator[Part]:
    """Measure and print part after part. Memory only grows, so the training step comes last."""

    def several(tensor: torch.Tensor) -> torch.Tensor:
        return tensor.repeat(config.batch, *(1,) * (tensor.ndim - 1))

    def forecast() -> Step:
        with model.watch.time("inpaint"):
            pair = [street_layers(frame) for frame in frames[:2]]
        with torch.no_grad(), model.watch.time("forward"):
            return model(*pair, K, prior=prior_of(model, pair[1]))

    model.eval()
    yield _show(config, console, _measure(f"{config.model}, forecast", model, forecast, "forward", config.runs))
    if config.training:
        pair = [LayerBatch(*map(several, street_layers(frame))) for frame in frames[:2]]
        truth, cameras = several(torch.from_numpy(frames[2].colour)), several(K)
        adam = torch.optim.Adam(model.train().parameters(), LEARNING_RATE)

        def train() -> None:
            with model.watch.time("training step"):
                train_once(model, adam, pair, truth, cameras)

        title = f"{config.model}, training, batch {config.batch}"
        yield _show(config, console, _measure(title, model, train, "training step", config.runs))


def train_once(
    model: TimedForecaster,
    adam: torch.optim.Optimizer,
    pair: Sequence[LayerBatch],
    truth: torch.Tensor,
    K: torch.Tensor,
) -> float:
    """One step down the L1 loss; the loss."""
    adam.zero_grad(set_to_none=True)
    session, busy = opencl.current(), opencl.current().seconds
    with model.watch.time("all of forward"):
        loss = nn.functional.l1_loss(model(*pair, K, prior=prior_of(model, pair[1])).views[0].image, truth)
    with model.watch.time("backward"):
        loss.backward()
    with model.watch.time("Adam"):
        adam.step()
    model.watch.wall[OPENCL], model.watch.cpu[OPENCL] = session.seconds - busy, 0.0
    return loss.item()


def _measure(title: str, model: TimedForecaster, task: Callable[[], object], whole: str, runs: int) -> Part:
    for _ in range(WARM_UP):
        task()
    watches = []
    with _timing.watching_others() as others:
        for _ in range(runs):
            model.watch = Stopwatch()
            task()
            watches.append(model.watch)
    names = sorted(watches[0].wall, key=lambda name: name == whole)
    timings = [
        Timing(
            name, *(Spread.of(np.array([getattr(watch, kind)[name] for watch in watches])) for kind in ("wall", "cpu"))
        )
        for name in names
    ]
    return Part(title, timings, peak_gigabytes(), others.cores)


def peak_gigabytes() -> float:
    """The most memory that the process has had resident, GB."""
    units = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * units / 1e9


def _show(config: NetworkBench, console: Console, part: Part) -> Part:
    """Print ``part`` beside its targets, and hand it on."""
    targets = TARGETS.get((config.model, config.height, config.width), {})
    title = f"{part.title}, {config.height}x{config.width}, {config.threads} threads"
    table = Table(title=title, title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0))
    for column in ("", "ms (quartiles)", "CPU ms", "target"):
        table.add_column(column, justify="right" if column else "left")
    for timing in part.timings:
        target = targets.get(timing.name)
        verdict = "" if target is None else f"<= {target * 1e3:.0f} {_verdict(timing.wall.median <= target, part)}"
        cpu = "" if timing.name == OPENCL else f"{timing.cpu.median * 1e3:.0f}"
        table.add_row(timing.name, _ms(timing.wall), cpu, verdict)
    memory = targets.get("memory")
    verdict = "" if memory is None else f"<= {memory:g} {_verdict(part.peak_gigabytes <= memory)}"
    table.add_row("peak memory, GB", f"{part.peak_gigabytes:.2f}", "", verdict)
    if not _timing.is_quiet(part.others_cores):
        table.caption = f"other processes kept {part.others_cores:.1f} cores busy meanwhile: measure again"
        table.caption_style, table.caption_justify = "red", "left"
    console.print(table)
    return part


def _ms(spread: Spread) -> str:
    return f"{spread.median * 1e3:.0f} ({spread.low * 1e3:.0f}-{spread.high * 1e3:.0f})"


def _verdict(reached: bool, timed: Part | None = None) -> str:
    """A time that is too long on a machine with other work proves nothing."""
    if reached:
        return "[green]reached[/]"
    disturbed = timed is not None and not _timing.is_quiet(timed.others_cores)
    return "[yellow]can't tell[/]" if disturbed else "[red]missed[/]"

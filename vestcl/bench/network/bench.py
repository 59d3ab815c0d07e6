"""`vestcl bench network`: one forecast stage by stage, one training step, and the memory that they take."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
from rich.console import Console
from torch import nn

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.options import DeviceOptions
from vestcl.bench.common.table import Measurement, Section, busy, show_grid, verdict
from vestcl.bench.common.timing import Spread
from vestcl.clock import Clock
from vestcl.data import Frame, Street, intrinsics
from vestcl.data.street.raycast import STREET_SKY_DEPTH
from vestcl.io.labels import background
from vestcl.models import ModelConfig, configuration
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.stage_times import watching
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

#: Stages of a `Forecaster`, as the table names them where it is not by `stage_times.STAGES`.
_NAMES: Final = {"EMF": "camera motion (EMF)", "OMF": "object motion (OMF)", "splat": "displace and splat"}

#: Of Adam (SPEC section 7).
LEARNING_RATE: Final = 1e-4


@dataclass(frozen=True)
class NetworkBench(DeviceOptions):
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
    device: str | None = field(default=None, kw_only=True)
    """OpenCL device: an index of `vestcl devices` or a part of its name."""


#: Deviation of the last layers' weights of object motion, metres: as it is made it changes nothing, and would not run
#: where it does not learn.
_STIRRED: Final = 1e-5


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
        _results.show_machine(machine, console)
        model = made(model_config, config.seed)
        model.options = dataclasses.replace(model.options, seen=False)  # the frames are the same ones in all runs
        frames, K = street_frames(config.height, config.width, config.seed)
        parts = list(_parts(config, console, model, frames, torch.from_numpy(K)[None].float()))
    if config.json is not None:
        results = {"machine": machine, "config": _results.settings(config), "parts": parts}
        _results.write_json(config.json, _results.plain(results))
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


def made(config: ModelConfig, seed: int) -> Forecaster:
    """A network as at the start of a training, but with object motion that has an effect."""
    torch.manual_seed(seed)
    model = Forecaster(config)
    for block in () if model.object_motion is None else model.object_motion.blocks:
        for parameter in block.get_submodule("out").parameters():
            nn.init.normal_(parameter, std=_STIRRED)
    return model


def prior_of(model: Forecaster, frame: LayerBatch) -> MotionPrior | None:
    """What a model starts from, as if nothing had moved: what it costs does not depend on it."""
    return nothing_moves(frame.image) if model.config.start == "prior" else None


def _parts(
    config: NetworkBench, console: Console, model: Forecaster, frames: Sequence[Frame], K: torch.Tensor
) -> Iterator[dict[str, Any]]:
    """Measure and print part after part. Memory only grows, so the training step comes last."""

    def several(tensor: torch.Tensor) -> torch.Tensor:
        return tensor.repeat(config.batch, *(1,) * (tensor.ndim - 1))

    def forecast(watch: Clock) -> None:
        with watch.time("inpaint"):
            pair = [street_layers(frame) for frame in frames[:2]]
        with torch.no_grad(), watch.time("forward"):
            model(*pair, K, prior=prior_of(model, pair[1]))

    model.eval()
    yield show(config, console, _measure(f"{config.model}, forecast", forecast, "forward", config.runs))
    if config.training:
        pair = [LayerBatch(*map(several, street_layers(frame))) for frame in frames[:2]]
        truth, cameras = several(torch.from_numpy(frames[2].colour)), several(K)
        adam = torch.optim.Adam(model.train().parameters(), LEARNING_RATE)

        def train(watch: Clock) -> None:
            session, busy = opencl.current(), opencl.current().seconds
            with watch.time("training step"):
                adam.zero_grad(set_to_none=True)
                with watch.time("all of forward"):
                    image = model(*pair, cameras, prior=prior_of(model, pair[1])).views[0].image
                    loss = nn.functional.l1_loss(image, truth)
                with watch.time("backward"):
                    loss.backward()
                with watch.time("Adam"):
                    adam.step()
            watch.add(OPENCL, session.seconds - busy, 0.0)

        title = f"{config.model}, training, batch {config.batch}"
        yield show(config, console, _measure(title, train, "training step", config.runs))


def _measure(title: str, task: Callable[[Clock], None], whole: str, runs: int) -> dict[str, Any]:
    """A forecast or a training step, its stages first and the whole last; memory is the most that was taken so far."""
    watches = []
    for _ in range(WARM_UP):
        task(Clock())
    with _timing.watching_others() as others:
        for _ in range(runs):
            with watching() as watch:
                task(watch)
            watches.append(watch)
    wall, cpu = (Spread.of_each([getattr(watch, kind) for watch in watches]) for kind in ("seconds", "cpu_seconds"))
    names = sorted(wall, key=lambda name: name == whole)
    timings = [{"name": _NAMES.get(name, name), "wall": wall[name], "cpu": cpu[name]} for name in names]
    memory = {"peak_gigabytes": _timing.peak_gigabytes(), "others_cores": others.cores}
    return {"title": title, "timings": timings, **memory}


def show(config: NetworkBench, console: Console, part: dict[str, Any]) -> dict[str, Any]:
    """Print what `_measure` found with its targets, and hand it on."""
    targets, cores = TARGETS.get((config.model, config.height, config.width), {}), part["others_cores"]
    rows = list[Measurement]()
    for timing in part["timings"]:
        name, wall = timing["name"], timing["wall"]
        rows.append(Measurement(name, "ms (quartiles)", wall, "s"))
        if name != OPENCL:
            rows.append(Measurement(name, "CPU ms", timing["cpu"], "s", ".0f"))
        if name in targets:
            word = verdict(wall.median <= targets[name], cores)
            rows.append(Measurement(name, "target", f"<= {targets[name] * 1e3:.0f} {word}"))
    memory = part["peak_gigabytes"]
    rows.append(Measurement("peak memory, GB", "ms (quartiles)", f"{memory:.2f}"))
    if "memory" in targets:
        word = verdict(memory <= targets["memory"])
        rows.append(Measurement("peak memory, GB", "target", f"<= {targets['memory']:g} {word}"))
    title = f"{part['title']}, {config.height}x{config.width}, {config.threads} threads"
    show_grid(Section(title, rows, busy(cores)).grid(), console)
    return part

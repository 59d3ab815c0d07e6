"""`vestcl bench operators`: each operator next to its reference in torch and a copy of its bytes, both passes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import torch
from rich.console import Console

from vestcl import opencl, reference
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.options import Options
from vestcl.bench.common.results import X_COPY
from vestcl.bench.common.table import Measurement, Section, busy
from vestcl.bench.common.timing import Spread, Task
from vestcl.bench.splat import roofline
from vestcl.bench.splat.kernels import profile
from vestcl.bench.splat.measure import Record
from vestcl.bench.splat.scenes import AHEAD, CHANNELS, street
from vestcl.data import Street, intrinsics
from vestcl.opencl import trace
from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.splat import splat
from vestcl.ops.unproject import unproject

Tensors = tuple[torch.Tensor, ...]

PASSES: Final = ("forward", "forward + backward")

#: Rotation of the camera from frame to frame, (w, x, y, z): two degrees to the right, as in a bend.
_TURN: Final = (0.99985, 0.0, 0.01745, 0.0)


@dataclass(frozen=True)
class OperatorsBench(Options):
    """Time unproject, rigid_flow, displace and splat in float32 on a street, one point a pixel."""

    height: int = 256
    """Pixels."""
    width: int = 832
    """Pixels."""
    channels: int = CHANNELS
    """Of the features that are splatted."""
    radius: float = 1.0
    """Of the splatted points, pixels."""
    seed: int = 0
    """Of the street, opacities and features."""
    seconds: float = 5.0
    """About how long each operator is measured."""
    roofline: bool = False
    """Also each splat kernel against the roofs of its device: memory bandwidth and arithmetic."""


@dataclass(frozen=True, eq=False)
class Operator:
    """What is timed: an operator with arguments, and its reference implementation."""

    name: str
    ours: Callable[..., Any]
    reference: Callable[..., Any]
    arguments: tuple[Any, ...]
    differentiated: tuple[int, ...]
    """Which of the arguments get gradients."""
    rereads: bool = True
    """Whether the backward needs the forward's inputs."""

    def run(self, function: Callable[..., Any]) -> Tensors:
        """The outputs of a forward without gradients."""
        with torch.no_grad():
            return _tensors(function(*self.arguments))

    def run_both(self, function: Callable[..., Any], grads: Tensors) -> Tensors:
        """Gradients of all `differentiated`, after a forward."""
        recording = list(self.arguments)
        for index in self.differentiated:
            recording[index] = recording[index].detach().requires_grad_()
        outputs = _tensors(function(*recording))
        return torch.autograd.grad(outputs, [recording[index] for index in self.differentiated], grads)


def main(config: OperatorsBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size or time that is not positive.
        DeviceError: no such device.
    """
    _results.check_positive(config, "height", "width", "channels", "radius", "seconds", "threads")
    _results.run("operators", config, partial(_sections, config))


def operators(config: OperatorsBench) -> Iterator[Operator]:
    """All of them on the street seen from a camera further on, each on what the one before it made."""
    town, camera = Street.generate(config.seed), intrinsics(config.height, config.width)
    frame = town.render(np.linalg.inv(town.camera_pose(0.0)), camera, config.height, config.width)
    depth, K = torch.from_numpy(frame.depth), torch.from_numpy(camera)[None].float()
    quaternion, translation = torch.tensor([_TURN]), torch.tensor([[0.0, 0.0, -AHEAD]])
    yield Operator("unproject", unproject, reference.unproject, (depth, K), (0,), rereads=False)
    points_xyz = unproject(depth, K)
    rigid = points_xyz, quaternion, translation
    yield Operator("rigid_flow", rigid_flow, reference.rigid_flow, rigid, (0, 1, 2))
    displacement_xyz = rigid_flow(*rigid)
    moved = points_xyz, displacement_xyz, K
    yield Operator("displace", displace, reference.displace, moved, (0, 1))
    points_uv, z = displace(*moved)
    generator = torch.Generator().manual_seed(config.seed)
    radii, opacities = torch.full_like(z, config.radius), 0.6 + 0.4 * torch.rand(z.shape, generator=generator)
    features = torch.randn((*z.shape, config.channels), generator=generator)
    cloud = points_uv, z, radii, opacities, features, config.height, config.width
    yield Operator("splat", splat, reference.splat, cloud, (0, 2, 3, 4))


def measure(operator: Operator, seconds: float, threads: int) -> list[Record]:
    """Time an operator, its reference and copies in turns, then profile its kernels.

    Args:
        operator: with its arguments.
        seconds: about how long the turns take.
        threads: of the copies.

    Returns:
        One of each of `PASSES`. "moved_bytes" are read and written, every array once; "kernels" are seconds that
        kernels ran, of profiled calls, and "around" those in which none did; "error" is the largest of the results'
        distances to the reference's, relative, in the Euclidean norm.
    """
    outputs = operator.run(operator.ours)
    grads = tuple(torch.randn_like(output) for output in outputs)
    runs = {"vestcl": _passes(operator, operator.ours, grads), "twin": _passes(operator, operator.reference, grads)}
    moved = _moved_bytes(operator, outputs)
    # Ones, not zeros: memory that was never written is one page of zeros, and reading it costs nothing.
    copies = {what: _timing.copies_of_forward(torch.ones(size // 8), threads) for what, size in moved.items()}
    tasks: dict[str, Task] = {f"{what}, {who}": task for who, own in runs.items() for what, task in own.items()}
    tasks |= {f"{what}, {by}": task for what, ways in copies.items() for by, task in ways.items()}
    with _timing.watching_others() as others:
        staged = {name: partial(_staged, f"{operator.name} {name}", task) for name, task in tasks.items()}
        times = _timing.interleave(staged, seconds)
    found = []
    for what in PASSES:
        by = min(copies[what], key=lambda way: float(np.median(times[f"{what}, {way}"])))
        ours, twin, copy = (times[f"{what}, {who}"] for who in ("vestcl", "twin", by))
        inside = profile(runs["vestcl"][what])
        seconds_of = {"time": ours, "x_copy": ours / copy, "twin": twin, "x_twin": twin / ours, "copy": copy}
        seconds_of |= {"kernels": inside.kernels, "around": inside.around}
        about = {"copied_by": by, "moved_bytes": moved[what], "others_cores": others.cores}
        error = max(map(_distance, runs["vestcl"][what](), runs["twin"][what]()))
        spreads = {name: Spread.of(values) for name, values in seconds_of.items()}
        found.append({"operator": operator.name, "what": what, **spreads, **about, "error": error})
    return found


def _passes(operator: Operator, function: Callable[..., Any], grads: Tensors) -> dict[str, Callable[[], Tensors]]:
    both = partial(operator.run_both, function, grads)
    return dict(zip(PASSES, (partial(operator.run, function), both), strict=True))


def _tensors(outputs: Any) -> Tensors:
    return outputs if isinstance(outputs, tuple) else (outputs,)


def _staged(name: str, task: Task) -> object:
    with trace.stage(name):
        return task()


def _moved_bytes(operator: Operator, outputs: Tensors) -> dict[str, int]:
    """By pass: arguments and outputs; then outputs' gradients, arguments again where needed, and their gradients."""
    arguments = [argument for argument in operator.arguments if isinstance(argument, torch.Tensor)]
    read, written = (sum(array.nbytes for array in arrays) for arrays in (arguments, outputs))
    grads = sum(operator.arguments[index].nbytes for index in operator.differentiated)
    return dict(zip(PASSES, (read + written, (1 + operator.rereads) * read + 2 * written + grads), strict=True))


def _distance(got: torch.Tensor, true: torch.Tensor) -> float:
    return float((got - true).norm() / true.norm())


# ---------------------------------------------------------------- one device's results


def _sections(config: OperatorsBench, _: opencl.Session, console: Console) -> Iterator[Section]:
    torch.manual_seed(config.seed)
    timed: list[Record] = []
    for operator in operators(config):
        with console.status(operator.name), trace.stage(operator.name):
            timed += measure(operator, config.seconds, config.threads)
    size = f"{config.height}x{config.width}, C = {config.channels}, radius {config.radius:g} px, float32"
    notes = (
        "x copy: over a copy of the same bytes. kernels, around: of profiled calls.",
        *busy(*(one["others_cores"] for one in timed)),
    )
    rows = [row for one in timed for row in _rows(one)]
    columns = ("ms (quartiles)", "reference ms", "copy ms"), ("kernels ms", "around ms")
    yield Section(f"Operators, {size}", rows, notes, {"operators": timed}, columns)
    if config.roofline:
        scene = street(config.height, config.width, config.channels, config.radius, config.seed)
        yield roofline.section(roofline.roofline(scene))


def _rows(one: Record) -> Iterator[Measurement]:
    name = f"{one['operator']} {one['what']}"
    yield Measurement(name, "ms (quartiles)", one["time"], "s", name=name)
    yield Measurement(name, "runs", str(one["time"].runs))
    yield Measurement(name, "MB", one["moved_bytes"], "B", ".1f")
    yield Measurement(name, "GB/s", f"{one['moved_bytes'] / 1e9 / one['time'].median:.1f}")
    yield Measurement(name, "copy ms", one["copy"], "s", ".2f")
    yield Measurement(name, "x copy", one["x_copy"], digits=".1f", name=name + X_COPY)
    yield Measurement(name, "kernels ms", one["kernels"], "s", ".2f", f"{name}, kernels")
    yield Measurement(name, "around ms", one["around"], "s", ".2f", f"{name}, around kernels")
    yield Measurement(name, "reference ms", one["twin"], "s", ".2f")
    yield Measurement(name, "x reference", one["x_twin"], "1", ".1f", f"{name}, twin / vestcl", "higher")
    yield Measurement(name, "error", one["error"], digits=".0e")

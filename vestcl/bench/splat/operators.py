"""`vestcl bench operators`: each operator next to its reference in torch and a copy of its bytes, both passes."""

from collections.abc import Callable, Iterator, Mapping
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
from vestcl.bench.common.plots import bars
from vestcl.bench.common.results import X_COPY
from vestcl.bench.common.table import Measurement, Section
from vestcl.bench.common.timing import Spread, Task
from vestcl.bench.splat import roofline
from vestcl.bench.splat.kernels import profile
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
    reference: bool = True
    """Also the reference implementation in torch, which is slow, and the error against it."""
    roofline: bool = False
    """Also each splat kernel against the roofs of its device: memory bandwidth and arithmetic."""


#: How many operators there are.
_OPERATORS: Final = 4


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
    _results.run("operators", config, partial(_sections, config), lambda seconds, _: seconds * _OPERATORS)


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


def measure(operator: Operator, seconds: float, threads: int, peer: bool = True) -> list[Measurement]:
    """Time an operator, its reference and copies in turns, then profile its kernels.

    Bytes are read and written, every array once. The error is the largest of the results' distances to the reference's,
    relative, in the Euclidean norm.

    Args:
        operator: with its arguments.
        seconds: about how long the turns take.
        threads: of the copies.
        peer: whether the reference is timed, and the error measured.

    Returns:
        A row for each of `PASSES`.
    """
    outputs = operator.run(operator.ours)
    grads = tuple(torch.randn_like(output) for output in outputs)
    ours, others = (_passes(operator, function, grads) for function in (operator.ours, operator.reference))
    moved = _moved_bytes(operator, outputs)
    # Ones, not zeros: memory that was never written is one page of zeros, and reading it costs nothing.
    copies = {what: _timing.memcpy(threads, torch.ones(size // 8)) for what, size in moved.items()}
    timed: dict[str, Mapping[str, Task]] = {"vestcl": ours, **({"reference": others} if peer else {}), "copy": copies}
    tasks = {f"{what}, {who}": task for who, own in timed.items() for what, task in own.items()}
    staged = {name: partial(_staged, f"{operator.name} {name}", task) for name, task in tasks.items()}
    times = _timing.interleave(staged, seconds)
    rows = list[Measurement]()
    for what in PASSES:
        own, copy = (times[f"{what}, {who}"] for who in ("vestcl", "copy"))
        name, inside, size = f"{operator.name} {what}", profile(ours[what]), moved[what]
        rows += [
            Measurement(name, "ms (quartiles)", Spread.of(own), "s", name=name),
            Measurement(name, "MB", size, "B", ".1f"),
            Measurement(name, "GB/s", size / 1e9 / float(np.median(own)), digits=".1f"),
            Measurement(name, "copy ms", Spread.of(copy), "s", ".2f"),
            Measurement(name, "x copy", Spread.of(own / copy), digits=".1f", name=name + X_COPY),
            Measurement(name, "kernels ms", Spread.of(inside.kernels), "s", ".2f", f"{name}, kernels"),
            Measurement(name, "around ms", Spread.of(inside.around), "s", ".2f", f"{name}, around kernels"),
        ]
        if peer:
            theirs, error = times[f"{what}, reference"], max(map(_distance, ours[what](), others[what]()))
            ratio = Spread.of(theirs / own)
            rows += [
                Measurement(name, "reference ms", Spread.of(theirs), "s", ".2f"),
                Measurement(name, "x reference", ratio, "1", ".1f", f"{name}, twin / vestcl", "higher"),
                Measurement(name, "error", error, digits=".0e"),
            ]
    return rows


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


def _sections(config: OperatorsBench, _: opencl.Session, console: Console) -> Iterator[Section]:
    """Everything on one device."""
    torch.manual_seed(config.seed)
    rows = list[Measurement]()
    for operator in operators(config):
        with console.status(operator.name), trace.stage(operator.name):
            rows += measure(operator, config.seconds, config.threads, config.reference)
    size = f"{config.height}x{config.width}, C = {config.channels}, radius {config.radius:g} px, float32"
    notes = (
        "x copy: over a copy of the same bytes. Of profiled calls, kernels ms: while a kernel runs; around ms: all "
        "the rest, which is Python, autograd, launches, and what the device's driver copies and maps.",
    )
    shown = ("ms (quartiles)", *(["reference ms"] if config.reference else []), "copy ms")
    plots = {
        "operators": partial(bars, columns=shown),
        "operators, kernels": partial(bars, columns=("kernels ms", "around ms")),
    }
    yield Section(f"Operators, {size}", rows, notes, plots)
    if config.roofline:
        scene = street(config.height, config.width, config.channels, config.radius, config.seed)
        yield roofline.roofline(scene)

"""`vestcl bench operators`: each operator beside its torch twin and a copy of the same bytes, forward and backward."""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from rich.console import Console

from vestcl import opencl, reference
from vestcl.bench.common import plots as _plots
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.results import X_COPY, Measure, Results
from vestcl.bench.common.timing import Spread, Task
from vestcl.bench.splat import report as _report
from vestcl.bench.splat.bench import CHANNELS
from vestcl.bench.splat.scenes import AHEAD
from vestcl.data import Street, intrinsics
from vestcl.evaluation.tables import Grid
from vestcl.opencl import trace
from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.splat import splat
from vestcl.ops.unproject import unproject

Tensors = tuple[torch.Tensor, ...]

#: Profiled calls: medians of that many have settled.
CALLS: Final = 15

PASSES: Final = ("forward", "forward + backward")

#: Rotation of the camera from frame to frame, (w, x, y, z): two degrees to the right, as in a bend.
_TURN: Final = (0.99985, 0.0, 0.01745, 0.0)


@dataclass(frozen=True)
class OperatorsBench:
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
    threads: int = 2
    """Of torch, for the copies and the twins."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices`, a part of its name, or "all": every one that works."""
    json: Path | None = None
    """File for the results."""
    markdown: Path | None = None
    """File for the tables."""
    plots: Path | None = None
    """Folder for plots (PNG)."""
    trace: Path | None = None
    """File for a trace of calls and kernels, which ui.perfetto.dev opens; it makes times a bit longer."""


@dataclass(frozen=True, eq=False)
class Operator:
    """What is timed: an operator with arguments, and its twin."""

    name: str
    ours: Callable[..., Any]
    twin: Callable[..., Any]
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


class Timed(NamedTuple):
    """One pass of one operator."""

    operator: str
    what: str
    """Of `PASSES`."""
    time: Spread
    x_copy: Spread
    twin: Spread
    x_twin: Spread
    """The twin's time as a multiple."""
    copy: Spread
    copied_by: str
    kernels: Spread
    """Seconds that kernels ran, of profiled calls."""
    around: Spread
    """Seconds of these calls in which no kernel ran."""
    moved_bytes: int
    """Read and written, every array once."""
    error: float
    """Largest of the results' distances to the twin's, relative, in the Euclidean norm."""
    others_cores: float | None


def main(config: OperatorsBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size or time that is not positive.
        DeviceError: no such device.
    """
    _results.check_positive(config, "height", "width", "channels", "radius", "seconds", "threads")
    console = _results.console()
    with trace.record(config.trace), _timing.torch_threads(config.threads):
        results = _results.measure_each(config.device, partial(_measure_device, config, console), console)
    _results.save(results, config.json, config.markdown)
    _results.tell_written(console, config.json, config.markdown, config.trace, config.plots)


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


def measure(operator: Operator, seconds: float, threads: int) -> list[Timed]:
    """Time an operator, its twin and copies in turns, then profile its kernels.

    Args:
        operator: with its arguments.
        seconds: about how long the turns take.
        threads: of the copies.

    Returns:
        One of each of `PASSES`.
    """
    outputs = operator.run(operator.ours)
    grads = tuple(torch.randn_like(output) for output in outputs)
    runs = {"vestcl": _passes(operator, operator.ours, grads), "twin": _passes(operator, operator.twin, grads)}
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
        spread, x_copy, of_twin, x_twin, of_copy = map(Spread.of, (ours, ours / copy, twin, twin / ours, copy))
        error = _error(runs["vestcl"][what](), runs["twin"][what]())
        inside = *_inside(runs["vestcl"][what]), moved[what], error, others.cores
        found.append(Timed(operator.name, what, spread, x_copy, of_twin, x_twin, of_copy, by, *inside))
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


def _inside(task: Task) -> tuple[Spread, Spread]:
    """Seconds of kernels, and of calls without any kernel running."""
    kernels, around = [], []
    for _ in range(CALLS):
        with opencl.current().profile() as times:
            start = time.perf_counter()
            task()
            wall = time.perf_counter() - start
        kernels.append(sum(kernel.end_ns - kernel.start_ns for kernel in times) / 1e9)
        around.append(wall - kernels[-1])
    return Spread.of(np.array(kernels)), Spread.of(np.array(around))


def _error(got: Tensors, true: Tensors) -> float:
    return max(float((one - other).norm() / other.norm()) for one, other in zip(got, true, strict=True))


# ---------------------------------------------------------------- one device's results


def _measure_device(config: OperatorsBench, console: Console, session: opencl.Session) -> Results:
    machine = _results.describe(session)
    _results.show_machine(machine, console)
    torch.manual_seed(config.seed)
    timed: list[Timed] = []
    for operator in operators(config):
        with console.status(operator.name), trace.stage(operator.name):
            timed += measure(operator, config.seconds, config.threads)
    grid = _grid(config, timed)
    console.print(_report.screen(grid))
    if config.plots is not None:
        _plot(config.plots, session.info, timed)
    details = {"operators": [_results.plain(one._asdict()) for one in timed]}
    measures = [measure for one in timed for measure in _measures(one)]
    return Results("operators", machine, _results.settings(config), measures, [grid], details)


def _measures(one: Timed) -> Iterator[Measure]:
    name = f"{one.operator} {one.what}"
    yield Measure.of(name, "s", one.time)
    yield Measure.of(name + X_COPY, "1", one.x_copy)
    yield Measure.of(f"{name}, kernels", "s", one.kernels)
    yield Measure.of(f"{name}, around kernels", "s", one.around)
    yield Measure.of(f"{name}, twin / vestcl", "1", one.x_twin, "higher")


def _grid(config: OperatorsBench, timed: list[Timed]) -> Grid:
    heading = (
        "",
        "ms (quartiles)",
        "runs",
        "MB",
        "GB/s",
        "x copy",
        "kernels ms",
        "around ms",
        "twin ms",
        "x twin",
        "error",
    )
    rows = []
    for one in timed:
        moved = f"{one.moved_bytes / 1e6:.1f}", f"{one.moved_bytes / 1e9 / one.time.median:.1f}"
        measured = _report.milliseconds(one.time), str(one.time.runs), *moved, f"{one.x_copy.median:.1f}"
        inside = (f"{spread.median * 1e3:.2f}" for spread in (one.kernels, one.around, one.twin))
        rows.append((f"{one.operator} {one.what}", *measured, *inside, f"{one.x_twin.median:.1f}", f"{one.error:.0e}"))
    notes = (
        "x copy: over a copy of the same bytes. kernels, around them: of profiled calls. twin: vestcl.reference.",
        *_report.busy(*(one.others_cores for one in timed)),
    )
    size = f"{config.height}x{config.width}, C = {config.channels}, radius {config.radius:g} px, float32"
    return Grid(f"Operators, {size}", heading, tuple(rows), notes)


def _plot(folder: Path, info: opencl.DeviceInfo, timed: list[Timed]) -> None:
    """Times beside twin and copy, and where the time goes."""

    def group(field: str) -> Mapping[str, Spread]:
        return {f"{one.operator}\n{one.what}": getattr(one, field) for one in timed}

    device = f"{info.platform} / {info.name}"
    beside = {"vestcl": group("time"), "torch twin": group("twin"), "copy of the bytes": group("copy")}
    path = folder / _plots.file_name(f"operators {info.index}")
    _plots.bars(path, f"Operators\n{device}", "ms", beside, 1e3, log=True)
    inside = {"kernels": group("kernels"), "around them": group("around")}
    path = folder / _plots.file_name(f"operators inside {info.index}")
    _plots.bars(path, f"Kernels and the time around them\n{device}", "ms", inside, 1e3, log=True)

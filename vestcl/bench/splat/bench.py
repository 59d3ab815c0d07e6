"""`vestcl bench splat`: splat beside a copy of its bytes, beside torch alone, and kernel by kernel."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import plots as _plots
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.results import Measure, Results
from vestcl.bench.splat import kernels as _kernels
from vestcl.bench.splat import measure as _measure
from vestcl.bench.splat import pytorch3d as _pytorch3d
from vestcl.bench.splat import report as _report
from vestcl.bench.splat import scenes as _scenes
from vestcl.bench.splat import torch_fragments as _fragments
from vestcl.bench.splat import torch_peers as _peers
from vestcl.evaluation.tables import Grid
from vestcl.opencl import trace

__all__ = ["SplatBench", "main"]

#: Channels of the features: what the encoder gives (SPEC section 3).
CHANNELS: Final = 32

#: What ``--channels`` times: colour, colour and coverage, half the features, all, all that a side renders, twice.
CHANNEL_SWEEP: Final = (3, 4, 16, 32, 37, 64)

#: What ``--scaling`` times, each four times the pixels of the one before, up to 8.4 million points.
SIZES: Final = ((64, 208), (128, 416), (256, 832), (512, 1664), (1024, 3328), (2048, 4096))

#: (height, width, radius) -> copies that forward, and forward + backward, may take.
TARGETS: Final = {(256, 832, 1.0): (4.0, 6.0), (256, 832, 2.0): (10.0, 16.0)}


@dataclass(frozen=True)
class SplatBench:
    """Time splat on a street seen from a camera further on, one point a pixel, 32 channels."""

    height: int = 256
    """Pixels."""
    width: int = 832
    """Pixels."""
    radii: tuple[float, ...] = (1.0, 2.0)
    """Pixels; each is a scene of its own."""
    seed: int = 0
    """Of the street, opacities and features."""
    seconds: float = 10.0
    """About how long each of the measurements takes."""
    threads: int = 2
    """Of torch, for the copies and the peers."""
    peers: bool = True
    """Beside the best splatting in torch alone, too."""
    compile: bool = True
    """Let torch.compile speed the peers up; it needs a C++ compiler."""
    scaling: bool = False
    """Also sizes from 64x208 to 1024x3328."""
    channels: bool = False
    """Also 3, 4, 16, 32, 37 and 64 channels."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices`, a part of its name, or "all": every one that works."""
    json: Path | None = None
    """File for the results."""
    markdown: Path | None = None
    """File for the tables."""
    plots: Path | None = None
    """Folder for plots (PNG)."""
    trace: Path | None = None
    """File for a trace of the kernels, which ui.perfetto.dev opens; times are a bit longer while it is recorded."""


class Part(NamedTuple):
    """What one measurement adds to the results."""

    details: dict[str, Any]
    measures: list[Measure]
    grids: list[Grid]


def main(config: SplatBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size, radius or time that is not positive.
        DeviceError: no such device.
    """
    _check(config)
    console = _results.console()
    with trace.record(config.trace), _timing.torch_threads(config.threads):
        results = _results.measure_each(config.device, partial(_measure_device, config, console), console)
    _results.save(results, config.json, config.markdown)
    _results.tell_written(console, config.json, config.markdown, config.trace, config.plots)


def _check(config: SplatBench) -> None:
    _results.check_positive(config, "height", "width", "seconds", "threads")
    if not config.radii or min(config.radii) <= 0:
        raise ValueError(f"`radii` must be one or more positive numbers, got {config.radii}")


def _measure_device(config: SplatBench, console: Console, session: opencl.Session) -> Results:
    """Everything on one device, printed as it comes."""
    machine = _results.describe(session)
    _results.show_machine(machine, console)
    parts = list(_parts(config, console))
    details = {key: value for part in parts for key, value in part.details.items()}
    settings = _results.settings(config) | {"channels_of_scenes": CHANNELS}
    if config.plots is not None:
        _plot(config.plots, session.info, details)
    plain = {key: _results.plain(value) for key, value in details.items()}
    measures = [measure for part in parts for measure in part.measures]
    grids = [grid for part in parts for grid in part.grids]
    return Results("splat", machine, settings, measures, grids, plain)


def _parts(config: SplatBench, console: Console) -> Iterator[Part]:
    """Measure and print part after part."""
    yield _speed(config, console)
    if config.peers:
        yield _peers_part(config, console)
    yield _inside(config, console)
    if config.scaling:
        scenes = [(height, width, CHANNELS, radius) for radius in config.radii for height, width in SIZES]
        yield _series(config, console, "scaling", "Over size", scenes)
    if config.channels:
        scenes = [(config.height, config.width, count, radius) for radius in config.radii for count in CHANNEL_SWEEP]
        yield _series(config, console, "channels", "Over channels", scenes)


def _scene(config: SplatBench, radius: float) -> _scenes.Scene:
    return _scenes.street(config.height, config.width, CHANNELS, radius, config.seed)


def _print(console: Console, grid: Grid) -> Grid:
    console.print(_report.screen(grid))
    return grid


def _speed(config: SplatBench, console: Console) -> Part:
    speeds, grids = [], []
    for radius in config.radii:
        with _stage(console, f"splat beside copies, radius {radius:g}"):
            targets = TARGETS.get((config.height, config.width, radius), (None, None))
            speeds.append(_measure.measure_speed(_scene(config, radius), config.seconds, config.threads, targets))
        grids.append(_print(console, _report.speed_grid(speeds[-1])))
    return Part({"speed": speeds}, [measure for one in speeds for measure in _report.speed_measures(one)], grids)


def _peers_part(config: SplatBench, console: Console) -> Part:
    expanding, compiled = _expanding(config, console)
    torch_peers = {kind: partial(_peers.splat, kind=kind, expanding=expanding) for kind in _peers.KINDS}
    found, grids = [], []
    for radius in config.radii:
        with _stage(console, f"splat beside torch, radius {radius:g}"):
            found.append(_measure.measure_peers(_scene(config, radius), torch_peers, config.seconds))
        grids.append(_print(console, _report.peer_grid(found[-1])))
    if _pytorch3d.is_installed():
        with _stage(console, "splat beside PyTorch3D"):
            scene = _scenes.street(*_pytorch3d.SIZE, CHANNELS, config.radii[0], config.seed)
            pytorch3d = partial(_pytorch3d.splat, layers=_measure.facts_of(scene).most_layers)
            found.append(_measure.measure_peers(scene, {"pytorch3d": pytorch3d}, config.seconds))
        grids.append(_print(console, _report.peer_grid(found[-1])))
    else:
        console.print("PyTorch3D is not installed: skipped")
    measures = [measure for one in found for measure in _report.peer_measures(one)]
    return Part({"peers": found, "peers_compiled": compiled}, measures, grids)


def _expanding(config: SplatBench, console: Console) -> tuple[Callable[..., _fragments.Candidates], bool]:
    """How the peers find their fragments, and whether torch.compile could help."""
    if not config.compile:
        return _fragments.expand, False
    try:
        with console.status("torch.compile for the peers"):
            return _peers.compiled_expand(), True
    except RuntimeError as error:
        console.print(f"peers without torch.compile: {str(error).splitlines()[0]}", markup=False, soft_wrap=True)
        return _fragments.expand, False


def _inside(config: SplatBench, console: Console) -> Part:
    """Kernels and memory."""
    profiles, memories, grids = [], [], []
    for radius in config.radii:
        with _stage(console, f"kernels, radius {radius:g}"):
            scene = _scene(config, radius)
            profiles.append(_kernels.measure_kernels(scene))
            memories.append(_measure.measure_memory(scene))
        grids.append(_print(console, _report.kernel_grid(profiles[-1])))
    grids.append(_print(console, _report.memory_grid(memories)))
    pairs = zip(profiles, memories, strict=True)
    measures = [measure for pair in pairs for measure in _report.inside_measures(*pair)]
    return Part({"kernels": profiles, "memory": memories}, measures, grids)


def _series(
    config: SplatBench, console: Console, name: str, title: str, scenes: Sequence[tuple[int, int, int, float]]
) -> Part:
    """Time (height, width, channels, radius) one by one."""
    speeds = []
    for height, width, channels, radius in scenes:
        with _stage(console, f"{height}x{width}, {channels} channels, radius {radius:g}"):
            scene = _scenes.street(height, width, channels, radius, config.seed)
            speeds.append(_measure.measure_speed(scene, config.seconds, config.threads))
    grid = _print(console, _report.series_grid(title, speeds))
    measures = [
        dataclasses.replace(measure, name=f"{title.lower()}: {measure.name}")
        for one in speeds
        for measure in _report.speed_measures(one)
    ]
    return Part({name: speeds}, measures, [grid])


@contextlib.contextmanager
def _stage(console: Console, name: str) -> Iterator[None]:
    """Tell what is going on, on the screen and in the trace."""
    with console.status(name), trace.stage(name):
        yield


def _plot(folder: Path, info: opencl.DeviceInfo, details: dict[str, Any]) -> None:
    """What was measured on one device."""
    device = f"{info.platform} / {info.name}"
    for name, over in (("scaling", "size"), ("channels", "channels")):
        if name in details:
            path = folder / _plots.file_name(f"splat over {over} {info.index}")
            _report.series_plot(path, f"splat over {over}\n{device}", details[name], over == "size")
    path = folder / _plots.file_name(f"splat kernels {info.index}")
    _report.kernel_plot(path, f"splat's kernels\n{device}", details["kernels"])

"""`vestcl bench splat`: splat in turns with a copy of its bytes and with torch, and kernel by kernel."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import plots as _plots
from vestcl.bench.common import results as _results
from vestcl.bench.common.options import Options
from vestcl.bench.common.table import Section, busy
from vestcl.bench.splat import measure as _measure
from vestcl.bench.splat import pytorch3d as _pytorch3d
from vestcl.bench.splat import torch_peer as _torch_peer
from vestcl.bench.splat.kernels import facts_of
from vestcl.bench.splat.measure import Record
from vestcl.bench.splat.scenes import CHANNELS, Scene, street
from vestcl.opencl import trace

__all__ = ["SplatBench", "main"]

#: What ``--channels`` times: colour, colour and coverage, half the features, all, all that a side renders, twice.
CHANNEL_SWEEP: Final = (3, 4, 16, 32, 37, 64)

#: What ``--scaling`` times, each four times the pixels of the one before, up to 8.4 million points.
SIZES: Final = ((64, 208), (128, 416), (256, 832), (512, 1664), (1024, 3328), (2048, 4096))

#: (height, width, radius) -> copies that forward, and forward + backward, may take.
TARGETS: Final = {(256, 832, 1.0): (4.0, 6.0), (256, 832, 2.0): (10.0, 16.0)}


@dataclass(frozen=True)
class SplatBench(Options):
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
    peers: bool = True
    """Also the fastest splatting in torch, and PyTorch3D where it is installed."""
    compile: bool = True
    """Let torch.compile speed the peer in torch up; it needs a C++ compiler."""
    scaling: bool = False
    """Also sizes from 64x208 to 2048x4096."""
    channels: bool = False
    """Also 3, 4, 16, 32, 37 and 64 channels."""


def main(config: SplatBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size, radius or time that is not positive.
        DeviceError: no such device.
    """
    _results.check_positive(config, "height", "width", "seconds", "threads")
    if not config.radii or min(config.radii) <= 0:
        raise ValueError(f"`radii` must be one or more positive numbers, got {config.radii}")
    _results.run("splat", config, partial(_sections, config))


def _sections(config: SplatBench, session: opencl.Session, console: Console) -> Iterator[Section]:
    """Everything on one device."""
    yield from _speed(config, console)
    if config.peers:
        yield from _peers(config, console)
    inside = list(_inside(config, console))
    yield from inside
    kernels = [one for section in inside for one in section.details.get("kernels", ())]
    if config.plots is not None:
        groups = {f"radius {one['radius']:g} px": {k["name"]: k["time"] for k in one["kernels"]} for one in kernels}
        path, device = config.plots / _plots.file_name(f"splat kernels {session.info.index}"), _device(session)
        _plots.bars(path, f"splat's kernels\n{device}", "ms in one forward + backward", groups)
    sweeps = {
        "scaling": [(height, width, CHANNELS, radius) for radius in config.radii for height, width in SIZES],
        "channels": [
            (config.height, config.width, count, radius) for radius in config.radii for count in CHANNEL_SWEEP
        ],
    }
    for name, over in (("scaling", "size"), ("channels", "channels")):
        if getattr(config, name):
            section = _series(config, console, name, f"Over {over}", sweeps[name])
            yield section
            if config.plots is not None:
                path = config.plots / _plots.file_name(f"splat over {over} {session.info.index}")
                _series_plot(path, f"splat over {over}\n{_device(session)}", section.details[name], over)


def _speed(config: SplatBench, console: Console) -> Iterator[Section]:
    for radius in config.radii:
        with _stage(console, f"splat beside copies, radius {radius:g}"):
            scene = street(config.height, config.width, CHANNELS, radius, config.seed)
            targets = TARGETS.get((config.height, config.width, radius), (None, None))
            found = _measure.measure_speed(scene, config.seconds, config.threads, targets)
        rows, notes = list(_measure.speed_rows(found)), busy(found["others_cores"])
        yield Section(found["facts"].title, rows, notes, {"speed": [found]})


def _peers(config: SplatBench, console: Console) -> Iterator[Section]:
    expanding, compiled = _expanding(config, console)
    torch_peer = {"sparse": partial(_torch_peer.splat, expanding=expanding)}
    for radius in config.radii:
        scene = street(config.height, config.width, CHANNELS, radius, config.seed)
        yield _peer_section(config, console, scene, torch_peer)
    yield Section("", [], details={"peers_compiled": compiled})
    if not _pytorch3d.is_installed():
        console.print("PyTorch3D is not installed: skipped")
        return
    scene = street(*_pytorch3d.SIZE, CHANNELS, config.radii[0], config.seed)
    pytorch3d = partial(_pytorch3d.splat, layers=facts_of(scene).most_layers)
    yield _peer_section(config, console, scene, {"pytorch3d": pytorch3d})


def _peer_section(
    config: SplatBench, console: Console, scene: Scene, peers: Mapping[str, _measure.Splatter]
) -> Section:
    with _stage(console, f"splat beside {', '.join(peers)}"):
        found = _measure.measure_peers(scene, peers, config.seconds)
    title = f"{found['facts'].title}; errors relative to the reference in float64"
    return Section(title, list(_measure.peer_rows(found)), busy(found["others_cores"]), {"peers": [found]})


def _expanding(config: SplatBench, console: Console) -> tuple[_torch_peer.Expand, bool]:
    """How the peer finds its fragments, and whether torch.compile could help."""
    if not config.compile:
        return _torch_peer.expand, False
    try:
        with console.status("torch.compile for the peers"):
            return _torch_peer.compiled_expand(), True
    except RuntimeError as error:
        console.print(f"peers without torch.compile: {str(error).splitlines()[0]}", markup=False, soft_wrap=True)
        return _torch_peer.expand, False


def _inside(config: SplatBench, console: Console) -> Iterator[Section]:
    """Kernels and memory."""
    memories = []
    for radius in config.radii:
        with _stage(console, f"kernels, radius {radius:g}"):
            scene = street(config.height, config.width, CHANNELS, radius, config.seed)
            found = _measure.measure_kernels(scene)
            memories.append(_measure.measure_memory(scene))
        title = f"Kernels of one forward + backward, radius {radius:g} px"
        yield Section(title, list(_measure.kernel_rows(found)), busy(found["others_cores"]), {"kernels": [found]})
    rows = list(_measure.memory_rows(memories))
    yield Section("Scratch memory of forward + backward", rows, details={"memory": memories})


def _series(
    config: SplatBench, console: Console, name: str, title: str, scenes: Sequence[tuple[int, int, int, float]]
) -> Section:
    """Time (height, width, channels, radius) one by one."""
    speeds = []
    for sizes in scenes:
        with _stage(console, f"{title} {sizes}"):
            speeds.append(_measure.measure_speed(street(*sizes, config.seed), config.seconds, config.threads))
    notes = *_measure.growth_notes(speeds), *busy(*(speed["others_cores"] for speed in speeds))
    return Section(title, list(_measure.series_rows(title, speeds)), notes, {name: speeds})


@contextlib.contextmanager
def _stage(console: Console, name: str) -> Iterator[None]:
    """Name what is measured, on the screen and in the trace."""
    with console.status(name), trace.stage(name):
        yield


def _device(session: opencl.Session) -> str:
    return f"{session.info.platform} / {session.info.name}"


def _series_plot(path: Path, title: str, speeds: Sequence[Record], over: str) -> None:
    """Time over points or channels: splat's passes, and the copies of the forward's bytes dashed."""
    lines = []
    for radius in dict.fromkeys(speed["facts"].radius for speed in speeds):
        those = [speed for speed in speeds if speed["facts"].radius == radius]
        x = [one["facts"].points if over == "size" else one["facts"].channels for one in those]
        for key, way in _measure.PASSES.items():
            lines.append(_plots.Curve(f"{way}, radius {radius:g}", x, [one[key]["time"] for one in those], 1e3))
    copy = [one["forward_copy"]["time"] for one in those]
    lines.append(_plots.Curve("copy of the forward's bytes", x, copy, 1e3, dashed=True))
    _plots.curves(path, title, "points (and pixels)" if over == "size" else "channels", "ms", lines)

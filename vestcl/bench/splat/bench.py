"""`vestcl bench splat`: splat in turns with a copy of its bytes and with torch, and kernel by kernel."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results
from vestcl.bench.common.options import Options
from vestcl.bench.common.table import Section, busy
from vestcl.bench.splat import measure, pytorch3d, torch_peer
from vestcl.bench.splat.kernels import facts_of
from vestcl.bench.splat.scenes import CHANNELS, Scene, street
from vestcl.opencl import trace

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
    results.check_positive(config, "height", "width", "seconds", "threads")
    if not config.radii or min(config.radii) <= 0:
        raise ValueError(f"`radii` must be one or more positive numbers, got {config.radii}")
    results.run("splat", config, partial(_sections, config))


def _sections(config: SplatBench, session: opencl.Session, console: Console) -> Iterator[Section]:
    """Everything on one device."""
    size, threads = (config.height, config.width), config.threads
    scenes = [street(*size, CHANNELS, radius, config.seed) for radius in config.radii]
    for scene, radius in zip(scenes, config.radii, strict=True):
        with _stage(console, f"splat next to copies, radius {radius:g}"):
            targets = TARGETS.get((*size, radius), (None, None))
            found = measure.measure_speed(scene, config.seconds, threads, targets)
        yield Section(
            found["facts"].title, [*measure.speed_rows(found)], busy(found["others_cores"]), {"speed": [found]}
        )
    if config.peers:
        yield from _peers(config, console, scenes)
    yield from _inside(console, scenes)
    sizes = [(*size, CHANNELS, radius) for radius in config.radii for size in SIZES] if config.scaling else []
    yield from _series(config, console, "scaling", "Over size", sizes)
    sizes = [(*size, count, radius) for radius in config.radii for count in CHANNEL_SWEEP] if config.channels else []
    yield from _series(config, console, "channels", "Over channels", sizes)


def _peers(config: SplatBench, console: Console, scenes: Sequence[Scene]) -> Iterator[Section]:
    expanding, compiled = _expanding(config, console)
    pairs = [(scene, {"sparse": partial(torch_peer.splat, expanding=expanding)}) for scene in scenes]
    if pytorch3d.is_installed():
        scene = street(*pytorch3d.SIZE, CHANNELS, config.radii[0], config.seed)
        pairs.append((scene, {"pytorch3d": partial(pytorch3d.splat, layers=facts_of(scene).most_layers)}))
    else:
        console.print("PyTorch3D is not installed: skipped")
    for scene, peers in pairs:
        with _stage(console, f"splat next to {', '.join(peers)}"):
            found = measure.measure_peers(scene, peers, config.seconds)
        title = f"{found['facts'].title}; errors relative to the reference in float64"
        yield Section(title, [*measure.peer_rows(found)], busy(found["others_cores"]), {"peers": [found]})
    yield Section("", [], details={"peers_compiled": compiled})


def _expanding(config: SplatBench, console: Console) -> tuple[torch_peer.Expand, bool]:
    """How the peer finds its fragments, and whether torch.compile could help."""
    if not config.compile:
        return torch_peer.expand, False
    try:
        with console.status("torch.compile for the peers"):
            return torch_peer.compiled_expand(), True
    except RuntimeError as error:
        console.print(f"peers without torch.compile: {str(error).splitlines()[0]}", markup=False, soft_wrap=True)
        return torch_peer.expand, False


def _inside(console: Console, scenes: Sequence[Scene]) -> Iterator[Section]:
    """Kernels and memory."""
    for scene in scenes:
        with _stage(console, "kernels"):
            found = measure.measure_kernels(scene)
        title = f"Kernels of one forward + backward, radius {found['radius']:g} px"
        notes = busy(found["others_cores"])
        yield Section(title, [*measure.kernel_rows(found)], notes, {"kernels": [found]}, plots=(("ms",),))
    memories = [measure.measure_memory(scene) for scene in scenes]
    yield Section(
        "Scratch memory of forward + backward", [*measure.memory_rows(memories)], details={"memory": memories}
    )


def _series(
    config: SplatBench, console: Console, name: str, title: str, sizes: Sequence[tuple[int, int, int, float]]
) -> Iterator[Section]:
    """Time scenes by (height, width, channels, radius), one by one; no section without any."""
    speeds = []
    for size in sizes:
        with _stage(console, f"{title} {size}"):
            speeds.append(measure.measure_speed(street(*size, config.seed), config.seconds, config.threads))
    if speeds:
        notes, columns = busy(*(speed["others_cores"] for speed in speeds)), (("forward ms", "both ms", "copy ms"),)
        rows = [*measure.series_rows(title, speeds)]
        yield Section(title, rows, (*measure.growth_notes(speeds), *notes), {name: speeds}, columns)


@contextlib.contextmanager
def _stage(console: Console, name: str) -> Iterator[None]:
    """Name what is measured, on the screen and in the trace."""
    with console.status(name), trace.stage(name):
        yield

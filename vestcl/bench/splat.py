"""`vestcl bench splat`: splat beside a copy of its bytes, beside torch alone, and kernel by kernel."""

import contextlib
import dataclasses
import importlib.metadata
import json
import os
import platform
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from vestcl import __version__, runtime
from vestcl.bench import _fragments, _kernels, _measure, _peers, _pytorch3d, _report, _scenes, _timing

#: Channels of the features: what the encoder gives (SPEC section 3).
CHANNELS: Final = 32

#: What ``--channels`` times: colour, colour and coverage, half the features, all, all that a side renders, twice.
CHANNEL_SWEEP: Final = (3, 4, 16, 32, 37, 64)

#: What ``--scaling`` times, each four times the pixels of the one before.
SIZES: Final = ((64, 208), (128, 416), (256, 832), (512, 1664), (1024, 3328))

#: (height, width, radius) -> copies that forward, and forward + backward, may take.
TARGETS: Final = {(256, 832, 1.0): (6.0, 8.0), (256, 832, 2.0): (10.0, 16.0)}

#: Columns of the tables where they don't go to a terminal, whose own number counts there.
WIDTH: Final = 140

_PACKAGES: Final = ("torch", "numpy", "pyopencl", "pocl-binary-distribution")


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
    """OpenCL device: an index of `vestcl devices` or a part of its name."""
    json: Path | None = None
    """File for the results."""


def main(config: SplatBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size, radius or time that is not positive.
        DeviceError: no such device.
    """
    _check(config)
    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    with runtime.use(config.device) as session, _timing.torch_threads(config.threads):
        machine = describe(session)
        for name, value in machine.items():
            console.print(f"{name}: {value}", soft_wrap=True, highlight=False)
        results = {key: value for part in _parts(config, console) for key, value in part.items()}
    if config.json is not None:
        settings = dataclasses.asdict(config) | {"json": str(config.json), "channels_of_scenes": CHANNELS}
        write_json(config.json, {"machine": machine, "config": settings, **results})
        console.print(f"wrote {config.json}", soft_wrap=True)


def _check(config: SplatBench) -> None:
    for name in ("height", "width", "seconds", "threads"):
        if getattr(config, name) <= 0:
            raise ValueError(f"`{name}` must be positive, got {getattr(config, name)}")
    if not config.radii or min(config.radii) <= 0:
        raise ValueError(f"`radii` must be one or more positive numbers, got {config.radii}")


def _parts(config: SplatBench, console: Console) -> Iterator[dict[str, Any]]:
    """Measure and print part after part."""
    yield {"speed": _speed(config, console)}
    if config.peers:
        yield _peers_part(config, console)
    yield _inside(config, console)
    if config.scaling:
        scenes = [(height, width, CHANNELS, radius) for radius in config.radii for height, width in SIZES]
        yield {"scaling": _series(config, console, "Over size", scenes)}
    if config.channels:
        scenes = [(config.height, config.width, count, radius) for radius in config.radii for count in CHANNEL_SWEEP]
        yield {"channels": _series(config, console, "Over channels", scenes)}


def _scene(config: SplatBench, radius: float) -> _scenes.Scene:
    return _scenes.street(config.height, config.width, CHANNELS, radius, config.seed)


def _speed(config: SplatBench, console: Console) -> list[dict[str, Any]]:
    speeds = []
    for radius in config.radii:
        with console.status(f"splat beside copies, radius {radius:g}"):
            targets = TARGETS.get((config.height, config.width, radius), (None, None))
            speeds.append(_measure.measure_speed(_scene(config, radius), config.seconds, config.threads, targets))
        console.print(_report.speed_table(speeds[-1]))
    return [dataclasses.asdict(speed) for speed in speeds]


def _peers_part(config: SplatBench, console: Console) -> dict[str, Any]:
    expanding, compiled = _expanding(config, console)
    torch_peers = {kind: partial(_peers.splat, kind=kind, expanding=expanding) for kind in _peers.KINDS}
    found = []
    for radius in config.radii:
        with console.status(f"splat beside torch, radius {radius:g}"):
            found.append(_measure.measure_peers(_scene(config, radius), torch_peers, config.seconds))
        console.print(_report.peer_table(found[-1]))
    if _pytorch3d.is_installed():
        with console.status("splat beside PyTorch3D"):
            scene = _scenes.street(*_pytorch3d.SIZE, CHANNELS, config.radii[0], config.seed)
            pytorch3d = partial(_pytorch3d.splat, layers=_measure.facts_of(scene).most_layers)
            found.append(_measure.measure_peers(scene, {"pytorch3d": pytorch3d}, config.seconds))
        console.print(_report.peer_table(found[-1]))
    else:
        console.print("PyTorch3D is not installed: skipped")
    return {"peers": [dataclasses.asdict(result) for result in found], "peers_compiled": compiled}


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


def _inside(config: SplatBench, console: Console) -> dict[str, Any]:
    """Kernels and memory."""
    profiles, memories = [], []
    for radius in config.radii:
        with console.status(f"kernels, radius {radius:g}"):
            scene = _scene(config, radius)
            profiles.append(_kernels.measure_kernels(scene))
            memories.append(_measure.measure_memory(scene))
        console.print(_report.kernel_table(profiles[-1]))
    for memory in memories:
        console.print(_report.memory_line(memory), highlight=False, soft_wrap=True)
    return {
        "kernels": [dataclasses.asdict(profile) for profile in profiles],
        "memory": [dataclasses.asdict(memory) for memory in memories],
    }


def _series(
    config: SplatBench, console: Console, title: str, scenes: list[tuple[int, int, int, float]]
) -> list[dict[str, Any]]:
    """Time (height, width, channels, radius) one by one."""
    speeds = []
    for height, width, channels, radius in scenes:
        with console.status(f"{height}x{width}, {channels} channels, radius {radius:g}"):
            scene = _scenes.street(height, width, channels, radius, config.seed)
            speeds.append(_measure.measure_speed(scene, config.seconds, config.threads))
    console.print(_report.series_table(title, speeds))
    for line in _report.growth_lines(speeds):
        console.print(line, highlight=False, soft_wrap=True)
    return [dataclasses.asdict(speed) for speed in speeds]


# ---------------------------------------------------------------- machine and file


def describe(session: runtime.Session) -> dict[str, str]:
    """What the numbers depend on: versions, device, processor, date."""
    versions = {}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "vestcl": __version__,
        **versions,
        "python": platform.python_version(),
        "system": platform.platform(),
        "device": f"{session.info.index} {session.info.platform} / {session.info.name}",
        "driver": session.info.driver,
        "compute units": str(session.info.compute_units),
        "mapping": session.mapping,
        "processor": _processor(),
        "cores": str(os.cpu_count()),
    }


def _processor() -> str:
    """The CPU's model, as its maker calls it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def write_json(path: Path, results: dict[str, Any]) -> None:
    """Write ``results`` under another name and rename: ``path`` is the old file or the new one, never half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)

"""`vestcl bench splat`: splat in turns with a copy of its bytes and with torch.

All times are seconds; every ratio is of two runs in the same round.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import torch
from rich.console import Console

from vestcl import opencl, reference
from vestcl.bench.common import results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.options import Options
from vestcl.bench.common.plots import bars
from vestcl.bench.common.results import X_COPY
from vestcl.bench.common.table import Measurement, Section, verdict
from vestcl.bench.common.timing import Spread, Task
from vestcl.bench.splat import pytorch3d, torch_peer
from vestcl.bench.splat.kernels import facts_of
from vestcl.bench.splat.scenes import CHANNELS, DIFFERENTIATED, Scene, both_passes, street
from vestcl.opencl import trace

#: What ``--channels`` times: colour, colour and coverage, half the features, all, all that a side renders, twice.
CHANNEL_SWEEP: Final = (3, 4, 16, 32, 37, 64)

#: What ``--scaling`` times, each four times the pixels of the one before, up to 8.4 million points.
SIZES: Final = ((64, 208), (128, 416), (256, 832), (512, 1664), (1024, 3328), (2048, 4096))

#: (height, width, radius) -> copies that forward, and forward + backward, may take.
TARGETS: Final = {(256, 832, 1.0): (4.0, 6.0), (256, 832, 2.0): (10.0, 16.0)}

#: How many times faster than torch, forward + backward; scratch memory of forward + backward, in features.
PEER_TARGET: Final = 10.0
MEMORY_TARGET: Final = 1.5

#: Of tables, and of figures' names.
PASSES: Final = {"forward": "forward", "both": "forward + backward"}

Splatter = Callable[[Scene], torch.Tensor]
"""Makes the image of a scene."""


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
    reference: bool = True
    """Also everything that is slow next to vestcl: the peers, and the reference implementation that errors are
    relative to; --no-reference is --no-peers."""
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
    results.run("splat", config, partial(_sections, config), lambda seconds, _: seconds * _measurements(config))


def _measurements(config: SplatBench) -> int:
    """How many the bench makes, of about equal time."""
    peers = len(config.radii) + pytorch3d.is_installed() if config.peers and config.reference else 0
    sweeps = config.scaling * len(SIZES) + config.channels * len(CHANNEL_SWEEP)
    return len(config.radii) * (1 + sweeps) + peers


def _sections(config: SplatBench, _: opencl.Session, console: Console) -> Iterator[Section]:
    """Everything on one device."""
    size, radii = (config.height, config.width), config.radii
    yield _timed(config, console, "Splat", [(*size, CHANNELS, radius) for radius in radii])
    if config.peers and config.reference:
        yield from _peers(config, console)
    if config.scaling:
        sizes = [(*size, CHANNELS, radius) for radius in radii for size in SIZES]
        yield _timed(config, console, "Over size", sizes, "over size: ")
    if config.channels:
        sizes = [(*size, count, radius) for radius in radii for count in CHANNEL_SWEEP]
        yield _timed(config, console, "Over channels", sizes, "over channels: ")


# ---------------------------------------------------------------- in turns with copies


def _timed(
    config: SplatBench, console: Console, title: str, sizes: Sequence[tuple[int, int, int, float]], prefix: str = ""
) -> Section:
    """Scenes by (height, width, channels, radius), a row each; targets where figures have no ``prefix``."""
    rows = list[Measurement]()
    for height, width, channels, radius in sizes:
        with console.status(f"{title} {height}x{width}"), trace.stage(f"{title}, radius {radius:g}"):
            scene = street(height, width, channels, radius, config.seed)
            targets = (None, None) if prefix else TARGETS.get((height, width, radius), (None, None))
            rows += speed_rows(scene, config.seconds, config.threads, targets, prefix)
            rows += [] if prefix else memory_rows(scene)
    plot = partial(bars, columns=("forward ms", "both ms", "copy ms"))
    return Section(title, rows, (), {f"splat {title}": plot})


def speed_rows(
    scene: Scene, seconds: float, threads: int, targets: tuple[float | None, float | None], prefix: str
) -> list[Measurement]:
    """Time `splat` in turns with copies of its bytes.

    Args:
        scene: what is splatted.
        seconds: about how long to measure.
        threads: of the copies.
        targets: of the ratios to the copies, forward and both.
        prefix: of the figures' names.
    """
    facts = facts_of(scene)
    copies = {"copy": _timing.memcpy(threads, scene.features)}
    copies |= {"add": _timing.memcpy(threads, scene.features, torch.ones_like(scene.features))}
    tasks: dict[str, Task] = {"forward": scene.forward, "both": both_passes(scene), **copies}
    times = _timing.interleave(tasks, seconds)
    copy, back_copy = times["copy"], times["add"]
    rows = [Measurement(facts.size, "fragments", f"{facts.fragments:,}")]
    for key, moved, target in zip(PASSES, (copy, copy + back_copy), targets, strict=True):
        ratio, name = Spread.of(times[key] / moved), f"{prefix}splat {PASSES[key]}, {facts.size}"
        rows += [
            Measurement(facts.size, f"{key} ms", Spread.of(times[key]), "s", name=name),
            Measurement(facts.size, f"{key} x copy", ratio, digits=".1f", name=name + X_COPY),
        ]
        if target is not None:
            word = verdict(ratio.median <= target)
            rows.append(Measurement(facts.size, f"{key} target", f"<= {target:g} {word}"))
        per_pixel = float(np.median(times[key])) * 1e9 / (facts.height * facts.width)
        rows.append(Measurement(facts.size, f"{key} ns/pixel", per_pixel, digits=".1f"))
    return [*rows, Measurement(facts.size, "copy ms", Spread.of(copy), "s", ".2f")]


def memory_rows(scene: Scene) -> list[Measurement]:
    """The pool that one forward + backward leaves behind: it never shrinks by itself, so that is its peak."""
    session, facts = opencl.current(), facts_of(scene)
    session.free_scratch()
    before = session.scratch_bytes
    both_passes(scene)()
    scratch, features = session.scratch_bytes - before, scene.features.nbytes
    word = verdict(scratch <= MEMORY_TARGET * features, timed=False)
    return [
        Measurement(facts.size, "scratch MB", scratch, "B", ".1f", f"scratch memory, radius {facts.radius:g}"),
        Measurement(facts.size, "x features", scratch / features, digits=".2f"),
        Measurement(facts.size, "target", f"<= {MEMORY_TARGET:g} {word}"),
    ]


# ---------------------------------------------------------------- in turns with peers


def _peers(config: SplatBench, console: Console) -> Iterator[Section]:
    expanding, size = _expanding(config, console), (config.height, config.width)
    scenes = [street(*size, CHANNELS, radius, config.seed) for radius in config.radii]
    pairs = [(scene, {"sparse": partial(torch_peer.splat, expanding=expanding)}) for scene in scenes]
    if pytorch3d.is_installed():
        scene = street(*pytorch3d.SIZE, CHANNELS, config.radii[0], config.seed)
        pairs.append((scene, {"pytorch3d": partial(pytorch3d.splat, layers=facts_of(scene).most_layers)}))
    else:
        console.print("PyTorch3D is not installed: skipped")
    for scene, peers in pairs:
        with console.status(f"splat next to {', '.join(peers)}"), trace.stage(f"splat next to {', '.join(peers)}"):
            yield peer_section(scene, peers, config.seconds)


def _expanding(config: SplatBench, console: Console) -> torch_peer.Expand:
    """How the peer finds its fragments: by torch.compile where it can help."""
    if config.compile:
        try:
            with console.status("torch.compile for the peers"):
                return torch_peer.compiled_expand()
        except RuntimeError as error:
            console.print(f"peers without torch.compile: {str(error).splitlines()[0]}", markup=False, soft_wrap=True)
    return torch_peer.expand


def peer_section(scene: Scene, peers: Mapping[str, Splatter], seconds: float) -> Section:
    """vestcl and all ``peers`` in turns, in the same process, with memory recycled for all.

    Errors are relative, in the Euclidean norm, against the reference in float64: of the image and of each gradient.
    """
    images, size = {"vestcl": Scene.forward, **peers}, facts_of(scene).size
    tasks: dict[str, Task] = {}
    for name, image_of in images.items():
        tasks |= {f"{name} forward": partial(image_of, scene), f"{name} both": both_passes(scene, image_of)}
    with _timing.recycling_allocator():
        times = _timing.interleave(tasks, seconds)
    truth, rows = _image_and_grads(scene.double(), _reference), list[Measurement]()
    for name, image_of in images.items():
        for key, way in PASSES.items():
            own, figure = times[f"{name} {key}"], f"{name} / splat {way}, {size}" if name in peers else ""
            ratio = Spread.of(own / times[f"vestcl {key}"])
            rows.append(Measurement(name, f"{key} ms", Spread.of(own), "s", ".1f"))
            rows.append(Measurement(name, f"{key} x vestcl", ratio, "1", ".1f", figure, "higher"))
        if name in peers:
            word = verdict(ratio.median >= PEER_TARGET)
            rows.append(Measurement(name, "target", f">= {PEER_TARGET:g} {word}"))
        got = _image_and_grads(scene, image_of)
        for key, true in truth.items():
            error = float((got[key].double() - true).norm() / true.norm())
            rows.append(Measurement(name, f"error of {key}", error, digits=".0e"))
    return Section(f"{size} px; errors relative to the reference in float64", rows)


def _reference(scene: Scene) -> torch.Tensor:
    arrays = (scene.points_uv, scene.z, scene.radii, scene.opacities, scene.features)
    return reference.splat(*arrays, scene.height, scene.width)[0]


def _image_and_grads(scene: Scene, image_of: Splatter) -> dict[str, torch.Tensor]:
    recording = scene.requiring_grad()
    image = image_of(recording)
    grads = torch.autograd.grad(image, recording.leaves, recording.grad_image)
    return {"image": image.detach(), **dict(zip(DIFFERENTIATED, grads, strict=True))}

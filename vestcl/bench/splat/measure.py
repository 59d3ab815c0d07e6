"""What `vestcl bench splat` measures. All times are seconds; every ratio is of two runs in the same round."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import torch

from vestcl import opencl, reference
from vestcl.bench.common.timing import (
    Others,
    Spread,
    Task,
    copies_of_backward,
    copies_of_forward,
    interleave,
    is_quiet,
    recycling_allocator,
    watching_others,
)
from vestcl.bench.splat.scenes import DIFFERENTIATED, Scene
from vestcl.bench.splat.torch_fragments import list_fragments

Splatter = Callable[[Scene], torch.Tensor]
"""Makes the image of a scene."""

#: How many times faster than torch alone, forward + backward.
PEER_TARGET: Final = 10.0

#: Scratch memory of forward + backward, in features.
MEMORY_TARGET: Final = 1.5


@dataclass(frozen=True)
class Ratio:
    """One time as a multiple of another."""

    spread: Spread
    target: float | None
    reached: bool | None
    """None without a target, and where the machine was too busy to tell."""

    @classmethod
    def at_most(cls, spread: Spread, target: float | None, others: Others) -> "Ratio":
        if target is None or not is_quiet(others.cores):
            return cls(spread, target, None)
        return cls(spread, target, spread.median <= target)

    @classmethod
    def at_least(cls, spread: Spread, target: float | None, others: Others) -> "Ratio":
        if target is None or not is_quiet(others.cores):
            return cls(spread, target, None)
        return cls(spread, target, spread.median >= target)


@dataclass(frozen=True)
class Pass:
    """Forward, or forward + backward."""

    time: Spread
    copies: Ratio
    """To the copy of the bytes that must move."""
    forward_copies: Spread
    """To the copy of the forward's bytes alone."""


@dataclass(frozen=True)
class Facts:
    """What a scene is made of."""

    height: int
    width: int
    channels: int
    radius: float
    points: int
    shown_points: int
    """Whose footprint reaches the image, and that are not in front of the near plane."""
    fragments: int
    most_layers: int
    """On one pixel."""


@dataclass(frozen=True)
class Copy:
    """A yardstick: the fastest of several ways to move the bytes."""

    by: str
    time: Spread
    megabytes: float
    """Read and written."""


@dataclass(frozen=True)
class Speed:
    """One scene against the copies."""

    facts: Facts
    forward: Pass
    both: Pass
    forward_copy: Copy
    backward_copy: Copy
    others_cores: float | None
    """That other processes kept busy meanwhile."""


@dataclass(frozen=True)
class Peer:
    """One way to splat; the ratios are its times over vestcl's, which is a peer itself."""

    name: str
    forward: Spread
    both: Spread
    forward_ratio: Spread
    both_ratio: Ratio
    errors: Mapping[str, float]
    """Relative, in the Euclidean norm, against the twin in float64: of the image and of each gradient."""


@dataclass(frozen=True)
class Peers:
    """One scene splatted by vestcl, the first, and its peers."""

    facts: Facts
    peers: tuple[Peer, ...]
    others_cores: float | None
    """That other processes kept busy meanwhile."""


def facts_of(scene: Scene) -> Facts:
    """Count what there is in ``scene``."""
    arrays = [array[0] for array in (scene.points_uv, scene.z, scene.radii, scene.opacities)]
    fragments = list_fragments((scene.height, scene.width), arrays[0], arrays[1], arrays[2], arrays[3])
    return Facts(
        height=scene.height,
        width=scene.width,
        channels=scene.features.shape[-1],
        radius=float(scene.radii.max()),
        points=scene.z.numel(),
        shown_points=len(fragments.order),
        fragments=len(fragments.points),
        most_layers=int(fragments.starts.diff().max()),
    )


def both_passes(scene: Scene, image_of: Splatter) -> Task:
    """Forward and backward of ``image_of``, with all gradients."""
    recording = scene.requiring_grad()
    return lambda: torch.autograd.grad(image_of(recording), recording.leaves, recording.grad_image)


def measure_speed(
    scene: Scene, seconds: float, threads: int, targets: tuple[float | None, float | None] = (None, None)
) -> Speed:
    """Time `splat` in turns with copies by ``threads`` threads.

    Args:
        scene: what is splatted.
        seconds: about how long to measure.
        threads: of the copies.
        targets: of the ratios to the copies, forward and both.
    """
    into, back = copies_of_forward(scene.features, threads), copies_of_backward(scene.features, threads)
    tasks: dict[str, Task] = {
        **into,
        "forward": scene.forward,
        **back,
        "both": both_passes(scene, Scene.forward),
    }
    with watching_others() as others:
        times = interleave(tasks, seconds)
    by, back_by = (min(ways, key=lambda way: float(np.median(times[way]))) for ways in (into, back))
    yardstick = {"forward": times[by], "both": times[by] + times[back_by]}
    passes = {
        name: Pass(
            Spread.of(times[name]),
            Ratio.at_most(Spread.of(times[name] / yardstick[name]), target, others),
            Spread.of(times[name] / times[by]),
        )
        for name, target in zip(("forward", "both"), targets, strict=True)
    }
    copy = Copy(by, Spread.of(times[by]), 2 * scene.features.nbytes / 1e6)
    back_copy = Copy(back_by, Spread.of(times[back_by]), 3 * scene.features.nbytes / 1e6)
    return Speed(facts_of(scene), passes["forward"], passes["both"], copy, back_copy, others.cores)


def measure_peers(scene: Scene, peers: Mapping[str, Splatter], seconds: float) -> Peers:
    """vestcl and all ``peers`` in turns, in the same process, with memory recycled for all."""
    images = {"vestcl": Scene.forward, **peers}
    tasks: dict[str, Task] = {}
    for name, image_of in images.items():
        tasks[name] = partial(image_of, scene)
        tasks[f"{name} both"] = both_passes(scene, image_of)
    with recycling_allocator(), watching_others() as others:
        times = interleave(tasks, seconds)
    truth = _image_and_grads(scene.double(), _twin)
    results = []
    for name, image_of in images.items():
        forward, both = times[name], times[f"{name} both"]
        ratio = Spread.of(both / times["vestcl both"])
        target = None if name == "vestcl" else PEER_TARGET
        errors = _errors(_image_and_grads(scene, image_of), truth)
        spreads = Spread.of(forward), Spread.of(both), Spread.of(forward / times["vestcl"])
        results.append(Peer(name, *spreads, Ratio.at_least(ratio, target, others), errors))
    return Peers(facts_of(scene), tuple(results), others.cores)


def _twin(scene: Scene) -> torch.Tensor:
    arrays = (scene.points_uv, scene.z, scene.radii, scene.opacities, scene.features)
    return reference.splat(*arrays, scene.height, scene.width)[0]


def _image_and_grads(scene: Scene, image_of: Splatter) -> dict[str, torch.Tensor]:
    recording = scene.requiring_grad()
    image = image_of(recording)
    grads = torch.autograd.grad(image, recording.leaves, recording.grad_image)
    return {"image": image.detach(), **dict(zip(DIFFERENTIATED, grads, strict=True))}


def _errors(got: Mapping[str, torch.Tensor], truth: Mapping[str, torch.Tensor]) -> dict[str, float]:
    return {name: float((got[name].double() - true).norm() / true.norm()) for name, true in truth.items()}


@dataclass(frozen=True)
class Memory:
    """Scratch memory of forward + backward on the device, beyond inputs and outputs."""

    radius: float
    scratch_bytes: int
    features_bytes: int
    ratio: float
    target: float
    reached: bool


def measure_memory(scene: Scene) -> Memory:
    """The pool that one forward + backward leaves behind: it never shrinks by itself, so that is its peak."""
    session = opencl.current()
    session.free_scratch()
    before = session.scratch_bytes
    both_passes(scene, Scene.forward)()
    scratch, features = session.scratch_bytes - before, scene.features.nbytes
    reached = scratch <= MEMORY_TARGET * features
    return Memory(float(scene.radii.max()), scratch, features, scratch / features, MEMORY_TARGET, reached)


def growth(pixels: list[int], times: list[float]) -> float:
    """p of the power law time ~ pixels^p that fits best: 1 is linear."""
    return float(np.polyfit(np.log(pixels), np.log(times), 1)[0])

"""What `vestcl bench splat` measures, as rows of the long table and as records for JSON.

All times are seconds; every ratio is of two runs in the same round.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import torch

from vestcl import opencl, reference
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.results import X_COPY
from vestcl.bench.common.table import Measurement
from vestcl.bench.common.timing import Spread, Task
from vestcl.bench.splat.kernels import Facts, bytes_of, facts_of, profile
from vestcl.bench.splat.scenes import DIFFERENTIATED, Scene

Splatter = Callable[[Scene], torch.Tensor]
"""Makes the image of a scene."""

Record = dict[str, Any]
"""What JSON has of a measurement."""

#: How many times faster than torch, forward + backward.
PEER_TARGET: Final = 10.0

#: Scratch memory of forward + backward, in features.
MEMORY_TARGET: Final = 1.5

#: Of the records, and as tables name them.
PASSES: Final = {"forward": "forward", "both": "forward + backward"}


def both_passes(scene: Scene, image_of: Splatter = Scene.forward) -> Task:
    """Forward and backward of ``image_of``, with all gradients."""
    recording = scene.requiring_grad()
    return lambda: torch.autograd.grad(image_of(recording), recording.leaves, recording.grad_image)


def ratio(spread: Spread, target: float | None, others_cores: float | None, at_most: bool = True) -> Record:
    """A ratio and its target; "reached" is None without a target, and where the machine was too busy to decide."""
    reached = None
    if target is not None and _timing.is_quiet(others_cores):
        reached = spread.median <= target if at_most else spread.median >= target
    return {"spread": spread, "target": target, "reached": reached}


def _verdict(one: Record, sign: str) -> str:
    if one["target"] is None:
        return ""
    return f"{sign} {one['target']:g} " + {True: "reached", False: "missed", None: "can't tell"}[one["reached"]]


# ---------------------------------------------------------------- in turns with copies


def measure_speed(
    scene: Scene, seconds: float, threads: int, targets: tuple[float | None, float | None] = (None, None)
) -> Record:
    """Time `splat` in turns with copies of its bytes by ``threads`` threads.

    Args:
        scene: what is splatted.
        seconds: about how long to measure.
        threads: of the copies.
        targets: of the ratios to the copies, forward and both.
    """
    into = _timing.copies_of_forward(scene.features, threads)
    back = _timing.copies_of_backward(scene.features, threads)
    tasks: dict[str, Task] = {**into, "forward": scene.forward, **back, "both": both_passes(scene)}
    with _timing.watching_others() as others:
        times = _timing.interleave(tasks, seconds)
    by, back_by = (min(ways, key=lambda way: float(np.median(times[way]))) for ways in (into, back))
    copies = {"forward": times[by], "both": times[by] + times[back_by]}
    found: Record = {"facts": facts_of(scene)}
    for name, target in zip(PASSES, targets, strict=True):
        of_copy = ratio(Spread.of(times[name] / copies[name]), target, others.cores)
        of_forward = Spread.of(times[name] / times[by])
        found[name] = {"time": Spread.of(times[name]), "copies": of_copy, "forward_copies": of_forward}
    size = scene.features.nbytes / 1e6
    for name, way, moved in (("forward_copy", by, 2 * size), ("backward_copy", back_by, 3 * size)):
        found[name] = {"by": way, "time": Spread.of(times[way]), "megabytes": moved}
    return found | {"others_cores": others.cores}


def speed_rows(speed: Record) -> Iterator[Measurement]:
    """Times, and as multiples of the copy."""
    for key, row in PASSES.items():
        one, name = speed[key], f"splat {row}, {speed['facts'].size}"
        yield Measurement(row, "ms (quartiles)", one["time"], "s", name=name)
        yield Measurement(row, "runs", str(one["time"].runs))
        yield Measurement(row, "x copy", one["copies"]["spread"], digits=".1f", name=name + X_COPY)
        yield Measurement(row, "target", _verdict(one["copies"], "<="))
        yield Measurement(row, "x forward copy", one["forward_copies"], digits=".1f")
    for key in ("forward", "backward"):
        copy = speed[f"{key}_copy"]
        row = f"{key} copy, {copy['megabytes']:.0f} MB, {copy['by']}"
        yield Measurement(row, "ms (quartiles)", copy["time"], "s")
        yield Measurement(row, "runs", str(copy["time"].runs))


def series_rows(title: str, speeds: Sequence[Record]) -> Iterator[Measurement]:
    """Time per pixel, over sizes or channels."""
    for speed in speeds:
        facts: Facts = speed["facts"]
        for key, way in PASSES.items():
            one, name = speed[key], f"{title.lower()}: splat {way}, {facts.size}"
            yield Measurement(facts.size, f"{key} ms", one["time"], "s", ".2f", name)
            yield Measurement(facts.size, f"{key} ns/pixel", _per_pixel(one["time"], facts))
            yield Measurement(facts.size, f"{key} x copy", one["copies"]["spread"], digits=".1f", name=name + X_COPY)
        yield Measurement(facts.size, "copy ms", speed["forward_copy"]["time"], "s", ".2f")
        yield Measurement(facts.size, "copy ns/pixel", _per_pixel(speed["forward_copy"]["time"], facts))


def _per_pixel(time: Spread, facts: Facts) -> str:
    return f"{time.median * 1e9 / (facts.height * facts.width):.1f}"


def growth(pixels: Sequence[int], times: Sequence[float]) -> float:
    """p of the power law time ~ pixels^p that fits best: 1 is linear."""
    return float(np.polyfit(np.log(pixels), np.log(times), 1)[0])


def growth_notes(speeds: Sequence[Record]) -> Iterator[str]:
    """How time grows with size, a sentence a radius; none where size stays the same."""
    for radius in dict.fromkeys(speed["facts"].radius for speed in speeds):
        those = [speed for speed in speeds if speed["facts"].radius == radius]
        pixels = [speed["facts"].height * speed["facts"].width for speed in those]
        if len(set(pixels)) > 1:
            forward, both = (growth(pixels, [speed[name]["time"].median for speed in those]) for name in PASSES)
            yield f"radius {radius:g}: time ~ pixels^{forward:.2f} forward, pixels^{both:.2f} with backward (1: linear)"


# ---------------------------------------------------------------- in turns with peers


def measure_peers(scene: Scene, peers: Mapping[str, Splatter], seconds: float) -> Record:
    """vestcl and all ``peers`` in turns, in the same process, with memory recycled for all.

    Errors are relative, in the Euclidean norm, against the reference in float64: of the image and of each gradient.
    """
    images = {"vestcl": Scene.forward, **peers}
    tasks: dict[str, Task] = {}
    for name, image_of in images.items():
        tasks |= {name: partial(image_of, scene), f"{name} both": both_passes(scene, image_of)}
    with _timing.recycling_allocator(), _timing.watching_others() as others:
        times = _timing.interleave(tasks, seconds)
    truth = _image_and_grads(scene.double(), _reference)
    found = []
    for name, image_of in images.items():
        forward, both = times[name], times[f"{name} both"]
        target = None if name == "vestcl" else PEER_TARGET
        got = _image_and_grads(scene, image_of)
        found.append({
            "name": name,
            "forward": Spread.of(forward),
            "both": Spread.of(both),
            "forward_ratio": Spread.of(forward / times["vestcl"]),
            "both_ratio": ratio(Spread.of(both / times["vestcl both"]), target, others.cores, at_most=False),
            "errors": {key: float((got[key].double() - true).norm() / true.norm()) for key, true in truth.items()},
        })  # fmt: skip
    return {"facts": facts_of(scene), "peers": found, "others_cores": others.cores}


def _reference(scene: Scene) -> torch.Tensor:
    arrays = (scene.points_uv, scene.z, scene.radii, scene.opacities, scene.features)
    return reference.splat(*arrays, scene.height, scene.width)[0]


def _image_and_grads(scene: Scene, image_of: Splatter) -> dict[str, torch.Tensor]:
    recording = scene.requiring_grad()
    image = image_of(recording)
    grads = torch.autograd.grad(image, recording.leaves, recording.grad_image)
    return {"image": image.detach(), **dict(zip(DIFFERENTIATED, grads, strict=True))}


def peer_rows(result: Record) -> Iterator[Measurement]:
    """Each peer's times, as multiples of vestcl's, and errors."""
    for peer in result["peers"]:
        row, size, both = peer["name"], result["facts"].size, peer["both_ratio"]
        names = [f"{row} / splat {way}, {size}" if peer is not result["peers"][0] else "" for way in PASSES.values()]
        yield Measurement(row, "forward ms", peer["forward"], "s", ".1f")
        yield Measurement(row, "both ms", peer["both"], "s", ".1f")
        yield Measurement(row, "x vestcl", peer["forward_ratio"], digits=".1f", name=names[0], better="higher")
        yield Measurement(row, "both x vestcl", both["spread"], digits=".1f", name=names[1], better="higher")
        yield Measurement(row, "target", _verdict(both, ">="))
        for of, error in peer["errors"].items():
            yield Measurement(row, f"error of {of}", error, digits=".0e")


# ---------------------------------------------------------------- kernels and memory


def measure_kernels(scene: Scene) -> Record:
    """Profile forward + backward, kernel by kernel: time, and the bandwidth it reaches."""
    task, facts = both_passes(scene), facts_of(scene)
    task()
    found, moved, kernels = profile(task), bytes_of(scene, facts), []
    for name, count in found.launches.items():
        spread, size = Spread.of(found.seconds[name]), moved.get(name)
        kernel = {"name": name, "launches": count, "time": spread}
        kernel |= {"megabytes": size and size / 1e6, "gigabytes_per_second": size and size / 1e9 / spread.median}
        kernels.append(kernel)
    about = {"call": Spread.of(found.calls), "between": float(np.median(found.around))}
    return {"radius": facts.radius, "kernels": kernels, **about, "others_cores": found.others_cores}


def kernel_rows(found: Record) -> Iterator[Measurement]:
    """The kernels of one forward + backward."""
    for kernel in found["kernels"]:
        row, name = kernel["name"], f"kernel {kernel['name']}, radius {found['radius']:g}"
        yield Measurement(row, "launches", str(kernel["launches"]))
        yield Measurement(row, "ms", kernel["time"], "s", ".3f", name)
        for key, column in (("megabytes", "MB"), ("gigabytes_per_second", "GB/s")):
            yield Measurement(row, column, "-" if kernel[key] is None else f"{kernel[key]:.1f}")
    yield Measurement("no kernel running", "ms", found["between"], "s", ".3f")
    yield Measurement("the call, profiled", "ms", found["call"], "s", ".3f")


def measure_memory(scene: Scene) -> Record:
    """The pool that one forward + backward leaves behind: it never shrinks by itself, so that is its peak."""
    session = opencl.current()
    session.free_scratch()
    before = session.scratch_bytes
    both_passes(scene)()
    scratch, features = session.scratch_bytes - before, scene.features.nbytes
    sizes = {"scratch_bytes": scratch, "features_bytes": features, "ratio": scratch / features}
    reached = scratch <= MEMORY_TARGET * features
    return {"radius": float(scene.radii.max()), **sizes, "target": MEMORY_TARGET, "reached": reached}


def memory_rows(memories: Sequence[Record]) -> Iterator[Measurement]:
    """Scratch memory of forward + backward on the device, beyond inputs and outputs."""
    for one in memories:
        row, name = f"radius {one['radius']:g} px", f"scratch memory, radius {one['radius']:g}"
        yield Measurement(row, "MB", one["scratch_bytes"], "B", ".1f", name)
        yield Measurement(row, "features MB", one["features_bytes"], "B", ".1f")
        yield Measurement(row, "x features", one["ratio"], digits=".2f")
        yield Measurement(row, "target", _verdict(one, "<="))

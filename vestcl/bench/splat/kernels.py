"""Where the time goes: every kernel of one forward + backward, from OpenCL events, and the bandwidth it reaches."""

import statistics
import time
from collections import Counter
from dataclasses import dataclass
from typing import Final

import numpy as np

from vestcl import opencl
from vestcl.bench.common.timing import Spread, watching_others
from vestcl.bench.splat.measure import Facts, both_passes, facts_of
from vestcl.bench.splat.scenes import Scene
from vestcl.ops.splat import rasterize

#: Profiled calls.
CALLS: Final = 15


@dataclass(frozen=True)
class Kernel:
    """One kernel in one call of forward + backward."""

    name: str
    launches: int
    time: Spread
    """Of all launches of a call together."""
    megabytes: float | None
    """What it must move: every array that it reads or writes, once. None where that is not counted."""
    gigabytes_per_second: float | None


@dataclass(frozen=True)
class Profile:
    """The kernels of a call in the order of their first launch, and the call as a whole."""

    radius: float
    kernels: tuple[Kernel, ...]
    call: Spread
    between: float
    """Median seconds of a call in which no kernel ran: Python, autograd, launches."""
    others_cores: float | None
    """That other processes kept busy meanwhile."""


def measure_kernels(scene: Scene) -> Profile:
    """Profile `CALLS` calls of forward + backward."""
    task, session = both_passes(scene, Scene.forward), opencl.current()
    task()
    walls, calls = [], []
    with watching_others() as others:
        for _ in range(CALLS):
            with session.profile() as times:
                start = time.perf_counter()
                task()
                walls.append(time.perf_counter() - start)
            calls.append(times)
    launches = Counter(kernel.name for kernel in calls[0])
    seconds = {
        name: np.array([sum(k.end_ns - k.start_ns for k in times if k.name == name) / 1e9 for times in calls])
        for name in launches
    }
    moved = bytes_of(scene, facts_of(scene))
    kernels = tuple(_kernel(name, count, seconds[name], moved.get(name)) for name, count in launches.items())
    idle = [wall - sum(k.end_ns - k.start_ns for k in times) / 1e9 for wall, times in zip(walls, calls, strict=True)]
    return Profile(float(scene.radii.max()), kernels, Spread.of(np.array(walls)), statistics.median(idle), others.cores)


def _kernel(name: str, launches: int, seconds: np.ndarray, moved: int | None) -> Kernel:
    spread = Spread.of(seconds)
    if moved is None:
        return Kernel(name, launches, spread, None, None)
    return Kernel(name, launches, spread, moved / 1e6, moved / 1e9 / spread.median)


def bytes_of(scene: Scene, facts: Facts) -> dict[str, int]:
    """What each kernel must move, bytes, by name; not for those that take next to no time."""
    raster = rasterize(scene.points_uv, scene.z, scene.radii, scene.opacities, scene.height, scene.width)
    real, index = scene.z.element_size(), 4
    row, number = real * facts.channels, real + index
    entries = int(raster.lists.tile_starts[-1])
    lists, records = 2 * real * entries, (4 * real + 2 * index) * entries
    pixels, shown = facts.height * facts.width, facts.shown_points
    forward = records + row * shown + (row + real) * pixels
    sort = lists + records + 4 * real * shown
    return {
        "count_tiles": (5 * real + index) * facts.points,
        "fill_tiles": number * facts.points + lists,
        "sort_tiles": sort,
        "sort_tiles_together": sort,
        "composite_tiles": forward,
        "composite_pixels": forward,
        "clear_gradients": index * facts.points + (row + 4 * real) * (facts.points - shown),
        "composite_tiles_backward": records + (2 * row + 4 * real) * shown + row * pixels,
    }


def flops_of(facts: Facts) -> dict[str, int]:
    """Additions and multiplications that the formulas of `splat` ask of each kernel, by name; sorting has none.

    A fragment's alpha takes 7 (two differences, d2, the slope), its weight and what it lets through 3, its features two
    a channel. Backward: alpha and what it lets through 9, the weight 1, two dot products a channel, 18 for the rest.
    """
    pixels, fragments, channels = facts.height * facts.width, facts.fragments, facts.channels
    forward = (10 + 2 * channels) * fragments + (1 + 2 * channels) * pixels
    return {
        "count_tiles": 18 * facts.points,  # the corners of the footprint 8, whether all numbers are finite 10
        "composite_tiles": forward,
        "composite_pixels": forward,
        "composite_tiles_backward": (28 + 4 * channels) * fragments,
    }

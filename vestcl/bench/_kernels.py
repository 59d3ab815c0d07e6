"""Where the time goes: every kernel of one forward + backward, from OpenCL events, and the bandwidth it reaches."""

import statistics
import time
from collections import Counter
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from vestcl import constants, runtime
from vestcl.bench._measure import Facts, both_passes, facts_of
from vestcl.bench._scenes import Scene
from vestcl.bench._timing import Spread, watching_others
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
    task, session = both_passes(scene, Scene.forward), runtime.current()
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
    moved = _bytes(scene, facts_of(scene))
    kernels = tuple(_kernel(name, count, seconds[name], moved.get(name)) for name, count in launches.items())
    idle = [wall - sum(k.end_ns - k.start_ns for k in times) / 1e9 for wall, times in zip(walls, calls, strict=True)]
    return Profile(float(scene.radii.max()), kernels, Spread.of(np.array(walls)), statistics.median(idle), others.cores)


def _kernel(name: str, launches: int, seconds: np.ndarray, moved: int | None) -> Kernel:
    spread = Spread.of(seconds)
    if moved is None:
        return Kernel(name, launches, spread, None, None)
    return Kernel(name, launches, spread, moved / 1e6, moved / 1e9 / spread.median)


def _bytes(scene: Scene, facts: Facts) -> dict[str, int]:
    """What each kernel must move; not for those that take next to no time."""
    raster = rasterize(scene.points_uv, scene.z, scene.radii, scene.opacities, scene.height, scene.width)
    real, index = scene.z.element_size(), 4
    row, number = real * facts.channels, real + index
    entries = int(raster.lists.tile_starts[-1])
    lists, records = 2 * real * entries, (6 * real + 2 * index) * entries
    pixels, shown = facts.height * facts.width, facts.shown_points
    forward = records + row * shown + (row + real) * pixels
    cleared = facts.points - int(_in_one_tile(scene).sum())
    sort = lists + records + 4 * real * shown
    return {
        "count_tiles": (5 * real + index) * facts.points,
        "fill_tiles": number * facts.points + lists,
        "sort_tiles": sort,
        "sort_tiles_together": sort,
        "composite_tiles": forward,
        "composite_pixels": forward,
        "clear_gradients": index * facts.points + (row + 4 * real) * cleared,
        "composite_tiles_backward": records + (2 * row + 4 * real) * shown + row * pixels,
    }


def _in_one_tile(scene: Scene) -> torch.Tensor:
    """[1, N] bool: points whose pixels are there, and are all in one tile."""
    reach = scene.radii[..., None]
    last = torch.tensor([scene.width - 1, scene.height - 1])
    low = (scene.points_uv - reach - 0.5).ceil().clamp(min=0).long()
    high = torch.minimum((scene.points_uv + reach - 0.5).floor().long(), last)
    return ((low <= high) & (low // constants.TILE == high // constants.TILE)).all(-1)

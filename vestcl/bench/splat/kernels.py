"""What a scene is made of, and the kernels of a call with their time, from OpenCL events."""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl import opencl
from vestcl.bench.common.timing import Task, watching_others
from vestcl.bench.splat.scenes import Scene
from vestcl.bench.splat.torch_peer import list_fragments

#: Profiled calls: medians of that many have settled.
CALLS: Final = 15


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

    @property
    def size(self) -> str:
        """ "256x832, C = 32, radius 1"."""
        return f"{self.height}x{self.width}, C = {self.channels}, radius {self.radius:g}"


def facts_of(scene: Scene) -> Facts:
    """Count what there is in ``scene``."""
    cloud = (scene.points_uv[0], scene.z[0], scene.radii[0], scene.opacities[0])
    fragments = list_fragments((scene.height, scene.width), *cloud)
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


@dataclass(frozen=True)
class Profile:
    """Some calls; all arrays have an element per call, in seconds."""

    launches: Counter[str]
    """Of one call, by kernel, in the order of their first launch."""
    seconds: dict[str, NDArray[np.float64]]
    """By kernel, all launches of a call together."""
    calls: NDArray[np.float64]
    """From begin to end."""

    @property
    def kernels(self) -> NDArray[np.float64]:
        """While a kernel ran."""
        return np.sum(list(self.seconds.values()), axis=0)

    @property
    def around(self) -> NDArray[np.float64]:
        """While no kernel ran: Python, autograd, launches."""
        return self.calls - self.kernels


def profile(task: Task, calls: int = CALLS, before: Callable[[], object] = lambda: None) -> Profile:
    """Call ``task`` on the current device with profiling; kernels of what runs ``before`` each call are listed, too."""
    session, runs, walls = opencl.current(), [], []
    with watching_others():
        for _ in range(calls):
            with session.profile() as times:
                before()
                start = time.perf_counter()
                task()
                walls.append(time.perf_counter() - start)
            runs.append(times)
    launches = Counter(kernel.name for kernel in runs[0])
    seconds = {
        name: np.array([sum(one.end_ns - one.start_ns for one in times if one.name == name) / 1e9 for times in runs])
        for name in launches
    }
    return Profile(launches, seconds, np.array(walls))

"""Each splat kernel beside the roofs of its device.

A kernel that moves b bytes and computes f flops takes at least max(b / bandwidth, f / peak). Both roofs are measured in
turns with the kernels: a copy past the cache, and chains of multiply-adds, both in OpenCL
(kernels/splat/splat_roofline.cl).
"""

import statistics
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl import opencl
from vestcl.bench.common.timing import Spread, watching_others
from vestcl.bench.splat.kernels import bytes_of, flops_of
from vestcl.bench.splat.measure import Facts, both_passes, facts_of
from vestcl.bench.splat.scenes import Scene

Floats = NDArray[np.float64]

_FILE: Final = "splat/splat_roofline.cl"

#: Of kernels/splat/splat_roofline.cl: bytes that a work-group copies, and flops of a work-item's round.
_BLOCK_BYTES: Final = 1024 * 16 * 4
_ROUND_FLOPS: Final = 10 * 16 * 2

#: Bytes that the copy reads, and as many that it writes: beyond the caches of most processors.
COPY_BYTES: Final = 1 << 26

#: Rounds of multiply-adds: a millisecond or so. A GPU has thousands of work-items that share them.
ROUNDS: Final = {"tile": 1 << 16, "pixel": 1 << 11}

#: Work-items of a group, and groups for each compute unit: a CPU's kernels run one a group.
_LOCAL: Final = {"tile": 1, "pixel": 256}
_GROUPS: Final = {"tile": 4, "pixel": 8}


@dataclass(frozen=True)
class Point:
    """One kernel of forward + backward; all its launches of a call together."""

    name: str
    launches: int
    time: Spread
    moved_bytes: int
    flops: int
    share: Spread
    """The least time that the roofs allow over the time it took."""
    bound: str
    """ "memory" or "compute": the roof that is lower here."""


@dataclass(frozen=True)
class Roofline:
    """The kernels whose work is counted, the roofs, and what else the call took."""

    facts: Facts
    bandwidth: Spread
    """Bytes a second, read and written."""
    peak: Spread
    """Flops a second, float32."""
    points: tuple[Point, ...]
    call: Spread
    kernels: float
    """Median seconds of all kernels of a call."""
    between: float
    """Median seconds of a call in which no kernel ran."""
    others_cores: float | None
    """That other processes kept busy meanwhile."""


def roofline(scene: Scene, calls: int = 30, copy_bytes: int = COPY_BYTES) -> Roofline:
    """Profile forward + backward in turns with the roofs, on the current device.

        share = max(bytes / bandwidth, flops / peak) / time

    Args:
        scene: what is splatted, float32.
        calls: rounds of copy, multiply-adds and forward + backward.
        copy_bytes: that the copy reads, and as many that it writes.

    Returns:
        A `Roofline`; shares are of the medians of the roofs, in each round.

    Raises:
        ValueError: ``calls`` or ``copy_bytes`` not positive.

    Source: Williams, Waterman, Patterson: Roofline (2009).
    """
    if calls < 1 or copy_bytes < 1:
        raise ValueError(f"`calls` and `copy_bytes` must be positive, got {calls} and {copy_bytes}")
    task, session, roofs = both_passes(scene, Scene.forward), opencl.current(), _Roofs(copy_bytes)
    task()
    rounds, walls = [], []
    with watching_others() as others:
        for _ in range(calls):
            with session.profile() as times:
                roofs.run()
                start = time.perf_counter()
                task()
                walls.append(time.perf_counter() - start)
            rounds.append(times)
    launches = Counter(kernel.name for kernel in rounds[0])
    seconds = {name: np.array([_seconds(times, name) for times in rounds]) for name in launches}
    bandwidth = Spread.of(roofs.moved_bytes / seconds.pop("copy_numbers"))
    peak = Spread.of(roofs.flops / seconds.pop("multiply_add"))
    facts = facts_of(scene)
    moved, flops = bytes_of(scene, facts), flops_of(facts)
    points = tuple(
        _point(name, launches[name], taken, moved[name], flops.get(name, 0), bandwidth.median, peak.median)
        for name, taken in seconds.items()
        if name in moved
    )
    busy = sum(seconds.values())
    between = statistics.median(np.array(walls) - busy)
    kernels = float(np.median(busy))
    return Roofline(facts, bandwidth, peak, points, Spread.of(np.array(walls)), kernels, between, others.cores)


def _seconds(times: Sequence[opencl.KernelTime], name: str) -> float:
    return sum(kernel.end_ns - kernel.start_ns for kernel in times if kernel.name == name) / 1e9


def _point(name: str, launches: int, seconds: Floats, moved: int, flops: int, bandwidth: float, peak: float) -> Point:
    by_memory, by_compute = moved / bandwidth, flops / peak
    share = Spread.of(max(by_memory, by_compute) / seconds)
    bound = "memory" if by_memory >= by_compute else "compute"
    return Point(name, launches, Spread.of(seconds), moved, flops, share, bound)


class _Roofs:
    """What measures the roofs: launches of kernels/splat/splat_roofline.cl on memory that has been written before."""

    def __init__(self, copy_bytes: int) -> None:
        self._session = opencl.current()
        mapping = self._session.mapping
        self._local, self._rounds = _LOCAL[mapping], ROUNDS[mapping]
        self._blocks = -(-copy_bytes // _BLOCK_BYTES)
        self._items = _GROUPS[mapping] * self._local * self._session.info.compute_units
        self.moved_bytes = 2 * self._blocks * _BLOCK_BYTES
        self.flops = self._items * self._rounds * _ROUND_FLOPS
        with self._session.job() as job:
            self._from, self._to = (job.scratch(self._blocks * _BLOCK_BYTES, np.uint8) for _ in range(2))
            self._sums = job.scratch(self._items, np.float32)
        self.run()
        self._from, self._to = self._to, self._from  # memory never written would be one page of zeros, in the cache
        self.run()

    def run(self) -> None:
        """Copy, and multiply and add."""
        defines = {"BUILTINS": int(self._session.compiles_builtins)}
        numbers = [np.int32(self._rounds), np.float32(0.5), np.float32(1)]
        with self._session.job() as job:
            size = (self._blocks * self._local,)
            job.launch(_FILE, "copy_numbers", defines, size, [self._from, self._to], (self._local,))
            job.launch(_FILE, "multiply_add", defines, (self._items,), [*numbers, self._sums], (self._local,))

"""Each splat kernel against the roofs of its device: `vestcl bench operators --roofline`.

A kernel that moves b bytes and computes f flops takes at least max(b / bandwidth, f / peak). Both roofs are measured in
turns with the kernels: a copy past the cache, and chains of multiply-adds, both in OpenCL
(kernels/splat/splat_roofline.cl). `python -m vestcl.bench.splat.roofline` is the same command.
"""

import sys
from functools import partial
from typing import Final

import numpy as np

from vestcl import opencl
from vestcl.bench.common.plots import bars
from vestcl.bench.common.table import Measurement, Section
from vestcl.bench.common.timing import Spread
from vestcl.bench.splat.kernels import Facts, facts_of, profile
from vestcl.bench.splat.scenes import Scene, both_passes
from vestcl.cli.main import main
from vestcl.ops.splat import rasterize

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

#: Profiled calls of forward + backward.
CALLS: Final = 30


def roofline(scene: Scene, calls: int = CALLS, copy_bytes: int = COPY_BYTES) -> Section:
    """Profile forward + backward in turns with the roofs, on the current device; a row a kernel.

        share = max(bytes / bandwidth, flops / peak) / time

    Args:
        scene: what is splatted, float32.
        calls: rounds of copy, multiply-adds and forward + backward.
        copy_bytes: that the copy reads, and as many that it writes.

    Raises:
        ValueError: ``calls`` or ``copy_bytes`` not positive.

    Source: Williams, Waterman, Patterson: Roofline (2009).
    """
    if calls < 1 or copy_bytes < 1:
        raise ValueError(f"`calls` and `copy_bytes` must be positive, got {calls} and {copy_bytes}")
    task, roofs, facts = both_passes(scene), _Roofs(copy_bytes), facts_of(scene)
    task()
    found = profile(task, calls, roofs.run)
    bandwidth = Spread.of(roofs.moved_bytes / found.seconds.pop("copy_numbers"))
    peak = Spread.of(roofs.flops / found.seconds.pop("multiply_add"))
    moved, flops, all_least = bytes_of(scene, facts), flops_of(facts), 0.0
    radius, rows = f", radius {facts.radius:g}", list[Measurement]()
    for name, unit, roof in (("bandwidth", "B/s", bandwidth), ("peak", "flop/s", peak)):
        rows.append(Measurement(name, "", roof, unit, name=f"roofline {name}{radius}", better="higher"))
    for name in (name for name in found.seconds if name in moved):
        by_memory, by_compute = moved[name] / bandwidth.median, flops.get(name, 0) / peak.median
        least, share = max(by_memory, by_compute), Spread.of(max(by_memory, by_compute) / found.seconds[name])
        rows += [
            Measurement(name, "launches", str(found.launches[name])),
            Measurement(name, "ms", Spread.of(found.seconds[name]), "s", ".3f"),
            Measurement(name, "least ms", least, "s", ".3f"),
            Measurement(name, "bound by", "memory" if by_memory >= by_compute else "compute"),
            Measurement(name, "of the roof", share, "1", ".0%", f"roofline {name}{radius}", "higher"),
        ]
        all_least += least
    kernels = float(np.median(found.kernels))
    rows.append(Measurement("all kernels", "ms", kernels, "s", ".3f"))
    rows.append(Measurement("all kernels", "of the roof", all_least / kernels, digits=".0%"))
    rows.append(Measurement("no kernel running", "ms", float(np.median(found.around)), "s", ".3f"))
    roofs_note = f"roofs: {bandwidth.median / 1e9:.1f} GB/s copied, {peak.median / 1e9:.0f} Gflop/s"
    title, plot = f"Roofline, {facts.size} px", partial(bars, columns=("ms", "least ms"))
    return Section(title, rows, (roofs_note,), {title: plot})


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
        numbers = {"rounds": np.int32(self._rounds), "m": np.float32(0.5), "c": np.float32(1)}
        with self._session.job() as job:
            size, copied = (self._blocks * self._local,), {"from": self._from, "to": self._to}
            job.launch(_FILE, "copy_numbers", defines, size, copied, (self._local,))
            sums = numbers | {"sums": self._sums}
            job.launch(_FILE, "multiply_add", defines, (self._items,), sums, (self._local,))


if __name__ == "__main__":
    sys.exit(main(["bench", "operators", "--roofline", *sys.argv[1:]]))

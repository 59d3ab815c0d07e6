"""Each splat kernel against the roofs of its device: `vestcl bench operators --roofline`.

A kernel that moves b bytes and computes f flops takes at least max(b / bandwidth, f / peak). Both roofs are measured in
turns with the kernels: a copy past the cache, and chains of multiply-adds, both in OpenCL
(kernels/splat/splat_roofline.cl). `python -m vestcl.bench.splat.roofline` measures several radii.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import tyro
from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common.options import Options
from vestcl.bench.common.table import Measurement, Section, busy
from vestcl.bench.common.timing import Spread
from vestcl.bench.splat.kernels import bytes_of, facts_of, flops_of, profile
from vestcl.bench.splat.measure import Record, both_passes
from vestcl.bench.splat.scenes import CHANNELS, Scene, street

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


@dataclass(frozen=True)
class RooflineBench(Options):
    """How near each splat kernel comes to what its device can do."""

    height: int = 256
    """Pixels."""
    width: int = 832
    """Pixels."""
    channels: int = CHANNELS
    """Of the features."""
    radii: tuple[float, ...] = (1.0, 2.0)
    """Pixels; each is a scene of its own."""
    calls: int = CALLS
    """Profiled calls of forward + backward."""
    seed: int = 0
    """Of the street, opacities and features."""


def main(config: RooflineBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size, radius or number of calls that is not positive.
        DeviceError: no such device.
    """
    _results.check_positive(config, "height", "width", "channels", "calls")
    if not config.radii or min(config.radii) <= 0:
        raise ValueError(f"`radii` must be one or more positive numbers, got {config.radii}")
    _results.run("roofline", config, partial(_sections, config))


def _sections(config: RooflineBench, session: opencl.Session, _: Console) -> Iterator[Section]:
    for radius in config.radii:
        scene = street(config.height, config.width, config.channels, radius, config.seed)
        yield section(roofline(scene, config.calls))


def roofline(scene: Scene, calls: int = CALLS, copy_bytes: int = COPY_BYTES) -> Record:
    """Profile forward + backward in turns with the roofs, on the current device.

        share = max(bytes / bandwidth, flops / peak) / time

    Args:
        scene: what is splatted, float32.
        calls: rounds of copy, multiply-adds and forward + backward.
        copy_bytes: that the copy reads, and as many that it writes.

    Returns:
        "facts"; the roofs "bandwidth" (bytes a second, read and written) and "peak" (flops a second); "points", those
        kernels whose work is counted, with their share of the lower roof's median; seconds of a call ("call"), and
        their medians while kernels ran ("kernels") and none did ("between").

    Raises:
        ValueError: ``calls`` or ``copy_bytes`` not positive.

    Source: Williams, Waterman, Patterson: Roofline (2009).
    """
    if calls < 1 or copy_bytes < 1:
        raise ValueError(f"`calls` and `copy_bytes` must be positive, got {calls} and {copy_bytes}")
    task, roofs = both_passes(scene), _Roofs(copy_bytes)
    task()
    found = profile(task, calls, roofs.run)
    bandwidth = Spread.of(roofs.moved_bytes / found.seconds.pop("copy_numbers"))
    peak = Spread.of(roofs.flops / found.seconds.pop("multiply_add"))
    facts = facts_of(scene)
    moved, flops, points = bytes_of(scene, facts), flops_of(facts), list[Record]()
    for name in (name for name in found.seconds if name in moved):
        by_memory, by_compute = moved[name] / bandwidth.median, flops.get(name, 0) / peak.median
        points.append({
            "name": name,
            "launches": found.launches[name],
            "time": Spread.of(found.seconds[name]),
            "moved_bytes": moved[name],
            "flops": flops.get(name, 0),
            "share": Spread.of(max(by_memory, by_compute) / found.seconds[name]),
            "bound": "memory" if by_memory >= by_compute else "compute",
        })  # fmt: skip
    seconds = {"kernels": float(np.median(found.kernels)), "between": float(np.median(found.around))}
    result = {"facts": facts, "bandwidth": bandwidth, "peak": peak, "points": points, "call": Spread.of(found.calls)}
    return result | seconds | {"others_cores": found.others_cores}


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


def section(result: Record) -> Section:
    """A row a kernel, the roofs below."""
    roofs = f"roofs: {result['bandwidth'].median / 1e9:.1f} GB/s copied, {result['peak'].median / 1e9:.0f} Gflop/s"
    notes = roofs, *busy(result["others_cores"])
    title, columns = f"Roofline, {result['facts'].size} px", (("ms", "least ms"),)
    return Section(title, [*_rows(result)], notes, {"rooflines": [result]}, columns)


def _rows(result: Record) -> Iterator[Measurement]:
    radius = f", radius {result['facts'].radius:g}"
    for name, unit in (("bandwidth", "B/s"), ("peak", "flop/s")):
        yield Measurement(name, "", result[name], unit, name=f"roofline {name}{radius}", better="higher")
    least = 0.0
    for point in result["points"]:
        row, share, seconds = point["name"], point["share"], point["time"].median
        moved, flops = point["moved_bytes"], point["flops"]
        least += share.median * seconds
        yield Measurement(row, "launches", str(point["launches"]))
        yield Measurement(row, "ms", point["time"], "s", ".3f")
        yield Measurement(row, "least ms", share.median * seconds, "s", ".3f")
        yield Measurement(row, "bound by", point["bound"])
        yield Measurement(row, "of the roof", f"{share.median:.0%} ({share.low:.0%}-{share.high:.0%})")
        yield Measurement(row, "", share, name=f"roofline {row}{radius}", better="higher")
        work = {"MB": moved / 1e6, "Mflop": flops / 1e6, "flop/byte": flops / moved}
        for column, value in (work | {"GB/s": moved / seconds / 1e9, "Gflop/s": flops / seconds / 1e9}).items():
            yield Measurement(row, column, value, digits=".1f")
    yield Measurement("all kernels", "ms", result["kernels"], "s", ".3f")
    yield Measurement("all kernels", "of the roof", least / result["kernels"], digits=".0%")
    yield Measurement("no kernel running", "ms", result["between"], "s", ".3f")


if __name__ == "__main__":
    main(tyro.cli(RooflineBench))

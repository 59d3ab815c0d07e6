"""Rasterisation: points sorted into depth-ordered tile lists on the device (kernels/splat/splat_bin.cl)."""

import functools
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from vestcl import constants, opencl

Array = np.ndarray[Any, Any]

#: Points that one GPU thread counts and lists: few, for a GPU needs many threads.
GPU_CHUNK: Final = 256
#: At most this many counters (chunks x tiles) are kept: 64 MiB.
MAX_COUNTERS: Final = 1 << 24
#: A CPU lists at most this many points, with at most this many pairs of a point and a tile, in one launch without a
#: wait.
FEW_POINTS: Final = 1024
FEW_PAIRS: Final = 1 << 14
#: Chunks for each compute unit of a CPU, so that an uneven one does not hold up the others.
CHUNKS_PER_UNIT: Final = 4


@dataclass(frozen=True)
class Geometry:
    """The points of all clouds, contiguous and of one dtype: points_uv [P, 2], z, radii, opacities [P]."""

    points_uv: Array
    z: Array
    radii: Array
    opacities: Array
    cloud_starts: Array
    """[B + 1] int32: cloud b owns points cloud_starts[b] up to cloud_starts[b + 1]."""
    height: int
    width: int
    list_transparent: bool
    """Whether points of opacity 0 are listed: they show nothing, but the gradient of their opacity is not 0."""

    @property
    def points(self) -> int:
        return len(self.z)

    @property
    def batch(self) -> int:
        return len(self.cloud_starts) - 1

    @functools.cached_property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return -(-self.height // constants.TILE), -(-self.width // constants.TILE)

    @functools.cached_property
    def tiles(self) -> int:
        """Tiles of one image."""
        rows, columns = self.grid
        return rows * columns

    @functools.cached_property
    def sizes(self) -> list[np.int32]:
        """The first arguments of every kernel."""
        return [np.int32(n) for n in (self.height, self.width, *self.grid)]


@dataclass(frozen=True)
class TileLists:
    """Depth-sorted lists of every tile, on the device. E entries, one for each (point, tile) with a fragment."""

    session: opencl.Session
    tile_starts: Array
    """[B * tiles + 1] int32."""
    tile_scratch: Array
    """[B * tiles] int64: scratch memory of the backward, in pixels of all footprints inside the tile."""
    extent: Array
    """[] int32: most tiles that a footprint covers along an axis. Like the arrays above, known when the job is done."""
    grid: tuple[int, int]
    """Rows and columns of tiles."""
    records: opencl.Buffer
    """[E] record_t of kernels/splat/splat.h."""
    intersections: opencl.Buffer
    """[P] int32: the tile intersections of each point, see pack_intersections in kernels/splat/splat.h."""
    entry_offsets: opencl.Buffer
    """[E] int64: offset of an entry's first pixel in its tile's scratch; empty for the mapping "tile"."""

    @property
    def steps(self) -> tuple[int, int]:
        """Rows and columns of tiles from one tile to the next that certainly share no point."""
        return _steps(self.extent, self.grid)


def chunks_of(session: opencl.Session, points: int, counters: int) -> tuple[int, int]:
    """Work-items that share ``points``, with ``counters`` numbers each, and how many of them are a work-group.

    No result depends on it.
    """
    most = max(1, MAX_COUNTERS // counters)
    if session.mapping == "tile":
        return min(CHUNKS_PER_UNIT * session.info.compute_units, most), 1
    group = min(opencl.GPU_GROUP, most)
    return min(-(-points // (GPU_CHUNK * group)), most // group) * group, group


def list_tiles(session: opencl.Session, geometry: Geometry) -> TileLists:
    """Count each chunk's points per tile, list them by tile in order of their index, sort each list by depth."""
    defines = _defines(session, geometry)
    tile_counts = np.zeros(geometry.batch * geometry.tiles, np.int32)
    if are_few(session, geometry):
        return _list_few(session, geometry, defines)
    with session.job() as job:
        intersections = job.scratch(geometry.points, np.int32)
        if geometry.points == 0:
            return _sort(job, geometry, _starts(tile_counts), np.ones((), np.int32), intersections, None)
        mean_points = -(-geometry.points // geometry.batch)
        chunks, group = chunks_of(session, mean_points, geometry.tiles * geometry.batch)
        extents = np.ones((geometry.batch, chunks), np.int32)
        starts, points_uv, z, radii, opacities = (
            job.read(array)
            for array in (geometry.cloud_starts, geometry.points_uv, geometry.z, geometry.radii, geometry.opacities)
        )
        transparent = np.int32(geometry.list_transparent)
        counts = job.scratch(geometry.batch * chunks * geometry.tiles, np.int32)
        job.launch(
            "splat/splat_bin.cl", "count_tiles", defines, (chunks, geometry.batch),
            [*geometry.sizes, starts, points_uv, z, radii, opacities, transparent, intersections, counts,
             job.write(extents)],
            (group, 1),
        )  # fmt: skip
        items, together = opencl.grouped(session, geometry.tiles)
        job.launch(
            "splat/splat_bin.cl", "scan_chunks", defines, (items, geometry.batch),
            [np.int32(chunks), np.int32(geometry.tiles), counts, job.write(tile_counts)],
            (together, 1),
        )  # fmt: skip
        job.sync()
        tile_starts = _starts(tile_counts)
        entries = job.scratch(int(tile_starts[-1]), _entry_type(geometry))
        job.launch(
            "splat/splat_bin.cl", "fill_tiles", defines, (chunks, geometry.batch),
            [*geometry.sizes, starts, points_uv, z, radii, intersections, job.read(tile_starts), counts, entries],
            (group, 1),
        )  # fmt: skip
        return _sort(job, geometry, tile_starts, extents.max(), intersections, entries)


def are_few(session: opencl.Session, geometry: Geometry) -> bool:
    pairs = geometry.points * geometry.tiles
    few = 0 < geometry.points <= FEW_POINTS and max(pairs, geometry.batch * geometry.tiles) <= FEW_PAIRS
    return few and session.mapping == "tile" and session.shares_host_memory and session.writes_host_memory


def _list_few(session: opencl.Session, geometry: Geometry, defines: dict[str, str | int]) -> TileLists:
    """`list_tiles` by one work-item; the lists are allocated for all points in all tiles."""
    tiles, pairs = geometry.batch * geometry.tiles, geometry.points * geometry.tiles
    tile_starts, tile_scratch, extent = np.empty(tiles + 1, np.int32), np.empty(tiles, np.int64), np.empty((), np.int32)
    with session.job() as job:
        arrays = (geometry.cloud_starts, geometry.points_uv, geometry.z, geometry.radii, geometry.opacities)
        intersections, counts = job.scratch(geometry.points, np.int32), job.scratch(tiles, np.int32)
        entries, scratch = (job.scratch(pairs, _entry_type(geometry)) for _ in range(2))
        records = job.scratch(pairs, _record_type(geometry))
        scalars, transparent = [*geometry.sizes, np.int32(geometry.batch)], np.int32(geometry.list_transparent)
        job.launch(
            "splat/splat_bin_few.cl", "list_few", defines, (1,),
            [*scalars, *(job.read(array) for array in arrays), transparent,
             intersections, counts, entries, scratch, records,
             *(job.write(array) for array in (tile_starts, tile_scratch, extent))],
        )  # fmt: skip
        none = job.scratch(0, np.int64)
        return TileLists(session, tile_starts, tile_scratch, extent, geometry.grid, records, intersections, none)


def _steps(extent: Array, grid: tuple[int, int]) -> tuple[int, int]:
    rows, columns = grid
    return min(int(extent), rows), min(int(extent), columns)


def _defines(session: opencl.Session, geometry: Geometry) -> dict[str, str | int]:
    return opencl.defines_for(geometry.z.dtype, BUILTINS=int(session.compiles_builtins))


def _starts(tile_counts: Array) -> Array:
    starts = np.zeros(len(tile_counts) + 1, np.int64)
    np.cumsum(tile_counts, out=starts[1:])
    if starts[-1] >= 2**31:
        raise ValueError(f"`radii` must make fewer than 2**31 pairs of a point and a tile, got {starts[-1]}")
    return starts.astype(np.int32)


def _entry_type(geometry: Geometry) -> np.dtype[Any]:
    return np.dtype(f"V{2 * geometry.z.dtype.itemsize}")


def _record_type(geometry: Geometry) -> np.dtype[Any]:
    return np.dtype(f"V{4 * geometry.z.dtype.itemsize + 8}")


def _sort(
    job: opencl.Job,
    geometry: Geometry,
    tile_starts: Array,
    extent: Array,
    intersections: opencl.Buffer,
    entries: opencl.Buffer | None,
) -> TileLists:
    """Sort every tile's entries by (z, index) into records. Without points there is nothing to sort."""
    count, tiles = int(tile_starts[-1]), len(tile_starts) - 1
    steps = _steps(extent, geometry.grid)
    together = job.session.mapping == "pixel"
    records = job.scratch(count, _record_type(geometry))
    entry_offsets = job.scratch(count if together else 0, np.int64)
    tile_scratch = np.zeros(tiles, np.int64)
    if entries is not None and count:
        arrays = (tile_starts, geometry.points_uv, geometry.radii, geometry.opacities)
        scratch = job.scratch(count, _entry_type(geometry))
        arguments: list[opencl.Argument] = [*geometry.sizes, *map(np.int32, steps), *map(job.read, arrays)]
        arguments += [entries, scratch, records, job.write(tile_scratch)]
        defines = _defines(job.session, geometry)
        if together:
            group = constants.TILE**2
            job.launch(
                "splat/splat_bin.cl", "sort_tiles_together", defines | {"TOGETHER": 1}, (tiles * group,),
                [*arguments, entry_offsets], (group,),
            )  # fmt: skip
        else:
            job.launch("splat/splat_bin.cl", "sort_tiles", defines, (tiles,), arguments)
    return TileLists(
        job.session, tile_starts, tile_scratch, extent, geometry.grid, records, intersections, entry_offsets
    )

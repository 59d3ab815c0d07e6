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

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.z.dtype

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
    def sizes(self) -> dict[str, opencl.Argument]:
        """The first arguments of every kernel."""
        names = ("height", "width", "tiles_y", "tiles_x")
        return {name: np.int32(n) for name, n in zip(names, (self.height, self.width, *self.grid), strict=True)}


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
        opacities, transparent = job.read(geometry.opacities), np.int32(geometry.list_transparent)
        shared = geometry.sizes | {
            "cloud_starts": job.read(geometry.cloud_starts),
            "points_uv": job.read(geometry.points_uv),
            "z": job.read(geometry.z),
            "radii": job.read(geometry.radii),
            "intersections": intersections,
            "counts": job.scratch(geometry.batch * chunks * geometry.tiles, np.int32),
        }
        job.launch(
            "splat/splat_bin.cl", "count_tiles", defines, (chunks, geometry.batch),
            {**shared, "opacities": opacities, "list_transparent": transparent, "extents": job.write(extents)},
            (group, 1),
        )  # fmt: skip
        items, together = opencl.grouped(session, geometry.tiles)
        job.launch(
            "splat/splat_bin.cl", "scan_chunks", defines, (items, geometry.batch),
            {"chunks": np.int32(chunks), "tiles": np.int32(geometry.tiles), "counts": shared["counts"],
             "tile_counts": job.write(tile_counts)},
            (together, 1),
        )  # fmt: skip
        job.sync()
        tile_starts = _starts(tile_counts)
        entries = job.scratch(int(tile_starts[-1]), entry_type(geometry.dtype))
        job.launch(
            "splat/splat_bin.cl", "fill_tiles", defines, (chunks, geometry.batch),
            {**shared, "tile_starts": job.read(tile_starts), "entries": entries},
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
        intersections, records = job.scratch(geometry.points, np.int32), job.scratch(pairs, record_type(geometry.dtype))
        arguments: opencl.Arguments = geometry.sizes | {
            "batch": np.int32(geometry.batch),
            "cloud_starts": job.read(geometry.cloud_starts),
            "points_uv": job.read(geometry.points_uv),
            "z": job.read(geometry.z),
            "radii": job.read(geometry.radii),
            "opacities": job.read(geometry.opacities),
            "list_transparent": np.int32(geometry.list_transparent),
            "intersections": intersections,
            "next": job.scratch(tiles, np.int32),
            "entries": job.scratch(pairs, entry_type(geometry.dtype)),
            "scratch": job.scratch(pairs, entry_type(geometry.dtype)),
            "records": records,
            "tile_starts": job.write(tile_starts),
            "tile_scratch": job.write(tile_scratch),
            "extent": job.write(extent),
        }
        job.launch("splat/splat_bin_few.cl", "list_few", defines, (1,), arguments)
        none = job.scratch(0, np.int64)
        return TileLists(session, tile_starts, tile_scratch, extent, geometry.grid, records, intersections, none)


def _steps(extent: Array, grid: tuple[int, int]) -> tuple[int, int]:
    rows, columns = grid
    return min(int(extent), rows), min(int(extent), columns)


def entry_type(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """entry_t of kernels/splat/splat.h."""
    bits = np.dtype(f"u{dtype.itemsize}")
    return np.dtype([("key", bits), ("id", bits)])


def record_type(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """record_t of kernels/splat/splat.h."""
    return np.dtype([*((name, dtype) for name in "uvro"), ("box", np.int32), ("id", np.int32)])


def splat_defines(dtype: np.dtype[Any], **more: str | int) -> dict[str, str | int]:
    """What every splat kernel is built with: it asserts that its structures have these sizes."""
    sizes = {"ENTRY_BYTES": entry_type(dtype).itemsize, "RECORD_BYTES": record_type(dtype).itemsize}
    return opencl.defines_for(dtype, **sizes, **more)


def _defines(session: opencl.Session, geometry: Geometry) -> dict[str, str | int]:
    return splat_defines(geometry.dtype, BUILTINS=int(session.compiles_builtins))


def _starts(tile_counts: Array) -> Array:
    starts = np.zeros(len(tile_counts) + 1, np.int64)
    np.cumsum(tile_counts, out=starts[1:])
    if starts[-1] >= 2**31:
        raise ValueError(f"`radii` must make fewer than 2**31 pairs of a point and a tile, got {starts[-1]}")
    return starts.astype(np.int32)


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
    records = job.scratch(count, record_type(geometry.dtype))
    entry_offsets = job.scratch(count if together else 0, np.int64)
    tile_scratch = np.zeros(tiles, np.int64)
    if entries is not None and count:
        arguments = geometry.sizes | {
            "step_y": np.int32(steps[0]),
            "step_x": np.int32(steps[1]),
            "tile_starts": job.read(tile_starts),
            "points_uv": job.read(geometry.points_uv),
            "radii": job.read(geometry.radii),
            "opacities": job.read(geometry.opacities),
            "entries": entries,
            "scratch": job.scratch(count, entry_type(geometry.dtype)),
            "records": records,
            "tile_scratch": job.write(tile_scratch),
        }
        defines = _defines(job.session, geometry)
        if together:
            group = constants.TILE**2
            job.launch(
                "splat/splat_bin.cl", "sort_tiles_together", defines | {"TOGETHER": 1}, (tiles * group,),
                {**arguments, "entry_offsets": entry_offsets}, (group,),
            )  # fmt: skip
        else:
            job.launch("splat/splat_bin.cl", "sort_tiles", defines, (tiles,), arguments)
    return TileLists(
        job.session, tile_starts, tile_scratch, extent, geometry.grid, records, intersections, entry_offsets
    )

"""Launches of compositing, forward and backward, in both mappings: one work-item per tile or per pixel."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from vestcl import constants, opencl
from vestcl.opencl import host_memory
from vestcl.ops._splat_lists import Array, Geometry, TileLists, are_few, chunks_of

#: Few points in at most so many tiles of all images have their backward in one launch of one work-item ...
FEW_TILES: Final = 8
#: ... unless tiles x channels are more than that: work that is worth sharing.
FEW_NUMBERS: Final = 256
#: Channels that a GPU's work-item keeps in registers; more are composited in groups.
CHANNEL_GROUP: Final = 32
_GROUP: Final = constants.TILE**2
_TILES: Final = "splat/splat_composite.cl"
_PIXELS: Final = "splat/splat_composite_pixels.cl"


@dataclass(frozen=True)
class NeedsGrad:
    """Which gradients `composite_backward` computes; the fields are the names of `splat`'s arguments."""

    points_uv: bool
    radii: bool
    opacities: bool
    features: bool
    backgrounds: bool

    def defines(self) -> dict[str, int]:
        return {f"GRAD_{name.upper()}": int(needed) for name, needed in vars(self).items()}


@dataclass(frozen=True)
class Layer:
    """One feature set on a geometry: what compositing reads."""

    geometry: Geometry
    lists: TileLists
    features: Array
    """[P, C]"""
    backgrounds: Array | None
    """[B, C]; None is zero."""
    min_transmittance: float

    @property
    def channels(self) -> int:
        return int(self.features.shape[1])

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.features.dtype

    @property
    def pixels(self) -> bool:
        return self.lists.session.mapping == "pixel"

    @property
    def channel_group(self) -> int:
        return min(CHANNEL_GROUP, self.channels)

    def defines(self) -> Mapping[str, str | int]:
        truncates, builtins = self.min_transmittance > 0, self.lists.session.compiles_builtins
        if self.pixels:
            return _defines_of_pixels(self.dtype, self.channels, truncates)
        return _defines_of_tiles(self.dtype, self.channels, truncates, builtins)

    def backgrounds_or_zero(self) -> Array:
        zero = (self.geometry.batch, self.channels)
        return np.zeros(zero, self.dtype) if self.backgrounds is None else self.backgrounds

    def scalars(self) -> list[np.generic]:
        return [*self.geometry.sizes, self.dtype.type(self.min_transmittance)]


@functools.cache
def _defines_of_pixels(dtype: np.dtype[Any], channels: int, truncates: bool) -> dict[str, str | int]:
    own = {"CHANNELS": channels, "TRUNCATE": int(truncates), "CHANNEL_GROUP": min(CHANNEL_GROUP, channels)}
    return opencl.defines_for(dtype, **own)


@functools.cache
def _defines_of_tiles(dtype: np.dtype[Any], channels: int, truncates: bool, builtins: bool) -> dict[str, str | int]:
    line = constants.CACHE_LINE
    own = {"CHANNELS": channels, "TRUNCATE": int(truncates), "SEGMENT": constants.SEGMENT, "BUILTINS": int(builtins)}
    own["VECTOR"] = next(n for n in (16, 8, 4, 1) if n <= channels and n * dtype.itemsize <= line)
    own["STREAM"] = int(builtins and channels * dtype.itemsize % line == 0)
    return opencl.defines_for(dtype, **own)


def composite_forward(layer: Layer) -> tuple[Array, Array, Array]:
    """Image [B, H, W, C], coverage [B, H, W], and what the forward saves for the backward, int32.

    For the mapping "pixel" that is whether each point's features are finite [P], for "tile" pack_traversed of
    kernels/splat/splat_traversal.h [B * tiles].
    """
    geometry, lists = layer.geometry, layer.lists
    image = host_memory.empty((geometry.batch, geometry.height, geometry.width, layer.channels), layer.dtype)
    coverage = host_memory.empty(image.shape[:3], layer.dtype)
    tiles = len(lists.tile_scratch)
    saved = np.ones(geometry.points if layer.pixels else tiles, np.int32)
    if geometry.batch == 0:
        return image, coverage, saved
    with lists.session.job() as job:
        features = _read(job, layer.features)
        backgrounds = job.read(layer.backgrounds_or_zero())
        lists_read = [job.read(lists.tile_starts), lists.records]
        shown = [job.write(image), job.write(coverage)]
        if not layer.pixels:
            job.launch(
                _TILES, "composite_tiles", layer.defines(), (tiles,),
                [*layer.scalars(), *lists_read, features, backgrounds, *shown, job.write(saved)],
            )  # fmt: skip
            return image, coverage, saved
        defines = layer.defines()
        saved_buffer = job.write(saved) if geometry.points else job.scratch(1, np.int32)
        if geometry.points:
            items, group = opencl.grouped(lists.session, geometry.points)
            arguments: list[opencl.Argument] = [np.int32(geometry.points), features, saved_buffer]
            job.launch(_PIXELS, "find_finite", defines, (items,), arguments, (group,))
        job.launch(
            _PIXELS, "composite_pixels", defines, (tiles * _GROUP, -(-layer.channels // layer.channel_group)),
            [*layer.scalars(), *lists_read, saved_buffer, features, backgrounds, *shown],
            (_GROUP, 1),
        )  # fmt: skip
    return image, coverage, saved


def composite_backward(
    layer: Layer, saved: Array, grad_image: Array, grad_coverage: Array | None, needs_grad: NeedsGrad
) -> dict[str, Array]:
    """The gradients that are needed, by name.

    Args:
        layer: as in the forward.
        saved: from the forward.
        grad_image: [B, C, H, W] in any memory order, with any strides >= 0, such as 0 of what is expanded.
        grad_coverage: [B, H, W]; None is zero.
        needs_grad: the gradients to compute.
    """
    geometry = layer.geometry
    shapes = {
        "features": layer.features.shape,
        "points_uv": geometry.points_uv.shape,
        "radii": geometry.radii.shape,
        "opacities": geometry.opacities.shape,
        "backgrounds": (geometry.batch, layer.channels),
    }
    grads = {name: host_memory.empty(shape, layer.dtype) for name, shape in shapes.items() if getattr(needs_grad, name)}
    if geometry.batch == 0:
        return grads
    has = {"HAS_BACKGROUNDS": int(layer.backgrounds is not None), "HAS_GRAD_COVERAGE": int(grad_coverage is not None)}
    defines = {**layer.defines(), **needs_grad.defines(), **has}
    file, launch = (_PIXELS, _launch_pixels_backward) if layer.pixels else (_TILES, _launch_tiles_backward)
    with layer.lists.session.job() as job:
        none = job.scratch(1, layer.dtype)
        *outputs, backgrounds = (job.write(grads[n]) if n in grads and grads[n].size else none for n in shapes)
        per_tile = job.scratch(
            len(layer.lists.tile_scratch) * layer.channels if needs_grad.backgrounds else 1, layer.dtype
        )
        if _is_little(layer):
            both = [per_tile, backgrounds]
            _launch_few_backward(job, layer, defines, saved, grad_image, grad_coverage, outputs, both)
            return grads
        if geometry.points:
            clear: list[opencl.Argument] = [np.int32(geometry.points), layer.lists.intersections, *outputs]
            chunks, group = chunks_of(layer.lists.session, geometry.points, 1)
            job.launch(file, "clear_gradients", defines, (chunks,), clear, (group,))
        launch(job, layer, defines, saved, grad_image, grad_coverage, outputs, per_tile)
        if needs_grad.backgrounds:
            total: list[opencl.Argument] = [np.int32(geometry.batch), np.int32(geometry.tiles), per_tile, backgrounds]
            items, group = opencl.grouped(layer.lists.session, geometry.batch * layer.channels)
            job.launch(file, "sum_grad_backgrounds", defines, (items,), total, (group,))
    return grads


def _is_little(layer: Layer) -> bool:
    tiles = len(layer.lists.tile_scratch)
    little = tiles <= FEW_TILES and tiles * layer.channels <= FEW_NUMBERS
    return little and are_few(layer.lists.session, layer.geometry)


def _launch_tiles_backward(
    job: opencl.Job, layer: Layer, defines: dict[str, str | int], saved: Array, grad_image: Array,
    grad_coverage: Array | None, outputs: list[opencl.Buffer], per_tile: opencl.Buffer,
) -> None:  # fmt: skip
    scalars, inputs = _tiles_backward_inputs(job, layer, saved, grad_image, grad_coverage)
    for phase, count in _phases(layer):
        job.launch(
            _TILES, "composite_tiles_backward", defines, count,
            [*layer.scalars(), *phase, *scalars, *inputs, *outputs, per_tile],
        )  # fmt: skip


def _launch_few_backward(
    job: opencl.Job, layer: Layer, defines: dict[str, str | int], saved: Array, grad_image: Array,
    grad_coverage: Array | None, outputs: list[opencl.Buffer], backgrounds: list[opencl.Buffer],
) -> None:  # fmt: skip
    scalars, inputs = _tiles_backward_inputs(job, layer, saved, grad_image, grad_coverage)
    inputs.insert(2, layer.lists.intersections)
    step_y, step_x = layer.lists.steps
    sizes = [np.int32(n) for n in (layer.geometry.batch, layer.geometry.points, step_x, step_y)]
    job.launch(
        _TILES, "composite_few_backward", defines | {"ONE_ITEM": 1}, (1,),
        [*layer.scalars(), *sizes, *scalars, *inputs, *outputs, *backgrounds],
    )  # fmt: skip


def _tiles_backward_inputs(
    job: opencl.Job, layer: Layer, saved: Array, grad_image: Array, grad_coverage: Array | None
) -> tuple[list[np.int64], list[opencl.Buffer]]:
    """The strides of the image's gradient, and what the backward by tiles reads, and scratch memory for checkpoints."""
    lists = layer.lists
    strides, grad_image = _strides(lists.session, grad_image)
    # A segment but the last has space for less than one more footprint, which bounds their number.
    segments = 1 + lists.tile_scratch // (constants.SEGMENT - _GROUP)
    checkpoint_starts = (np.cumsum(segments) - segments).astype(np.int32)
    checkpoints = int(segments.sum()) if segments.max(initial=1) > 1 else 1
    inputs = [
        job.read(lists.tile_starts), lists.records, _read(job, layer.features),
        _read(job, layer.backgrounds), job.read(saved), job.read(grad_image), _read(job, grad_coverage),
        job.read(checkpoint_starts),
        job.scratch(checkpoints * (constants.TILE + 1) ** 2, layer.dtype), job.scratch(checkpoints, np.int32),
    ]  # fmt: skip
    return strides, inputs


def _launch_pixels_backward(
    job: opencl.Job, layer: Layer, defines: dict[str, str | int], saved: Array, grad_image: Array,
    grad_coverage: Array | None, outputs: list[opencl.Buffer], per_tile: opencl.Buffer,
) -> None:  # fmt: skip
    geometry, lists = layer.geometry, layer.lists
    strides, grad_image = _strides(lists.session, grad_image)
    tiles = len(lists.tile_scratch)
    starts = job.read(np.cumsum(lists.tile_scratch) - lists.tile_scratch)
    weights, scratch_grads = (job.scratch(int(lists.tile_scratch.sum()), layer.dtype) for _ in range(2))
    transmittance = job.scratch(geometry.batch * geometry.height * geometry.width, layer.dtype)
    grad = job.read(grad_image)
    entries = [job.read(lists.tile_starts), lists.records, starts, lists.entry_offsets]
    job.launch(
        _PIXELS, "composite_pixels_backward", defines, (tiles * _GROUP,),
        [*layer.scalars(), *strides, *entries, _read(job, saved), _read(job, layer.features),
         _read(job, layer.backgrounds), grad, _read(job, grad_coverage), weights, scratch_grads, transmittance],
        (_GROUP,),
    )  # fmt: skip
    for phase, (columns, rows, batch) in _phases(layer):
        job.launch(
            _PIXELS, "sum_scratch", defines, (columns * _GROUP, rows, batch),
            [*geometry.sizes, *phase, *strides, *entries, weights, scratch_grads, grad, *outputs],
            (_GROUP, 1, 1),
        )  # fmt: skip
    if defines["GRAD_BACKGROUNDS"]:
        items, group = opencl.grouped(lists.session, tiles * layer.channels)
        job.launch(
            _PIXELS, "sum_tile_backgrounds", defines, (items,),
            [*geometry.sizes, np.int32(tiles), *strides, transmittance, grad, per_tile], (group,),
        )  # fmt: skip


def _phases(layer: Layer) -> Iterator[tuple[list[np.int32], tuple[int, int, int]]]:
    """Launches that together visit every tile; no two tiles of a launch share a point. (x0, y0, steps), grid."""
    rows, columns = layer.geometry.grid
    step_y, step_x = layer.lists.steps
    for y in range(step_y):
        for x in range(step_x):
            grid = -(-(columns - x) // step_x), -(-(rows - y) // step_y), layer.geometry.batch
            yield [np.int32(n) for n in (x, y, step_x, step_y)], grid


def _read(job: opencl.Job, array: Array | None) -> opencl.Buffer:
    """A kernel argument, even where there is nothing that the kernel would read."""
    return job.read(array) if array is not None and array.size else job.scratch(1, np.float64)


def _strides(session: opencl.Session, grad_image: Array) -> tuple[list[np.int64], Array]:
    """Numbers from one image, row, pixel and channel to the next, and an array over the memory that they span."""
    strides = [stride // grad_image.itemsize for stride in grad_image.strides]
    span = 1 + sum((size - 1) * stride for size, stride in zip(grad_image.shape, strides, strict=True))
    if span > grad_image.size and not session.shares_host_memory:  # what lies between is not worth a transfer
        return _strides(session, np.ascontiguousarray(grad_image))
    batch, channels, rows, pixels = map(np.int64, strides)
    memory = np.lib.stride_tricks.as_strided(grad_image, (span,), (grad_image.itemsize,), writeable=False)
    return [batch, rows, pixels, np.int64(1) if grad_image.shape[1] == 1 else channels], memory

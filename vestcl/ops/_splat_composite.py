"""Launches of compositing, forward and backward, in both mappings: one work-item per tile or per pixel."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from vestcl import constants, opencl
from vestcl.opencl import host_memory
from vestcl.ops._splat_layer import Layer
from vestcl.ops._splat_lists import Array, are_few, chunks_of

#: Few points in at most so many tiles of all images have their backward in one launch of one work-item ...
FEW_TILES: Final = 8
#: ... unless tiles x channels are more than that: work that is worth sharing.
FEW_NUMBERS: Final = 256
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
        saved_buffer = job.write(saved) if saved.size else job.scratch(1, np.int32)
        arguments: opencl.Arguments = layer.scalars() | {
            "tile_starts": job.read(lists.tile_starts),
            "records": lists.records,
            "features": _read(job, layer.features),
            "backgrounds": job.read(layer.backgrounds_or_zero()),
            "image": job.write(image),
            "coverage": job.write(coverage),
            "finite" if layer.pixels else "tile_traversed": saved_buffer,
        }
        if layer.pixels:
            _launch_pixels(job, layer, tiles, arguments)
        else:
            job.launch(_TILES, "composite_tiles", layer.defines(), (tiles,), arguments)
    return image, coverage, saved


def _launch_pixels(job: opencl.Job, layer: Layer, tiles: int, arguments: opencl.Arguments) -> None:
    points, defines = layer.geometry.points, layer.defines()
    if points:
        items, group = opencl.grouped(job.session, points)
        first: opencl.Arguments = {"points": np.int32(points)} | {n: arguments[n] for n in ("features", "finite")}
        job.launch(_PIXELS, "find_finite", defines, (items,), first, (group,))
    size = tiles * _GROUP, -(-layer.channels // layer.channel_group)
    job.launch(_PIXELS, "composite_pixels", defines, size, arguments, (_GROUP, 1))


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
        outputs = {
            f"grad_{n}": job.write(grads[n]) if n in grads and grads[n].size else none
            for n in shapes if n != "backgrounds"
        }  # fmt: skip
        backgrounds = job.write(grads["backgrounds"]) if needs_grad.backgrounds else none
        per_tile = job.scratch(
            len(layer.lists.tile_scratch) * layer.channels if needs_grad.backgrounds else 1, layer.dtype
        )
        both = {"tile_grad_backgrounds": per_tile, "grad_backgrounds": backgrounds}
        if _is_little(layer):
            _launch_few_backward(job, layer, defines, saved, grad_image, grad_coverage, outputs, both)
            return grads
        if geometry.points:
            clear: opencl.Arguments = {
                "points": np.int32(geometry.points),
                "intersections": layer.lists.intersections,
                **outputs,
            }
            chunks, group = chunks_of(layer.lists.session, geometry.points, 1)
            job.launch(file, "clear_gradients", defines, (chunks,), clear, (group,))
        launch(job, layer, defines, saved, grad_image, grad_coverage, outputs, per_tile)
        if needs_grad.backgrounds:
            total: opencl.Arguments = {"batch": np.int32(geometry.batch), "tiles": np.int32(geometry.tiles), **both}
            items, group = opencl.grouped(layer.lists.session, geometry.batch * layer.channels)
            job.launch(file, "sum_grad_backgrounds", defines, (items,), total, (group,))
    return grads


def _is_little(layer: Layer) -> bool:
    tiles = len(layer.lists.tile_scratch)
    little = tiles <= FEW_TILES and tiles * layer.channels <= FEW_NUMBERS
    return little and are_few(layer.lists.session, layer.geometry)


def _launch_tiles_backward(
    job: opencl.Job, layer: Layer, defines: dict[str, str | int], saved: Array, grad_image: Array,
    grad_coverage: Array | None, outputs: dict[str, opencl.Buffer], per_tile: opencl.Buffer,
) -> None:  # fmt: skip
    inputs = _tiles_backward_inputs(job, layer, saved, grad_image, grad_coverage)
    arguments = {**layer.scalars(), **inputs, **outputs, "tile_grad_backgrounds": per_tile}
    for phase, count in _phases(layer):
        job.launch(_TILES, "composite_tiles_backward", defines, count, arguments | phase)


def _launch_few_backward(
    job: opencl.Job, layer: Layer, defines: dict[str, str | int], saved: Array, grad_image: Array,
    grad_coverage: Array | None, outputs: dict[str, opencl.Buffer], backgrounds: dict[str, opencl.Buffer],
) -> None:  # fmt: skip
    inputs = _tiles_backward_inputs(job, layer, saved, grad_image, grad_coverage)
    step_y, step_x = layer.lists.steps
    arguments: opencl.Arguments = {
        **layer.scalars(),
        "batch": np.int32(layer.geometry.batch),
        "points": np.int32(layer.geometry.points),
        "step_x": np.int32(step_x),
        "step_y": np.int32(step_y),
        "intersections": layer.lists.intersections,
        **inputs,
        **outputs,
        **backgrounds,
    }
    job.launch(_TILES, "composite_few_backward", defines | {"ONE_ITEM": 1}, (1,), arguments)


def _tiles_backward_inputs(
    job: opencl.Job, layer: Layer, saved: Array, grad_image: Array, grad_coverage: Array | None
) -> dict[str, opencl.Argument]:
    """The strides of the image's gradient, and what the backward by tiles reads, and scratch memory for checkpoints."""
    lists = layer.lists
    strides, grad_image = _strides(lists.session, grad_image)
    # A segment but the last has space for less than one more footprint, which bounds their number.
    segments = 1 + lists.tile_scratch // (constants.SEGMENT - _GROUP)
    checkpoint_starts = (np.cumsum(segments) - segments).astype(np.int32)
    checkpoints = int(segments.sum()) if segments.max(initial=1) > 1 else 1
    return {
        **strides,
        "tile_starts": job.read(lists.tile_starts),
        "records": lists.records,
        "features": _read(job, layer.features),
        "backgrounds": _read(job, layer.backgrounds),
        "tile_traversed": job.read(saved),
        "grad_image": job.read(grad_image),
        "grad_coverage": _read(job, grad_coverage),
        "checkpoint_starts": job.read(checkpoint_starts),
        "checkpoints": job.scratch(checkpoints * (constants.TILE + 1) ** 2, layer.dtype),
        "checkpoint_entries": job.scratch(checkpoints, np.int32),
    }


def _launch_pixels_backward(
    job: opencl.Job, layer: Layer, defines: dict[str, str | int], saved: Array, grad_image: Array,
    grad_coverage: Array | None, outputs: dict[str, opencl.Buffer], per_tile: opencl.Buffer,
) -> None:  # fmt: skip
    geometry, lists = layer.geometry, layer.lists
    strides, grad_image = _strides(lists.session, grad_image)
    tiles = len(lists.tile_scratch)
    shown: dict[str, opencl.Argument] = {**geometry.sizes, **strides, "grad_image": job.read(grad_image)}
    entries: dict[str, opencl.Argument] = shown | {
        "tile_starts": job.read(lists.tile_starts),
        "records": lists.records,
        "tile_offsets": job.read(np.cumsum(lists.tile_scratch) - lists.tile_scratch),
        "entry_offsets": lists.entry_offsets,
        "scratch_weights": job.scratch(int(lists.tile_scratch.sum()), layer.dtype),
        "scratch_grads": job.scratch(int(lists.tile_scratch.sum()), layer.dtype),
    }
    transmittance = job.scratch(geometry.batch * geometry.height * geometry.width, layer.dtype)
    arguments = entries | {
        "min_transmittance": layer.dtype.type(layer.min_transmittance),
        "finite": _read(job, saved),
        "features": _read(job, layer.features),
        "backgrounds": _read(job, layer.backgrounds),
        "grad_coverage": _read(job, grad_coverage),
        "transmittance": transmittance,
    }
    job.launch(_PIXELS, "composite_pixels_backward", defines, (tiles * _GROUP,), arguments, (_GROUP,))
    for phase, (columns, rows, batch) in _phases(layer):
        size = columns * _GROUP, rows, batch
        job.launch(_PIXELS, "sum_scratch", defines, size, {**entries, **phase, **outputs}, (_GROUP, 1, 1))
    if defines["GRAD_BACKGROUNDS"]:
        items, group = opencl.grouped(lists.session, tiles * layer.channels)
        arguments = shown | {
            "tiles": np.int32(tiles), "transmittance": transmittance, "tile_grad_backgrounds": per_tile
        }  # fmt: skip
        job.launch(_PIXELS, "sum_tile_backgrounds", defines, (items,), arguments, (group,))


def _phases(layer: Layer) -> Iterator[tuple[dict[str, np.int32], tuple[int, int, int]]]:
    """Launches that together visit every tile; no two tiles of a launch share a point. Arguments, and grid."""
    rows, columns = layer.geometry.grid
    step_y, step_x = layer.lists.steps
    for y in range(step_y):
        for x in range(step_x):
            grid = -(-(columns - x) // step_x), -(-(rows - y) // step_y), layer.geometry.batch
            phase = {"x0": x, "y0": y, "step_x": step_x, "step_y": step_y}
            yield {name: np.int32(n) for name, n in phase.items()}, grid


def _read(job: opencl.Job, array: Array | None) -> opencl.Buffer:
    """A kernel argument, even where there is nothing that the kernel would read."""
    return job.read(array) if array is not None and array.size else job.scratch(1, np.float64)


def _strides(session: opencl.Session, grad_image: Array) -> tuple[dict[str, np.int64], Array]:
    """Numbers from one image, row, pixel and channel to the next, and an array over the memory that they span."""
    strides = [stride // grad_image.itemsize for stride in grad_image.strides]
    span = 1 + sum((size - 1) * stride for size, stride in zip(grad_image.shape, strides, strict=True))
    if span > grad_image.size and not session.shares_host_memory:  # what lies between is not worth a transfer
        return _strides(session, np.ascontiguousarray(grad_image))
    batch, channels, rows, pixels = map(np.int64, strides)
    memory = np.lib.stride_tricks.as_strided(grad_image, (span,), (grad_image.itemsize,), writeable=False)
    channels = np.int64(1) if grad_image.shape[1] == 1 else channels
    named = {"image_stride": batch, "row_stride": rows, "pixel_stride": pixels, "channel_stride": channels}
    return named, memory

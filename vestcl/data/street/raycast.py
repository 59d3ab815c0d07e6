"""Launcher of the ray caster: solids seen by a pinhole camera, as colour, z-depth and Cityscapes train ids.

A pixel's ray is s (R K^-1) (u, v, 1), scaled so that s is its z-depth; see kernels/raycast/raycast.cl.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl import constants, opencl

#: z-depth of the sky in metres: far enough that a metre's move shifts it by less than a pixel, and finite.
STREET_SKY_DEPTH: Final = 1000.0

#: Side of a cell of the shadow grid in metres: about a car, so that few shadows touch one.
SHADOW_CELL: Final = 4.0

#: Metres from the camera, to every side, within which shadows fall; beyond it the haze has washed them out.
SHADOW_REACH: Final = 160.0

#: Lists of solids are kept in 16 bits.
MAX_SOLIDS: Final = 1 << 16


class Shape(IntEnum):
    """A solid's surface before it is scaled by half_size."""

    BOX = 0
    CYLINDER = 1
    ELLIPSOID = 2


class Material(IntEnum):
    """How a solid's surface is painted."""

    PLAIN = 0
    PAVEMENT = 1
    BRICK = 2
    PLASTER = 3
    ROOF = 4
    CAR_BODY = 5
    CAR_CABIN = 6
    WHEEL = 7
    BARK = 8
    FOLIAGE = 9
    CLOTH = 10
    HEAD = 11
    CAR_PANEL = 12


class Label(IntEnum):
    """The Cityscapes train ids that a street has."""

    ROAD = 0
    SIDEWALK = 1
    BUILDING = 2
    POLE = 5
    VEGETATION = 8
    SKY = 10
    PERSON = 11
    CAR = 13


#: Those of them that are foreground (SPEC section 3.2).
FOREGROUND: Final = (Label.POLE, Label.PERSON, Label.CAR)


#: One solid, as kernels/raycast/raycast_types.h lays it out. Axes and metres as everywhere; tint is linear RGB.
SOLID: Final = np.dtype(
    [
        ("centre", np.float32, 3),
        ("half_size", np.float32, 3),
        ("yaw", np.float32, 2),
        ("taper", np.float32, 3),
        ("tint", np.float32, 3),
        ("shape", np.int32),
        ("material", np.int32),
        ("label", np.int32),
        ("seed", np.uint32),
        ("instance", np.int32),
    ]
)

_VIEW: Final = np.dtype(
    [
        ("ray", np.float32, (3, 3)),
        ("project", np.float32, (3, 3)),
        ("camera", np.float32, 3),
        ("sun", np.float32, 3),
        ("pixel", np.float32),
        ("lane", np.float32),
        ("kerb", np.float32),
        ("grid", np.float32, 2),
        ("seed", np.uint32),
    ]
)

Solids = NDArray[np.void]
"""An array [P] of dtype SOLID."""

#: Metres along a bent street's middle line between the points that a scene has of it, how many of them are skipped in
#: the search for the nearest, and Newton's steps from there: at a radius of 40 m they end within 1 mm.
COURSE_STEP: Final = 1.0
_COARSE, _NEWTON = 16, 5

#: On a bent street a pixel's rays are shaded as one where the mean of their 1 / z differs from the centre's by less.
_SMOOTH: Final = "1e-3f"

#: One point of it, as kernels/raycast/raycast_types.h lays it out.
COURSE: Final = np.dtype(
    [("place", np.float32, 2), ("ahead", np.float32, 2), ("curvature", np.float32), ("along", np.float32)]
)


@dataclass(frozen=True)
class Frame:
    """What a camera sees."""

    colour: NDArray[np.float32]
    """[B,3,H,W], display RGB in [0, 1]."""
    depth: NDArray[np.float32]
    """[B,1,H,W], z-depth in metres; SKY_DEPTH where there is sky."""
    labels: NDArray[np.uint8]
    """[B,1,H,W], Cityscapes train ids, see `Label`."""
    instances: NDArray[np.int32] | None = None
    """[B,1,H,W], one number for each car and person that moves, the same at all times; 0: static. None if it was
    not asked for."""


@dataclass(frozen=True)
class Scene:
    """Everything around one camera. Solids are placed from the camera, in world axes."""

    solids: Solids
    """[P], P > 0."""
    crossings: NDArray[np.float32]
    """[n,2], the world's z where side streets begin and end."""
    sun: tuple[float, float, float]
    """Unit vector towards it."""
    lane: float
    """From the centre line to the edge line, metres."""
    kerb: float
    """From the centre line to the kerb, metres."""
    seed: int
    """Seed of the road's and the sky's texture."""
    course: NDArray[np.void] | None = None
    """An array [n] of dtype COURSE, n > 0, COURSE_STEP apart: of a bent street its middle line, placed from the camera;
    ``crossings`` are along it. None is straight: x = 0, along z."""


def blank_frame(batch: int, height: int, width: int, instances: bool = False) -> Frame:
    """A `Frame` of ``batch`` images whose arrays are still to be written, with or without ``instances``."""
    return Frame(
        np.empty((batch, 3, height, width), np.float32),
        np.empty((batch, 1, height, width), np.float32),
        np.empty((batch, 1, height, width), np.uint8),
        np.empty((batch, 1, height, width), np.int32) if instances else None,
    )


def cast(
    scene: Scene,
    camera_from_world: NDArray[np.float64],
    K: NDArray[np.float64],
    frame: Frame,
    index: int,
    samples: int = 1,
) -> None:
    """Fill image ``index`` of ``frame``.

    Args:
        scene: what there is, placed from this camera.
        camera_from_world: [4,4], a rigid transform.
        K: [3,3] intrinsics in pixels, last row (0, 0, 1).
        frame: where the result goes, from `blank_frame`.
        index: which image of the batch.
        samples: samples x samples rays per pixel for colour, averaged in linear light; 0 leaves colour unwritten. All
            the rest is of the ray through the pixel's centre.
    """
    height, width = frame.depth.shape[2:]
    view = _view(scene, camera_from_world, K, samples)
    with opencl.current().job() as job:
        listed = _list_solids(job, scene, job.read(view), height, width)
        wanted = _int32(samples=samples, with_instances=frame.instances is not None)
        tiles = [-(-height // constants.TILE) * -(-width // constants.TILE), constants.TILE]
        arguments: opencl.Arguments = {**listed, **wanted, **_outputs(job, frame, index), **_course(job, scene)}
        _launch(job, "raycast", tiles, arguments, bent=scene.course is not None)


def _list_solids(
    job: opencl.Job, scene: Scene, view: opencl.Buffer, height: int, width: int
) -> dict[str, opencl.Argument]:
    """Which solids each tile of the image and each square of road has: what the kernel raycast reads."""
    count, tile, bent = len(scene.solids), constants.TILE, scene.course is not None
    assert 0 < count <= MAX_SOLIDS and scene.solids.dtype == SOLID
    rows, columns, cells = -(-height // tile), -(-width // tile), int(2 * SHADOW_REACH / SHADOW_CELL)
    crossings = scene.crossings if len(scene.crossings) else np.zeros((1, 2), np.float32)
    image_rects, shadow_cells = job.scratch(4 * count, np.int32), job.scratch(4 * count, np.int32)
    tile_solids, tile_counts = _lists(job, rows * columns, count)
    cell_solids, cell_counts = _lists(job, cells * cells, count)
    shared: dict[str, opencl.Argument] = {
        **_int32(height=height, width=width, solid_count=count, cell_rows=cells, cell_columns=cells),
        "view": view,
        "solids": job.read(scene.solids),
        "image_rects": image_rects,
        "shadow_rects": job.scratch(4 * count, np.float32),
    }
    _launch(job, "project_solids", [count], {**shared, "shadow_cells": shadow_cells}, bent=bent)
    for cell_rows, cell_columns, cell, rects, lists, counts in (
        (rows, columns, tile, image_rects, tile_solids, tile_counts),
        (cells, cells, 1, shadow_cells, cell_solids, cell_counts),
    ):
        sizes = _int32(rows=cell_rows, columns=cell_columns, cell=cell, solid_count=count)
        listed = {"rects": rects, "cell_solids": lists, "cell_counts": counts}
        _launch(job, "list_solids", [cell_rows], {**sizes, **listed}, bent=bent)
    return {
        **shared,
        **_int32(tile_rows=rows, tile_columns=columns, crossing_count=len(scene.crossings)),
        "tile_solids": tile_solids,
        "tile_counts": tile_counts,
        "cell_solids": cell_solids,
        "cell_counts": cell_counts,
        "crossings": job.read(crossings),
    }


def _course(job: opencl.Job, scene: Scene) -> dict[str, opencl.Argument]:
    if scene.course is None:
        return {}
    return {**_int32(course_points=len(scene.course)), "course": job.read(scene.course)}


def _outputs(job: opencl.Job, frame: Frame, index: int) -> dict[str, opencl.Buffer]:
    names = [name for name in ("colour", "depth", "labels", "instances") if getattr(frame, name) is not None]
    written = {name: job.write(getattr(frame, name)[index]) for name in names}
    return {"instances": job.scratch(1, np.int32)} | written


def _launch(
    job: opencl.Job,
    name: str,
    global_size: list[int],
    arguments: opencl.Arguments,
    *,
    bent: bool,
) -> None:
    """A kernel for the first dimension's items; a second dimension is a tile's rows, which share a group."""
    first, *rows = global_size
    items, group = opencl.grouped(job.session, first, at_once=math.prod(rows))
    job.launch("raycast/raycast.cl", name, defines(bent), (items, *rows), arguments, (group, *rows))


def defines(bent: bool) -> opencl.Defines:
    """What raycast.cl is built with, for a straight or a bent street."""
    names = {f"{kind.__name__.upper()}_{m.name}": int(m) for kind in (Shape, Material, Label) for m in kind}
    straight = opencl.defines_for(
        np.dtype(np.float32), SKY_DEPTH=f"{STREET_SKY_DEPTH}f", SHADOW_CELL=f"{SHADOW_CELL}f", **names,
        SOLID_BYTES=SOLID.itemsize, VIEW_BYTES=_VIEW.itemsize,
    )  # fmt: skip
    course: opencl.Defines = {"BENT": 1, "COURSE_BYTES": COURSE.itemsize, "COURSE_STEP": f"{COURSE_STEP}f"}
    search: opencl.Defines = {"COARSE": _COARSE, "NEWTON": _NEWTON, "SMOOTH": _SMOOTH}
    return {**straight, **course, **search} if bent else straight


def _int32(**values: int) -> dict[str, np.int32]:
    return {name: np.int32(value) for name, value in values.items()}


def _lists(job: opencl.Job, cells: int, count: int) -> tuple[opencl.Buffer, opencl.Buffer]:
    return job.scratch(cells * count, np.uint16), job.scratch(cells, np.int32)


def _view(
    scene: Scene, camera_from_world: NDArray[np.float64], K: NDArray[np.float64], samples: int
) -> NDArray[np.void]:
    rotation, translation = camera_from_world[:3, :3], camera_from_world[:3, 3]
    view = np.zeros(1, _VIEW)
    view["ray"] = rotation.T @ np.linalg.inv(K)
    view["project"] = K @ rotation
    view["camera"] = -rotation.T @ translation
    view["sun"] = scene.sun
    view["pixel"] = 1 / (K[0, 0] * max(samples, 1))
    view["lane"], view["kerb"] = scene.lane, scene.kerb
    # The grid starts at a multiple of a cell in the world, so that shadows do not depend on where the camera is.
    view["grid"] = -SHADOW_REACH - np.mod(view["camera"][0, [0, 2]], SHADOW_CELL)
    view["seed"] = scene.seed
    return view

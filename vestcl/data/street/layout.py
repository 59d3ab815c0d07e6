"""Static and dynamic objects along the procedural street, and where.

The street is built in blocks of BLOCK metres, each from the seed and its own index, so that any stretch of it can be
built separately; moving cars and pedestrians go in endless files, see vestcl/data/street/driving/traffic.py.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl.data.street import objects
from vestcl.data.street.raycast import Label, Material, Shape, Solids

#: Length of a block of the street in metres.
BLOCK: Final = 48.0

#: A side street's width in metres, at the end of its block.
CROSSING: Final = 9.0

#: Height of the pavement above the road in metres.
PAVEMENT_HEIGHT: Final = 0.12


#: Metres of a pavement's piece on a bent street: at a radius of 40 m its edge is 1 cm off the arc. The share by which
#: it is longer covers the gaps outside of such a bend.
PIECE: Final = 2.0
OVERLAP: Final = 0.4

Part = tuple[Solids, float]
"""What is placed as one, and the z where it joins the street."""


@dataclass(frozen=True)
class Layout:
    """What of a street decides where objects are."""

    seed: int
    kerb: float
    """From the centre line to the kerb, metres."""
    pavement: float
    """Width of the pavements, metres."""


@dataclass(frozen=True)
class File:
    """Cars or pedestrians that follow each other, one in each slot of ``spacing`` metres."""

    tag: int
    kind: str
    """"car" or "pedestrian"."""
    x: float
    speed: float
    """Mean, metres per second along +z; negative goes and faces the other way."""
    spacing: float
    gap: int | None = None
    """A slot that stays empty: the camera's own, whose drive this file follows."""


# ---------------------------------------------------------------- what is static


def _rng(seed: int, purpose: int, index: int) -> np.random.Generator:
    """A separate generator for item ``index``, of either sign, of ``purpose``."""
    return np.random.default_rng([seed, purpose, 2 * abs(index) + (index < 0)])


@functools.lru_cache(maxsize=4096)
def has_crossing(seed: int, index: int) -> bool:
    """Whether a side street crosses the last CROSSING metres of block ``index``."""
    return bool(_rng(seed, 10, index).random() < 0.4)


def is_crossing(seed: int, z: float) -> bool:
    """Whether z metres along the street lies in a side street."""
    return has_crossing(seed, int(z // BLOCK)) and z % BLOCK > BLOCK - CROSSING


@functools.lru_cache(maxsize=256)
def block(layout: Layout, index: int) -> Solids:
    """Everything that stands in block ``index``, z from the block's beginning."""
    return np.concatenate([part for part, _ in _parts(layout, index, None)])


@functools.lru_cache(maxsize=256)
def anchored_block(layout: Layout, index: int) -> tuple[Solids, NDArray[np.float64]]:
    """The same for a bent street: pavements in pieces of PIECE metres, and what is placed as one has one anchor.

    Returns:
        The solids [P], and for each the z [P] from the block's beginning where it joins the street.
    """
    parts = list(_parts(layout, index, PIECE))
    return np.concatenate([part for part, _ in parts]), np.repeat([z for _, z in parts], [len(p) for p, _ in parts])


def _parts(layout: Layout, index: int, piece: float | None) -> Iterator[Part]:
    rng = _rng(layout.seed, 11, index)
    length = BLOCK - CROSSING if has_crossing(layout.seed, index) else BLOCK
    after_crossing = has_crossing(layout.seed, index - 1)
    for side in (-1, 1):
        yield from _pavement(layout, rng, side, length, piece)
        yield from _houses(layout, rng, side, length)
        yield from _furniture(layout, rng, side, length, after_crossing)
        if length < BLOCK:
            yield from _side_street(layout, rng, side, length)


def _pavement(
    layout: Layout, rng: np.random.Generator, side: int, length: float, piece: float | None
) -> Iterator[Part]:
    """One box, or several that overlap by OVERLAP on the outside of bends."""
    grey = 0.30 + 0.06 * rng.random()
    tint = (grey, 0.98 * grey, 0.94 * grey)
    seed = int(rng.integers(1 << 32))
    count = 1 if piece is None else int(np.ceil(length / piece))
    each = length / count
    half = (layout.pavement / 2, PAVEMENT_HEIGHT / 2, each / 2 * (1.0 if piece is None else 1 + OVERLAP))
    for i in range(count):
        middle = (i + 0.5) * each
        centre = (side * (layout.kerb + half[0]), -half[1], middle)
        yield objects.solid(Shape.BOX, Material.PAVEMENT, Label.SIDEWALK, centre, half, tint, seed=seed), middle


def _houses(layout: Layout, rng: np.random.Generator, side: int, length: float) -> Iterator[Part]:
    count = int(rng.integers(3, 6)) if length > 40 else int(rng.integers(3, 5))
    widths = rng.uniform(0.75, 1.25, count)
    widths *= length / widths.sum()
    front = layout.kerb + layout.pavement
    for width, end in zip(widths, np.cumsum(widths), strict=True):
        depth, height = rng.uniform(11, 14), 4.2 + 3.1 * rng.integers(2, 5) + rng.uniform(0, 0.6)
        home = objects.house(rng, depth, height, float(width))
        z = end - width / 2
        yield objects.placed(home, side * (front + depth / 2 + rng.choice([0.0, 0.0, 0.35])), 0.0, z), z


def _furniture(
    layout: Layout, rng: np.random.Generator, side: int, length: float, after_crossing: bool
) -> Iterator[Part]:
    """Trees, lamps and bollards along the kerb, and parked cars next to it."""
    x = side * (layout.kerb + 0.75)
    for i, z in enumerate(np.arange(4.0, length - 2, 8.0)):
        if i % 3 == 1:
            yield objects.placed(objects.lamp(), x, -PAVEMENT_HEIGHT, z, 0.0 if side > 0 else np.pi), z
        elif rng.random() < 0.75:
            tree, at = objects.tree(rng), z + rng.uniform(-1, 1)
            yield objects.placed(tree, x, -PAVEMENT_HEIGHT, at, rng.uniform(0, 6.3)), at
    if length < BLOCK:
        for z in (length - 1.2, length - 2.7):
            yield objects.placed(objects.bollard(), side * (layout.kerb + 0.4), -PAVEMENT_HEIGHT, z), z
    first = 9.0 if after_crossing else 3.5
    for z in np.arange(first, length - (8.0 if length < BLOCK else 2.0), 6.2):
        if rng.random() < 0.62:
            yaw = (0.0 if side > 0 else np.pi) + rng.normal(0, 0.015)
            middle = side * (layout.kerb - 0.25 - 0.95 + rng.normal(0, 0.04))
            car, at = objects.car(rng), z + rng.uniform(-0.5, 0.5)
            yield objects.placed(car, middle, 0.0, at, yaw), at


def _side_street(layout: Layout, rng: np.random.Generator, side: int, length: float) -> Iterator[Part]:
    """Houses that line the side street behind the corner houses, and one that closes its view."""
    front = layout.kerb + layout.pavement + 11
    middle = length + CROSSING / 2
    for z in (middle - CROSSING / 2 - 6, middle + CROSSING / 2 + 6):
        yield objects.placed(objects.house(rng, 24.0, rng.uniform(8, 12), 12.0), side * (front + 12), 0.0, z), middle
    yield objects.placed(objects.house(rng, 12.0, rng.uniform(9, 14), 40.0), side * (front + 46), 0.0, middle), middle
    for offset in (-2.5, 2.5):
        tree = objects.placed(objects.tree(rng), side * (front + 32), 0.0, middle + offset, rng.uniform(0, 6.3))
        yield tree, middle


# ---------------------------------------------------------------- what moves


@functools.lru_cache(maxsize=1024)
def member(layout: Layout, file: File, slot: int) -> tuple[Solids, float]:
    """Who walks or drives in ``slot``, standing at z = 0, and how many metres from the slot's middle."""
    rng = _rng(layout.seed, 20 + file.tag, slot)
    yaw = 0.0 if file.speed > 0 else np.pi
    car = file.kind == "car"
    made = objects.car(rng) if car else objects.pedestrian(rng)
    offset = 0.22 * file.spacing * rng.uniform(-1, 1)
    return objects.placed(made, file.x + rng.uniform(-0.2, 0.2), 0.0 if car else -PAVEMENT_HEIGHT, 0.0, yaw), offset

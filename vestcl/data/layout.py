"""What stands and moves along the procedural street, and where.

The street is built in blocks of BLOCK metres, each from the seed and its own index, so that any stretch of it can be
built alone; moving cars and pedestrians go in endless files, see vestcl/data/street_traffic.py.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from vestcl.data import objects
from vestcl.data.raycast import Label, Material, Shape, Solids

#: Length of a block of the street in metres.
BLOCK: Final = 48.0

#: A side street's width in metres, at the end of its block.
CROSSING: Final = 9.0

#: Height of the pavement above the road in metres.
PAVEMENT_HEIGHT: Final = 0.12


@dataclass(frozen=True)
class Layout:
    """What of a street decides where things stand."""

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
    """Mean, metres a second along +z; negative goes and faces the other way."""
    spacing: float
    gap: int | None = None
    """A slot that stays empty: the camera's own, whose drive this file follows."""


# ---------------------------------------------------------------- what stands still


def _rng(seed: int, purpose: int, index: int) -> np.random.Generator:
    """A generator of its own for item ``index``, of either sign, of ``purpose``."""
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
    rng = _rng(layout.seed, 11, index)
    length = BLOCK - CROSSING if has_crossing(layout.seed, index) else BLOCK
    after_crossing = has_crossing(layout.seed, index - 1)
    parts: list[Solids] = []
    for side in (-1, 1):
        parts += _pavement(layout, rng, side, length)
        parts += _houses(layout, rng, side, length)
        parts += _furniture(layout, rng, side, length, after_crossing)
        if length < BLOCK:
            parts += _side_street(layout, rng, side, length)
    return np.concatenate(parts)


def _pavement(layout: Layout, rng: np.random.Generator, side: int, length: float) -> Iterator[Solids]:
    half = (layout.pavement / 2, PAVEMENT_HEIGHT / 2, length / 2)
    centre = (side * (layout.kerb + half[0]), -half[1], half[2])
    grey = 0.30 + 0.06 * rng.random()
    tint = (grey, 0.98 * grey, 0.94 * grey)
    seed = int(rng.integers(1 << 32))
    yield objects.solid(Shape.BOX, Material.PAVEMENT, Label.SIDEWALK, centre, half, tint, seed=seed)


def _houses(layout: Layout, rng: np.random.Generator, side: int, length: float) -> Iterator[Solids]:
    count = int(rng.integers(3, 6)) if length > 40 else int(rng.integers(3, 5))
    widths = rng.uniform(0.75, 1.25, count)
    widths *= length / widths.sum()
    front = layout.kerb + layout.pavement
    for width, end in zip(widths, np.cumsum(widths), strict=True):
        depth, height = rng.uniform(11, 14), 4.2 + 3.1 * rng.integers(2, 5) + rng.uniform(0, 0.6)
        home = objects.house(rng, depth, height, float(width))
        yield objects.placed(home, side * (front + depth / 2 + rng.choice([0.0, 0.0, 0.35])), 0.0, end - width / 2)


def _furniture(
    layout: Layout, rng: np.random.Generator, side: int, length: float, after_crossing: bool
) -> Iterator[Solids]:
    """Trees, lamps and bollards along the kerb, and parked cars beside it."""
    x = side * (layout.kerb + 0.75)
    for i, z in enumerate(np.arange(4.0, length - 2, 8.0)):
        if i % 3 == 1:
            yield objects.placed(objects.lamp(), x, -PAVEMENT_HEIGHT, z, 0.0 if side > 0 else np.pi)
        elif rng.random() < 0.75:
            yield objects.placed(objects.tree(rng), x, -PAVEMENT_HEIGHT, z + rng.uniform(-1, 1), rng.uniform(0, 6.3))
    if length < BLOCK:
        for z in (length - 1.2, length - 2.7):
            yield objects.placed(objects.bollard(), side * (layout.kerb + 0.4), -PAVEMENT_HEIGHT, z)
    first = 9.0 if after_crossing else 3.5
    for z in np.arange(first, length - (8.0 if length < BLOCK else 2.0), 6.2):
        if rng.random() < 0.62:
            yaw = (0.0 if side > 0 else np.pi) + rng.normal(0, 0.015)
            middle = side * (layout.kerb - 0.25 - 0.95 + rng.normal(0, 0.04))
            yield objects.placed(objects.car(rng), middle, 0.0, z + rng.uniform(-0.5, 0.5), yaw)


def _side_street(layout: Layout, rng: np.random.Generator, side: int, length: float) -> Iterator[Solids]:
    """Houses that line the side street behind the corner houses, and one that closes its view."""
    front = layout.kerb + layout.pavement + 11
    middle = length + CROSSING / 2
    for z in (middle - CROSSING / 2 - 6, middle + CROSSING / 2 + 6):
        yield objects.placed(objects.house(rng, 24.0, rng.uniform(8, 12), 12.0), side * (front + 12), 0.0, z)
    yield objects.placed(objects.house(rng, 12.0, rng.uniform(9, 14), 40.0), side * (front + 46), 0.0, middle)
    for offset in (-2.5, 2.5):
        yield objects.placed(objects.tree(rng), side * (front + 32), 0.0, middle + offset, rng.uniform(0, 6.3))


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

"""What a street is built from, each a few solids: houses, cars, trees, lamps, people.

Every object stands on y = 0 at the origin of its own axes and faces +z; `placed` moves it. The functions draw what
they leave open from the generator that they are given, and nothing else.
"""

from collections.abc import Sequence

import numpy as np

from vestcl.data.street.raycast import SOLID, Label, Material, Shape, Solids

Vector = tuple[float, float, float]

_PAINTS: tuple[Vector, ...] = (
    (0.50, 0.51, 0.50),
    (0.30, 0.32, 0.34),
    (0.055, 0.058, 0.064),
    (0.014, 0.014, 0.017),
    (0.36, 0.020, 0.016),
    (0.020, 0.075, 0.27),
    (0.030, 0.13, 0.085),
    (0.42, 0.30, 0.09),
    (0.12, 0.17, 0.22),
)
_BRICKS: tuple[Vector, ...] = ((0.34, 0.12, 0.075), (0.27, 0.15, 0.10), (0.38, 0.24, 0.14), (0.24, 0.085, 0.065))
_PLASTERS: tuple[Vector, ...] = (
    (0.58, 0.53, 0.42),
    (0.60, 0.45, 0.27),
    (0.50, 0.52, 0.50),
    (0.52, 0.33, 0.25),
    (0.38, 0.45, 0.48),
    (0.62, 0.60, 0.55),
)
_ROOFS: tuple[Vector, ...] = ((0.30, 0.105, 0.06), (0.10, 0.105, 0.115), (0.22, 0.12, 0.08))
_LEAVES: tuple[Vector, ...] = ((0.11, 0.21, 0.035), (0.16, 0.24, 0.045), (0.08, 0.17, 0.04), (0.22, 0.22, 0.04))
_CLOTHES: tuple[Vector, ...] = (
    (0.40, 0.05, 0.05),
    (0.05, 0.10, 0.30),
    (0.55, 0.52, 0.45),
    (0.03, 0.03, 0.035),
    (0.08, 0.20, 0.12),
    (0.50, 0.33, 0.06),
)
_SKINS: tuple[Vector, ...] = ((0.55, 0.36, 0.26), (0.40, 0.24, 0.16), (0.16, 0.09, 0.055))

#: (length, width, height, cabin's rear and front end as shares of half the length, taper of its front and back)
_CARS: tuple[tuple[float, ...], ...] = (
    (4.55, 1.80, 1.44, -0.78, 0.46, 0.62, 0.45),  # saloon
    (3.95, 1.72, 1.50, -0.96, 0.50, 0.52, 0.20),  # hatchback
    (4.60, 1.78, 1.48, -0.97, 0.46, 0.48, 0.16),  # estate
    (4.50, 1.88, 1.70, -0.97, 0.52, 0.42, 0.14),  # off-roader
    (4.90, 1.94, 1.96, -0.98, 0.74, 0.34, 0.03),  # van
)


def solid(
    shape: Shape,
    material: Material,
    label: Label,
    centre: Vector,
    half_size: Vector,
    tint: Vector,
    taper: Vector = (0.0, 0.0, 0.0),
    seed: int = 0,
) -> Solids:
    """One solid, [1], unturned; see kernels/raycast/raycast_types.h for its fields."""
    return np.array([(centre, half_size, (1.0, 0.0), taper, tint, shape, material, label, seed, 0)], SOLID)


def placed(solids: Solids, x: float, y: float, z: float, yaw: float = 0.0) -> Solids:
    """A copy, turned about y by ``yaw`` (from +z towards +x, radians) and then moved."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    moved = solids.copy()
    right, down, ahead = solids["centre"].T
    moved["centre"] = np.stack([cos * right + sin * ahead + x, down + y, cos * ahead - sin * right + z], axis=1)
    solid_cos, solid_sin = solids["yaw"].T
    moved["yaw"] = np.stack([solid_cos * cos - solid_sin * sin, solid_sin * cos + solid_cos * sin], axis=1)
    return moved


def _pick(rng: np.random.Generator, choices: Sequence[Vector], spread: float = 0.12) -> Vector:
    """One of ``choices``, a little lighter or darker."""
    red, green, blue = choices[int(rng.integers(len(choices)))]
    factor = 1 + spread * rng.uniform(-1, 1)
    return red * factor, green * factor, blue * factor


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 32))


def car(rng: np.random.Generator) -> Solids:
    """A car in one of five shapes: lower body, shoulder, cabin, wheels and mirrors."""
    length, width, height, rear, front, windscreen, hatch = _CARS[rng.integers(len(_CARS))]
    paint = _pick(rng, _PAINTS)
    reach, side, waist, shoulder = length / 2, width / 2, 0.70, 0.62 * min(height, 1.6)
    middle, half_cabin = reach * (front + rear) / 2, reach * (front - rear) / 2
    boxes = (
        (Material.CAR_BODY, 0.20, waist, 0.0, (side, reach), (0.03, 0.03, 0.02)),
        (Material.CAR_PANEL, waist, shoulder, 0.0, (0.97 * side, 0.97 * reach), (0.10, 1 - front, 0.05)),
        (Material.CAR_CABIN, shoulder, height, middle, (0.90 * side, half_cabin), (0.26, windscreen, hatch)),
    )
    parts = [
        solid(Shape.BOX, material, Label.CAR, (0.0, -(low + high) / 2, z), (x, (high - low) / 2, ahead), paint, taper)
        for material, low, high, z, (x, ahead), taper in boxes
    ]
    for x in (-1, 1):
        for z in (-0.62, 0.62):
            at = (x * (side - 0.09), -0.32, z * reach)
            parts.append(solid(Shape.ELLIPSOID, Material.WHEEL, Label.CAR, at, (0.12, 0.32, 0.32), (0.02, 0.02, 0.02)))
        at = (x * (0.9 * side + 0.1), -shoulder - 0.08, middle + 0.62 * half_cabin)
        parts.append(solid(Shape.BOX, Material.CAR_PANEL, Label.CAR, at, (0.1, 0.07, 0.05), paint))
    return np.concatenate(parts)


def tree(rng: np.random.Generator) -> Solids:
    """A trunk and a crown of ten overlapping shells of leaves."""
    top, radius = rng.uniform(4.6, 6.2), rng.uniform(0.12, 0.20)
    wood, green, spread = (0.115, 0.085, 0.06), _pick(rng, _LEAVES), rng.uniform(0.85, 1.15)
    trunk = solid(
        Shape.CYLINDER,
        Material.BARK,
        Label.VEGETATION,
        (0, -top / 2, 0),
        (radius, top / 2, radius),
        wood,
        seed=_seed(rng),
    )
    parts = [trunk]
    for i in range(10):
        turn, out = i * 2.4 + rng.uniform(-0.4, 0.4), spread * (0.3 + 1.2 * np.sqrt(i / 9))
        size = spread * rng.uniform(0.75, 1.1)
        at = (out * np.cos(turn), -top - 0.7 + rng.uniform(-0.7, 0.7) + 0.5 * (out - 1), out * np.sin(turn))
        tint = _pick(rng, (green,), 0.2)
        half = (size, 0.85 * size, size)
        parts.append(solid(Shape.ELLIPSOID, Material.FOLIAGE, Label.VEGETATION, at, half, tint, seed=_seed(rng)))
    return np.concatenate(parts)


def lamp() -> Solids:
    """A street lamp whose arm reaches out to -x."""
    grey = (0.13, 0.14, 0.14)
    parts = (
        (Shape.CYLINDER, (0.0, -3.3, 0.0), (0.065, 3.3, 0.065)),
        (Shape.CYLINDER, (0.0, -0.5, 0.0), (0.11, 0.5, 0.11)),
        (Shape.BOX, (-0.75, -6.58, 0.0), (0.8, 0.035, 0.035)),
        (Shape.BOX, (-1.45, -6.55, 0.0), (0.32, 0.06, 0.12)),
    )
    return np.concatenate([solid(shape, Material.PLAIN, Label.POLE, at, half, grey) for shape, at, half in parts])


def bollard() -> Solids:
    """A short post with a ball on top."""
    iron = (0.045, 0.05, 0.05)
    post = solid(Shape.CYLINDER, Material.PLAIN, Label.POLE, (0.0, -0.42, 0.0), (0.06, 0.42, 0.06), iron)
    ball = solid(Shape.ELLIPSOID, Material.PLAIN, Label.POLE, (0.0, -0.9, 0.0), (0.09, 0.09, 0.09), iron)
    return np.concatenate([post, ball])


def pedestrian(rng: np.random.Generator) -> Solids:
    """A person in mid-step: legs, shoes, torso, arms and head."""
    s = rng.uniform(0.92, 1.06)
    trousers, coat, skin, seed = _pick(rng, _CLOTHES[1:4]), _pick(rng, _CLOTHES), _pick(rng, _SKINS), _seed(rng)
    step = rng.choice([-1, 1])
    ellipsoids: list[tuple[Material, Vector, Vector, Vector]] = [
        (Material.CLOTH, (0.0, -1.17, 0.0), (0.215, 0.36, 0.14), coat),
        (Material.CLOTH, (0.0, -0.88, 0.0), (0.18, 0.17, 0.14), trousers),
        (Material.HEAD, (0.0, -1.64, 0.02), (0.098, 0.135, 0.115), skin),
        (Material.CLOTH, (0.0, -1.49, 0.0), (0.06, 0.10, 0.06), skin),
    ]
    for side in (-1, 1):
        swing = side * step
        ellipsoids += [
            (Material.CLOTH, (0.095 * side, -0.62, 0.06 * swing), (0.095, 0.32, 0.11), trousers),
            (Material.CLOTH, (0.095 * side, -0.30, 0.13 * swing), (0.07, 0.29, 0.085), trousers),
            (Material.CLOTH, (0.095 * side, -0.05, 0.18 * swing), (0.055, 0.055, 0.14), (0.03, 0.025, 0.02)),
            (Material.CLOTH, (0.255 * side, -1.23, -0.03 * swing), (0.065, 0.22, 0.075), coat),
            (Material.CLOTH, (0.265 * side, -0.97, -0.09 * swing), (0.05, 0.19, 0.06), coat),
        ]
    parts = []
    for material, (x, y, z), (a, b, c), tint in ellipsoids:
        at, half = (s * x, s * y, s * z), (s * a, s * b, s * c)
        parts.append(solid(Shape.ELLIPSOID, material, Label.PERSON, at, half, tint, seed=seed))
    return np.concatenate(parts)


def house(rng: np.random.Generator, depth: float, height: float, width: float) -> Solids:
    """A house ``depth`` along x and ``width`` along z, with a pitched or a flat roof, its ridge along z."""
    brick = rng.random() < 0.5
    material = Material.BRICK if brick else Material.PLASTER
    tint = _pick(rng, _BRICKS if brick else _PLASTERS)
    tiles, seed = _pick(rng, _ROOFS), _seed(rng)
    half = (depth / 2, height / 2, width / 2)
    parts = [solid(Shape.BOX, material, Label.BUILDING, (0.0, -height / 2, 0.0), half, tint, seed=seed)]
    if rng.random() < 0.75:
        rise = rng.uniform(2.2, 4.2)
        at, half = (0.0, -height - rise / 2, 0.0), (depth / 2 + 0.35, rise / 2, width / 2)
        hip = rng.choice([0.0, 0.0, 0.5])
        parts.append(solid(Shape.BOX, Material.ROOF, Label.BUILDING, at, half, tiles, (1.0, hip, hip), seed))
        top, size = -height - 0.8 * rise, (0.35, 0.9, 0.5)
        at = (depth * rng.uniform(-0.2, 0.2), top, width * rng.uniform(-0.3, 0.3))
        parts.append(solid(Shape.BOX, Material.PLAIN, Label.BUILDING, at, size, (0.24, 0.12, 0.09)))
    else:
        at, half = (0.0, -height - 0.15, 0.0), (depth / 2 + 0.2, 0.18, width / 2)
        parts.append(solid(Shape.BOX, Material.PLAIN, Label.BUILDING, at, half, (0.42, 0.40, 0.36), seed=seed))
    return np.concatenate(parts)

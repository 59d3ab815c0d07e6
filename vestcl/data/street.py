"""The procedural street: an endless, seeded driving scene with exact colour, depth and labels at any time.

World axes: x right, y down, z forward along the road, metres; the road is y = 0 and its centre line x = 0. Traffic
keeps right. The street is built in blocks of BLOCK metres, each from the seed and its own index, so that any stretch
of it can be built alone; moving cars and pedestrians walk in endless files of constant velocity.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.data import objects
from vestcl.data.raycast import Frame, Label, Material, Scene, Shape, Solids, blank_frame, cast

#: Length of a block of the street in metres.
BLOCK: Final = 48.0

#: A side street's width in metres, at the end of its block.
CROSSING: Final = 9.0

#: How far ahead of the camera the street is built, metres: there the haze hides a house appearing.
AHEAD: Final = 300.0

#: How far behind the camera, metres: shadows and wide views.
BEHIND: Final = 60.0

#: The camera's height above the road in metres, as on KITTI's car.
CAMERA_HEIGHT: Final = 1.65

#: Height of the pavement above the road in metres.
PAVEMENT_HEIGHT: Final = 0.12

#: Focal length over image width, as in KITTI.
FOCAL_SHARE: Final = 0.58


@dataclass(frozen=True)
class File:
    """Cars or pedestrians that follow each other at constant velocity, one in each slot of ``spacing`` metres."""

    tag: int
    kind: str
    """"car" or "pedestrian"."""
    x: float
    speed: float
    """Metres a second along +z; negative walks and faces the other way."""
    spacing: float
    gap: int | None = None
    """A slot that stays empty: the camera's own."""


def intrinsics(height: int, width: int) -> NDArray[np.float64]:
    """K [3,3] of a KITTI-like camera: focal length FOCAL_SHARE * width, principal point in the middle."""
    focal = FOCAL_SHARE * width
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Street:
    """A street. `generate` draws one; every field may be set by hand."""

    seed: int
    lane: float
    """Width of each of the two lanes, metres."""
    parking: float
    """Width of the strip of parked cars on either side, metres."""
    pavement: float
    """Width of the pavements, metres."""
    sun: tuple[float, float, float]
    """Unit vector towards it."""
    speed: float
    """Of the camera, metres a second."""
    phase: float
    """Of the camera's sway, radians."""

    @classmethod
    def generate(cls, seed: int) -> "Street":
        """The street of ``seed``, a non-negative integer. Equal seeds give equal streets.

        Raises:
            ValueError: ``seed`` is negative or no integer.
        """
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise ValueError(f"`seed` must be a non-negative integer, got {seed!r}")
        rng = np.random.default_rng([seed, 0])
        height, turn = np.radians(rng.uniform(36, 50)), np.radians(rng.uniform(20, 42)) * rng.choice([-1, 1])
        sun = (np.cos(height) * np.sin(turn), -np.sin(height), -np.cos(height) * np.cos(turn))
        return cls(
            seed=int(seed),
            lane=rng.uniform(3.1, 3.5),
            parking=rng.uniform(2.1, 2.4),
            pavement=rng.uniform(3.4, 4.4),
            sun=(float(sun[0]), float(sun[1]), float(sun[2])),
            speed=rng.uniform(8.0, 11.0),
            phase=rng.uniform(0, 2 * np.pi),
        )

    @property
    def kerb(self) -> float:
        """From the centre line to the kerb, metres."""
        return self.lane + self.parking

    def camera_pose(self, t: float) -> NDArray[np.float64]:
        """world_from_camera [4,4] at time ``t`` seconds: along the right lane, swaying gently, facing its heading."""
        slow, fast = 0.45 * t + self.phase, 0.8 * t + self.phase
        z = self.speed * t + 0.8 * np.sin(fast)
        x = self.lane / 2 + 0.35 * np.sin(slow)
        heading = np.arctan2(0.35 * 0.45 * np.cos(slow), self.speed + 0.8 * 0.8 * np.cos(fast))
        yaw = heading + 0.02 * np.sin(0.31 * t + self.phase)
        cos, sin = np.cos(yaw), np.sin(yaw)
        return np.array([[cos, 0, sin, x], [0, 1, 0, -CAMERA_HEIGHT], [-sin, 0, cos, z], [0, 0, 0, 1]])

    def render(self, camera_from_world: ArrayLike, K: ArrayLike, height: int, width: int, t: ArrayLike = 0.0) -> Frame:
        """What cameras see at times ``t``.

        Args:
            camera_from_world: [B,4,4] or [4,4], rigid transforms.
            K: [B,3,3] or [3,3] intrinsics, pixel centres at +0.5, last row (0, 0, 1).
            height: of the images in pixels.
            width: of the images in pixels.
            t: seconds, one for all or [B].

        Returns:
            A `Frame` of B images.

        Raises:
            ValueError: an argument has the wrong shape or a value that is no camera; the message names it.
        """
        poses, cameras, times = _cameras(camera_from_world, K, height, width, t)
        frame = blank_frame(len(poses), height, width)
        for index, (pose, camera, time) in enumerate(zip(poses, cameras, times, strict=True)):
            cast(self._scene(pose, float(time)), pose, camera, frame, index)
        return frame

    def _scene(self, camera_from_world: NDArray[np.float64], t: float) -> Scene:
        rotation = camera_from_world[:3, :3]
        position, forward = -rotation.T @ camera_from_world[:3, 3], rotation[2, 2]
        low = position[2] - (BEHIND if forward > 0.5 else AHEAD)
        high = position[2] + (BEHIND if forward < -0.5 else AHEAD)
        parts, offsets = [], []
        blocks = range(int(low // BLOCK), int(high // BLOCK) + 1)
        for index in blocks:
            parts.append(_block(self, index))
            offsets.append((0.0, 0.0, index * BLOCK))
        for file in self._files():
            for solids, z in _members(self, file, t, low, high):
                parts.append(solids)
                side_street = file.kind == "pedestrian" and self._is_crossing(z)
                offsets.append((0.0, PAVEMENT_HEIGHT if side_street else 0.0, z))
        solids = np.concatenate(parts)
        counts = [len(part) for part in parts]
        solids["centre"] += np.repeat(np.array(offsets) - position, counts, axis=0)
        # Leaves last: their noise is looked up only where nothing nearer was hit.
        solids = solids[np.argsort(solids["material"] == Material.FOLIAGE, kind="stable")]
        ends = [(index + 1) * BLOCK for index in blocks if _has_crossing(self.seed, index)]
        crossings = np.array([(end - CROSSING, end) for end in ends], np.float32).reshape(-1, 2)
        return Scene(solids, crossings, self.sun, self.lane, self.kerb, self.seed)

    def _is_crossing(self, z: float) -> bool:
        return _has_crossing(self.seed, int(z // BLOCK)) and z % BLOCK > BLOCK - CROSSING

    def _files(self) -> tuple[File, ...]:
        walk = self.kerb + self.pavement
        return (
            File(1, "car", self.lane / 2, self.speed, 27.0, gap=0),
            File(2, "car", -self.lane / 2, -0.9 * self.speed, 31.0),
            File(3, "pedestrian", walk - 0.8, 1.3, 17.0),
            File(4, "pedestrian", walk - 1.6, -1.2, 23.0),
            File(5, "pedestrian", 0.8 - walk, -1.35, 19.0),
            File(6, "pedestrian", 1.6 - walk, 1.25, 29.0),
        )


def _cameras(
    camera_from_world: ArrayLike, K: ArrayLike, height: int, width: int, t: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The arguments of `Street.render`, checked and with one entry an image."""
    poses, cameras = np.asarray(camera_from_world, np.float64), np.asarray(K, np.float64)
    times = np.asarray(t, np.float64)
    for name, size in (("height", height), ("width", width)):
        if not isinstance(size, int | np.integer) or size < 1:
            raise ValueError(f"`{name}` must be a positive integer, got {size!r}")
    if poses.shape[-2:] != (4, 4) or poses.ndim not in (2, 3):
        raise ValueError(f"`camera_from_world` must be [B, 4, 4] or [4, 4], got {list(poses.shape)}")
    poses = poses.reshape(-1, 4, 4)
    batch = len(poses)
    if cameras.shape not in ((3, 3), (batch, 3, 3)):
        raise ValueError(f"`K` must be [{batch}, 3, 3] or [3, 3], got {list(cameras.shape)}")
    if times.shape not in ((), (batch,)) or not np.isfinite(times).all():
        raise ValueError(f"`t` must be one or {batch} finite times in seconds, got {t!r}")
    rotation = poses[:, :3, :3]
    square = rotation @ rotation.transpose(0, 2, 1)
    rigid = np.allclose(square, np.eye(3), atol=1e-4) and np.all(np.linalg.det(rotation) > 0)
    if not (rigid and np.isfinite(poses).all() and np.array_equal(poses[:, 3], [[0, 0, 0, 1]] * batch)):
        raise ValueError("`camera_from_world` must be rigid transforms: orthonormal rotations, last row (0, 0, 0, 1)")
    cameras = np.broadcast_to(cameras, (batch, 3, 3))
    sound = np.isfinite(cameras).all() and np.all(cameras[:, [0, 1], [0, 1]] > 0)
    if not (sound and np.array_equal(cameras[:, 2], [[0, 0, 1]] * batch)):
        raise ValueError("`K` must have positive focal lengths and the last row (0, 0, 1)")
    return poses, cameras, np.broadcast_to(times, (batch,))


# ---------------------------------------------------------------- what stands still


def _rng(seed: int, purpose: int, index: int) -> np.random.Generator:
    """A generator of its own for item ``index``, of either sign, of ``purpose``."""
    return np.random.default_rng([seed, purpose, 2 * abs(index) + (index < 0)])


@functools.lru_cache(maxsize=4096)
def _has_crossing(seed: int, index: int) -> bool:
    return bool(_rng(seed, 10, index).random() < 0.4)


@functools.lru_cache(maxsize=256)
def _block(street: Street, index: int) -> Solids:
    """Everything that stands in block ``index``, z from the block's beginning."""
    rng = _rng(street.seed, 11, index)
    length = BLOCK - CROSSING if _has_crossing(street.seed, index) else BLOCK
    after_crossing = _has_crossing(street.seed, index - 1)
    parts: list[Solids] = []
    for side in (-1, 1):
        parts += _pavement(street, rng, side, length)
        parts += _houses(street, rng, side, length)
        parts += _furniture(street, rng, side, length, after_crossing)
        if length < BLOCK:
            parts += _side_street(street, rng, side, length)
    return np.concatenate(parts)


def _pavement(street: Street, rng: np.random.Generator, side: int, length: float) -> Iterator[Solids]:
    half = (street.pavement / 2, PAVEMENT_HEIGHT / 2, length / 2)
    centre = (side * (street.kerb + half[0]), -half[1], half[2])
    grey = 0.30 + 0.06 * rng.random()
    tint = (grey, 0.98 * grey, 0.94 * grey)
    seed = int(rng.integers(1 << 32))
    yield objects.solid(Shape.BOX, Material.PAVEMENT, Label.SIDEWALK, centre, half, tint, seed=seed)


def _houses(street: Street, rng: np.random.Generator, side: int, length: float) -> Iterator[Solids]:
    count = int(rng.integers(3, 6)) if length > 40 else int(rng.integers(3, 5))
    widths = rng.uniform(0.75, 1.25, count)
    widths *= length / widths.sum()
    front = street.kerb + street.pavement
    for width, end in zip(widths, np.cumsum(widths), strict=True):
        depth, height = rng.uniform(11, 14), 4.2 + 3.1 * rng.integers(2, 5) + rng.uniform(0, 0.6)
        home = objects.house(rng, depth, height, float(width))
        yield objects.placed(home, side * (front + depth / 2 + rng.choice([0.0, 0.0, 0.35])), 0.0, end - width / 2)


def _furniture(
    street: Street, rng: np.random.Generator, side: int, length: float, after_crossing: bool
) -> Iterator[Solids]:
    """Trees, lamps and bollards along the kerb, and parked cars beside it."""
    x = side * (street.kerb + 0.75)
    for i, z in enumerate(np.arange(4.0, length - 2, 8.0)):
        if i % 3 == 1:
            yield objects.placed(objects.lamp(), x, -PAVEMENT_HEIGHT, z, 0.0 if side > 0 else np.pi)
        elif rng.random() < 0.75:
            yield objects.placed(objects.tree(rng), x, -PAVEMENT_HEIGHT, z + rng.uniform(-1, 1), rng.uniform(0, 6.3))
    if length < BLOCK:
        for z in (length - 1.2, length - 2.7):
            yield objects.placed(objects.bollard(), side * (street.kerb + 0.4), -PAVEMENT_HEIGHT, z)
    first = 9.0 if after_crossing else 3.5
    for z in np.arange(first, length - (8.0 if length < BLOCK else 2.0), 6.2):
        if rng.random() < 0.62:
            yaw = (0.0 if side > 0 else np.pi) + rng.normal(0, 0.015)
            middle = side * (street.kerb - 0.25 - 0.95 + rng.normal(0, 0.04))
            yield objects.placed(objects.car(rng), middle, 0.0, z + rng.uniform(-0.5, 0.5), yaw)


def _side_street(street: Street, rng: np.random.Generator, side: int, length: float) -> Iterator[Solids]:
    """Houses that line the side street behind the corner houses, and one that closes its view."""
    front = street.kerb + street.pavement + 11
    middle = length + CROSSING / 2
    for z in (middle - CROSSING / 2 - 6, middle + CROSSING / 2 + 6):
        yield objects.placed(objects.house(rng, 24.0, rng.uniform(8, 12), 12.0), side * (front + 12), 0.0, z)
    yield objects.placed(objects.house(rng, 12.0, rng.uniform(9, 14), 40.0), side * (front + 46), 0.0, middle)
    for offset in (-2.5, 2.5):
        yield objects.placed(objects.tree(rng), side * (front + 32), 0.0, middle + offset, rng.uniform(0, 6.3))


# ---------------------------------------------------------------- what moves


@functools.lru_cache(maxsize=1024)
def _member(street: Street, file: File, slot: int) -> tuple[Solids, float]:
    """Who walks or drives in ``slot``, and how far from the slot's middle."""
    rng = _rng(street.seed, 20 + file.tag, slot)
    yaw = 0.0 if file.speed > 0 else np.pi
    car = file.kind == "car"
    made = objects.car(rng) if car else objects.pedestrian(rng)
    offset = 0.22 * file.spacing * rng.uniform(-1, 1)
    return objects.placed(made, file.x + rng.uniform(-0.2, 0.2), 0.0 if car else -PAVEMENT_HEIGHT, 0.0, yaw), offset


def _members(street: Street, file: File, t: float, low: float, high: float) -> Iterator[tuple[Solids, float]]:
    """The members of ``file`` between z = ``low`` and ``high`` at time ``t``, with their z."""
    start = file.speed * t
    first, last = (int(np.floor((z - start) / file.spacing)) for z in (low, high))
    for slot in range(first, last + 1):
        if slot != file.gap:
            solids, offset = _member(street, file, slot)
            yield solids, slot * file.spacing + offset + start

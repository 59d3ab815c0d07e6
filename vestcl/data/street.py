"""The procedural street: an endless, seeded driving scene with exact colour, depth and labels at any time.

World axes: x right, y down, z forward along the road, metres; the road is y = 0 and its centre line x = 0. Traffic
keeps right, and never ends: see vestcl/data/layout.py.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.data import layout
from vestcl.data.layout import BLOCK, CROSSING, PAVEMENT_HEIGHT, File, Layout
from vestcl.data.raycast import Frame, Material, Scene, blank_frame, cast

#: How far ahead of the camera the street is built, metres: there the haze hides a house appearing.
AHEAD: Final = 300.0

#: How far behind the camera, metres: shadows and wide views.
BEHIND: Final = 60.0

#: The camera's height above the road in metres, as on KITTI's car.
CAMERA_HEIGHT: Final = 1.65

#: Focal length over image width, as in KITTI.
FOCAL_SHARE: Final = 0.58


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
        parts, offsets, plan = [], [], Layout(self.seed, self.kerb, self.pavement)
        blocks = range(int(low // BLOCK), int(high // BLOCK) + 1)
        for index in blocks:
            parts.append(layout.block(plan, index))
            offsets.append((0.0, 0.0, index * BLOCK))
        for file in self._files():
            for solids, z in layout.members(plan, file, t, low, high):
                parts.append(solids)
                side_street = file.kind == "pedestrian" and layout.is_crossing(self.seed, z)
                offsets.append((0.0, PAVEMENT_HEIGHT if side_street else 0.0, z))
        solids = np.concatenate(parts)
        counts = [len(part) for part in parts]
        solids["centre"] += np.repeat(np.array(offsets) - position, counts, axis=0)
        # Leaves last: their noise is looked up only where nothing nearer was hit.
        solids = solids[np.argsort(solids["material"] == Material.FOLIAGE, kind="stable")]
        ends = [(index + 1) * BLOCK for index in blocks if layout.has_crossing(self.seed, index)]
        crossings = np.array([(end - CROSSING, end) for end in ends], np.float32).reshape(-1, 2)
        return Scene(solids, crossings, self.sun, self.lane, self.kerb, self.seed)

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

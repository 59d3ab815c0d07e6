"""The procedural street: an endless, seeded driving scene with exact colour, depth and labels at any time.

World axes: x right, y down, z forward along the road, metres; the road is y = 0 and its centre line x = 0. Traffic
keeps right, and never ends: see vestcl/data/street/layout.py and street_traffic.py. How the camera drives:
street_drive.py. With a `RoadDrive` the street bends along its course: the statements about x and z hold across it and
along it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.data import calibration
from vestcl.data.street import bent as street_bent
from vestcl.data.street import layout
from vestcl.data.street.camera import check_cameras, check_pose, check_samples, intrinsics
from vestcl.data.street.driving.course import Course
from vestcl.data.street.driving.drive import Drive, Recording, Sway, world_from_camera
from vestcl.data.street.driving.road import RoadDrive
from vestcl.data.street.driving.traffic import Mover, Traffic
from vestcl.data.street.layout import BLOCK, CROSSING, Layout
from vestcl.data.street.raycast import FOREGROUND, SOLID, Frame, Label, Material, Scene, Solids, blank_frame, cast

if TYPE_CHECKING:  # it needs torch, which takes seconds to import
    pass

__all__ = ["Street", "intrinsics"]

#: How far ahead of the camera the street is built, metres: there the haze hides a house appearing.
AHEAD: Final = 300.0

#: How far behind the camera, metres: shadows and wide views.
BEHIND: Final = 60.0

#: The camera's usual height above the road in metres, as on KITTI's car.
CAMERA_HEIGHT: Final = 1.65


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
    drive: Drive
    """How the camera moves, and with it the cars of its lane."""
    crowded: bool = False
    """As many cars in both lanes as fit, and more people: with a slow ``drive``, a jam."""

    @classmethod
    def generate(cls, seed: int, trajectory: ArrayLike | None = None) -> "Street":
        """The street of ``seed``. Equal arguments give equal streets.

        Args:
            seed: a non-negative integer.
            trajectory: [N,4,4] world_from_cam of a real drive in metres, 10 frames per second, N of 2 or more: the
                camera takes over its speed and its sideways, vertical, yaw, pitch and roll wobble, but not its turns,
                see `Recording.from_trajectory`. Beyond its end it is played backwards, then forwards again. Without
                it, `Sway`.

        Raises:
            ValueError: ``seed`` is negative or no integer, or ``trajectory`` no rigid motions.
        """
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise ValueError(f"`seed` must be a non-negative integer, got {seed!r}")
        rng = np.random.default_rng([seed, 0])
        height, turn = np.radians(rng.uniform(36, 50)), np.radians(rng.uniform(20, 42)) * rng.choice([-1, 1])
        sun = (np.cos(height) * np.sin(turn), -np.sin(height), -np.cos(height) * np.cos(turn))
        lane, parking, pavement = rng.uniform(3.1, 3.5), rng.uniform(2.1, 2.4), rng.uniform(3.4, 4.4)
        sway = Sway(speed=rng.uniform(8.0, 11.0), phase=rng.uniform(0, 2 * np.pi))
        return cls(
            seed=int(seed),
            lane=lane,
            parking=parking,
            pavement=pavement,
            sun=(float(sun[0]), float(sun[1]), float(sun[2])),
            drive=sway if trajectory is None else Recording.from_trajectory(trajectory),
        )

    @property
    def kerb(self) -> float:
        """From the centre line to the kerb, metres."""
        return self.lane + self.parking

    @property
    def course(self) -> Course | None:
        """The way of a bent street; None is straight."""
        return self.drive.course if isinstance(self.drive, RoadDrive) else None

    def camera_pose(self, t: float) -> NDArray[np.float64]:
        """world_from_camera [4,4] at time ``t`` seconds: along the right lane, as `drive` moves."""
        ahead, aside, down, *turn = self.drive.at(t)
        if self.course is None:
            return world_from_camera(self.lane / 2 + aside, down - CAMERA_HEIGHT, ahead, *turn)
        relative = world_from_camera(self.lane / 2 + aside, down - CAMERA_HEIGHT, 0.0, *turn)
        return street_bent.world_from_street(self.course, ahead) @ relative

    def render(
        self,
        camera_from_world: ArrayLike,
        K: ArrayLike,
        height: int,
        width: int,
        t: ArrayLike = 0.0,
        *,
        samples: int = 1,
        foreground: bool = True,
        instances: bool = False,
    ) -> Frame:
        """What cameras see at times ``t``.

        Args:
            camera_from_world: [B,4,4] or [4,4], rigid transforms.
            K: [B,3,3] or [3,3] intrinsics, pixel centres at +0.5, last row (0, 0, 1).
            height: of the images in pixels.
            width: of the images in pixels.
            t: seconds, one for all or [B].
            samples: colour is the mean over samples x samples evenly spaced rays per pixel, taken in linear light as a
                sensor sums it, before the display's curve. All the rest is of the ray through the pixel's centre.
            foreground: False leaves out cars, people and poles (SPEC section 3.2) and their shadows.
            instances: whether the frame shows which moving car or person each pixel shows.

        Returns:
            A `Frame` of B images.

        Raises:
            ValueError: an argument has the wrong shape or a value that is not a camera; the message names it.
        """
        poses, cameras, times = check_cameras(camera_from_world, K, height, width, t)
        check_samples(samples)
        frame = blank_frame(len(poses), height, width, instances)
        for index, (pose, camera, time) in enumerate(zip(poses, cameras, times, strict=True)):
            cast(self._scene(pose, float(time), foreground), pose, camera, frame, index, samples)
        return frame

    def motion(
        self,
        cur_from_world: ArrayLike,
        next_from_world: ArrayLike,
        K: ArrayLike,
        height: int,
        width: int,
        t_cur: float,
        t_next: float,
    ) -> NDArray[np.float32]:
        """How what each pixel shows moves: u = x_next - x_cur, x_next = next_from_world (world_from_cur x_cur + d).

        x_cur is the point that the ray through the pixel's centre meets at ``t_cur``, in that camera's frame; d, in the
        world, is how far its car or person gets until ``t_next``, 0 for what is static. The sky, SKY_DEPTH away,
        only turns: u = R x_cur - x_cur.

        Args:
            cur_from_world: [4,4], the camera at ``t_cur``.
            next_from_world: [4,4], the camera at ``t_next``.
            K: [3,3] intrinsics of the camera at ``t_cur``, pixel centres at +0.5, last row (0, 0, 1).
            height: of its image in pixels.
            width: of its image in pixels.
            t_cur: seconds.
            t_next: seconds.

        Returns:
            displacement_xyz [3,H,W], metres.

        Raises:
            ValueError: an argument has the wrong shape or a value that is not a camera; the message names it.
        """
        cur, after = check_pose("cur_from_world", cur_from_world), check_pose("next_from_world", next_from_world)
        _, cameras, times = check_cameras(np.stack([cur, after]), K, height, width, [t_cur, t_next])
        frame = blank_frame(1, height, width, instances=True)
        cast(self._scene(cur, float(times[0])), cur, cameras[0], frame, 0, samples=0)
        assert frame.instances is not None
        next_from_cur = after @ np.linalg.inv(cur)
        per_metre = (next_from_cur[:3, :3] - np.eye(3)) @ np.linalg.inv(cameras[0])  # (R - I) x of a pixel at z = 1 m
        u, v = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
        displacement = np.stack([frame.depth[0, 0] * (a * u + (b * v + c)) for a, b, c in per_metre])
        displacement += np.where(frame.labels[0] == Label.SKY, 0.0, next_from_cur[:3, 3, None, None])
        moving = frame.instances[0, 0] > 0
        names, span = frame.instances[0, 0][moving], (float(times[0]), float(times[1]))
        if self.course is None:
            moved = self._displacements(cur, names, *span)
        else:
            rows, columns = np.nonzero(moving)
            seen = np.linalg.inv(cameras[0]) @ np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
            moved = self._bent_displacements(cur, names, seen * frame.depth[0, 0][moving], *span)
        displacement[:, moving] += after[:3, :3] @ moved
        return displacement.astype(np.float32)

    def _displacements(
        self, camera_from_world: NDArray[np.float64], instances: NDArray[np.int32], t_cur: float, t_next: float
    ) -> NDArray[np.float64]:
        """[3,N] metres in the world's axes: how far each of ``instances`` [N], none 0, gets."""
        traffic, rows = self._traffic(), []
        for mover in traffic.movers(t_cur, *self._stretch(camera_from_world)):
            x0, y0, z0 = mover.position
            x1, y1, z1 = traffic.position(mover, t_next)
            rows.append((mover.instance, (x1 - x0, y1 - y0, z1 - z0)))
        rows.sort()
        names, ways = np.array([name for name, _ in rows], np.int32), np.array([way for _, way in rows]).reshape(-1, 3)
        return ways[np.searchsorted(names, instances)].T

    def _bent_displacements(
        self,
        camera_from_world: NDArray[np.float64],
        instances: NDArray[np.int32],
        points_xyz: NDArray[np.float64],
        t_cur: float,
        t_next: float,
    ) -> NDArray[np.float64]:
        """The same for points [3,N] in the camera's axes: on a bent street cars turn as well."""
        assert self.course is not None
        traffic, moved = self._traffic(), np.zeros_like(points_xyz)
        world = camera_from_world[:3, :3].T @ (points_xyz - camera_from_world[:3, 3:])
        for mover in traffic.movers(t_cur, *self._stretch(camera_from_world)):
            of_it = instances == mover.instance
            if of_it.any():
                places = [
                    street_bent.world_from_street(self.course, z) @ calibration.translation((0.0, y, 0.0))
                    for _, y, z in (mover.position, traffic.position(mover, t_next))
                ]
                next_from_cur = places[1] @ np.linalg.inv(places[0])
                moved[:, of_it] = (next_from_cur[:3, :3] - np.eye(3)) @ world[:, of_it] + next_from_cur[:3, 3:]
        return moved

    def _stretch(self, camera_from_world: NDArray[np.float64]) -> tuple[float, float]:
        """The z in metres between which the street is built for a camera; along it where it is bent."""
        if self.course is not None:
            return street_bent.stretch(self.course, camera_from_world, AHEAD, BEHIND)
        rotation = camera_from_world[:3, :3]
        z, forward = float(-rotation[:, 2] @ camera_from_world[:3, 3]), rotation[2, 2]
        return z - (BEHIND if forward > 0.5 else AHEAD), z + (BEHIND if forward < -0.5 else AHEAD)

    def _scene(self, camera_from_world: NDArray[np.float64], t: float, foreground: bool = True) -> Scene:
        position = -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]
        low, high = self._stretch(camera_from_world)
        plan, blocks = self._plan(), range(int(low // BLOCK), int(high // BLOCK) + 1)
        movers: list[Mover] = list(self._traffic().movers(t, low, high)) if foreground else []
        if self.course is not None:
            solids = street_bent.solids(self.course, plan, blocks, movers, position)
        else:
            solids = self._straight_solids(plan, blocks, movers, position)
        if not foreground:
            solids = solids[~np.isin(solids["label"], FOREGROUND)]
        # Leaves last: their noise is looked up only where nothing nearer was hit.
        solids = solids[np.argsort(solids["material"] == Material.FOLIAGE, kind="stable")]
        ends = [(index + 1) * BLOCK for index in blocks if layout.has_crossing(self.seed, index)]
        crossings = np.array([(end - CROSSING, end) for end in ends], np.float32).reshape(-1, 2)
        course = None if self.course is None else street_bent.points(self.course, low, high, position)
        return Scene(solids, crossings, self.sun, self.lane, self.kerb, self.seed, course)

    def _straight_solids(
        self, plan: Layout, blocks: range, movers: list[Mover], position: NDArray[np.float64]
    ) -> Solids:
        """Everything in ``blocks`` and all ``movers``, placed from ``position``."""
        parts = [*(layout.block(plan, index) for index in blocks), *(mover.solids for mover in movers)]
        offsets = [*((0.0, 0.0, index * BLOCK) for index in blocks), *(mover.position for mover in movers)]
        # As plain bytes, because NumPy compares the fields' names of all parts, which takes a millisecond.
        solids = np.concatenate([part.view(f"V{SOLID.itemsize}") for part in parts]).view(SOLID)
        counts = [len(part) for part in parts]
        solids["centre"] += np.repeat(np.array(offsets) - position, counts, axis=0)
        solids["instance"] = np.repeat([*(0 for _ in blocks), *(mover.instance for mover in movers)], counts)
        return solids

    def _plan(self) -> Layout:
        return Layout(self.seed, self.kerb, self.pavement)

    def _traffic(self) -> Traffic:
        return Traffic(self._plan(), self.lane, self.drive, self.crowded)

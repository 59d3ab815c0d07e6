"""Scenes for the geometric forecast whose depth, flow and motion are known exactly."""

import functools
from typing import Any, NamedTuple

import cv2
import numpy as np
from data_files import pose
from numpy.typing import NDArray

from vestcl.data import Street, intrinsics, street_clip
from vestcl.data.sample import Clip
from vestcl.forecasting.geometric.frame_cloud import FrameCloud
from vestcl.scene.flow.correspondence import Correspondence

Floats = NDArray[np.float32]
Matrix = NDArray[np.float64]

#: Small images with the proportions of KITTI's.
HEIGHT, WIDTH = 96, 320

#: Another focal length each way, and an odd principal point.
K = np.array([[190.0, 0.0, 157.5], [0.0, 180.0, 45.25], [0.0, 0.0, 1.0]])

#: Camera above the road, and the wall at its end, metres. From a car's 1.65 m neighbouring rows of so small an image
#: differ by 0.0034 / m on the road, which counts as a jump.
CAMERA_HEIGHT, WALL = 3.0, 40.0


def noise(height: int = HEIGHT, width: int = WIDTH, seed: int = 0, blur: float = 1.0) -> Floats:
    """[3, H, W] smooth random colours."""
    raw = np.random.default_rng(seed).random((height, width, 3), np.float32)
    smooth = cv2.GaussianBlur(raw, (0, 0), blur)
    return np.ascontiguousarray(((smooth - smooth.min()) / (smooth.max() - smooth.min())).transpose(2, 0, 1))


def planes(*values: float) -> Floats:
    """[C, 1, 1]: one number for each channel."""
    return np.array(values, np.float32)[:, None, None]


def flat(depth: float) -> Floats:
    """[1, H, W] m: a wall that faces the camera."""
    return np.full((1, HEIGHT, WIDTH), depth, np.float32)


def room() -> Floats:
    """[1, H, W] m: a road down to a wall, and a box at 8 m."""
    below = np.maximum(np.arange(HEIGHT) + 0.5 - K[1, 2], 1e-3)
    road = np.minimum(K[1, 1] * CAMERA_HEIGHT / below, WALL)
    depth = np.repeat(road[:, None], WIDTH, axis=1)[None].astype(np.float32)
    depth[:, 30:70, 40:100] = np.minimum(depth[:, 30:70, 40:100], 8)
    return depth


def points(depth: Floats, K: Matrix = K) -> Matrix:
    """[3, H, W] m, what each pixel shows."""
    y, x = np.mgrid[: depth.shape[1], : depth.shape[2]] + 0.5
    return np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)]) * depth.astype(np.float64)


def move(dst_from_src: Matrix, xyz: Matrix) -> Matrix:
    """R x + t of [3, H, W]."""
    return np.einsum("ij,jhw->ihw", dst_from_src[:3, :3], xyz) + dst_from_src[:3, 3, None, None]


def exact_flow(depth: Floats, dst_from_src: Matrix, shift_xyz: Any = 0.0, K: Matrix = K) -> Correspondence:
    """Where dst shows what src shows at each pixel, once it has moved by ``shift_xyz`` in src's axes."""
    x, y, z = move(dst_from_src, points(depth, K) + shift_xyz)
    rows, columns = np.mgrid[: depth.shape[1], : depth.shape[2]] + 0.5
    flow = np.stack([K[0, 0] * x / z + K[0, 2] - columns, K[1, 1] * y / z + K[1, 2] - rows])
    return Correspondence(flow.astype(np.float32), np.zeros_like(depth))


def with_noise(correspondence: Correspondence, std: float, seed: int = 0) -> Correspondence:
    """Gaussian errors of the flow, px."""
    error = np.random.default_rng(seed).normal(0, std, correspondence.flow_uv.shape)
    return correspondence._replace(flow_uv=(correspondence.flow_uv + error).astype(np.float32))


def turned(yaw: float, pitch: float, roll: float, xyz: tuple[float, float, float]) -> Matrix:
    """[4, 4]: turns about y, x and z, radians, and a shift, metres."""
    matrix = np.eye(4)
    for axis, angle in ((1, yaw), (0, pitch), (2, roll)):
        vector = np.zeros(3)
        vector[axis] = angle
        matrix[:3, :3] = matrix[:3, :3] @ cv2.Rodrigues(vector)[0]
    matrix[:3, 3] = xyz
    return matrix


def cloud_of(
    image: Floats,
    depth: Floats,
    *,
    which: NDArray[np.bool_] | None = None,
    dst_from_src: Matrix | None = None,
    step_xyz: tuple[float, float, float] = (0.0, 0.0, 0.0),
    K: Matrix = K,
) -> FrameCloud:
    """The pixels of ``which`` [H, W] as points, seen from dst."""
    y, x = np.nonzero(np.ones(depth.shape[1:], bool) if which is None else which)
    xyz = move(pose() if dst_from_src is None else dst_from_src, points(depth, K))[:, y, x].T.astype(np.float32)
    steps = np.tile(np.array(step_xyz, np.float32), (len(x), 1))
    return FrameCloud(xyz, depth[0, y, x], image, steps, y, x)


def decibels(got: NDArray[Any], wanted: NDArray[Any], where: NDArray[np.bool_] | None = None) -> float:
    """PSNR of [3, H, W], of the pixels of ``where`` [H, W]."""
    squares = np.square(got.astype(np.float64) - wanted).mean(0)
    return float(-10 * np.log10(squares.mean() if where is None else squares[where].mean()))


class Drive(NamedTuple):
    """A street, as a clip and as the truth."""

    street: Street
    clip: Clip

    def camera(self, index: int) -> Matrix:
        """camera_from_world."""
        return np.asarray(np.linalg.inv(self.street.camera_pose(self._time(index))), np.float64)

    def moving(self, index: int) -> NDArray[np.bool_]:
        """[H, W], True where a car or person shows that moves."""
        K = intrinsics(HEIGHT, WIDTH)
        frame = self.street.render(self.camera(index), K, HEIGHT, WIDTH, self._time(index), instances=True)
        assert frame.instances is not None
        return frame.instances[0, 0] > 0

    def cur_to_next(self, cur: int, after: int) -> Floats:
        """[3, H, W] m, x_after - x_cur of what the pixels of ``cur`` show."""
        K = intrinsics(HEIGHT, WIDTH)
        times = self._time(cur), self._time(after)
        return self.street.motion(self.camera(cur), self.camera(after), K, HEIGHT, WIDTH, *times)

    def _time(self, index: int) -> float:
        time = self.clip[index].timestamp
        assert time is not None
        return time


@functools.lru_cache(maxsize=4)
def drive(seed: int, frames: int = 8, start: float = 0.0, samples: int = 1) -> Drive:
    """A street's clip at the small size."""
    street = Street.generate(seed)
    return Drive(street, street_clip(street, frames, HEIGHT, WIDTH, start=start, samples=samples))

"""Cameras on the street: a KITTI-like one, and what a camera must be."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.data.resize import check_size

Array = NDArray[np.float64]

#: Focal length over image width, as in KITTI.
FOCAL_SHARE: Final = 0.58

#: How far R R^T may be from the identity: poses that were stored as float32 or as text pass.
ROTATION_TOLERANCE: Final = 1e-4


def intrinsics(height: int, width: int) -> Array:
    """K [3,3] of a KITTI-like camera: focal length FOCAL_SHARE * width, principal point in the middle."""
    focal = FOCAL_SHARE * width
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def are_rigid(poses: Array) -> bool:
    """Whether all of [B,4,4] are a rotation and a finite shift."""
    rotation = poses[:, :3, :3]
    square = rotation @ rotation.transpose(0, 2, 1)
    straight = np.allclose(square, np.eye(3), atol=ROTATION_TOLERANCE) and np.all(np.linalg.det(rotation) > 0)
    return bool(straight and np.isfinite(poses).all() and np.all(poses[:, 3] == [0, 0, 0, 1]))


def check_samples(samples: int) -> None:
    """Refuse what is not a number of rays.

    Raises:
        ValueError: ``samples`` is not a positive integer.
    """
    if not isinstance(samples, int | np.integer) or samples < 1:
        raise ValueError(f"`samples` must be a positive integer, got {samples!r}")


def check_pose(name: str, pose: ArrayLike) -> Array:
    """``pose`` as [4,4] float64.

    Raises:
        ValueError: no rigid transform; the message calls it ``name``.
    """
    matrix = np.asarray(pose, np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"`{name}` must be [4, 4], got {list(matrix.shape)}")
    if not are_rigid(matrix[None]):
        raise ValueError(f"`{name}` must be a rigid transform: orthonormal rotation, last row (0, 0, 0, 1)")
    return matrix


def check_cameras(
    camera_from_world: ArrayLike, K: ArrayLike, height: int, width: int, t: ArrayLike
) -> tuple[Array, Array, Array]:
    """The arguments of `Street.render`, checked and with one entry per image: [B,4,4], [B,3,3] and [B].

    Raises:
        ValueError: one of them is not a camera, size or time; the message names it.
    """
    poses, cameras = np.asarray(camera_from_world, np.float64), np.asarray(K, np.float64)
    times = np.asarray(t, np.float64)
    check_size(height, width)
    if poses.shape[-2:] != (4, 4) or poses.ndim not in (2, 3):
        raise ValueError(f"`camera_from_world` must be [B, 4, 4] or [4, 4], got {list(poses.shape)}")
    poses = poses.reshape(-1, 4, 4)
    batch = len(poses)
    if cameras.shape not in ((3, 3), (batch, 3, 3)):
        raise ValueError(f"`K` must be [{batch}, 3, 3] or [3, 3], got {list(cameras.shape)}")
    if times.shape not in ((), (batch,)) or not np.isfinite(times).all():
        raise ValueError(f"`t` must be one or {batch} finite times in seconds, got {t!r}")
    if not are_rigid(poses):
        raise ValueError("`camera_from_world` must be rigid transforms: orthonormal rotations, last row (0, 0, 0, 1)")
    cameras = np.broadcast_to(cameras, (batch, 3, 3))
    sound = np.isfinite(cameras).all() and np.all(cameras[:, [0, 1], [0, 1]] > 0)
    if not (sound and np.array_equal(cameras[:, 2], [[0, 0, 1]] * batch)):
        raise ValueError("`K` must have positive focal lengths and the last row (0, 0, 1)")
    return poses, cameras, np.broadcast_to(times, (batch,))

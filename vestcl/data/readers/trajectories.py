"""Camera trajectories without images, from files of KITTI's or TUM's format."""

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from vestcl.data import calibration
from vestcl.data.calibration import Matrix

#: Frames per second of KITTI's pose files, which have no times.
KITTI_FPS: Final = 10.0

#: Numbers in a line: 3 x 4 world_from_cam, or time, position and quaternion (x, y, z, w).
_KITTI, _TUM = 12, 8


class Trajectory(NamedTuple):
    """Poses of a camera over time."""

    seconds: Matrix
    """[N], rising."""
    world_from_cam: Matrix
    """[N, 4, 4] m."""


def read_trajectory(path: str | Path, fps: float = KITTI_FPS) -> Trajectory:
    """Poses of a text file, one per line, empty lines and lines that begin with "#" left out.

    Args:
        path: KITTI's (12 numbers, the rows of the 3 x 4 matrix world_from_cam) or TUM's format (timestamp in seconds,
            t_x t_y t_z, q_x q_y q_z q_w of world_from_cam).
        fps: frames per second of KITTI's format, which has no times.

    Raises:
        ValueError: fewer than two poses, another number of columns, no rigid motions, or times that do not rise.

    Source: devkit of KITTI odometry; the RGB-D benchmark of TU Munich.
    """
    path = Path(path)
    if not 0 < fps < np.inf:
        raise ValueError(f"`fps` must be positive, got {fps}")
    try:
        rows = np.loadtxt(path, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: must be lines of {_KITTI} or {_TUM} numbers: {error}") from error
    if len(rows) < 2 or rows.shape[1] not in (_KITTI, _TUM):
        found = f"{len(rows)} lines of {rows.shape[1]}"
        raise ValueError(f"{path}: must have two lines or more of {_KITTI} or {_TUM} numbers, got {found}")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if rows.shape[1] == _KITTI:
        seconds = np.arange(len(rows)) / fps
        poses[:, :3] = rows.reshape(-1, 3, 4)
    else:
        seconds, length = rows[:, 0], np.linalg.norm(rows[:, 4:], axis=1)
        if not np.all(np.abs(length - 1) < 1e-2):
            raise ValueError(f"{path}: quaternions must have length 1, got {length.min():g} to {length.max():g}")
        poses[:, :3, :3], poses[:, :3, 3] = Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]
    if np.any(np.diff(seconds) <= 0):
        line = int(np.argmax(np.diff(seconds) <= 0)) + 1
        raise ValueError(f"{path}: times must rise, got {seconds[line - 1]:.6f} and then {seconds[line]:.6f}")
    for index, pose in enumerate(poses):
        calibration.check_rigid(pose, f"{path}: pose {index}")
    poses[:, :3, :3] = _orthonormal(poses[:, :3, :3])
    return Trajectory(seconds, poses)


def _orthonormal(rotations: Matrix) -> Matrix:
    """The nearest rotations: files round their numbers."""
    left, _, right = np.linalg.svd(rotations)
    return np.asarray(left @ right, np.float64)

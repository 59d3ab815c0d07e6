"""`vestcl bench camera` and the files that it reads."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vestcl.bench import camera
from vestcl.bench.camera import CameraBench
from vestcl.data.readers.trajectories import read_trajectory


def poses(count: int) -> np.ndarray:
    """A drive of S-bends with nods, 10 frames a second."""
    t = 0.1 * np.arange(count)
    yaw = np.cumsum(0.04 * np.sin(0.8 * t))
    pitch = 0.003 * np.sin(2 * np.pi * 1.3 * t)
    world = np.tile(np.eye(4), (count, 1, 1))
    world[:, :3, :3] = Rotation.from_euler("yx", np.stack([yaw, pitch], axis=1)).as_matrix()
    speed = 0.9 + 0.3 * np.sin(0.5 * t)
    world[:, 0, 3], world[:, 2, 3] = np.cumsum(speed * np.sin(yaw)), np.cumsum(speed * np.cos(yaw))
    return world


def write_kitti(path: Path, world: np.ndarray) -> Path:
    np.savetxt(path, world[:, :3].reshape(-1, 12))
    return path


def test_kitti_and_tum_files_are_read_alike(tmp_path: Path) -> None:
    world = poses(20)
    kitti = read_trajectory(write_kitti(tmp_path / "kitti.txt", world), fps=10)
    quaternions = Rotation.from_matrix(world[:, :3, :3]).as_quat()
    rows = np.concatenate([0.1 * np.arange(20)[:, None], world[:, :3, 3], quaternions], axis=1)
    np.savetxt(tmp_path / "tum.txt", rows, header="timestamp tx ty tz qx qy qz qw")
    tum = read_trajectory(tmp_path / "tum.txt")
    np.testing.assert_allclose(kitti.seconds, tum.seconds, atol=1e-9)
    np.testing.assert_allclose(kitti.world_from_cam, tum.world_from_cam, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n4 5 6\n", "must have two lines or more of 12 or 8 numbers, got 2 lines of 3"),
        ("a b\n", "must be lines of 12 or 8 numbers"),
        ("0 0 0 0 0 0 0 1\n0 0 0 1 0 0 0 1\n", "times must rise"),
        ("0 0 0 0 0 0 0 2\n1 0 0 1 0 0 0 1\n", "quaternions must have length 1"),
        ("1 0 0 0 0 1 0 0 0 0 2 0\n" * 2, "pose 0"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_trajectory(tmp_path / "poses.txt")


@pytest.mark.parametrize("history", [None, 8])
def test_the_forecast_is_better_than_constant_velocity(tmp_path: Path, history: int | None) -> None:
    path, out = write_kitti(tmp_path / "drive.txt", poses(200)), tmp_path / "errors.json"
    camera.main(CameraBench((path,), ahead=(0.1, 0.5), seeds=2, history=history, json=out))
    errors = json.loads(out.read_text())["errors"][str(path)]
    for ahead in ("0.1 s", "0.5 s"):
        ours, constant = errors[ahead]["all"]["forecast"], errors[ahead]["all"]["constant velocity"]
        assert ours["rotation_deg"] < 0.8 * constant["rotation_deg"]
        assert ours["translation_percent"] < 0.8 * constant["translation_percent"]


def test_options_are_checked(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--history must be 1 to 16, got 0"):
        CameraBench((tmp_path,), history=0)
    path = write_kitti(tmp_path / "short.txt", poses(10))
    with pytest.raises(ValueError, match="more than 17 poses, got 10"):
        camera.main(CameraBench((path,), ahead=(0.1,)))

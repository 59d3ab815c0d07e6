"""How the camera drives: smoothly by itself, or with a recording's speed and wobble; and that it hits nobody."""

import pickle
from typing import Any

import numpy as np
import pytest
from data_files import real

from vestcl.data import Street
from vestcl.data.readers.files import read_poses
from vestcl.data.street.driving.drive import LIMITS, Drive, Recording, Sway, world_from_camera
from vestcl.data.street.driving.traffic import QUEUE_SPACING, Traffic
from vestcl.data.street.layout import Layout

FPS = 10.0


def recorded(yaw: Any = 0.0, pitch: Any = 0.0, y: Any = 0.0, speed: Any = 8.0, frames: int = 200) -> np.ndarray:
    """[N, 4, 4] of a car that drives where it looks; every number is one or one per frame."""
    yaw, pitch, y, speed = (np.broadcast_to(np.asarray(value, float), frames) for value in (yaw, pitch, y, speed))
    steps = np.stack([np.sin(yaw), np.cos(yaw)], axis=1) * speed[:, None] / FPS
    x, z = (np.cumsum(steps, axis=0) - steps).T
    return np.stack([world_from_camera(x[i], y[i], z[i], yaw[i], pitch[i], 0.0) for i in range(frames)])


def sine(amplitude: float, hertz: float, frames: int = 200) -> np.ndarray:
    return amplitude * np.sin(2 * np.pi * hertz * np.arange(frames) / FPS)


def test_sway_is_smooth_and_stays_in_its_lane() -> None:
    street = Street.generate(5)
    poses = np.stack([street.camera_pose(t) for t in np.arange(0, 60, 0.1)])
    steps = np.diff(poses[:, 2, 3])
    assert 0.4 < steps.min() < 0.95 * steps.mean()
    assert 1.05 * steps.mean() < steps.max() < 1.5
    assert np.abs(poses[:, 0, 3] - street.lane / 2).max() < 0.3
    assert np.abs(poses[:, 1, 3] + 1.65).max() < 0.03
    np.testing.assert_allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), [np.eye(3)] * 600, atol=1e-12)
    turns = np.degrees(np.diff(street.drive.at(np.arange(0, 60, 0.1))[:, 3:], axis=0))
    assert np.all(turns.std(axis=0) > 0.03)  # as much as KITTI odometry's calmer drive ...
    assert np.all(turns.std(axis=0) < 0.3)  # ... and no more than the wilder


def test_sway_faces_where_it_goes() -> None:
    """Without the yaw's own waves, tan(yaw) = dx / dz: on the mean of the sines' squares what is left is small."""
    drive = Sway(9.0, 0.7)
    t = np.arange(0, 200, 0.01)
    numbers = drive.at(t)
    slope = np.gradient(numbers[:, 1], t) / np.gradient(numbers[:, 0], t)
    assert np.corrcoef(slope, numbers[:, 3])[0, 1] > 0.8
    assert np.degrees((numbers[:, 3] - np.arctan(slope)).std()) < 0.4


def test_sway_speed_is_the_slope_of_its_way() -> None:
    drive = Sway(9.0, 1.3)
    t = np.arange(0, 300, 0.05)
    speeds = np.gradient(drive.travelled(t), t)
    assert speeds.mean() == pytest.approx(9.0, abs=0.1)
    assert float(drive.travelled(0.0)) == pytest.approx(0.0)
    assert 0.5 < speeds.std() < 2.5


def test_a_straight_recording_has_no_wobble() -> None:
    drive = Recording.from_trajectory(recorded(yaw=0.7, speed=8.0))
    assert drive.speed == pytest.approx(8.0)
    numbers = drive.at(np.arange(0, 19.9, 0.04))
    np.testing.assert_allclose(numbers[:, 0], 8.0 * np.arange(0, 19.9, 0.04), atol=1e-9)
    np.testing.assert_allclose(numbers[:, 1:], 0, atol=1e-9)


def test_turns_are_not_followed() -> None:
    """A quarter turn in 10 s of a circle: what is left is no more than the corner's smoothing."""
    yaw = np.interp(np.arange(200), [50, 150], [0, np.pi / 2])
    numbers = Recording.from_trajectory(recorded(yaw=yaw)).at(np.arange(200) / FPS)
    assert np.abs(numbers[:, 1]).max() < 0.2
    assert np.degrees(np.abs(numbers[:, 3]).max()) < 3
    np.testing.assert_allclose(np.diff(numbers[:, 0]), 0.8, atol=0.01)


@pytest.mark.parametrize(("column", "name", "size"), [(2, "y", 0.03), (3, "yaw", 0.01), (4, "pitch", 0.01)])
def test_wobble_is_followed(column: int, name: str, size: float) -> None:
    wave = sine(size, 1.0)
    numbers = Recording.from_trajectory(recorded(**{name: wave})).at(np.arange(200) / FPS)
    middle = slice(20, -20)
    np.testing.assert_allclose(numbers[middle, column], wave[middle], atol=0.2 * size)
    others = [other for other in (2, 3, 4, 5) if other != column]
    assert np.abs(numbers[middle][:, others]).max() < 0.02 * size


def test_wobble_is_bounded() -> None:
    wild = recorded(yaw=sine(0.5, 1.0), pitch=sine(0.3, 0.8), y=sine(1.0, 0.7))
    drive, limits = Recording.from_trajectory(wild), np.array(LIMITS)
    assert np.all(np.abs(drive.at(np.arange(200) / FPS)[:, 1:]) <= limits)
    between = np.abs(drive.at(np.arange(0, 19.9, 0.01))[:, 1:]).max(axis=0)
    assert np.all(between < 1.2 * limits)  # a cubic swings over its knots
    assert np.all(between[:4] > 0.8 * limits[:4])


def test_speed_is_followed_and_never_negative() -> None:
    speed = np.maximum(np.interp(np.arange(200), [0, 80, 120, 199], [10, -0.5, -0.5, 9]), -0.5)
    travelled = Recording.from_trajectory(recorded(speed=speed)).travelled(np.arange(200) / FPS)
    steps = np.diff(travelled)
    assert steps.min() == 0
    np.testing.assert_allclose(steps, np.maximum(speed[:-1], 0) / FPS, atol=1e-9)


def test_a_recording_continues_beyond_its_end() -> None:
    """Backwards, then forwards: what wobbles repeats, what is driven adds up, nothing jumps."""
    drive = Recording.from_trajectory(recorded(pitch=sine(0.01, 0.9, 50), speed=np.linspace(3, 9, 50), frames=50))
    t = np.arange(-12, 25, 0.01)
    numbers = drive.at(t)
    assert np.diff(numbers[:, 0]).min() > 0
    assert np.abs(np.diff(numbers, axis=0)).max(axis=0)[0] < 0.1
    assert np.abs(np.diff(numbers[:, 4])).max() < 1e-3
    end = 4.9
    np.testing.assert_allclose(drive.at(end + 0.73)[1:], drive.at(end - 0.73)[1:], atol=1e-12)
    np.testing.assert_allclose(drive.at(2 * end + 0.73)[1:], drive.at(0.73)[1:], atol=1e-12)
    length = float(drive.travelled(end))
    assert float(drive.travelled(2 * end + 0.73)) == pytest.approx(2 * length + float(drive.travelled(0.73)))


def test_streets_are_values() -> None:
    trajectory = recorded(pitch=sine(0.01, 0.9))
    for arguments in ((7,), (7, trajectory)):
        street, again = Street.generate(*arguments), Street.generate(*arguments)
        street.camera_pose(1.0)
        assert street == again
        assert hash(street) == hash(again)
        copy = pickle.loads(pickle.dumps(street))
        assert copy == street
        assert np.array_equal(copy.camera_pose(3.3), street.camera_pose(3.3))
    assert Street.generate(7) != Street.generate(7, trajectory)
    assert Street.generate(7).lane == Street.generate(7, trajectory).lane


@pytest.mark.parametrize(
    "drive", [Sway(9.0, 0.4), Recording.from_trajectory(recorded(speed=np.linspace(12, 0, 100), frames=100))]
)
def test_the_camera_hits_nobody(drive: Drive) -> None:
    """The nearest of its lane keeps a car's length of road free, at speed and at standstill."""
    traffic = Traffic(Layout(3, 5.5, 4.0), 3.3, drive)
    for t in np.arange(0, 30, 0.5):
        z = float(drive.travelled(t))
        lane = [mover for mover in traffic.movers(float(t), z - 80, z + 80) if mover.file.gap is not None]
        assert len(lane) >= 3
        assert min(abs(mover.position[2] - z) for mover in lane) > 0.75 * QUEUE_SPACING
        places = sorted(mover.position[2] for mover in lane)
        assert np.diff(places).min() > 5.0  # the longest car is 4.9 m


def test_a_real_drive() -> None:
    trajectory = read_poses(real("trajectories/06.txt"))
    street = Street.generate(0, trajectory)
    lengths = np.linalg.norm(np.diff(trajectory[:, :3, 3], axis=0), axis=1)
    poses = np.stack([street.camera_pose(i / FPS) for i in range(len(trajectory))])
    np.testing.assert_allclose(np.diff(poses[:, 2, 3]), lengths, atol=0.05)
    assert np.abs(poses[:, 0, 3] - street.lane / 2).max() < LIMITS[0]
    pitch = np.degrees(street.drive.at(np.arange(len(trajectory)) / FPS)[:, 4])
    assert 0.1 < pitch.std() < 0.4


@pytest.mark.parametrize(
    ("trajectory", "message"),
    [
        (np.eye(4), r"`trajectory` must be \[N, 4, 4\] with N of 2 or more, got \[4, 4\]"),
        (np.eye(4)[None], r"`trajectory` must be \[N, 4, 4\] with N of 2 or more, got \[1, 4, 4\]"),
        (np.stack([np.eye(4), 2 * np.eye(4)]), r"`trajectory\[1\]` must be a rigid transform"),
    ],
)
def test_refuses(trajectory: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Street.generate(0, trajectory)


def test_drawn_driving_is_forwards_varied_and_in_its_lane() -> None:
    drives = [Sway.drawn(np.random.default_rng(seed)) for seed in range(40)]
    t = np.arange(0, 60, 0.1)
    numbers = np.stack([drive.at(t) for drive in drives])
    steps = np.diff(numbers[..., 0], axis=1)
    assert steps.min() >= 0
    assert np.ptp([drive.speed for drive in drives]) > 8
    assert np.abs(numbers[..., 1]).max() < 0.6  # the room next to a car
    rates = np.degrees(np.diff(numbers[..., 3], axis=1)).std(axis=1)
    assert rates.max() > 4 * rates.min()


def test_drawn_speed_is_the_slope_of_its_way() -> None:
    drive = Sway(9.0, 1.3, amplitude=2.0, pace=1.5)
    t = np.arange(0, 300, 0.001)
    slope = np.gradient(drive.travelled(t), t)
    yaw_free = np.gradient(drive.at(t)[:, 1], t) / slope
    assert np.corrcoef(np.arctan(yaw_free), drive.at(t)[:, 3])[0, 1] > 0.7
    assert slope.mean() == pytest.approx(9.0, abs=0.1)
    assert 1.5 < np.abs(slope - 9.0).max() / np.abs(np.gradient(Sway(9.0, 1.3).travelled(t), t) - 9.0).max() < 2.2

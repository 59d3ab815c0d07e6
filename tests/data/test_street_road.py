"""Streets that bend, and cars that drive as cars do: the course, the driver, the body on its springs, the images."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from vestcl import opencl
from vestcl.data import Label, Street, intrinsics, street_clip
from vestcl.data.street.bent import world_from_street
from vestcl.data.street.driving import profile as street_profile
from vestcl.data.street.driving import road as street_road
from vestcl.data.street.driving.course import FARTHEST_HEADING, LATERAL_JERK, SMALLEST_RADIUS, Course
from vestcl.data.street.driving.drive import Sway
from vestcl.data.street.driving.road import JERK, RoadDrive
from vestcl.data.street.layout import BLOCK, Layout, anchored_block, block
from vestcl.data.street.raycast import Material

HEIGHT, WIDTH = 64, 208
K = intrinsics(HEIGHT, WIDTH)


def road(seed: int) -> Street:
    return dataclasses.replace(Street.generate(seed), drive=RoadDrive.drawn(seed))


# ---------------------------------------------------------------- the course


@pytest.mark.parametrize(("seed", "speed"), [(0, 8.0), (1, 14.0), (2, 22.0)])
def test_curvature_is_piecewise_linear_within_design_limits(seed: int, speed: float) -> None:
    course = Course(seed, speed)
    s = np.arange(-1500, 3000, 0.5)
    kappa = course.curvature(s)
    rate = np.diff(kappa) / 0.5
    assert (np.abs(np.diff(rate)) > 1e-9).sum() < 0.1 * len(s)  # it changes at knots only
    assert (kappa == 0).any() and (kappa > 0).any() and (kappa < 0).any()
    assert 1 / np.abs(kappa).max() >= SMALLEST_RADIUS - 1e-9
    assert np.abs(rate).max() * speed**3 <= LATERAL_JERK * (1 + 1e-6)
    assert np.abs(course.heading(s)).max() <= FARTHEST_HEADING + 0.01


def test_the_heading_is_the_direction_and_the_curvature_its_slope() -> None:
    course, s = Course(4, 9.0), np.arange(-300, 600, 0.01)
    x, z, theta = course.at(s).T
    np.testing.assert_allclose(np.gradient(x, s)[1:-1], np.sin(theta)[1:-1], atol=3e-5)
    np.testing.assert_allclose(np.gradient(z, s)[1:-1], np.cos(theta)[1:-1], atol=3e-5)
    np.testing.assert_allclose(np.gradient(theta, s)[1:-1], course.curvature(s)[1:-1], atol=3e-5)
    np.testing.assert_array_equal(course.at(0.0), [0, 0, 0])


def test_a_course_is_the_same_however_far_it_is_looked_at() -> None:
    course = Course(6, 12.0)
    near = course.at(np.arange(-50.0, 50.0))
    course.at(9000.0)
    np.testing.assert_array_equal(course.at(np.append(np.arange(-50.0, 50.0), 9000.0))[:-1], near)


def test_the_nearest_point() -> None:
    course = Course(3, 8.0)
    for s in (-700.0, 0.0, 512.3, 1400.0):
        x, z, theta = course.at(s)
        assert course.nearest(x + 5 * np.cos(theta), z - 5 * np.sin(theta)) == pytest.approx(s, abs=1e-6)


# ---------------------------------------------------------------- the driver and the body


def test_the_same_poses_at_the_same_times_at_any_rate() -> None:
    street = road(5)
    slow, fast = (street_clip(street, 1 + fps * 2, 8, 16, start=59.0, fps=fps) for fps in (8, 24))
    assert len(fast) == 49
    for one, other in zip(slow, fast[::3], strict=True):
        assert one.timestamp == pytest.approx(other.timestamp, abs=1e-12)
        np.testing.assert_allclose(one.world_from_cam, other.world_from_cam, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_speed_and_acceleration_stay_within_a_drivers(seed: int) -> None:
    drive = RoadDrive.drawn(seed)
    t = np.arange(-150, 90, 0.01)
    s, v, a = drive.state(t).T
    assert np.all(np.diff(s) >= 0) and v.min() >= 0 and v.max() < 1.02 * drive.speed
    np.testing.assert_allclose(np.gradient(s, t)[1:-1], v[1:-1], atol=0.03)
    assert a.max() <= drive.acceleration + 1e-9
    assert a.min() >= -1.3 * drive.deceleration - JERK * street_road.TICK - 1e-9
    assert np.ptp(v) > 2  # it brakes and accelerates
    bent = np.abs(v**2 * drive.course.curvature(s))
    assert bent.max() < 1.25 * drive.lateral
    assert drive.travelled(drive.time_at(77.0)) == pytest.approx(77.0, abs=1e-3)


def test_numbers_are_smooth_in_time() -> None:
    t = np.arange(-1.0, 31.0, 0.002)  # over the borders of stretches
    numbers = RoadDrive.drawn(8).at(t)
    assert np.abs(np.diff(numbers, 2, axis=0)).max() < 1e-4


def smooth(**changes: Any) -> RoadDrive:
    return dataclasses.replace(RoadDrive.drawn(11), roughness=1e-12, **changes)


def test_braking_dives_and_bends_lean_outward(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(street_profile, "BUMP_HEIGHT", 0.0)
    monkeypatch.setattr(street_road.RoadDrive, "_wander", lambda self, s: (0 * s, 0 * s, 0 * s))
    drive = smooth(seed=990011)
    t = np.arange(0, 60, 0.05)
    s, v, a = drive.state(t).T
    pitch, roll = drive.at(t)[:, 4:].T
    assert np.corrcoef(pitch, a)[0, 1] > 0.8 and np.polyfit(a, pitch, 1)[0] == pytest.approx(drive.pitch_gain, rel=0.2)
    sideways = v**2 * drive.course.curvature(s)
    assert np.corrcoef(roll, sideways)[0, 1] < -0.95
    assert np.polyfit(sideways, roll, 1)[0] == pytest.approx(-drive.roll_gain, rel=0.1)


def test_the_body_moves_as_much_as_on_real_roads() -> None:
    """KITTI odometry 00 and 06: pitch 0.15 and 0.31 degrees, roll 0.13 and 0.29; see `street_drive`."""
    spreads = np.array([RoadDrive.drawn(seed).at(np.arange(0, 40, 0.1))[:, 4:].std(axis=0) for seed in range(8)])
    assert np.all((np.degrees(np.median(spreads, axis=0)) > 0.1) & (np.degrees(np.median(spreads, axis=0)) < 0.4))


def test_the_profile_has_the_roughness_of_the_standard(monkeypatch: pytest.MonkeyPatch) -> None:
    """ISO 8608: the variance of a band of spatial frequencies is the integral of Gd(n0) (n / n0)^-2."""
    monkeypatch.setattr(street_profile, "BUMP_HEIGHT", 0.0)
    step, count = 0.1, 1 << 16
    height, _ = street_profile.profile(4, 16e-6, step * np.arange(count))
    power = 2 * np.abs(np.fft.rfft(height * np.hanning(count))) ** 2 * step / (0.375 * count)
    n = np.fft.rfftfreq(count, step)
    for low, high in ((0.03, 0.3), (0.3, 2.5)):
        band = (n > low) & (n < high)
        assert power[band].sum() * n[1] == pytest.approx(16e-6 * 0.01 * (1 / low - 1 / high), rel=0.25)


# ---------------------------------------------------------------- static and dynamic objects along it


def test_a_bent_street_has_the_same_parts() -> None:
    plan = Layout(3, 5.5, 4.0)
    straight, (pieces, anchors) = block(plan, 2), anchored_block(plan, 2)
    assert len(pieces) == len(anchors)
    kept = pieces["material"] != Material.PAVEMENT
    np.testing.assert_array_equal(pieces[kept], straight[straight["material"] != Material.PAVEMENT])
    assert anchors.min() >= 0 and anchors.max() <= BLOCK
    assert Street.generate(3).course is None and road(3).course is not None


def test_cars_keep_their_lanes_and_their_distance() -> None:
    street = road(9)
    traffic = street._traffic()
    before: dict[int, float] = {}
    for t in np.arange(20, 24, 0.5):
        s = float(street.drive.travelled(t))
        cars = [m for m in traffic.movers(t, s - 60, s + 300) if m.file.kind == "car"]
        for tag, side in ((1, 1), (2, -1)):
            lane = sorted(m.position[2] for m in cars if m.file.tag == tag)
            assert len(lane) > 3 and np.diff(lane).min() > 5
            for mover in (m for m in cars if m.file.tag == tag):
                assert traffic.position(mover, t) == pytest.approx(mover.position)
                moved = mover.position[2] - before.get(mover.instance, mover.position[2])
                assert -1e-6 < side * moved < 0.5 * 1.05 * street.drive.speed
                before[mover.instance] = mover.position[2]


@pytest.mark.parametrize(("seed", "t"), [(3, 10.0), (9, 30.0)])
def test_depth_poses_and_motion_agree_with_the_images(session: opencl.Session, seed: int, t: float) -> None:
    """What frame t shows, moved as `motion` says, is what is seen there at t + 0.1 s; of static parts rigidly so."""
    street, cameras = road(seed), []
    roll = np.eye(4)
    roll[:2, :2] = [[np.cos(0.04), -np.sin(0.04)], [np.sin(0.04), np.cos(0.04)]]  # beyond what springs do
    for time, extra in ((t, np.eye(4)), (t + 0.1, roll)):
        cameras.append(extra @ np.linalg.inv(street.camera_pose(time)))
    now, later = (
        street.render(camera, K, HEIGHT, WIDTH, time, instances=True)
        for camera, time in zip(cameras, (t, t + 0.1), strict=True)
    )
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    points = np.linalg.inv(K) @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1) * now.depth[0].reshape(1, -1)
    displacement = street.motion(*cameras, K, HEIGHT, WIDTH, t, t + 0.1).reshape(3, -1)
    next_from_cur = cameras[1] @ np.linalg.inv(cameras[0])
    rigid = next_from_cur[:3, :3] @ points + next_from_cur[:3, 3:]
    label = now.labels[0, 0].reshape(-1)
    static = (now.instances[0, 0].reshape(-1) == 0) & (label != Label.SKY)
    np.testing.assert_allclose((points + displacement)[:, static], rigid[:, static], atol=1e-3)
    moved = points + displacement
    seen = K @ moved
    columns, rows = np.floor(seen[:2] / np.maximum(seen[2], 1e-6)).astype(int)
    solid = np.isin(label, [Label.ROAD, Label.BUILDING, Label.SIDEWALK, Label.CAR]) & (moved[2] > 1) & (moved[2] < 60)
    inside = solid & (columns >= 0) & (columns < WIDTH) & (rows >= 0) & (rows < HEIGHT)
    found, wanted = later.depth[0, 0][rows[inside], columns[inside]], moved[2][inside]
    same = later.labels[0, 0][rows[inside], columns[inside]] == label[inside]
    assert same.mean() > 0.9  # the others are at an edge, or hidden by then
    ratio = (found / wanted)[same]
    assert np.median(np.abs(ratio - 1)) < 0.02 and (np.abs(ratio - 1) < 0.15).mean() > 0.95
    dynamic = inside & (now.instances[0, 0].reshape(-1) > 0) & (label == Label.CAR)
    assert dynamic.sum() > 20
    again = later.instances[0, 0][rows[dynamic], columns[dynamic]]
    assert (again == now.instances[0, 0].reshape(-1)[dynamic]).mean() > 0.9


def test_textures_stay_on_the_road(session: opencl.Session) -> None:
    """Seen straight down from 6 and 7 m, the road has the same colours: its texture does not follow the camera."""
    street, t, side = road(9), 30.0, 120
    assert street.course is not None
    there = world_from_street(street.course, float(street.drive.travelled(t)) + 8)
    frames = []
    for height in (6.0, 7.0):
        above = np.eye(4)
        above[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        above[:3, 3] = 1.7, -height, 0.0
        camera = np.array([[10 * height, 0, side / 2], [0, 10 * height, side / 2], [0, 0, 1]])
        frames.append(street.render(np.linalg.inv(there @ above), camera, side, side, t, samples=2, foreground=False))
    ground = np.all([frame.labels[0, 0] == Label.ROAD for frame in frames], axis=0)
    assert ground.mean() > 0.5
    one, other = (frame.colour[0][:, ground] for frame in frames)
    assert np.abs(one - other).mean() < 0.2 * one.std()


def test_the_default_drive_is_straight() -> None:
    assert isinstance(Street.generate(7).drive, Sway)
    assert road(7).drive == road(7).drive != road(8).drive

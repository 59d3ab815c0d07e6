"""`Street.motion`: by hand for what is static, drives and walks, and against what is rendered one step later."""

from typing import Any

import numpy as np
import pytest

from vestcl import opencl
from vestcl.data import STREET_SKY_DEPTH, Label, Street, intrinsics
from vestcl.data.street.driving.drive import world_from_camera

HEIGHT, WIDTH = 96, 320
K = intrinsics(HEIGHT, WIDTH)
STEP = 0.1


def camera(street: Street, t: float) -> np.ndarray:
    return np.linalg.inv(street.camera_pose(t))


def look(street: Street, t: float, pose: np.ndarray | None = None) -> Any:
    return street.render(camera(street, t) if pose is None else pose, K, HEIGHT, WIDTH, t, instances=True)


def move(street: Street, t_cur: float, t_next: float, cur: Any = None, after: Any = None) -> np.ndarray:
    cur = camera(street, t_cur) if cur is None else cur
    after = camera(street, t_next) if after is None else after
    return street.motion(cur, after, K, HEIGHT, WIDTH, t_cur, t_next)


def lift(depth: np.ndarray) -> np.ndarray:
    """[3, H, W] points of a depth map [1, H, W]."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)]) * depth.astype(np.float64)


def apply(dst_from_src: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.einsum("ij,jhw->ihw", dst_from_src[:3, :3], points) + dst_from_src[:3, 3, None, None]


@pytest.mark.parametrize("seed", [0, 3])
def test_what_is_static_moves_rigidly(session: opencl.Session, seed: int) -> None:
    street = Street.generate(seed)
    frame, displacement = look(street, 1.0), move(street, 1.0, 1.0 + STEP)
    assert displacement.shape == (3, HEIGHT, WIDTH)
    assert displacement.dtype == np.float32
    points = lift(frame.depth[0])
    rigid = apply(camera(street, 1.0 + STEP) @ street.camera_pose(1.0), points) - points
    still = (frame.instances[0, 0] == 0) & (frame.labels[0, 0] != Label.SKY)
    assert still.mean() > 0.5
    assert np.isin(frame.labels[0, 0][still], [Label.CAR]).any()  # parked
    np.testing.assert_allclose(displacement[:, still], rigid[:, still], atol=1e-4)
    moving = frame.instances[0, 0] > 0
    assert np.linalg.norm(displacement[:, moving] - rigid[:, moving], axis=0).min() > 0.05


def test_the_sky_only_turns(session: opencl.Session) -> None:
    street = Street.generate(1)
    frame = look(street, 0.0)
    sky = frame.labels[0, 0] == Label.SKY
    assert sky.sum() > 100
    cur = camera(street, 0.0)
    straight = np.eye(4)
    straight[:3, 3] = 0.3, -0.2, -1.0
    assert np.abs(move(street, 0.0, STEP, after=straight @ cur)[:, sky]).max() < 1e-9
    turn = world_from_camera(0.4, 0.0, 2.0, 0.05, 0.02, -0.01)
    points = lift(np.full((1, HEIGHT, WIDTH), STREET_SKY_DEPTH))
    turned = np.einsum("ij,jhw->ihw", turn[:3, :3], points) - points
    np.testing.assert_allclose(move(street, 0.0, STEP, after=turn @ cur)[:, sky], turned[:, sky], atol=1e-3)


def test_cars_and_people_by_hand(session: opencl.Session) -> None:
    """A static camera that looks along the road sees only u_z, each file's own speed."""
    street = Street.generate(0)
    level = np.eye(4)
    level[:3, 3] = -1.6, 1.65, 0.0
    frame, displacement = look(street, 0.0, level), move(street, 0.0, STEP, cur=level, after=level)
    tags = frame.instances[0, 0] >> 24
    speeds = {2: -0.9 * street.drive.speed, 3: 1.3, 4: -1.2, 5: -1.35, 6: 1.25}
    seen = [tag for tag in speeds if (tags == tag).any()]
    assert 2 in seen
    assert len(seen) > 2
    for tag in seen:
        np.testing.assert_allclose(displacement[2][tags == tag], STEP * speeds[tag], atol=1e-5)
    assert np.abs(displacement[0]).max() < 1e-6
    assert np.all(displacement[:, frame.instances[0, 0] == 0] == 0)


@pytest.mark.parametrize("seed", [0, 2])
def test_what_moved_is_found_where_it_should_be(session: opencl.Session, seed: int) -> None:
    """x + u, projected into the next camera, lies at the depth that is rendered there, on the same car or person."""
    street, found, asked = Street.generate(seed), 0, 0
    for t in (0.0, 1.5):
        frame, after = look(street, t), look(street, t + STEP)
        points = lift(frame.depth[0]) + move(street, t, t + STEP)
        moving = frame.instances[0, 0] > 0
        x, y, z = points[:, moving]
        column, row = np.floor(K[0, 0] * x / z + K[0, 2]), np.floor(K[1, 1] * y / z + K[1, 2])
        inside = (z > 0.5) & (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
        at = row[inside].astype(int), column[inside].astype(int)
        same = after.instances[0, 0][at] == frame.instances[0, 0][moving][inside]
        assert same.mean() > 0.8  # the others are at an edge, or hidden by then
        error = np.abs(after.depth[0, 0][at] / z[inside] - 1)[same]
        assert np.median(error) < 0.01
        found, asked = found + int((error < 0.03).sum()), asked + int(same.sum())
    assert asked > 300
    assert found / asked > 0.9


def test_there_and_back(session: opencl.Session) -> None:
    """The time may run backwards: seen from one camera, what a car does in a step it undoes in the step back."""
    street, pose = Street.generate(4), camera(Street.generate(4), 0.0)
    forth, back = (move(street, 0.0, t, cur=pose, after=pose) for t in (0.01, -0.01))
    np.testing.assert_allclose(forth, -back, atol=2e-4)
    assert np.abs(forth).max() > 0.05


def test_same_bits_twice(session: opencl.Session) -> None:
    assert np.array_equal(move(Street.generate(6), 2.0, 2.1), move(Street.generate(6), 2.0, 2.1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cur_from_world": np.eye(3)}, r"`cur_from_world` must be \[4, 4\], got \[3, 3\]"),
        ({"next_from_world": 2 * np.eye(4)}, "`next_from_world` must be a rigid transform"),
        ({"K": -np.eye(3)}, "`K` must have positive focal lengths"),
        ({"height": 0}, "`height` must be a positive integer, got 0"),
        ({"t_next": float("inf")}, "`t` must be one or 2 finite times"),
    ],
)
def test_refuses(changes: dict[str, Any], message: str) -> None:
    arguments = {
        "cur_from_world": np.eye(4),
        "next_from_world": np.eye(4),
        "K": K,
        "height": 8,
        "width": 8,
        "t_cur": 0.0,
        "t_next": 0.1,
    }
    with pytest.raises(ValueError, match=message):
        Street.generate(0).motion(**(arguments | changes))

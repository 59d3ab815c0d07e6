"""The procedural street: geometry by hand, the same image for a seed, and depth that agrees between cameras."""

from typing import Any

import numpy as np
import pytest
import torch

import vestcl
from vestcl import opencl
from vestcl.data import STREET_SKY_DEPTH, Label, Street, intrinsics
from vestcl.data.street.raycast import FOREGROUND
from vestcl.data.street.street import CAMERA_HEIGHT
from vestcl.io.labels import background

HEIGHT, WIDTH = 96, 320


def look(street: Street, t: float = 0.0, tgt_from_cam: np.ndarray | None = None, **changes: Any) -> Any:
    camera = np.linalg.inv(street.camera_pose(0.0))
    arguments = {
        "camera_from_world": camera if tgt_from_cam is None else tgt_from_cam @ camera,
        "K": intrinsics(HEIGHT, WIDTH),
        "height": HEIGHT,
        "width": WIDTH,
        "t": t,
    }
    return street.render(**(arguments | changes))


def shift(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    moved = np.eye(4)
    moved[:3, 3] = x, y, z
    return moved


def test_shapes_and_ranges(session: opencl.Session) -> None:
    frame = look(Street.generate(0))
    assert frame.colour.shape == (1, 3, HEIGHT, WIDTH)
    assert frame.depth.shape == frame.labels.shape == (1, 1, HEIGHT, WIDTH)
    assert frame.colour.min() >= 0
    assert frame.colour.max() <= 1
    assert set(np.unique(frame.labels)) <= {int(label) for label in Label}
    assert {Label.ROAD, Label.SIDEWALK, Label.BUILDING, Label.SKY, Label.CAR} <= set(np.unique(frame.labels))


def test_seed_decides(session: opencl.Session) -> None:
    first, again, other = (look(Street.generate(seed)) for seed in (3, 3, 4))
    assert np.array_equal(first.colour, again.colour)
    assert np.array_equal(first.depth, again.depth)
    assert not np.array_equal(first.colour, other.colour)


def test_depth_of_the_road_by_hand(session: opencl.Session) -> None:
    """A level camera sees flat road at z = h f / (v - cy)."""
    level = shift(x=-1.6, y=CAMERA_HEIGHT)
    frame, K = look(Street.generate(0), camera_from_world=level), intrinsics(HEIGHT, WIDTH)
    rows, columns = np.nonzero(frame.labels[0, 0] == Label.ROAD)
    by_hand = CAMERA_HEIGHT * K[1, 1] / (rows + 0.5 - K[1, 2])
    near = by_hand < 30
    assert near.sum() > 1000
    assert np.abs(frame.depth[0, 0][rows, columns][near] / by_hand[near] - 1).max() < 1e-3


def test_sky_is_far_and_only_sky_is(session: opencl.Session) -> None:
    frame = look(Street.generate(1))
    assert np.array_equal(frame.depth == STREET_SKY_DEPTH, frame.labels == Label.SKY)
    assert frame.depth.min() > 0.1


def test_a_camera_on_the_right_sees_objects_further_left(session: opencl.Session) -> None:
    """Points of the first camera, projected into the second, lie at the depth that is rendered there."""
    street, K = Street.generate(0), torch.from_numpy(intrinsics(HEIGHT, WIDTH)).float()[None]
    tgt_from_cam = shift(x=-0.5, z=-0.8)
    here, there = look(street), look(street, tgt_from_cam=tgt_from_cam)
    points = vestcl.unproject(torch.from_numpy(here.depth), K)
    pose = torch.from_numpy(tgt_from_cam).float()[None]
    uv, z = vestcl.displace(points, torch.zeros_like(points), K, pose)
    column, row = uv[0].floor().long().unbind(-1)
    seen = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT) & (z[0] > 0.1) & (z[0] < 100)
    depth = torch.from_numpy(there.depth)[0, 0][row[seen], column[seen]]
    agrees = ((depth - z[0][seen]) / z[0][seen]).abs() < 0.05
    assert float(agrees.float().mean()) > 0.9  # the rest is hidden from there, or at an edge
    colours = torch.from_numpy(here.colour)[0].flatten(1)[:, seen][:, agrees]
    matched = torch.from_numpy(there.colour)[0][:, row[seen][agrees], column[seen][agrees]]
    assert float((colours - matched).abs().median()) < 0.03


def test_time_moves_cars_and_nothing_else(session: opencl.Session) -> None:
    now, later = look(Street.generate(0)), look(Street.generate(0), t=0.4)
    changed = np.abs(now.depth - later.depth) > 0.05
    assert changed.any()
    movers = (Label.CAR, Label.PERSON)
    assert np.isin(now.labels[changed], movers).all() or np.isin(later.labels[changed], movers).mean() > 0.5
    building = (now.labels == Label.BUILDING) & (later.labels == Label.BUILDING)
    assert np.array_equal(now.depth[building], later.depth[building])


def test_batches_are_single_frames(session: opencl.Session) -> None:
    street = Street.generate(2)
    poses = np.stack([np.linalg.inv(street.camera_pose(t)) for t in (0.0, 0.5)])
    both = look(street, camera_from_world=poses, t=np.array([0.0, 0.5]))
    for i, t in enumerate((0.0, 0.5)):
        single = look(street, camera_from_world=poses[i], t=t)
        assert np.array_equal(both.colour[i], single.colour[0])
        assert np.array_equal(both.depth[i], single.depth[0])


def film_curve(light: np.ndarray) -> np.ndarray:
    """Linear light to a display's [0, 1], as `display` in kernels/raycast/raycast_light.h."""
    x = 0.7 * np.maximum(light, 0)
    return np.sqrt(np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1))


def light_of(colour: np.ndarray) -> np.ndarray:
    """Its inverse: of y = colour^2, the positive root of (2.51 - 2.43 y) x^2 + (0.03 - 0.59 y) x - 0.14 y = 0."""
    y = np.asarray(colour, np.float64) ** 2
    a, b, c = 2.51 - 2.43 * y, 0.03 - 0.59 * y, -0.14 * y
    return (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a) / 0.7


@pytest.mark.parametrize("samples", [2, 3])
def test_samples_are_averaged_in_linear_light(session: opencl.Session, samples: int) -> None:
    """An image ``samples`` times as large has one pixel for each ray."""
    street, size = Street.generate(1), (24, 80)
    small = look(street, K=intrinsics(*size), height=size[0], width=size[1], samples=samples)
    large = look(
        street,
        K=np.diag([samples, samples, 1.0]) @ intrinsics(*size),
        height=samples * size[0],
        width=samples * size[1],
    )
    rays = light_of(large.colour[0]).reshape(3, size[0], samples, size[1], samples)
    error = np.abs(film_curve(rays.mean(axis=(2, 4))) - small.colour[0])
    unclipped = rays.max(axis=(0, 2, 4)) < 5
    assert unclipped.mean() > 0.9
    # float32 puts a ray at a leaf's edge on one side or on the other, seldom.
    assert np.quantile(error[:, unclipped], 0.98) < 1e-3
    display_mean = large.colour[0].reshape(rays.shape).mean(axis=(2, 4))
    assert np.abs(display_mean - small.colour[0]).mean() > 4 * error.mean()


def test_samples_change_nothing_but_colour(session: opencl.Session) -> None:
    one, four = look(Street.generate(0)), look(Street.generate(0), samples=4)
    assert np.array_equal(one.depth, four.depth)
    assert np.array_equal(one.labels, four.labels)
    assert not np.array_equal(one.colour, four.colour)
    assert np.abs(one.colour - four.colour).mean() < 0.05


def test_foreground_is_what_the_labels_say() -> None:
    assert {label for label in Label if not background(np.array([label], np.uint8))[0]} == set(FOREGROUND)


@pytest.mark.parametrize("seed", [0, 5])
def test_background_without_foreground(session: opencl.Session, seed: int) -> None:
    """Bit for bit the whole street's where no foreground is, but for its shadows, and never nearer behind it."""
    whole, bare = look(Street.generate(seed)), look(Street.generate(seed), foreground=False)
    assert background(bare.labels).all()
    seen = background(whole.labels)
    assert 0.1 < (~seen).mean() < 0.9
    assert np.array_equal(whole.depth[seen], bare.depth[seen])
    assert np.array_equal(whole.labels[seen], bare.labels[seen])
    assert np.all(bare.depth[~seen] >= whole.depth[~seen])
    lightened = (bare.colour - whole.colour)[0][:, seen[0, 0]]
    assert lightened.min() >= -1e-6  # a shadow can only go
    assert 0.5 < np.all(lightened == 0, axis=0).mean() < 1
    far = seen & (whole.labels == Label.SKY)
    assert np.array_equal(whole.colour[0][:, far[0, 0]], bare.colour[0][:, far[0, 0]])


def test_instances_are_cars_and_people(session: opencl.Session) -> None:
    street = Street.generate(1)
    frame, later = look(street, instances=True), look(street, t=0.1, instances=True)
    plain = look(street)
    assert plain.instances is None
    assert np.array_equal(plain.colour, frame.colour)
    moving = frame.instances > 0
    assert frame.instances.min() == 0
    assert 0.005 < moving.mean() < 0.5
    assert np.isin(frame.labels[moving], (Label.CAR, Label.PERSON)).all()
    for name in np.unique(frame.instances[moving]):
        assert len(np.unique(frame.labels[frame.instances == name])) == 1
    large = [name for name in np.unique(frame.instances[moving]) if (frame.instances == name).sum() > 30]
    assert len(large) >= 2
    assert set(large) <= set(np.unique(later.instances))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"height": 0}, "`height` must be a positive integer, got 0"),
        ({"width": 2.5}, "`width` must be a positive integer, got 2.5"),
        ({"camera_from_world": np.eye(3)}, r"`camera_from_world` must be \[B, 4, 4\] or \[4, 4\], got \[3, 3\]"),
        ({"camera_from_world": 2 * np.eye(4)}, "`camera_from_world` must be rigid"),
        ({"K": np.eye(4)}, r"`K` must be \[1, 3, 3\] or \[3, 3\], got \[4, 4\]"),
        ({"K": -np.eye(3)}, "`K` must have positive focal lengths"),
        ({"t": float("nan")}, "`t` must be one or 1 finite times"),
        ({"samples": 0}, "`samples` must be a positive integer, got 0"),
    ],
)
def test_refuses(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        look(Street.generate(0), **changes)


@pytest.mark.parametrize("seed", [-1, 0.5, "0"])
def test_refuses_seeds(seed: Any) -> None:
    with pytest.raises(ValueError, match="`seed` must be a non-negative integer"):
        Street.generate(seed)

"""The ray caster by hand: single solids on the road, seen by a level camera 1.5 m above it that looks along z."""

import numpy as np
import pytest

from vestcl import opencl
from vestcl.data import STREET_SKY_DEPTH, Frame, Label
from vestcl.data.street import objects
from vestcl.data.street.raycast import SHADOW_CELL, SHADOW_REACH, Material, Scene, Shape, Solids, blank_frame, cast

EYE, FOCAL, HEIGHT, WIDTH = 1.5, 40.0, 48, 64
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
WHITE = (0.5, 0.5, 0.5)
NOON = (0.0, -1.0, 0.0)


def look(*solids: Solids, sun: tuple[float, float, float] = NOON, samples: int = 1, instances: bool = False) -> Frame:
    camera_from_world = np.eye(4)
    camera_from_world[1, 3] = EYE
    seen = objects.placed(np.concatenate(solids), 0.0, EYE, 0.0)
    scene = Scene(seen, np.zeros((0, 2), np.float32), sun, lane=3.0, kerb=5.0, seed=0)
    frame = blank_frame(1, HEIGHT, WIDTH, instances)
    cast(scene, camera_from_world, K, frame, 0, samples)
    return frame


def plain(shape: Shape, centre: objects.Vector, half_size: objects.Vector, taper: objects.Vector = (0, 0, 0)) -> Solids:
    return objects.solid(shape, Material.PLAIN, Label.POLE, centre, half_size, WHITE, taper)


def rays() -> tuple[np.ndarray, np.ndarray]:
    """x / z and y / z of every pixel's centre."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL


def test_box_by_hand(session: opencl.Session) -> None:
    """A box 2 m wide and high, its front 9 m ahead; next to it the road at z = h f / (v - cy), above it the sky."""
    frame = look(plain(Shape.BOX, (0.0, -1.0, 10.0), (1.0, 1.0, 1.0)))
    x, y = rays()
    front = (np.abs(x) < 1 / 9) & (y < EYE / 9) & (y > (EYE - 2) / 9)
    road = EYE / np.where(y > 0, y, np.inf)
    # Nothing of its side or top is seen but a strip of the top's far edge: the eye is lower than the box.
    expected = np.where(front, 9.0, np.where(y > 0, road, STREET_SKY_DEPTH))
    assert front.sum() > 60
    np.testing.assert_allclose(frame.depth[0, 0], expected, rtol=1e-5)
    labels = np.where(front, Label.POLE, np.where(y > 0, Label.ROAD, Label.SKY))
    assert np.array_equal(frame.labels[0, 0], labels)


def test_tapered_box_by_hand(session: opencl.Session) -> None:
    """A wedge: its back face slopes from z = 8 at the bottom to z = 10 at the top, 4 m up, where it is half as wide."""
    frame = look(plain(Shape.BOX, (0.0, -2.0, 10.0), (2.0, 2.0, 2.0), taper=(0.5, 0.0, 1.0)))
    x, y = rays()
    # z = 8 + (EYE - s y) / 2 on the slope, so s = (8 + EYE / 2) / (1 + y / 2); up is EYE - s y.
    s = (8 + EYE / 2) / (1 + y / 2)
    up = EYE - s * y
    inside = (up > 0.2) & (up < 3.8) & (np.abs(s * x) < 2 - up / 4 - 0.2)
    assert inside.sum() > 100
    np.testing.assert_allclose(frame.depth[0, 0][inside], s[inside], rtol=1e-5)
    outside = (up > 0.2) & (up < 3.8) & (np.abs(s * x) > 2 - up / 4 + 0.2)
    assert not np.any(frame.labels[0, 0][outside] == Label.POLE)


@pytest.mark.parametrize("shape", [Shape.ELLIPSOID, Shape.CYLINDER])
def test_round_solids_by_hand(session: opencl.Session, shape: Shape) -> None:
    """A ball of radius 1 m at the eye's height, or a post of it on the road and beyond the image, 10 m ahead."""
    ball = shape == Shape.ELLIPSOID
    frame = look(plain(shape, (0.0, -EYE if ball else -25.0, 10.0), (1.0, 1.0 if ball else 25.0, 1.0)))
    x, y = rays()
    across = x**2 + (y**2 if ball else 0)
    discriminant = 100 - 99 * (1 + across)  # of s^2 (1 + across) - 20 s + 99 = 0
    s = (10 - np.sqrt(np.maximum(discriminant, 0))) / (1 + across)
    hit = (discriminant > 0.1) & (s * y < EYE - 0.01)
    assert hit.sum() > 30
    np.testing.assert_allclose(frame.depth[0, 0][hit], s[hit], rtol=1e-4)
    assert np.all(frame.labels[0, 0][hit] == Label.POLE)
    assert not np.any(frame.labels[0, 0][discriminant < -0.1] == Label.POLE)


def test_a_turned_box_is_the_box_turned(session: opencl.Session) -> None:
    box = plain(Shape.BOX, (0.0, -1.0, 0.0), (1.0, 1.0, 3.0))
    quarter = look(objects.placed(box, 0.0, 0.0, 12.0, np.pi / 2))
    swapped = look(plain(Shape.BOX, (0.0, -1.0, 12.0), (3.0, 1.0, 1.0)))
    np.testing.assert_allclose(quarter.depth, swapped.depth, rtol=1e-4)


def test_what_is_nearer_hides(session: opencl.Session) -> None:
    near = plain(Shape.BOX, (0.0, -1.0, 6.0), (0.5, 1.0, 0.5))
    far = plain(Shape.ELLIPSOID, (0.5, -1.0, 12.0), (2.0, 1.0, 1.0))
    one, other, both, swapped = (look(*solids) for solids in ([near], [far], [near, far], [far, near]))
    assert np.array_equal(both.depth, np.minimum(one.depth, other.depth))
    assert np.array_equal(both.depth, swapped.depth)


def test_nothing_behind_or_around_the_camera_is_seen(session: opencl.Session) -> None:
    behind = plain(Shape.BOX, (0.0, -1.0, -5.0), (2.0, 2.0, 2.0))
    around = plain(Shape.ELLIPSOID, (0.0, -EYE, 0.0), (1.0, 1.0, 1.0))
    frame = look(behind, around)
    assert not np.any(frame.labels == Label.POLE)


def test_shadow_falls_away_from_the_sun(session: opencl.Session) -> None:
    """A post 2 m high under a sun at 45 degrees on the left: the road on its right is dark for 2 m."""
    half = np.sqrt(0.5)
    post = plain(Shape.BOX, (0.0, -1.0, 8.0), (0.2, 1.0, 0.2))
    lit, shaded = look(post), look(post, sun=(-half, -half, 0.0))
    x, y = rays()
    z = EYE / np.where(y > 0, y, np.inf)
    strip = (y > 0) & (np.abs(z - 8) < 0.5)
    row = np.nonzero(strip.any(axis=1))[0][0]
    metres = x[row] * z[row]
    brightness = shaded.colour[0].mean(0)[row] / lit.colour[0].mean(0)[row]
    dark, light = brightness[(metres > 0.4) & (metres < 1.7)], brightness[(metres < -0.4) | (metres > 2.5)]
    assert dark.size
    assert dark.max() < 0.8 * light.min()


def test_instances_by_hand(session: opencl.Session) -> None:
    """Of a box with a number, before one without: 7 on its front, 0 on the other, the road and the sky."""
    front = plain(Shape.BOX, (0.0, -1.0, 10.0), (1.0, 1.0, 1.0))
    front["instance"] = 7
    frame = look(plain(Shape.BOX, (0.0, -1.0, 14.0), (4.0, 1.0, 1.0)), front, instances=True)
    assert frame.instances is not None
    assert np.array_equal(
        frame.instances[0, 0] == 7, frame.depth[0, 0] < np.where(frame.labels[0, 0] == Label.POLE, 10, 0)
    )
    assert set(np.unique(frame.instances)) == {0, 7}


def test_samples_cover_part_of_a_pixel(session: opencl.Session) -> None:
    """A far post 1.5 pixels wide: many rays see it in part of its two columns, one ray in all or nothing of them."""
    post = plain(Shape.BOX, (0.0, -25.0, 20.0), (0.375, 25.0, 0.01))
    one, many = look(post), look(post, samples=4)
    row = 6  # above the horizon, where the sky is even
    columns = slice(WIDTH // 2 - 3, WIDTH // 2 + 3)
    sky, dark = one.colour[0, 2, row, columns].max(), one.colour[0, 2, row, columns].min()
    between = (many.colour[0, 2, row, columns] < sky - 0.02) & (many.colour[0, 2, row, columns] > dark + 0.02)
    assert sky - dark > 0.1
    assert between.sum() == 2
    assert not np.any((one.colour[0, 2, row, columns] < sky - 0.02) & (one.colour[0, 2, row, columns] > dark + 0.02))


def test_shadows_reach_over_the_whole_grid() -> None:
    assert SHADOW_REACH % SHADOW_CELL == 0


def test_same_bits_twice(session: opencl.Session) -> None:
    solids = objects.tree(np.random.default_rng(0)), objects.car(np.random.default_rng(1))
    placed = [objects.placed(part, x, 0.0, 9.0, 0.3) for part, x in zip(solids, (1.5, -1.5), strict=True)]
    for samples in (1, 2):
        first, second = look(*placed, samples=samples), look(*placed, samples=samples)
        assert np.array_equal(first.colour, second.colour)
        assert np.array_equal(first.depth, second.depth)

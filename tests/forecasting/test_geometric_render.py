"""vestcl.forecasting.geometric.render: planes on new views, by hand."""

import dataclasses

import numpy as np
import pytest
import torch
from data_files import pose
from geometric_scenes import HEIGHT, WIDTH, Floats, K, Matrix, cloud_of, decibels, flat, noise, planes, room

from vestcl.forecasting.geometric.frame_cloud import FrameCloud
from vestcl.forecasting.geometric.render import Shown, holes, rendered, show
from vestcl.scene.flow.optical_flow import backward_warp

EYE = np.eye(4)
RED, GREEN, BLUE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
LEFT = np.broadcast_to(np.arange(WIDTH) < 160, (HEIGHT, WIDTH))


def colour(rgb: tuple[float, float, float]) -> Floats:
    return np.broadcast_to(planes(*rgb), (3, HEIGHT, WIDTH))


def seen(*clouds: FrameCloud, tgt_from_next: Matrix = EYE) -> Shown:
    return show(list(clouds), K, tgt_from_next, HEIGHT, WIDTH)


# ---------------------------------------------------------------- one cloud


def test_at_rest_the_image_stays() -> None:
    image, depth = noise(), room()
    shown = seen(cloud_of(image, depth))
    assert shown.planes.shape == (7, HEIGHT, WIDTH) and shown.planes.dtype == np.float32
    sides = (slice(None), slice(1, -1), slice(1, -1))  # a corner has three neighbours, if none is torn off
    np.testing.assert_allclose(shown.planes[:3][sides], image[sides], atol=1e-3)
    np.testing.assert_allclose(1 / shown.planes[3:4][sides], depth[sides], rtol=1e-3)
    assert shown.coverage.min() > 0.9 and shown.coverage.max() <= 1


def test_no_cracks_in_a_wall_that_comes_nearer() -> None:
    """Zoomed by 1.3, a wall stays covered, and looks as the image warped backwards."""
    image, zoom = noise(blur=2.0), 1.3
    ahead = pose(xyz=(0, 0, 10 / zoom - 10))
    shown = seen(cloud_of(image, flat(10)), tgt_from_next=ahead)
    assert shown.coverage.min() > 0.7
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    flow_uv = np.stack([(x - K[0, 2]) * (1 / zoom - 1), (y - K[1, 2]) * (1 / zoom - 1)])
    warped = backward_warp(torch.from_numpy(image)[None], torch.from_numpy(flow_uv)[None].float())[0].numpy()
    assert decibels(shown.planes[:3], warped) > 30


@pytest.mark.parametrize("zoom", [0.8, 1.0, 1.3, 2.0])
def test_colour_is_divided_by_coverage(zoom: float) -> None:
    """All of one colour stays that colour, however thinly it is covered."""
    shown = seen(cloud_of(colour((0.2, 0.5, 0.9)), flat(10)), tgt_from_next=pose(xyz=(0, 0, 10 / zoom - 10)))
    there = ~holes(shown)[0]
    assert there.mean() > 0.6
    np.testing.assert_allclose(shown.planes[:3, there], colour((0.2, 0.5, 0.9))[:, there], atol=1e-5)


@pytest.mark.parametrize("zoom", [0.4, 1.0, 3.2, 6.0])
def test_a_camera_with_another_focal_length_sees_the_same_wall(zoom: float) -> None:
    image = noise(blur=2.0)
    cloud = dataclasses.replace(cloud_of(image, flat(10)), focal=K[0, 0])
    zoomed = np.diag([zoom, zoom, 1]) @ K
    zoomed[:2, 2] = K[:2, 2]
    shown = show([cloud], zoomed, EYE, HEIGHT, WIDTH)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    at = np.stack([(x - K[0, 2]) * (1 / zoom - 1), (y - K[1, 2]) * (1 / zoom - 1)])
    warped = backward_warp(torch.from_numpy(image)[None], torch.from_numpy(at)[None].float())[0].numpy()
    there = (np.abs(x - K[0, 2]) < 0.9 * zoom * WIDTH / 2) & (np.abs(y - K[1, 2]) < 0.9 * zoom * HEIGHT / 2)
    assert shown.coverage[0][there].min() > 0.7
    assert decibels(shown.planes[:3, there], warped[:, there]) > 30


def test_inverse_depth_and_motion() -> None:
    """From 2 m further on; the motion is as it was given."""
    shown = seen(cloud_of(noise(), flat(10), step_xyz=(0.5, -0.25, -2.0)), tgt_from_next=pose(xyz=(0, 0, -2)))
    np.testing.assert_allclose(shown.planes[3], 1 / 8, rtol=1e-5)
    np.testing.assert_allclose(shown.planes[4:], np.broadcast_to(planes(0.5, -0.25, -2), (3, HEIGHT, WIDTH)), atol=1e-5)


def test_a_camera_to_the_right_sees_objects_further_left() -> None:
    """By f t / z = 190 x 0.5 / 9.5 = 10 px."""
    image = noise()
    shown = seen(cloud_of(image, flat(9.5)), tgt_from_next=pose(xyz=(-0.5, 0, 0)))
    np.testing.assert_allclose(shown.planes[:3, 1:-1, 1:-12], image[:, 1:-1, 11:-2], atol=1e-3)
    assert holes(shown)[:, :, -9:].all() and not holes(shown)[:, :, :-11].any()


@pytest.mark.parametrize("tgt_from_next", [pose(xyz=(0, 0, -20)), pose(xyz=(100, 0, 0))])
def test_what_is_behind_or_next_to_the_camera_is_not_seen(tgt_from_next: Matrix) -> None:
    shown = seen(cloud_of(noise(), flat(10)), tgt_from_next=tgt_from_next)
    assert not shown.planes.any() and not shown.coverage.any() and holes(shown).all()


# ---------------------------------------------------------------- several clouds


def test_trust_comes_before_depth() -> None:
    """The first cloud, left and far, hides what the second has before it."""
    far, near = cloud_of(colour(RED), flat(20), which=LEFT), cloud_of(colour(BLUE), flat(5))
    shown = seen(far, near)
    np.testing.assert_allclose(shown.planes[:3, :, :158], colour(RED)[..., :158], atol=1e-5)
    np.testing.assert_allclose(shown.planes[:3, :, 162:], colour(BLUE)[..., 162:], atol=1e-5)
    np.testing.assert_allclose(shown.planes[3, :, :158], 1 / 20, rtol=1e-4)
    assert np.allclose(seen(near, far).planes[:3], colour(BLUE), atol=1e-5)


def test_a_third_cloud_fills_what_two_leave_open() -> None:
    thirds = [np.broadcast_to(np.arange(WIDTH) // 108 == third, (HEIGHT, WIDTH)) for third in range(3)]
    clouds = [cloud_of(colour(rgb), flat(9), which=w) for rgb, w in zip((RED, GREEN, BLUE), thirds, strict=True)]
    shown = seen(*clouds)
    for rgb, third in zip((RED, GREEN, BLUE), range(3), strict=True):
        middle = shown.planes[:3, 5:-5, 108 * third + 5 : min(108 * third + 103, WIDTH - 5)]
        np.testing.assert_allclose(middle, np.broadcast_to(planes(*rgb), middle.shape), atol=1e-4)


def test_coverage_is_what_any_cloud_covers() -> None:
    """1 - (1 - c_1)(1 - c_2)."""
    first, second = cloud_of(noise(), flat(10), which=LEFT), cloud_of(noise(), flat(12))
    ahead = pose(xyz=(0, 0, -3))
    one, two = (seen(cloud, tgt_from_next=ahead).coverage for cloud in (first, second))
    both = seen(first, second, tgt_from_next=ahead).coverage
    np.testing.assert_allclose(both, 1 - (1 - one) * (1 - two), atol=1e-6)
    assert (one[..., 200:] == 0).all() and one[..., 10:150].min() > 0.5


def test_a_cloud_of_no_points_changes_nothing() -> None:
    cloud, none = cloud_of(noise(), room()), cloud_of(noise(), room(), which=np.zeros((HEIGHT, WIDTH), bool))
    for clouds in ((none, cloud), (cloud, none)):
        assert np.array_equal(seen(*clouds).planes, seen(cloud).planes)
    assert not seen(none).coverage.any() and not seen().planes.any()


# ---------------------------------------------------------------- spray and thin objects


def edge_with_spray() -> tuple[Floats, Floats]:
    """A green box at 5 m before a blue wall at 20 m; at its left a column of red, at depths in between."""
    image, depth = colour(BLUE).copy(), flat(20)
    image[:, 20:80, 100:200], depth[:, 20:80, 100:200] = planes(*GREEN), 5
    image[:, 20:80, 99:100] = planes(*RED)
    depth[:, 20:80, 99] = 1 / np.random.default_rng(0).uniform(0.07, 0.18, 60)
    return image, depth


def test_no_cracks_in_a_wall_that_turns_towards_the_camera() -> None:
    """A wall along the road, 2 m to the right: from 2 m further left its columns are twice as far apart, no nearer."""
    ray = np.broadcast_to((np.arange(WIDTH) + 0.5 - K[0, 2]) / K[0, 0], (HEIGHT, WIDTH))
    wall = (ray > 0.1) & (ray < 0.4)
    depth = np.where(wall, 2 / np.maximum(ray, 0.1), 1000).astype(np.float32)[None]
    covered = (
        seen(cloud_of(colour((1, 1, 1)), depth, which=wall), tgt_from_next=pose(xyz=(2.0, 0.0, 0.0))).coverage[0] > 0.5
    )
    rows = covered[HEIGHT // 2 - 10 : HEIGHT // 2 + 10]
    first, last = rows.any(0).nonzero()[0][[0, -1]]
    assert last - first > 0.5 * K[0, 0] and rows[:, first + 2 : last - 1].all()


def test_no_cracks_in_the_road_that_comes_close() -> None:
    """A road 1.5 m below, after 12 m: what was 17 m away is at the lower border, its rows 10 px apart."""
    ray = np.broadcast_to(((np.arange(HEIGHT) + 0.5 - K[1, 2]) / K[1, 1])[:, None], (HEIGHT, WIDTH))
    depth = np.where(ray > 0, 1.5 / np.maximum(ray, 1e-3), 1000).astype(np.float32)[None]
    road = cloud_of(colour((1, 1, 1)), depth, which=ray > 0)
    shown = seen(road, tgt_from_next=pose(xyz=(0.0, 0.0, -12.0)))
    assert shown.coverage[0, HEIGHT // 2 + 5 :, 2:-2].min() > 0.9


def test_spray_is_suppressed() -> None:
    """The camera steps 0.7 m to the left, the box 20 px further than the wall: of the red, little is left between."""
    shown = seen(cloud_of(*edge_with_spray()), tgt_from_next=pose(xyz=(0.7, 0, 0)))
    red = (shown.planes[0] > 0.5)[20:80]
    assert red.sum() < 0.2 * 60
    assert (shown.planes[1] > 0.5)[25:75, 128:220].mean() > 0.95  # the box itself is whole


@pytest.mark.parametrize("width", [1, 2, 3])
def test_a_pole_is_kept(width: int) -> None:
    """At 5 m before a wall at 20 m, seen from 0.35 m to the left: 10 px from where it stood before the wall."""
    image, depth = colour(BLUE).copy(), flat(20)
    pole = np.s_[:, 10:86, 150 : 150 + width]
    image[pole], depth[pole] = 1, 5
    shown = seen(cloud_of(image, depth), tgt_from_next=pose(xyz=(0.35, 0, 0)))
    moved = round(K[0, 0] * 0.35 / 5)
    white = (shown.planes[0] > 0.5)[12:84, 148 + moved : 152 + moved + width]
    assert white.any(axis=1).mean() > 0.95


# ---------------------------------------------------------------- as a forecast holds it


def test_rendered() -> None:
    shown = seen(cloud_of(noise(), flat(10), which=LEFT, step_xyz=(1.0, 0.0, 0.0)))
    image = np.full((3, HEIGHT, WIDTH), 1.5, np.float32)
    result, hole = rendered(shown, image), holes(shown)
    assert hole[..., 162:].all() and not hole[..., 1:159].any()
    assert (result.image == 1).all() and np.array_equal(result.coverage, shown.coverage)
    np.testing.assert_allclose(result.depth[~hole], 10, rtol=1e-5)
    assert not result.depth[hole].any() and not result.motion_xyz[:, hole[0]].any()
    np.testing.assert_allclose(result.motion_xyz[0][~hole[0]], 1, rtol=1e-5)


def test_same_bits_twice() -> None:
    clouds, aside = (cloud_of(noise(), room()), cloud_of(noise(seed=1), flat(30))), pose(0.02, (0.3, 0, -0.8))
    assert np.array_equal(seen(*clouds, tgt_from_next=aside).planes, seen(*clouds, tgt_from_next=aside).planes)


@pytest.mark.parametrize("share", [1.0, 0.8, 0.2])
def test_wanted_pixels_are_the_same_bits_as_in_the_whole_view(share: float) -> None:
    """Of dense and sparse clouds, two of them; all else is 0. Pixels at the border and none at all are cases, too."""
    rng = np.random.default_rng(3)
    which = rng.random((HEIGHT, WIDTH)) < share
    moved = pose(0.05, (0.4, 0.0, -0.5))
    clouds = [cloud_of(noise(), room(), which=which, dst_from_src=moved), cloud_of(noise(seed=1), room())]
    whole = show(clouds, K, EYE, HEIGHT, WIDTH)
    for where in (rng.random((1, HEIGHT, WIDTH)) < 0.01, holes(whole), np.zeros((1, HEIGHT, WIDTH), bool)):
        where[:, 0] = where.any()
        some = show(clouds, K, EYE, HEIGHT, WIDTH, where=where)
        assert np.array_equal(some.planes, np.where(where, whole.planes, 0))
        assert np.array_equal(some.coverage, np.where(where, whole.coverage, 0))

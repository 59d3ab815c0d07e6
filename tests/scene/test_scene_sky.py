"""vestcl.scene.sky on images made for it, on the street, and on real ones."""

import numpy as np
import pytest
from data_files import real
from numpy.typing import NDArray

from vestcl.data.open import open_sequence
from vestcl.data.street.street import Street, intrinsics
from vestcl.forecasting.geometric import Perception
from vestcl.io import read_image
from vestcl.io.depth import read_depth
from vestcl.io.labels import SKY, read_train_ids
from vestcl.scene.sky import sky_mask

HEIGHT, WIDTH = 64, 160
BUILDING, ROAD = 2, 0

#: Of the depth PNGs of kitti_clip.
UNITS_PER_METRE = 256


def horizon() -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Even light blue above row 25, dark noise below: the image, and where its sky is."""
    image = np.random.default_rng(0).random((3, HEIGHT, WIDTH), np.float32) * np.float32(0.3)
    image[:, :25] = np.array([0.6, 0.75, 0.95], np.float32)[:, None, None]
    return image, np.arange(HEIGHT)[None, :, None] < np.full((1, 1, WIDTH), 25)


def overlap(found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    return float((found & truth).sum() / (found | truth).sum())


def test_even_and_bright_above_the_horizon() -> None:
    image, truth = horizon()
    found = sky_mask(image)
    assert found.shape == (1, HEIGHT, WIDTH) and found.dtype == np.bool_
    assert overlap(found, truth) > 0.9


def test_what_does_not_reach_the_upper_border_is_none() -> None:
    image, _ = horizon()
    image[:, :4] = 0.05
    assert not sky_mask(image).any()


def test_a_bright_wall_is_identified_by_its_depth() -> None:
    image, _ = horizon()
    depth = np.full((1, HEIGHT, WIDTH), 12, np.float32)
    assert not sky_mask(image, depth).any()


def test_sky_with_depths_far_away_is_sky() -> None:
    image, truth = horizon()
    depth = np.where(truth, np.float32(400), np.float32(12))
    assert overlap(sky_mask(image, depth), truth) > 0.9


def matched(left: float, right: float) -> NDArray[np.float32]:
    """[1, H, W] m, as a stereo pair fills an even region: from one rim's depth to the other's."""
    return np.broadcast_to(np.geomspace(left, right, WIDTH, dtype=np.float32), (1, HEIGHT, WIDTH)).copy()


@pytest.mark.parametrize(
    ("left", "right", "is_sky"), [(12, 90, True), (14, 18, False), (6, 9, False), (6, 24, False), (150, 180, True)]
)
def test_the_sky_of_a_stereo_pair_has_no_surface(left: float, right: float, is_sky: bool) -> None:
    """A white wall or a lorry has one depth, and a lorry is near; far is far."""
    image, truth = horizon()
    found = sky_mask(image, matched(left, right), matched=True)
    assert overlap(found, truth) > 0.9 if is_sky else not found.any()
    assert not sky_mask(image, matched(left, right)).any() or left > 80


def test_the_sky_of_a_stereo_pair_is_above_the_road() -> None:
    """A white wall at the side is none next to the sky, nor without it, however its matched depths vary."""
    image, truth = horizon()
    wall = np.s_[:, :25, 130:]
    image[wall] = 1.0
    image[:, :25, 128:130], truth[:, :, 128:] = 0.05, False
    depth = matched(12, 90)
    depth[wall] = np.linspace(8, 44, WIDTH - 130, dtype=np.float32)
    assert overlap(sky_mask(image, depth, matched=True), truth) > 0.9
    image[:, :25, :128] = np.random.default_rng(0).random((3, 25, 128)) * 0.3
    assert not sky_mask(image, depth, matched=True).any()


def test_without_any_match_the_sky_is_found_as_before() -> None:
    image, truth = horizon()
    for depth in (None, np.zeros((1, HEIGHT, WIDTH), np.float32)):
        assert overlap(sky_mask(image, depth, matched=True), truth) > 0.9


@pytest.mark.parametrize(("name", "index"), [("kitti_odometry", 15), ("kitti_odometry_00", 45)])
def test_kitti_stereo_spares_white_walls(name: str, index: int) -> None:
    """Both images have white walls that touch the upper border, brighter than the sky."""
    perception = Perception(open_sequence(real(name)))
    found, image = perception._sky(index, perception.raw_depth(index))[0], perception.image(index)[0]
    assert 0.04 < found.mean() < 0.13 and not (found & (image > 0.97)).any() and not found[200:].any()


def test_nothing_below_where_a_car_looks() -> None:
    assert not sky_mask(np.full((3, HEIGHT, WIDTH), 0.9, np.float32))[:, HEIGHT * 3 // 4 :].any()


def test_no_sky_in_noise() -> None:
    assert not sky_mask(np.random.default_rng(0).random((3, HEIGHT, WIDTH), np.float32)).any()


@pytest.mark.parametrize("seed", [2001, 2003, 2004])
def test_the_street_with_its_depth(seed: int) -> None:
    """Depth 0 in the sky, as a scanner has it. These skies have no clouds, which are rough and would be missed."""
    street = Street.generate(seed)
    time = 1.0 + seed % 7
    frame = street.render(np.linalg.inv(street.camera_pose(time)), intrinsics(192, 624), 192, 624, time)
    truth = frame.labels[0] == SKY
    found = sky_mask(frame.colour[0], np.where(truth, np.float32(0), frame.depth[0]))
    assert overlap(found, truth) > 0.9
    assert (found & (frame.labels[0] == BUILDING)).sum() < 0.005 * (frame.labels[0] == BUILDING).sum()


@pytest.mark.parametrize("index", [0, 24])
def test_kitti_in_colour_spares_houses_and_road(index: int) -> None:
    folder = real("kitti_clip")
    image = read_image(folder / "image" / f"{index:06d}.jpg")
    depth = read_depth(folder / "depth" / f"{index:06d}.png", UNITS_PER_METRE)[None]
    labels = read_train_ids(folder / "labels" / f"{index:06d}.png", "trainIds")[None]
    found = sky_mask(image, depth)
    assert found.any()
    assert (found & (labels == SKY)).sum() > 0.85 * found.sum() - 0.01 * found.size
    for kind in (BUILDING, ROAD):
        assert (found & (labels == kind)).sum() < 0.02 * max((labels == kind).sum(), 1)


def test_arguments() -> None:
    image, _ = horizon()
    with pytest.raises(ValueError, match=r"`image` must be \[3, H, W\]"):
        sky_mask(image[:1])
    with pytest.raises(ValueError, match=r"`depth` must be \[1, 64, 160\]"):
        sky_mask(image, np.ones((1, 8, 8), np.float32))
    with pytest.raises(ValueError, match="`image` must be finite"):
        sky_mask(np.full_like(image, np.nan))

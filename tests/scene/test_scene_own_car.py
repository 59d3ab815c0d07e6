"""vestcl.scene.own_car: a bonnet is found where there is one."""

import cv2
import numpy as np
import pytest
from data_files import real

from vestcl.data.open import open_sequence
from vestcl.forecasting.geometric import Perception
from vestcl.scene.own_car import PAIRS, own_car

HEIGHT, WIDTH = 180, 320


def road(seed: int = 0) -> np.ndarray:
    """[600, W] grey: texture that is coarse enough to be followed."""
    noise = np.random.default_rng(seed).random((600, WIDTH)).astype(np.float32)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return ((blurred - blurred.min()) / np.ptp(blurred)).astype(np.float32)


def frames(count: int, shift: int, rim: int | None) -> list[np.ndarray]:
    """[3, H, W], the newest first: a texture that moves down by ``shift`` px per frame, below ``rim`` a bonnet."""
    images = []
    for back in range(count):
        start = 200 + shift * back
        image = road()[start : start + HEIGHT].copy()
        if rim is not None:
            arch = rim + 8 * np.square(np.linspace(-1, 1, WIDTH))
            image = np.where(np.arange(HEIGHT)[:, None] >= arch, np.float32(0.05), image)
        images.append(np.stack([image] * 3))
    return images


@pytest.mark.parametrize("shift", [3, 7])
def test_what_stays_while_the_road_moves_is_the_bonnet(shift: int) -> None:
    found = own_car(frames(4, shift, 160))[0]
    wanted = np.arange(HEIGHT)[:, None] >= 160 + 8 * np.square(np.linspace(-1, 1, WIDTH))
    assert (found == wanted).mean() > 0.97 and found[165:].mean() > 0.97 and not found[:155].any()


@pytest.mark.parametrize(("shift", "rim"), [(3, None), (0, None), (0, 160)])
def test_nothing_without_a_bonnet_or_without_motion(shift: int, rim: int | None) -> None:
    assert not own_car(frames(4, shift, rim)).any()


def test_two_images_are_too_few() -> None:
    assert not own_car(frames(PAIRS, 3, 160)).any() and own_car(frames(PAIRS + 1, 3, 160)).any()


def test_a_lane_line_along_its_own_motion_is_no_bonnet() -> None:
    """A solid line looks the same in all frames, as bare asphalt does."""
    image = np.full((3, HEIGHT, WIDTH), 0.3, np.float32)
    column = np.arange(WIDTH)[None] - 60 - np.arange(HEIGHT)[:, None]
    image[:, np.abs(column) < 3] = 0.9
    assert not own_car([image] * 4).any()


def test_the_motorway_shows_one_and_other_clips_do_not() -> None:
    for name, index, least, most in (
        ("motorway.mp4", 14, 0.04, 0.09),
        ("highway.mp4", 60, 0, 0),
        ("kitti_clip", 20, 0, 0),
    ):
        perception = Perception(open_sequence(real(name)))
        assert least <= perception.own(index).mean() <= most, name

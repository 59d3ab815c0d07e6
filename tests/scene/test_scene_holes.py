"""vestcl.scene.inpainting.holes: what fills a hole, and that nothing else changes."""

import numpy as np
import pytest

from vestcl.scene.inpainting.holes import deep_holes, fill_holes

HEIGHT, WIDTH = 45, 64


def scene(first: int = 22) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Red at 5 m to the left of a hole of 20 columns, blue at 50 m to its right: image, inverse depth, hole."""
    left = np.arange(WIDTH) < first + 10
    image = np.zeros((3, HEIGHT, WIDTH), np.float32)
    image[0, :, left], image[2, :, ~left] = 1, 1
    inverse = np.broadcast_to(np.where(left, 0.2, 0.02), (1, HEIGHT, WIDTH)).astype(np.float32)
    hole = np.zeros((1, HEIGHT, WIDTH), bool)
    hole[:, 10:35, first : first + 20] = True
    return image, inverse, hole


@pytest.mark.parametrize("first", range(16, 32, 3))
def test_the_far_side_fills_most_of_the_hole(first: int) -> None:
    """Weights of (0.2 + 0.01)^-2 against (0.02 + 0.01)^-2, one in 50; of one depth, either side takes half."""
    image, inverse, hole = scene(first)
    inside = np.s_[:, 18:27, first : first + 20]
    red, _, blue = fill_holes(image, inverse, hole)[inside].mean((1, 2))
    assert blue > 0.6 and red < 0.4
    even = fill_holes(image, np.full_like(inverse, 0.1), hole)[inside].mean((1, 2))
    np.testing.assert_allclose(even, [0.5, 0, 0.5], atol=0.15)


def test_outside_the_hole_nothing_changes() -> None:
    image, inverse, hole = scene()
    filled = fill_holes(image, inverse, hole)
    assert filled.dtype == np.float32 and filled.shape == image.shape
    assert np.array_equal(filled[:, ~hole[0]], image[:, ~hole[0]])


def test_what_is_in_the_hole_does_not_matter() -> None:
    image, inverse, hole = scene()
    other, elsewhere = np.where(hole, np.float32(np.nan), image), np.where(hole, np.float32(9), inverse)
    assert np.array_equal(fill_holes(image, inverse, hole), fill_holes(other, elsewhere, hole))


def test_a_slope_continues_through_the_hole() -> None:
    slope = np.broadcast_to(np.linspace(0, 1, WIDTH, dtype=np.float32), (1, HEIGHT, WIDTH))
    _, inverse, hole = scene()
    filled = fill_holes(slope, np.full_like(inverse, 0.1), hole)
    assert np.abs(filled - slope).max() < 0.15
    assert filled.min() >= 0 and filled.max() <= 1


@pytest.mark.parametrize("channels", [1, 2, 3, 6])
def test_all_of_one_colour(channels: int) -> None:
    _, inverse, hole = scene()
    image = np.broadcast_to(np.linspace(0.2, 0.7, channels, dtype=np.float32)[:, None, None], (channels, HEIGHT, WIDTH))
    np.testing.assert_allclose(fill_holes(image, inverse, hole), image, atol=1e-5)


def test_one_pixel_fills_everything() -> None:
    image, inverse = np.zeros((3, HEIGHT, WIDTH), np.float32), np.full((1, HEIGHT, WIDTH), 10.0, np.float32)
    hole = np.ones((1, HEIGHT, WIDTH), bool)
    image[:, 44, 63], hole[:, 44, 63] = (0.2, 0.5, 0.9), False
    filled = fill_holes(image, inverse, hole)
    np.testing.assert_allclose(filled, np.broadcast_to(image[:, 44:, 63:], filled.shape), atol=1e-5)


def test_all_is_a_hole() -> None:
    image, inverse, hole = scene()
    assert not fill_holes(image, inverse, np.ones_like(hole)).any()


def test_no_hole() -> None:
    image, inverse, hole = scene()
    assert np.array_equal(fill_holes(image, inverse, np.zeros_like(hole)), image)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 9), (9, 1), (2, 3), (97, 31)])
def test_any_size(height: int, width: int) -> None:
    """All holes but the last pixel."""
    image, hole = np.full((3, height, width), 0.25, np.float32), np.ones((1, height, width), bool)
    hole[:, -1, -1] = False
    np.testing.assert_allclose(fill_holes(image, np.ones((1, height, width), np.float32), hole), 0.25, atol=1e-5)


def test_deep_holes_are_wide_and_inside() -> None:
    hole = np.zeros((1, 100, 400), bool)
    hole[0, 40:60, 100:130] = True  # wide
    hole[0, 20:80, 200:202] = True  # a crack: 0.006 of 400 columns
    hole[0, 30:70, 380:] = True  # at the border
    deep = deep_holes(hole)
    assert deep[0, 45:55, 105:125].all() and not deep[0, :, 150:].any() and not (deep & ~hole).any()


def test_a_hole_at_the_border_is_filled_from_all_sides() -> None:
    """Near below and far above, as in the tests above, but the hole reaches the image's edge."""
    image = np.zeros((1, 64, 64), np.float32)
    image[:, 32:] = 1
    inverse = np.where(image > 0, np.float32(0.5), np.float32(0.01))
    inside, border = np.zeros((2, 1, 64, 64), bool)
    inside[0, 24:40, 20:40], border[0, 24:40, :20] = True, True
    at = np.s_[0, 28:36]
    far = float((fill_holes(image, inverse, inside)[at][:, 20:40] < 0.5).mean())
    equal = float((fill_holes(image, inverse, border)[at][:, :20] < 0.5).mean())
    assert far > 0.9 and 0.3 < equal < 0.7


def test_same_bits_twice() -> None:
    assert np.array_equal(fill_holes(*scene()), fill_holes(*scene()))

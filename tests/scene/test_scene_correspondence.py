"""vestcl.scene.flow.correspondence: shifts that are known, and what leaves the image."""

from typing import Any

import numpy as np
import pytest
from geometric_scenes import HEIGHT, WIDTH, noise

from vestcl.scene.flow.correspondence import correspond, sample

#: Dense inverse search is that good on smooth noise, px; as a median it is 0.02.
SUBPIXEL = 0.1


def shifted(right: int, down: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Two windows of one image: src(p) = dst(p + (right, down))."""
    canvas = noise(HEIGHT + 40, WIDTH + 40, seed, blur=2.0)
    src = canvas[:, 20 : 20 + HEIGHT, 20 : 20 + WIDTH]
    return src, canvas[:, 20 - down : 20 - down + HEIGHT, 20 - right : 20 - right + WIDTH]


@pytest.mark.parametrize("shift", [(3, 0), (-7, 2), (0, -4)])
def test_a_shift_is_found(shift: tuple[int, int]) -> None:
    found = correspond(*shifted(*shift))
    assert found.flow_uv.shape == (2, HEIGHT, WIDTH) and found.error.shape == (1, HEIGHT, WIDTH)
    assert found.flow_uv.dtype == found.error.dtype == np.float32
    inside = np.s_[:, 12:-12, 12:-12]
    off = np.hypot(*(found.flow_uv - np.array(shift)[:, None, None]))[None]
    assert np.median(off[inside]) < SUBPIXEL and np.quantile(off[inside], 0.99) < 3 * SUBPIXEL
    assert np.quantile(found.error[inside], 0.99) < 3 * SUBPIXEL


def test_half_a_pixel() -> None:
    """Five pixels of images of twice the size."""
    src, dst = (large.reshape(3, HEIGHT // 2, 2, WIDTH // 2, 2).mean((2, 4)) for large in shifted(5, 0))
    flow_uv = correspond(src, dst).flow_uv[:, 8:-8, 8:-8]
    np.testing.assert_allclose(np.median(flow_uv, axis=(1, 2)), [2.5, 0], atol=SUBPIXEL)


def test_the_error_is_infinite_exactly_where_flow_leaves_the_image() -> None:
    found = correspond(*shifted(9, 0))
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    column, row = x + found.flow_uv[0], y + found.flow_uv[1]
    leaves = (column < 0) | (column > WIDTH - 1) | (row < 0) | (row > HEIGHT - 1)
    assert np.array_equal(np.isinf(found.error[0]), leaves)
    assert leaves[10:-10, -7:].mean() > 0.9 and not leaves[10:-10, 20:-20].any()


def test_what_dst_hides_does_not_return() -> None:
    """A board that moves by 12 px: the strip of wall it covers next has nothing to match."""
    wall, board = noise(seed=1, blur=2.0), noise(seed=2, blur=2.0)
    src, dst = wall.copy(), wall.copy()
    src[:, 30:70, 100:160] = board[:, 30:70, 100:160]
    dst[:, 30:70, 112:172] = board[:, 30:70, 100:160]
    error = correspond(src, dst).error[0]
    assert np.median(error[36:64, 162:170]) > 2 > 0.2 > np.median(error[36:64, 110:150])


def test_still_images() -> None:
    found = correspond(noise(), noise())
    assert np.abs(found.flow_uv).max() < SUBPIXEL and np.median(found.error) < SUBPIXEL


def test_flow_is_doubted_where_the_image_has_no_texture_or_only_a_line() -> None:
    """Blank, a vertical edge and noise, side by side: only the last one holds flow in both directions."""
    image = np.full((3, HEIGHT, WIDTH), 0.5, np.float32)
    image[:, :, 150:] = 0.8  # an edge along the columns
    image[:, :, 220:] = noise()[:, :, 220:]
    error = correspond(image, image).error[0]
    middle = np.s_[20:-20]
    assert error[middle, 50:100].min() > 10 and error[middle, 148:152].min() > 1
    assert np.median(error[middle, 250:]) < SUBPIXEL


def test_same_bits_twice() -> None:
    pair = shifted(3, 1)
    for first, second in zip(correspond(*pair), correspond(*pair), strict=True):
        assert np.array_equal(first, second)


def test_sample_by_hand() -> None:
    planes = np.array([[[0, 1], [2, 3]], [[10, 20], [30, 50]]], np.float32)
    x, y = np.array([[0.5, 1.0, 0.0, 1.01]]), np.array([[0.5, 1.0, 0.25, 0.0]])
    wanted = [[[1.5, 3, 0.5, -7]], [[27.5, 50, 15, -7]]]
    np.testing.assert_allclose(sample(planes, x, y, outside=-7), wanted, rtol=1e-6)
    assert not sample(planes, x - 5, y).any()


@pytest.mark.parametrize(
    ("src", "dst", "message"),
    [
        (noise()[:1], noise(), r"`src` must be \[3, H, W\], got \[1, 96, 320\]"),
        (noise(), noise()[:, :, 1:], r"`dst` must be \[3, 96, 320\], got \[3, 96, 319\]"),
        (noise(), np.full_like(noise(), np.nan), "`dst` must be finite, got 92160 values that are not"),
        (noise(8, 8), noise(8, 8), "H and W must be 12 or more for optical flow, got 8 x 8"),
    ],
)
def test_refuses(src: Any, dst: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        correspond(src, dst)

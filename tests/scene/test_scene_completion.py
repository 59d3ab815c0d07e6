"""vestcl.scene.depth.completion: known depth is kept, and goes up to the edges of the image."""

from typing import Any

import numpy as np
import pytest
from geometric_scenes import HEIGHT, WIDTH, Floats, flat, noise, room

from vestcl.scene.depth.completion import complete_depth


def scattered(depth: Floats, share: float = 0.05) -> Floats:
    """Only this many pixels are known."""
    keep = np.random.default_rng(0).random(depth.shape) < share
    return np.where(keep, depth, np.float32(0))


def halves() -> tuple[Floats, Floats]:
    """Dark at 5 m to the left of column 160, bright at 50 m to its right: the image and its depth."""
    left = np.arange(WIDTH) < WIDTH // 2
    image = np.broadcast_to(np.where(left, 0.2, 0.8), (3, HEIGHT, WIDTH)).astype(np.float32)
    return image, np.broadcast_to(np.where(left, 5, 50), (1, HEIGHT, WIDTH)).astype(np.float32)


def test_what_is_known_is_kept() -> None:
    depth = scattered(room())
    completed = complete_depth(depth, noise())
    assert completed.shape == depth.shape and completed.dtype == np.float32
    assert np.array_equal(completed[depth > 0], depth[depth > 0])
    assert (completed > 0).all() and np.isfinite(completed).all()


def test_nothing_to_do() -> None:
    assert np.array_equal(complete_depth(room(), noise()), room())


def test_crisp_at_an_edge_of_the_image() -> None:
    image, truth = halves()
    np.testing.assert_allclose(complete_depth(scattered(truth), image), truth, rtol=0.02)


def test_without_an_edge_depth_blends() -> None:
    """The same depths in an image that shows no edge."""
    _, truth = halves()
    blended = complete_depth(scattered(truth), np.full((3, HEIGHT, WIDTH), 0.5, np.float32))
    across = blended[0, :, 150:170]
    assert ((across > 6) & (across < 45)).mean() > 0.3


def test_one_valid_pixel_is_enough() -> None:
    depth = np.zeros((1, HEIGHT, WIDTH), np.float32)
    depth[0, 48, 160] = 12
    np.testing.assert_allclose(complete_depth(depth, np.full((3, HEIGHT, WIDTH), 0.5, np.float32)), 12, rtol=1e-3)


def test_what_an_edge_shuts_off_has_the_median() -> None:
    image, depth = np.zeros((3, HEIGHT, WIDTH), np.float32), flat(20)
    shut = np.s_[:, 30:60, 100:160]
    image[shut] = 1
    depth[:, :20] = 10
    depth[shut] = 0
    np.testing.assert_allclose(complete_depth(depth, image)[shut], 20, rtol=0.02)


def test_nothing_is_guessed_beyond_500_m() -> None:
    depth = flat(10_000)
    depth[:, :, 100:200] = 0
    completed = complete_depth(depth, noise())
    np.testing.assert_allclose(completed[:, :, 100:200], 500, rtol=1e-5)
    assert (completed[:, :, :100] == 10_000).all()


@pytest.mark.parametrize(
    ("depth", "image", "message"),
    [
        (0 * room(), noise(), "`depth` must have a valid pixel, got none above 0 m"),
        (room()[0], noise(), r"`depth` must be \[1, H, W\], got \[96, 320\]"),
        (-room(), noise(), r"`depth` must be 0 \(invalid\) or more, got -40 m"),
        (room(), noise()[:, 1:], r"`image` must be \[3, 96, 320\], got \[3, 95, 320\]"),
        (room(), np.full_like(noise(), np.nan), "`image` must be finite"),
    ],
)
def test_refuses(depth: Any, image: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        complete_depth(depth, image)

"""Stereo depth of dynamic objects: their windows and smooth sides."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vestcl.scene.depth.foreground import StereoPair, foreground_depth
from vestcl.scene.flow.correspondence import sample

HEIGHT, WIDTH, FOCAL = 96, 160, 60.0
CAR = np.s_[20:80, 30:130]
WINDOW = np.s_[35:60, 55:105]


def inverse_depth() -> NDArray[np.float64]:
    """1/z of a car's side that comes nearer to the right, 10 m to 4 m, before a wall 30 m away."""
    inverse = np.full((HEIGHT, WIDTH), 1 / 30)
    inverse[CAR] = np.linspace(1 / 10, 1 / 4, 100)
    return inverse


def pair_of(inverse: NDArray[np.float64], flat: tuple[slice, slice] | None) -> StereoPair:
    """Noise seen by two cameras; ``flat`` of the left image is of one colour."""
    rng = np.random.default_rng(0)
    left = np.stack([cv2.GaussianBlur(rng.random((HEIGHT, WIDTH)), (0, 0), 1) for _ in range(3)]).astype(np.float32)
    if flat is not None:
        left[(slice(None), *flat)] = 0.3
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    # For a small region u_right ~ u_left - fx b / z, inverted by fixed-point iteration.
    there = columns.astype(np.float64)
    for _ in range(60):
        there = columns + FOCAL * sample(inverse[None].astype(np.float32), there, rows, outside=1 / 30)[0]
    return StereoPair(left, sample(left, there, rows, outside=0.5), FOCAL)


def foreground() -> NDArray[np.bool_]:
    mask = np.zeros((1, HEIGHT, WIDTH), bool)
    mask[(0, *CAR)] = True
    return mask


def depth_of(inverse: NDArray[np.float64]) -> NDArray[np.float32]:
    return (1 / inverse)[None].astype(np.float32)


def test_a_window_that_nothing_was_matched_on_lies_in_its_frames_plane() -> None:
    truth, measured = inverse_depth(), inverse_depth()
    measured[WINDOW] = 1 / 25
    depth = foreground_depth(depth_of(measured), foreground(), pair_of(truth, WINDOW))
    np.testing.assert_allclose(depth[(0, *WINDOW)], depth_of(truth)[(0, *WINDOW)], rtol=0.02)


def test_what_is_seen_through_a_gap_stays_far() -> None:
    """As a window, but the images show something far there."""
    truth = inverse_depth()
    truth[WINDOW] = 1 / 25
    depth = foreground_depth(depth_of(truth), foreground(), pair_of(truth, None))
    np.testing.assert_allclose(depth[(0, *WINDOW)], 25, rtol=0.02)


def test_a_region_that_background_surrounds_is_no_window() -> None:
    """A far car behind nothing: its plane is not that of the wall, and the wall is no frame."""
    mask = np.zeros((1, HEIGHT, WIDTH), bool)
    mask[(0, *WINDOW)] = True
    measured = inverse_depth()
    measured[WINDOW] = 1 / 25
    depth = foreground_depth(depth_of(measured), mask, pair_of(measured, WINDOW))
    np.testing.assert_allclose(depth[(0, *WINDOW)], 25, rtol=0.02)


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_a_side_is_a_surface(noise: float) -> None:
    """Steps and noise of a matcher on a slanted side go, by half or more; its outline and the background stay."""
    rng, truth = np.random.default_rng(1), inverse_depth()
    measured = truth * (1 + noise * rng.standard_normal(truth.shape))
    pair = pair_of(truth, None)
    depth = foreground_depth(depth_of(measured), foreground(), pair)
    before, after = (np.abs(each * truth - 1)[CAR].mean() for each in (1 / measured, depth[0]))
    assert after < before / 2
    np.testing.assert_array_equal(depth[~foreground()], depth_of(measured)[~foreground()])


def test_two_objects_stay_two() -> None:
    """One behind the other: neither takes the other's depth at the edge between them."""
    truth = inverse_depth()
    truth[CAR] = 1 / 12
    truth[CAR[0], 80:130] = 1 / 5
    depth = foreground_depth(depth_of(truth), foreground(), pair_of(truth, None))
    np.testing.assert_allclose(depth, depth_of(truth), rtol=1e-3)


def test_far_and_small_objects_keep_their_depth() -> None:
    rng = np.random.default_rng(2)
    measured = np.full((HEIGHT, WIDTH), 1 / 40) * (1 + 0.01 * rng.standard_normal((HEIGHT, WIDTH)))
    depth = foreground_depth(depth_of(measured), foreground(), pair_of(measured, None))
    np.testing.assert_allclose(depth, depth_of(measured), rtol=1e-6)


def test_without_foreground_nothing_changes() -> None:
    depth = depth_of(inverse_depth())
    assert foreground_depth(depth, np.zeros((1, HEIGHT, WIDTH), bool), pair_of(inverse_depth(), None)) is depth

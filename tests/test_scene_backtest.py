"""vestcl.scene.motion.backtest: candidate velocities weighted by how they would have forecast the last frame."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vestcl.scene.motion.backtest import Frame, backtest, mixed, residual_velocity

HEIGHT, WIDTH, FOCAL, DEPTH = 64, 160, 100.0, 10.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])

Image = NDArray[np.float32]


def texture() -> Image:
    """[3, H, 2 W], smooth noise."""
    noise = np.random.default_rng(0).random((HEIGHT, 2 * WIDTH, 3)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 2).transpose(2, 0, 1) * 3 % 1


def frames(left: float, right: float) -> tuple[Frame, Frame]:
    """Two frames of a wall whose left and right half move by ``left`` and ``right`` px; the camera does not."""
    wide = texture()
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    shift = np.where(x < WIDTH / 2, left, right).astype(np.float32)

    def shown(time: int) -> Image:
        at = x + WIDTH / 2 - time * shift
        return np.stack([cv2.remap(plane, at, y, cv2.INTER_LINEAR) for plane in wide])

    flow_uv = np.stack([-shift, np.zeros_like(shift)])
    depth = np.full((1, HEIGHT, WIDTH), DEPTH, np.float32)
    before, after = (Frame(shown(time), depth, flow_uv, np.eye(4), K) for time in (0, 1))
    return before, after


def test_what_flow_shows_is_a_velocity_at_constant_depth() -> None:
    velocity = residual_velocity(frames(2.0, 0.0)[1])
    np.testing.assert_allclose(velocity[0, :, 10:70], 2.0 * DEPTH / FOCAL, atol=1e-6)
    np.testing.assert_allclose(velocity[:, :, 90:], 0, atol=1e-6)


def test_the_cameras_own_motion_is_no_velocity() -> None:
    moved = np.eye(4)
    moved[0, 3] = 0.2  # prev_from_cur: points were 0.2 m further right, 2 px
    frame = frames(-2.0, -2.0)[1]._replace(prev_from_cur=moved)
    np.testing.assert_allclose(residual_velocity(frame), 0, atol=1e-5)


@pytest.mark.parametrize("far", [10_000.0])
def test_the_sky_has_no_velocity(far: float) -> None:
    frame = frames(2.0, 2.0)[1]
    assert not residual_velocity(frame._replace(depth=np.full_like(frame.depth, far))).any()


def test_each_region_follows_the_candidate_that_was_right_there() -> None:
    before, after = frames(3.0, 0.0)
    moving, still = np.zeros((2, 3, HEIGHT, WIDTH), np.float32)
    moving[0] = 3.0 * DEPTH / FOCAL
    candidates = np.stack([moving, still])
    errors = backtest(candidates, before, after)
    assert (errors[0, :, 10:60] < 0.2 * errors[1, :, 10:60]).all()
    assert (errors[1, :, 100:150] < 0.2 * errors[0, :, 100:150]).all()
    velocity = mixed(candidates, errors)
    np.testing.assert_allclose(velocity[0, :, 10:60], 0.3, atol=0.01)
    np.testing.assert_allclose(velocity[0, :, 100:150], 0, atol=0.01)


def test_candidates_that_err_alike_are_averaged() -> None:
    candidates = np.stack([np.full((3, 4, 4), value, np.float32) for value in (1.0, 3.0)])
    np.testing.assert_allclose(mixed(candidates, np.ones((2, 4, 4), np.float32)), 2.0, atol=1e-6)


def test_outside_of_the_image_nothing_is_decided() -> None:
    before, after = frames(0.0, 0.0)
    away = np.zeros((3, HEIGHT, WIDTH), np.float32)
    away[0] = 100.0
    errors = backtest(np.stack([away, 2 * away]), before, after)
    np.testing.assert_allclose(errors[0], errors[1])
    assert np.isfinite(errors).all() and (errors > 0).all()

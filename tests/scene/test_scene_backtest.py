"""vestcl.scene.motion.backtest: candidate motions weighted by how they would have forecast the last frame."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vestcl.scene.flow.parallax import pixel_centres
from vestcl.scene.motion.backtest import (
    BacktestFrame,
    backtest,
    by_step,
    candidates,
    coherent,
    held_together,
    mixed,
    residual_flow,
    untested,
)

HEIGHT, WIDTH, FOCAL, DEPTH = 64, 160, 100.0, 10.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
STILL = np.eye(4)
CENTRES = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5))

Image = NDArray[np.float32]

#: Indices of the candidates.
OBJECT, REST, FLOW, PLACE, LINEAR = range(5)


def texture() -> Image:
    """[3, H, 2 W], smooth noise."""
    noise = np.random.default_rng(0).random((HEIGHT, 2 * WIDTH, 3)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 2).transpose(2, 0, 1) * 3 % 1


def frames(left: float, right: float, elapsed: float = 1.0) -> tuple[BacktestFrame, BacktestFrame]:
    """Two frames of a wall whose left and right half move by ``left`` and ``right`` px; the camera does not."""
    wide = texture()
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    shift = np.where(x < WIDTH / 2, left, right).astype(np.float32)

    def shown(time: int) -> Image:
        at = x + WIDTH / 2 - time * shift
        return np.stack([cv2.remap(plane, at, y, cv2.INTER_LINEAR) for plane in wide])

    flow_uv = np.stack([-shift, np.zeros_like(shift)])
    depth, still = np.full((1, HEIGHT, WIDTH), DEPTH, np.float32), np.zeros((3, HEIGHT, WIDTH), np.float32)
    before, after = (BacktestFrame(shown(time), depth, still, flow_uv, np.eye(4), K, elapsed) for time in (0, 1))
    return before, after


def test_what_flow_shows_beyond_the_cameras_motion() -> None:
    residual = residual_flow(frames(2.0, 0.0)[1])
    np.testing.assert_allclose(residual[0, :, 10:70], 2.0, atol=1e-5)
    np.testing.assert_allclose(residual[:, :, 90:], 0, atol=1e-5)


def test_the_cameras_own_motion_is_no_residual() -> None:
    moved = np.eye(4)
    moved[0, 3] = 0.2  # prev_from_cur: points were 0.2 m further right, 2 px
    frame = frames(-2.0, -2.0)[1]._replace(prev_from_cur=moved)
    np.testing.assert_allclose(residual_flow(frame), 0, atol=1e-4)


def test_a_wrong_match_is_no_motion() -> None:
    assert not residual_flow(frames(50.0, 50.0)[1]).any()


def test_residual_flow_is_per_interval() -> None:
    np.testing.assert_allclose(residual_flow(frames(3.0, 3.0, elapsed=2.0)[1])[0], 1.5, atol=1e-5)


def test_candidates_by_hand() -> None:
    """Flow of 2 px per interval to the right, an object of 0.5 m per interval, the camera 1 m ahead: 10 m become 8."""
    frame = frames(2.0, 2.0)[1]
    frame = frame._replace(velocity=np.full_like(frame.velocity, 0) + np.float32([0.5, 0, 0])[:, None, None])
    ahead = np.eye(4)
    ahead[2, 3] = -2.0
    positions, depth = candidates(frame, residual_flow(frame), ahead, 2.0)
    assert len(positions) == 4
    np.testing.assert_allclose(depth, 8.0, atol=1e-5)
    middle = np.array([WIDTH / 2, HEIGHT / 2])[:, None, None]
    rest = middle + (CENTRES - middle) * DEPTH / 8
    np.testing.assert_allclose(positions[REST], rest, atol=1e-3)
    np.testing.assert_allclose(positions[OBJECT][0], rest[0] + FOCAL * 1.0 / 8, atol=1e-3)
    np.testing.assert_allclose(positions[FLOW][0], rest[0] + 4.0, atol=1e-3)
    np.testing.assert_allclose(positions[PLACE], positions[FLOW], atol=1e-3)


def test_flow_itself_is_a_candidate_where_depth_is_from_motion() -> None:
    frame = frames(2.0, 2.0, elapsed=2.0)[1]
    positions, _ = candidates(frame, residual_flow(frame), STILL, 3.0, by_flow=True)
    np.testing.assert_allclose(positions[LINEAR][0], CENTRES[0] + 3.0, atol=1e-4)
    np.testing.assert_allclose(positions[LINEAR][1], CENTRES[1], atol=1e-4)


@pytest.mark.parametrize("ahead", [1.0, 2.0, 2.5])
def test_at_a_place_motion_ends_where_the_flow_does(ahead: float) -> None:
    """The left half moves by 8 px per interval, and what crosses to the right half stops there."""
    positions, _ = candidates(frame := frames(8.0, 0.0)[1], residual_flow(frame), STILL, ahead)
    far = positions[PLACE][0, :, :40]
    np.testing.assert_allclose(far, CENTRES[0, :, :40] + 8 * ahead, atol=1e-3)
    assert (positions[PLACE][0, :, :80] < WIDTH / 2 + 8).all() and positions[FLOW][0, :, 79].min() > WIDTH / 2 + 7


def errors_of(before: BacktestFrame, after: BacktestFrame, positions: Image) -> Image:
    return backtest(positions, before, after.image, [after.flow_uv])


def test_each_region_follows_the_candidate_that_was_right_there() -> None:
    before, after = frames(3.0, 0.0)
    moving = CENTRES + np.array([3.0, 0])[:, None, None]
    positions = np.stack([moving, CENTRES]).astype(np.float32)
    errors = errors_of(before, after, positions)
    assert (errors[0, :, 10:60] < 0.2 * errors[1, :, 10:60]).all()
    assert (errors[1, :, 100:150] < 0.2 * errors[0, :, 100:150]).all()
    found = mixed(positions, errors) - CENTRES
    np.testing.assert_allclose(found[0, :, 10:60], 3.0, atol=0.1)
    np.testing.assert_allclose(found[0, :, 100:150], 0, atol=0.1)


def test_errors_of_two_frames_are_brought_along_both_flows() -> None:
    """Something wrong at columns 40 to 60 of t - 2 is at 46 to 66 of t when all moves by 3 px."""
    before, after = frames(3.0, 3.0)
    changed = after.image.copy()
    spoilt = before._replace(image=np.where((CENTRES[0] > 40) & (CENTRES[0] < 60), 0, before.image).astype(np.float32))
    moved = (CENTRES + np.array([3.0, 0])[:, None, None])[None].astype(np.float32)
    once = backtest(moved, spoilt, changed, [after.flow_uv])[0]
    twice = backtest(moved, spoilt, changed, [after.flow_uv, after.flow_uv])[0]
    x = CENTRES[0, :, 20:120]
    centre = [float((each[:, 20:120] * x).sum() / each[:, 20:120].sum()) for each in (once, twice)]
    assert centre[1] - centre[0] == pytest.approx(3.0, abs=0.4)


def test_candidates_with_equal_errors_are_averaged() -> None:
    positions = np.stack([np.full((2, 4, 4), value, np.float32) for value in (1.0, 3.0)])
    np.testing.assert_allclose(mixed(positions, np.ones((2, 4, 4), np.float32)), 2.0, atol=1e-6)


def test_outside_of_the_image_nothing_is_decided() -> None:
    before, after = frames(0.0, 0.0)
    away = CENTRES + np.array([500.0, 0])[:, None, None]
    errors = errors_of(before, after, np.stack([away, away + 500]).astype(np.float32))
    np.testing.assert_allclose(errors[0], errors[1])
    assert np.isfinite(errors).all() and (errors > 0).all()


def test_errors_by_step() -> None:
    """Flow needs a margin; later steps take the mean of two tests; flow itself is held back if it loses one."""
    first, second = (np.full((5, 2, 2), value, np.float32) for value in (0.01, 0.04))
    once, later = by_step([first, second], by_flow=False)
    np.testing.assert_allclose(once[:, 0, 0], [0.01, 0.01, 0.0125, 0.0125, 0.0125], rtol=1e-5)
    np.testing.assert_allclose(later[:, 0, 0], [0.02, 0.02, 0.025, 0.025, 0.025], rtol=1e-5)
    assert len(by_step([first], by_flow=True)) == 1 and by_step([], by_flow=True) == ()
    second[-1] *= 1.2
    held = by_step([first, second], by_flow=True)
    np.testing.assert_allclose(held[0][-1] / once[-1], 1.2**6, rtol=1e-4)
    np.testing.assert_allclose(held[0][:-1], once[:-1])


def test_what_no_candidate_explains_follows_its_surroundings() -> None:
    image = np.full((3, 40, 80), 0.2, np.float32)
    car, window = np.s_[10:30, 20:50], np.s_[14:20, 30:40]
    image[(slice(None), *car)] = 0.7
    way = np.zeros((2, 40, 80), np.float32)
    way[0][car] = 5
    way[0][window] = -9  # of a wrong depth
    errors = np.full((2, 40, 80), 1e-5, np.float32)
    errors[(slice(None), *window)] = 0.03
    centres = pixel_centres(40, 80)
    moving = np.zeros((40, 80), bool)
    moving[car] = True
    found = coherent(np.asarray(centres + way, np.float32), errors, image, moving) - centres
    assert np.abs(found[0][window] - 5).max() < 0.6, "the window goes with its car"
    assert np.abs(found[0, 4:9] - 0).max() < 0.1 and np.abs(found[0, 22:28, 24:46] - 5).max() < 0.1
    assert np.abs(found[1]).max() < 1e-3
    kept = coherent(np.asarray(centres + way, np.float32), errors, image, np.zeros_like(moving)) - centres
    assert np.array_equal(kept, way), "static pixels keep their motion"


def test_an_object_is_held_together() -> None:
    objects = np.zeros((4, 6), np.int32)
    objects[1:3, 1:5] = 1
    errors = np.full((2, 4, 6), 1e-3, np.float32)
    errors[0, 1, 1:5] = 4e-3  # the upper half of the object would follow the second candidate, the lower one the first
    errors[1, 2, 1:5] = 4e-3
    held = held_together(errors, objects)
    assert np.array_equal(held[:, objects == 0], errors[:, objects == 0])
    assert np.allclose(held[0, 1, 1:5], np.sqrt(4e-3 * 2e-3)) and np.allclose(held[0, 2, 1:5], np.sqrt(1e-3 * 2e-3))
    positions = np.zeros((2, 2, 4, 6), np.float32)
    positions[1, 0] = 10
    torn, whole = (mixed(positions, each)[0] for each in (errors, held))
    assert np.ptp(whole[1:3, 1]) < 0.85 * np.ptp(torn[1:3, 1]) > 0


def test_where_all_candidates_look_alike_the_object_decides() -> None:
    """A smooth side: its own errors are equal, but those of the rest of its object are not."""
    objects = np.ones((1, 40), np.int32)
    errors = np.full((2, 1, 40), 1e-3, np.float32)
    errors[1, 0, :20] = 8e-3
    positions = np.zeros((2, 2, 1, 40), np.float32)
    positions[1, 0] = 10
    plain, held = (mixed(positions, each)[0, 0, 30] for each in (errors, held_together(errors, objects)))
    assert plain == 5 and held < 0.5


def test_two_frames_mix_velocity_and_residual_flow() -> None:
    depth = np.full((1, 8, 12), 5.0, np.float32)
    one = np.ones((3, 8, 12), np.float32)
    frame = BacktestFrame(one, depth, 0 * one, 0 * one[:2], np.eye(4), np.diag([10.0, 10.0, 1.0]))
    errors = untested(frame)
    assert errors.shape == (4, 8, 12)
    positions = np.stack([np.full((2, 8, 12), value, np.float32) for value in (2.0, 50.0, 4.0, 90.0)])
    np.testing.assert_allclose(mixed(positions, errors), 3.0, atol=1e-5)
    assert len(untested(frame, by_flow=True)) == 5

"""vestcl.scene.exposure: frames of one camera brought to one exposure."""

import numpy as np
import pytest
from geometric_scenes import HEIGHT, WIDTH, Floats, flat, move, noise, points, turned

from vestcl.scene.exposure import as_exposed, curve_by_flow, matched_for_flow, nearest, tone_curve
from vestcl.scene.flow.correspondence import correspond, sample
from vestcl.scene.flow.parallax import pixel_centres
from vestcl.scene.motion.backtest import BacktestFrame, backtest

STILL = np.zeros((2, HEIGHT, WIDTH), np.float32)

#: Levels of half an image's range: 1.2 times that clips nothing.
GREY = 0.1 + 0.6 * noise(seed=3, blur=2.0)


def exposed(image: Floats, gain: float | Floats) -> Floats:
    """What a camera of 8 bits gives with another exposure."""
    return (np.round((gain * image).clip(0, 1) * 255) / 255).astype(np.float32)


@pytest.mark.parametrize("gain", [1.2, 1 / 1.2, 1.5])
def test_a_gain_is_found_and_undone(gain: float) -> None:
    before = exposed(GREY, gain)
    curve = curve_by_flow(before, GREY, STILL)
    np.testing.assert_allclose(curve.gains, 1 / gain, rtol=0.01)
    seen = before < 0.95
    np.testing.assert_allclose(as_exposed(before, GREY, STILL)[seen], GREY[seen], atol=0.01)


def test_each_channel_has_a_gain() -> None:
    gains = np.array([1.2, 1.0, 0.9], np.float32)
    curve = curve_by_flow(GREY, exposed(GREY, gains[:, None, None]), STILL)
    np.testing.assert_allclose(curve.gains, gains, rtol=0.01)


def test_colours_are_compared_along_the_flow() -> None:
    shifted = np.roll(GREY, 7, axis=2)
    flow_uv = STILL.copy()
    flow_uv[0] = 7
    np.testing.assert_allclose(curve_by_flow(shifted, exposed(GREY, 1.2), flow_uv).gains, 1.2, rtol=0.01)


@pytest.mark.parametrize("gain", [1.0, 0.97, 1.03])
def test_the_same_exposure_changes_no_bit(gain: float) -> None:
    before = exposed(GREY, gain)
    assert as_exposed(before, GREY, STILL) is before
    assert matched_for_flow(before, GREY, STILL) is before


def test_a_third_of_wrong_matches_changes_little() -> None:
    values = GREY.reshape(3, -1)
    wanted = np.float32(1.2) * values
    wanted[:, ::3] = np.random.default_rng(0).random(wanted[:, ::3].shape)
    np.testing.assert_allclose(tone_curve(values, wanted).gains, 1.2, rtol=0.05)


def test_white_reads_as_the_other_frame_shows_it() -> None:
    """A sky that is saturated in both frames stays white; a wall that only just saturates does not."""
    values, wanted = np.full((3, 1000), 0.5, np.float32), np.full((3, 1000), 0.4, np.float32)
    values[:, :300] = wanted[:, :300] = 1.0
    np.testing.assert_allclose(tone_curve(values, wanted)(np.ones((3, 1, 1), np.float32)), 1.0, atol=1e-6)
    wanted[:, :300] = 0.85
    np.testing.assert_allclose(tone_curve(values, wanted)(np.ones((3, 1, 1), np.float32)), 0.85, atol=1e-6)


@pytest.mark.parametrize("values", [np.zeros((3, 500), np.float32), np.full((3, 500), np.nan, np.float32)])
def test_too_little_to_compare_changes_nothing(values: Floats) -> None:
    assert (tone_curve(values, np.full_like(values, 0.5)).gains == 1).all()
    assert (tone_curve(np.full((3, 50), 0.5, np.float32), np.full((3, 50), 0.8, np.float32)).gains == 1).all()


def test_values_at_the_nearest_pixels() -> None:
    image = np.arange(6, dtype=np.float32).reshape(1, 2, 3)
    got = nearest(image, np.array([0.4, 1.6, 2.1, np.nan]), np.array([0.0, 1.0, 0.0, 0.0]))
    np.testing.assert_array_equal(got, [[0, 5, np.nan, np.nan]])


@pytest.mark.parametrize("gain", [1.2, 1 / 1.2, 1.5])
def test_flow_between_different_exposures(gain: float) -> None:
    """Half an image moves by 3 px, half does not."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    flow_uv = np.stack([np.where(x < WIDTH / 2, 3, 0), np.zeros_like(x)]).astype(np.float32)
    now = sample(GREY, x + flow_uv[0], y, outside=0.4)
    same, other = (correspond(now, exposed(GREY, factor)).flow_uv for factor in (1.0, gain))
    inner = np.s_[:, 10:-10, 10:-10]
    before, after = (np.hypot(*(found - flow_uv))[inner[1:]].mean() for found in (same, other))
    assert after < 1.1 * before + 0.02


def test_a_backtest_between_different_exposures() -> None:
    """Of rest and a wrong position rest is right, however bright the frames are."""
    K = np.array([[200.0, 0, WIDTH / 2], [0, 200.0, HEIGHT / 2], [0, 0, 1]])
    before = BacktestFrame(exposed(GREY, 1 / 1.2), flat(10), np.zeros_like(GREY), STILL, np.eye(4), K)
    rest = pixel_centres(HEIGHT, WIDTH).astype(np.float32)
    errors = backtest(np.stack([rest + np.float32(8), rest]), before, GREY, [STILL])
    assert (errors[1] < 0.1 * errors[0])[10:-20, 20:-20].all()


def test_flow_of_a_moving_camera_gives_the_gain() -> None:
    prev_from_cur = turned(0.01, 0.0, 0.0, (0.05, 0.0, 0.8))
    x, y, z = move(prev_from_cur, points(flat(20)))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    focal, centre = np.array([190.0, 180.0]), np.array([157.5, 45.25])
    u, v = focal[0] * x / z + centre[0] - 0.5, focal[1] * y / z + centre[1] - 0.5
    now = sample(GREY, u, v, outside=0.4)
    flow_uv = np.stack([u - columns, v - rows]).astype(np.float32)
    np.testing.assert_allclose(curve_by_flow(exposed(GREY, 1 / 1.2), now, flow_uv).gains, 1.2, rtol=0.02)

"""vestcl.scene.motion: banks of filters, and the camera's forecast by them."""

import numpy as np
import pytest
from numpy.typing import NDArray

from vestcl.scene.motion.camera_forecast import CameraForecaster, forecast_camera
from vestcl.scene.motion.ego_motion import rigid
from vestcl.scene.motion.gauss_markov import Bank, decaying_rate, driven_rate, joined, oscillator


def drive(yaw_rates: NDArray[np.float64], speeds: NDArray[np.float64], interval: float) -> list[NDArray[np.float64]]:
    """cur_from_prev of a car that turns at ``yaw_rates``, rad/s, and drives at ``speeds``, m/s."""
    return [
        rigid(np.array([0, -yaw * interval, 0]), np.array([0, 0, -speed * interval]))
        for yaw, speed in zip(yaw_rates, speeds, strict=True)
    ]


def test_a_filter_is_the_scalar_kalman_filter_worked_out_by_hand() -> None:
    bank = Bank([joined(decaying_rate(np.inf, 1.0), noise=1.0)])  # a constant rate N(0, 1), y = rate + N(0, 1)
    bank.measure(np.array([3.0]), 1.0)
    assert bank.forecast([1.0])[0, 0] == pytest.approx(1.5)  # variance 1 of each: half of the innovation
    bank.measure(np.array([3.0]), 1.0)
    assert bank.forecast([1.0, 3.0])[:, 0] == pytest.approx([2.0, 6.0])  # the mean of (0, 3, 3)


def test_a_long_gap_leaves_a_filter_as_it_was_before_anything_was_measured() -> None:
    """After 1,000 correlation times of a stationary rate nothing of the measurement is left."""
    fresh, bank = (Bank([joined(oscillator(1.0, 0.5, 1.0), decaying_rate(2.0, 1.0), noise=0.1)]) for _ in range(2))
    bank.measure(np.array([3.0]), 0.1)
    bank.measure(np.array([0.0]), 2000.0)
    for each in (fresh, bank):
        each.measure(np.array([0.4]), 0.1)
    assert bank.forecast([0.1, 0.2]) == pytest.approx(fresh.forecast([0.1, 0.2]), rel=1e-2)
    assert bank.weights.tolist() == [[1.0]]


def test_intervals_add_up() -> None:
    """An unmeasured gap of 8 s is 80 of 0.1 s."""
    once, often = (Bank([joined(oscillator(0.3, 0.2, 1.0), noise=0.1)]) for _ in range(2))
    for bank, parts in ((once, 1), (often, 80)):
        bank.measure(np.array([0.3]), 0.1)
        for _ in range(parts):
            bank.measure(None, 8.0 / parts)
        bank.measure(np.array([0.2]), 0.1)
    assert once.forecast([0.1, 1.0]) == pytest.approx(often.forecast([0.1, 1.0]), rel=1e-6)


def test_the_model_that_forecasts_better_outweighs_the_other() -> None:
    bank = Bank([joined(decaying_rate(1.0, rms), noise=0.01) for rms in (0.01, 1.0)])
    rng = np.random.default_rng(0)
    for increment in 0.001 * rng.standard_normal(30):
        bank.measure(np.array([increment]), 0.1)
    assert bank.weights[0, 0] > 0.9


def test_an_oscillation_swings_back() -> None:
    bank = Bank([joined(oscillator(1.0, 0.05, 1.0), noise=1e-3)])
    angle = np.sin(2 * np.pi * np.arange(0, 1.76, 0.05))  # ends at its lowest point, 1.75 s
    for increment in np.diff(angle):
        bank.measure(np.array([increment]), 0.05)
    ahead = bank.forecast([0.5, 1.0])[:, 0]
    assert ahead[0] > 1.0  # half a period later it is at its highest
    assert abs(ahead[1]) < 0.6  # a period later back


@pytest.mark.parametrize("interval", [0.04, 0.1, 0.125])
def test_a_steady_bend_is_followed(interval: float) -> None:
    motions = drive(np.full(16, 0.3), np.full(16, 8.0), interval)
    future = forecast_camera(motions, [interval] * 16, [interval, 5 * interval])
    np.testing.assert_allclose(future[0], motions[-1], atol=0.05 * interval)
    np.testing.assert_allclose(future[1], np.linalg.matrix_power(motions[-1], 5), atol=0.5 * interval)


def test_a_bend_that_begins_is_carried_on() -> None:
    rates = np.r_[np.zeros(8), 0.05 * np.arange(1, 9)]  # rad/s, at 0.5 rad/s^2
    motions = drive(rates, np.full(16, 8.0), 0.1)
    turned = np.arctan2(*forecast_camera(motions, [0.1] * 16, [0.1])[0][[0, 0], [2, 0]])
    assert 0.040 < -turned < 0.046  # the last was 0.040 rad, the next is 0.045


def test_a_car_that_brakes_comes_to_a_stop() -> None:
    speeds = np.linspace(6, 1, 11)  # 5 m/s^2: it stands after another 0.2 s
    motions = drive(np.zeros(11), speeds, 0.1)
    z = [future[2, 3] for future in forecast_camera(motions, [0.1] * 11, [0.1, 0.5, 2.0])]
    assert z[0] == pytest.approx(-0.06, abs=0.03)
    assert z[2] <= z[1] <= z[0] < 0
    assert z[2] > -0.5  # constant velocity: -2


def test_uneven_intervals_of_a_steady_drive_change_nothing() -> None:
    intervals = [0.1, 0.1, 0.3, 0.1, 0.2, 0.1, 0.1, 0.4, 0.1]
    motions = [rigid(np.array([0, -0.2 * dt, 0]), np.array([0, 0, -10 * dt])) for dt in intervals]
    future = forecast_camera(motions, intervals, [0.1, 0.7])
    assert future[0][2, 3] == pytest.approx(-1.0, abs=0.01)
    assert future[1][2, 3] == pytest.approx(-7.0, abs=0.1)


def test_a_camera_that_looks_aside_and_sits_ahead_is_learned() -> None:
    turn = np.radians(2.0)  # it looks 2 degrees to the right, 1.5 m ahead of the centre of rotation
    rates = 0.3 * np.sin(0.5 * np.arange(60))
    motions = drive(rates, np.full(60, 10.0), 0.1)
    for motion, rate in zip(motions, rates, strict=True):
        motion[0, 3] = -np.tan(turn) * 10 * 0.1 * -1 + 1.5 * rate * 0.1
    future = forecast_camera(motions[:-1], [0.1] * 59, [0.1])[0]
    assert future[0, 3] == pytest.approx(motions[-1][0, 3], abs=0.01)


def test_one_motion_is_constant_velocity_of_yaw_and_translation() -> None:
    motion = rigid(np.array([0.01, 0.05, -0.02]), np.array([0.1, 0, -1]))
    future = forecast_camera([motion], [0.1], [0.1, 0.3])
    yaw = np.arctan2(future[0][0, 2], future[0][0, 0])
    assert yaw == pytest.approx(0.05, abs=1e-3)
    np.testing.assert_allclose(future[0][:3, 3], [0.1, 0, -1], atol=1e-12)
    np.testing.assert_allclose(future[1], np.linalg.matrix_power(future[0], 3), atol=0.12)


def test_a_motion_that_was_not_measured_lets_time_pass() -> None:
    motions = drive(np.full(12, 0.1), np.full(12, 8.0), 0.1)
    future = forecast_camera([*motions[:8], None, *motions[9:]], [0.1] * 12, [0.1])
    np.testing.assert_allclose(future[0], motions[0], atol=0.01)


def test_drives_of_a_batch_do_not_mix() -> None:
    left, right = (drive(np.full(10, rate), np.full(10, 8.0), 0.1) for rate in (0.4, -0.1))
    both = CameraForecaster(2)
    for pair in zip(left, right, strict=True):
        both.measure(np.stack(pair), 0.1)
    future = both.forecast([0.1, 0.5])
    for index, motions in enumerate((left, right)):
        np.testing.assert_allclose(future[:, index], forecast_camera(motions, [0.1] * 10, [0.1, 0.5]), atol=1e-12)


def test_standing_still_stays() -> None:
    future = forecast_camera([np.eye(4)] * 10, [0.1] * 10, [0.1, 1.0])
    np.testing.assert_allclose(future[1], np.eye(4), atol=1e-9)


def test_bad_input_is_refused() -> None:
    forecaster = CameraForecaster()
    with pytest.raises(ValueError, match="before `forecast`"):
        forecaster.forecast([0.1])
    with pytest.raises(ValueError, match="`seconds` must be positive, got 0"):
        forecaster.measure(np.eye(4), 0)
    with pytest.raises(ValueError, match="`cur_from_prev` must be finite"):
        forecaster.measure(np.full((4, 4), np.nan), 0.1)
    forecaster.measure(np.eye(4), 0.1)
    with pytest.raises(ValueError, match="must rise from 0"):
        forecaster.forecast([0.2, 0.1])
    with pytest.raises(ValueError, match="equal length"):
        forecast_camera([np.eye(4)], [0.1, 0.1], [0.1])


def test_a_rate_without_an_end_needs_a_spread() -> None:
    model = driven_rate(np.inf, 1.0, 0.5, spread=20.0)
    np.testing.assert_allclose(model.covariance, np.diag([400.0, 0.25]))

"""Where the camera of a car will be: each part of its motion filtered by models of driving, and extrapolated by time.

The motion between two frames is six numbers, the rotation vector (pitch, yaw, roll) and the translation of
``cur_from_prev``. Each is forecast by a bank of models (`gauss_markov.Bank`), weighted by how well they would have
forecast the frames already seen:

- yaw rate: constant turn rate with a driven rate of change, since bends begin and end along clothoids;
- pitch and roll: the body's damped oscillation on its springs, and slowly changing grade and banking of the road;
- speed: constant acceleration that decays;
- sideways and vertical motion: what a camera mounted slightly askew and ahead of the car's centre of rotation sees of
  speed and rotation, y = b z + c w, with b and c estimated, and a rest that decays.

All constants come from vehicle dynamics and literature, none from the data that the forecast is evaluated on.
Source: constant turn rate and acceleration: Schubert et al., Comparison and evaluation of advanced motion models for
vehicle tracking, 2008; decaying manoeuvres: Singer, Estimating optimal tracking filter performance for manned
maneuvering targets, 1970; body modes: Gillespie, Fundamentals of Vehicle Dynamics, 1992, chapter 5.
"""

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from vestcl.scene.motion.gauss_markov import (
    MEMORY,
    Bank,
    Model,
    decaying_rate,
    driven_rate,
    joined,
    oscillator,
    softmax,
)

Array = NDArray[np.float64]

#: Standard deviation of a measured rotation, rad per axis: what PnP over a dense flow gives on a driving video with
#: depth, and of the yaw without depth, as a turn and a step aside look similar.
_TURN_NOISE: Final = (np.radians(0.045), np.radians(0.12))

#: Without depth a rotation has no depth's errors: between two sharp images flow gives it to a tenth of a pixel.
_FLOW_NOISE: Final = np.radians(0.01)

#: Yaw rate: it decays within the seconds that a bend takes, its rate of change follows the steering wheel (s), and
#: reaches from a lane's corrections to a crossing's (rms, rad/s^2: a turn of 30 degrees/s entered within 1 s is 0.5).
_BENDS: Final = (2.0, 5.0, 15.0)
_STEERING: Final = (0.3, 0.7, 1.5)
_TURNING: Final = (0.02, 0.06, 0.2, 0.6)

#: Pitch and roll: body modes between 1 and 2 Hz with dampers at 0.3 to 0.6 of critical (Gillespie), angles (rms,
#: degrees) from motorways to cobbles.
_BODY_HERTZ: Final = (1.0, 1.7)
_BODY_DAMPING: Final = (0.3, 0.6)
_BODY_DEGREES: Final = (0.02, 0.05, 0.15, 0.4)

#: The road's grade and banking: rms rate, degrees/s (a vertical curve of 700 m radius at 10 m/s has 0.8), and
#: correlation time, s.
_ROAD_RATES: Final = (0.05, 0.2, 0.8)
_ROAD_SECONDS: Final = (0.5, 2.0)

#: Acceleration: rms, m/s^2, from cruising to firm braking, and correlation time, s. Noise of a measured length, m.
_ACCELERATION: Final = (0.3, 0.8, 2.0)
_PEDAL_SECONDS: Final = (0.4, 1.0, 2.5)
_LENGTH_NOISE: Final = (0.004, 0.012)

#: Speed before anything is measured, m/s, standard deviation: never surprising.
_ANY_SPEED: Final = 20.0

#: How a camera sits: standard deviations of its angle to the direction of driving (rad) and of its distance ahead of
#: the centre of rotation (m). The rest of the motion across: rms, m/s, correlation time, s; noise, m.
_ASKEW: Final = 0.05
_AHEAD: Final = 1.5
_ACROSS: Final = (0.03, 0.1)
_ACROSS_SECONDS: Final = (0.1, 0.3, 1.0)
_ACROSS_NOISE: Final = 0.004

#: This many motions are the fewest to filter: one has no trend.
FEWEST: Final = 2


def _yaw(*noises: float) -> tuple[Model, ...]:
    return tuple(
        joined(driven_rate(decay, seconds, rms), noise=noise)
        for decay, seconds, rms, noise in itertools.product(_BENDS, _STEERING, _TURNING, noises)
    )


def _nod(*noises: float) -> tuple[Model, ...]:
    return tuple(
        joined(oscillator(hertz, damping, np.radians(degrees)), decaying_rate(seconds, np.radians(rate)), noise=noise)
        for hertz, damping, degrees, rate, seconds, noise in itertools.product(
            _BODY_HERTZ, _BODY_DAMPING, _BODY_DEGREES, _ROAD_RATES, _ROAD_SECONDS, noises
        )
    )


#: Models of yaw, and of pitch and roll, by whether rotations were measured without depth.
_YAW: Final = {False: _yaw(*_TURN_NOISE), True: _yaw(_FLOW_NOISE, *_TURN_NOISE)}
_NOD: Final = {False: _nod(_TURN_NOISE[0]), True: _nod(_FLOW_NOISE, _TURN_NOISE[0])}
_SPEED: Final = tuple(
    joined(driven_rate(np.inf, seconds, rms, _ANY_SPEED), noise=noise)
    for seconds, rms, noise in itertools.product(_PEDAL_SECONDS, _ACCELERATION, _LENGTH_NOISE)
)


class CameraForecaster:
    """Takes in measured motions one after the other, and forecasts from the last one on.

    S drives may be filtered at once; all of them have their frames at the same times.
    """

    def __init__(self, batch: int = 1, by_flow: bool = False) -> None:
        """Nothing measured yet.

        Args:
            batch: S.
            by_flow: whether motions are measured from flow only, without depth.
        """
        self.measured = 0
        self._pitch, self._yaw, self._roll = (Bank(of[by_flow], batch) for of in (_NOD, _YAW, _NOD))
        self._speed = Bank(_SPEED, batch)
        self._sideways, self._vertical = _Across(batch), _Across(batch)
        self._constant: tuple[Array, float] | None = None

    def measure(self, cur_from_prev: ArrayLike | None, seconds: float) -> None:
        """Take in the camera's motion over the next frame interval.

        Args:
            cur_from_prev: [4, 4] or [S, 4, 4] m, x_cur = R x_prev + t; None where it could not be measured.
            seconds: the interval, above 0.

        Raises:
            ValueError: another shape, numbers that are not finite, or an interval of 0 s or less.
        """
        if not 0 < seconds < np.inf:
            raise ValueError(f"`seconds` must be positive, got {seconds}")
        if cur_from_prev is None:
            for bank in self._banks:
                bank.measure(None, seconds)
            return
        motion = np.asarray(cur_from_prev, np.float64)
        if motion.shape[-2:] != (4, 4) or not np.isfinite(motion).all():
            raise ValueError(f"`cur_from_prev` must be finite and [4, 4] or [S, 4, 4], got {list(motion.shape)}")
        numbers = _numbers(motion.reshape(-1, 4, 4))
        for bank, increments in zip(self._banks, numbers.T[[0, 1, 2, 5]], strict=True):
            bank.measure(increments, seconds)
        self._sideways.measure(numbers[:, 3], numbers[:, 5], numbers[:, 1], seconds)
        self._vertical.measure(numbers[:, 4], numbers[:, 5], numbers[:, 0], seconds)
        self.measured += 1
        self._constant = numbers, seconds

    def forecast(self, seconds: Sequence[float]) -> Array:
        """``future_from_cur`` at rising times after the last frame.

        Args:
            seconds: from the last frame on, rising, above 0.

        Returns:
            [len(seconds), S, 4, 4] m. Of a single motion, it is that motion's yaw and translation at constant velocity.

        Raises:
            ValueError: nothing measured, or times that do not rise from 0.
        """
        if self._constant is None:
            raise ValueError("`measure` must be called before `forecast`, at least once")
        if not len(seconds) or np.any(np.diff([0.0, *seconds]) <= 0):
            raise ValueError(f"`seconds` must rise from 0, got {list(seconds)}")
        # A path is bent: it is put together of pieces that are no longer than the last interval.
        pieces = [max(1, round(gap / self._constant[1])) for gap in np.diff([0.0, *seconds])]
        ends = np.interp(np.arange(sum(pieces) + 1), [0, *np.cumsum(pieces)], [0.0, *seconds])[1:]
        increments = self._increments(ends) if self.measured >= FEWEST else self._constant_velocity(ends)
        future, path = np.eye(4), []
        for step in increments:
            future = _matrices(step) @ future
            path.append(future)
        return np.stack(path)[np.cumsum(pieces) - 1]

    @property
    def _banks(self) -> tuple[Bank, Bank, Bank, Bank]:
        return self._pitch, self._yaw, self._roll, self._speed

    def _increments(self, seconds: Array) -> Array:
        """[T, S, 6], the motion of each interval between ``seconds``."""
        pitch, yaw, roll, ahead = (np.diff(bank.forecast(seconds), axis=0, prepend=0) for bank in self._banks)
        assert self._constant is not None
        forwards = np.sign(self._constant[0][:, 5])
        ahead = np.where(ahead * forwards < 0, 0, ahead)  # who brakes comes to a stop
        sideways = self._sideways.forecast(seconds, ahead, yaw)
        vertical = self._vertical.forecast(seconds, ahead, pitch)
        return np.stack([pitch, yaw, roll, sideways, vertical, ahead], axis=-1)

    def _constant_velocity(self, seconds: Array) -> Array:
        assert self._constant is not None
        numbers, interval = self._constant
        kept = numbers * [0, 1, 0, 1, 1, 1]
        return np.diff([0.0, *seconds])[:, None, None] / interval * kept


class _Across:
    """y = b z + c w + e: increments of a motion across the direction of driving, by those along it and of a rotation.

    b and c are constants that are estimated, e an Ornstein-Uhlenbeck process: a bank of Kalman filters with the
    measured z and w for regressors.
    """

    def __init__(self, batch: int) -> None:
        self._rest, self._time = np.array(list(itertools.product(_ACROSS, _ACROSS_SECONDS))).T
        self._mean = np.zeros((batch, len(self._time), 3))
        self._covariance = np.zeros((batch, len(self._time), 3, 3))
        self._covariance[..., 0, 0], self._covariance[..., 1, 1] = _ASKEW**2, _AHEAD**2
        self._covariance[..., 2, 2] = self._rest**2
        self._evidence = np.zeros((batch, len(self._time)))

    def measure(self, across: Array, along: Array, turn: Array, seconds: float) -> None:
        """Take in increments [S] over an interval."""
        decay = np.stack([np.ones_like(self._time), np.ones_like(self._time), np.exp(-seconds / self._time)], axis=-1)
        mean = decay * self._mean
        covariance = decay[:, :, None] * self._covariance * decay[:, None, :]
        covariance[..., 2, 2] += self._rest**2 * (1 - decay[:, 2] ** 2)
        regressors = np.stack([along, turn, np.full_like(along, seconds)], axis=-1)
        shared = np.einsum("smij,sj->smi", covariance, regressors)
        variance = np.einsum("smi,si->sm", shared, regressors) + _ACROSS_NOISE**2
        innovation = across[:, None] - np.einsum("smi,si->sm", mean, regressors)
        likelihood = -(innovation**2 / variance + np.log(variance)) / 2
        self._evidence = np.exp(-seconds / MEMORY) * self._evidence + likelihood
        gain = shared / variance[..., None]
        self._mean = mean + gain * innovation[..., None]
        self._covariance = covariance - gain[..., :, None] * shared[..., None, :]

    def forecast(self, seconds: Array, along: Array, turn: Array) -> Array:
        """[T, S] increments of each interval between ``seconds``, by those forecast of the others [T, S]."""
        weights = softmax(self._evidence)
        askew, ahead = (np.sum(weights * self._mean[..., part], axis=1) for part in (0, 1))
        times = np.array([0.0, *seconds])
        lasting = -np.diff(np.exp(-times[:, None] / self._time), axis=0) * self._time  # its integral over the interval
        return askew * along + ahead * turn + np.einsum("sm,sm,tm->ts", weights, self._mean[..., 2], lasting)


def forecast_camera(
    motions: Sequence[ArrayLike | None], intervals: Sequence[float], ahead: Sequence[float], by_flow: bool = False
) -> list[Array]:
    """``future_from_cur`` by the last motions of a camera.

    Args:
        motions: [4, 4] m each, ``cur_from_prev`` of consecutive frames, oldest first; None where one could not be
            measured. At least one is not None.
        intervals: seconds of each.
        ahead: seconds after the last frame, rising.
        by_flow: whether motions are measured from flow only, without depth.

    Returns:
        [4, 4] m for each of ``ahead``.

    Raises:
        ValueError: no motion, not as many intervals, or as `CameraForecaster`.
    """
    if len(motions) == 0 or len(motions) != len(intervals):
        raise ValueError(
            f"`motions` and `intervals` must have equal length of 1 or more, got {len(motions)}, {len(intervals)}"
        )
    forecaster = CameraForecaster(by_flow=by_flow)
    for motion, seconds in zip(motions, intervals, strict=True):
        forecaster.measure(motion, seconds)
    return [future[0] for future in forecaster.forecast(ahead)]


def _numbers(motion: Array) -> Array:
    """[S, 6]: rotation vector, rad, and translation, m, of [S, 4, 4]."""
    turn = Rotation.from_matrix(motion[:, :3, :3]).as_rotvec()
    return np.concatenate([turn, motion[:, :3, 3]], axis=1)


def _matrices(numbers: Array) -> Array:
    """What `_numbers` was given."""
    motion = np.tile(np.eye(4), (len(numbers), 1, 1))
    motion[:, :3, :3], motion[:, :3, 3] = Rotation.from_rotvec(numbers[:, :3]).as_matrix(), numbers[:, 3:]
    return motion

"""Banks of linear models of motion, filtered side by side and weighted by how well each forecast what was measured.

A model is a linear stochastic system, dx = A x dt + noise of spectral density Q, of which increments are measured:
y = integral of C x over the interval + noise of standard deviation r. Its Kalman filter forecasts each measurement
before it comes: N(e; 0, v) is the likelihood of the innovation e. Models are weighted by the product of their
likelihoods, of which old ones are forgotten: w_i ~ exp(sum_t lambda^(T - t) log N(e_it; 0, v_it)).

Source: Kalman, 1960; Magill, Optimal adaptive estimation of sampled stochastic processes, 1965 (the bank); Van Loan,
Computing integrals involving the matrix exponential, 1978 (the discretisation).
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm, solve_continuous_lyapunov  # type: ignore[import-untyped]

Array = NDArray[np.float64]

#: Seconds after which a likelihood counts 1 / e in a model's weight: roads and driving change.
MEMORY: Final = 2.0

#: Decimals that intervals, seconds, are rounded to, so that the same one is discretised once.
_MICROSECONDS: Final = 6

#: Seconds that are integrated at once.
_LONGEST: Final = 1.0


@dataclass(frozen=True, eq=False)
class Model:
    """A linear system of n states whose increments are measured. See the module."""

    drift: Array
    """A [n, n], 1/s."""
    density: Array
    """Q [n, n], squared units of the states per second."""
    rate: Array
    """C [n], units of the measurement per second."""
    covariance: Array
    """P0 [n, n], of the states before anything is measured."""
    noise: float
    """r, units of the measurement."""


def joined(*models: Model, noise: float) -> Model:
    """The sum of independent systems, measured with ``noise``."""
    return Model(
        block_diag(*(model.drift for model in models)),
        block_diag(*(model.density for model in models)),
        np.concatenate([model.rate for model in models]),
        block_diag(*(model.covariance for model in models)),
        noise,
    )


def oscillator(hertz: float, damping: float, rms: float) -> Model:
    """x'' + 2 z w x' + w^2 x = white noise, w = 2 pi ``hertz``, z = ``damping``; x has ``rms``. Increments of x."""
    w = 2 * np.pi * hertz
    drift = np.array([[0, 1], [-w * w, -2 * damping * w]])
    density = np.diag([0, 4 * damping * w**3 * rms**2])
    return Model(drift, density, np.array([0.0, 1.0]), np.diag([rms**2, (rms * w) ** 2]), 0.0)


def decaying_rate(seconds: float, rms: float) -> Model:
    """A rate that is an Ornstein-Uhlenbeck process, of ``rms`` a second and correlation time ``seconds``."""
    drift, density = np.array([[-1 / seconds]]), np.array([[2 * rms**2 / seconds]])
    return Model(drift, density, np.ones(1), np.array([[rms**2]]), 0.0)


def driven_rate(decay: float, seconds: float, rms: float, spread: float | None = None) -> Model:
    """rate' = -rate / ``decay`` + a, with a an Ornstein-Uhlenbeck process of ``rms`` and ``seconds`` (Singer, 1970).

    Args:
        decay: s; infinity for a rate that does not return to 0, which then needs ``spread``.
        seconds: correlation time of a, s.
        rms: of a, units per second squared.
        spread: standard deviation of the rate before anything is measured; None is the stationary one.
    """
    drift = np.array([[-1 / decay, 1], [0, -1 / seconds]])
    density = np.diag([0, 2 * rms**2 / seconds])
    start = solve_continuous_lyapunov(drift, -density) if spread is None else np.diag([spread**2, rms**2])
    return Model(drift, density, np.array([1.0, 0.0]), start, 0.0)


class Bank:
    """Kalman filters of several models, on a batch of independent sequences that are measured at the same times."""

    def __init__(self, models: Sequence[Model], batch: int = 1) -> None:
        """Nothing measured yet.

        Args:
            models: M of them, of any numbers of states.
            batch: S sequences.
        """
        self._models = tuple(models)
        size = max(len(model.drift) for model in models) + 1  # the last state is the increment since the last frame
        self._mean = np.zeros((batch, len(models), size))
        self._covariance = np.zeros((len(models), size, size))
        for covariance, model in zip(self._covariance, models, strict=True):
            states = len(model.drift)
            covariance[:states, :states] = model.covariance
        self._noise = np.array([model.noise**2 for model in models])
        self._evidence = np.zeros((batch, len(models)))

    @property
    def weights(self) -> Array:
        """[S, M], sums 1."""
        return softmax(self._evidence)

    def measure(self, increments: Array | None, seconds: float) -> None:
        """Take in what was measured.

        Args:
            increments: [S], over the interval; None where it was not measured.
            seconds: its length.
        """
        step, noise = _transition(self._models, round(seconds, _MICROSECONDS))
        mean = np.einsum("mij,smj->smi", step, self._mean)
        covariance = step @ self._covariance @ step.transpose(0, 2, 1) + noise
        if increments is None:
            self._mean, self._covariance = mean, covariance
            return
        variance = covariance[:, -1, -1] + self._noise
        innovation = increments[:, None] - mean[..., -1]
        likelihood = -(innovation**2 / variance + np.log(variance)) / 2
        self._evidence = np.exp(-seconds / MEMORY) * self._evidence + likelihood
        gain = covariance[:, :, -1] / variance[:, None]
        self._mean = mean + gain * innovation[..., None]
        covariance -= gain[:, :, None] * covariance[:, None, -1]
        self._covariance = (covariance + covariance.transpose(0, 2, 1)) / 2

    def forecast(self, seconds: Sequence[float] | Array) -> Array:
        """The models' mean forecast of the increments from now to each of some rising times, [len(seconds), S]."""
        weights, mean, total, done, last = self.weights, self._mean, [], 0.0, 0.0
        for until in seconds:
            step, _ = _transition(self._models, round(until - last, _MICROSECONDS))
            mean, last = np.einsum("mij,smj->smi", step, mean), until
            done = done + np.sum(weights * mean[..., -1], axis=1)
            total.append(done)
        return np.stack(total)


@functools.lru_cache(maxsize=256)
def _transition(models: tuple[Model, ...], seconds: float) -> tuple[Array, Array]:
    """F and the noise's covariance over an interval, [M, n, n] each, by Van Loan's block exponential.

    That has exp(-drift t) as well, which is beyond float64 after a long gap: intervals above `_LONGEST` are doubled,
    F(2t) = F(t)^2, Q(2t) = F(t) Q(t) F(t)^T + Q(t).
    """
    doubled = math.ceil(math.log2(seconds / _LONGEST)) if seconds > _LONGEST else 0
    size = max(len(model.drift) for model in models) + 1
    steps, noises = np.zeros((2, len(models), size, size))
    for index, model in enumerate(models):
        states = len(model.drift)
        drift, density = np.zeros((2, states + 1, states + 1))
        drift[:states, :states], drift[states, :states] = model.drift, model.rate
        density[:states, :states] = model.density
        grown = expm(np.block([[-drift, density], [np.zeros_like(drift), drift.T]]) * (seconds / 2**doubled))
        step = grown[states + 1 :, states + 1 :].T
        noise = step @ grown[: states + 1, states + 1 :]
        for _ in range(doubled):
            step, noise = step @ step, step @ noise @ step.T + noise
        step[:, states] = 0  # each interval's increment counts from 0
        place = np.ix_([*range(states), size - 1], [*range(states), size - 1])
        steps[index][place], noises[index][place] = step, noise
    return steps, noises


def softmax(evidence: Array) -> Array:
    """exp(evidence) over the last axis, normalised to the sum 1."""
    weights = np.exp(evidence - evidence.max(axis=-1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True), np.float64)

"""A bounded correction of a camera's forecast motion: how far it may go is what a car can do within the time.

D_k = exp(g_k b_k tanh(a_k)) of frame interval k = 1, 2 ... after t, with the time dt between frames:

    a_k  linear in the mean token, and in the numbers of the motions that were measured and forecast
    b_k  rotation  TURN_RATE dt, translation  ACCELERATION dt (k dt): the speed that a car gains until then, times dt
    g_k  in [0, 1], learned, 0 at the start and where training showed no gain

So the correction is 0 until training finds one that helps, and never more than a car can do.
"""

from typing import Any, Final, NamedTuple

import torch
from torch import nn

from vestcl.models.networks.rigid_motion import RigidMotion

#: Rad/s by which a forecast rate of rotation may be wrong: a steering wheel is turned within a second, and kerbs and
#: bumps tilt a car by degrees at 1 to 2 Hz.
TURN_RATE: Final = 0.25

#: m/s^2: emergency braking has 8 to 10, and what else a car does less than 5.
ACCELERATION: Final = 6.0

#: Seconds between frames where a prior has none: KITTI's.
INTERVAL: Final = 0.1

#: Motions that were measured before the current frame, which the network is shown; and numbers of each: rotation rate,
#: velocity, and 1 where it was measured.
MEASURED: Final = 4
RATES: Final = 7

#: Numbers of a small motion: rotation vector and translation.
NUMBERS: Final = 6

#: Rates of rotation, rad/s, and velocities, m/s, are shown to the network times that.
_SHOWN: Final = (10.0, 0.1)

#: m/s from which on a correction counts in full: a static car does not turn or sway, and half of what little is
#: measured of it is noise.
_ROLLING: Final = 5.0


class CameraPrior(NamedTuple):
    """What is known of a camera's motion before a network looks: see `vestcl.models.steps.prior.MotionPrior`."""

    next_from_cur: RigidMotion
    cur_from_prev: RigidMotion
    prev_from_before: RigidMotion
    later: RigidMotion | None = None
    measured: torch.Tensor | None = None
    seconds: torch.Tensor | None = None

    def interval(self, k: int) -> RigidMotion:
        """The forecast motion of interval ``k`` after t, 0 from t to t + 1; the last one that is known repeats."""
        if k == 0 or self.later is None or not self.later.translation.shape[1]:
            return self.next_from_cur
        last = min(k, self.later.translation.shape[1]) - 1
        return RigidMotion(self.later.quaternion[:, last], self.later.translation[:, last])

    @property
    def intervals(self) -> int:
        """Number of intervals whose motion is known."""
        return 1 if self.later is None else 1 + self.later.translation.shape[1]

    @property
    def dt(self) -> torch.Tensor:
        """[B, 1] s between frames."""
        translation = self.next_from_cur.translation
        return translation.new_full((len(translation), 1), INTERVAL) if self.seconds is None else self.seconds[:, None]

    @property
    def rates(self) -> torch.Tensor:
        """[B, MEASURED, RATES] of the last motions, oldest first; of two where no more are known."""
        if self.measured is not None:
            return self.measured
        return rates_of([self.prev_from_before, self.cur_from_prev], self.dt)


class BoundedCorrection(nn.Module):
    """The last layers of EMF, as the head of this file has them.

    Args:
        path: frame intervals ahead that have their own correction; the last one holds for all later ones.
        tokens: channels of a token.
    """

    def __init__(self, path: int, tokens: int) -> None:
        super().__init__()
        shown = MEASURED * RATES + path * NUMBERS + 1
        self.path = path
        self.shown = nn.Linear(shown, tokens)
        self.seen = nn.Linear(tokens, path * NUMBERS)
        self.swayed = nn.Linear(shown, path * NUMBERS, bias=False)
        self.gate = nn.Parameter(torch.zeros(path, NUMBERS))

    @property
    def changes_nothing(self) -> bool:
        """Whether all gates are closed."""
        return not bool((self.gate > 0).any())

    def numbers(self, prior: CameraPrior) -> torch.Tensor:
        """What the network is shown of ``prior``: measured and forecast rates, and log(dt / INTERVAL).

        Returns:
            [B, numbers].
        """
        scale = prior.dt.new_tensor([_SHOWN[0]] * 3 + [_SHOWN[1]] * 3)
        ahead = torch.stack([_numbers(prior.interval(k)) for k in range(self.path)], dim=1) / prior.dt[:, None]
        measured = prior.rates * torch.cat([scale, scale.new_ones(1)])
        return torch.cat([measured.flatten(1), (ahead * scale).flatten(1), (prior.dt / INTERVAL).log()], dim=1)

    def forward(self, mean: torch.Tensor, numbers: torch.Tensor, prior: CameraPrior) -> list[RigidMotion]:
        """The camera's motion of each interval after t, corrected: D_k G_k.

        Args:
            mean: [B, tokens], the mean token.
            numbers: of `numbers`.
            prior: G.

        Returns:
            As many as ``path``, or as the prior has; differentiable.
        """
        said = torch.tanh(self.seen(mean) + self.swayed(numbers)).unflatten(1, (self.path, NUMBERS))
        clamped = self.gate + (self.gate.clamp(0, 1) - self.gate).detach()  # learns beyond its range, too
        corrections = (clamped * said * self._bounds(prior)).unbind(1)
        count = max(self.path, prior.intervals)
        motions = [_motion(corrections[min(k, self.path - 1)]) for k in range(count)]
        return [motion.after(prior.interval(k)) for k, motion in enumerate(motions)]

    def _bounds(self, prior: CameraPrior) -> torch.Tensor:
        """b [B, path, 6], rad and m; less of a camera that hardly moves."""
        dt = prior.dt
        k = torch.arange(1, self.path + 1, dtype=dt.dtype, device=dt.device)
        turn = (TURN_RATE * dt).expand(-1, self.path)
        bounds = torch.stack([turn] * 3 + [ACCELERATION * dt.square() * k] * 3, dim=2)
        speed = torch.linalg.vector_norm(prior.cur_from_prev.translation, dim=1, keepdim=True) / dt
        return bounds * (speed / _ROLLING).clamp(max=1)[:, None]


def rates_of(motions: list[RigidMotion], seconds: torch.Tensor) -> torch.Tensor:
    """The last motions as rates.

    Args:
        motions: B of each, of consecutive frames, oldest first.
        seconds: [B, n], or [B, 1] of all, that they took.

    Returns:
        [B, MEASURED, RATES]: rad/s, m/s, and 1; all 0 where there is no motion.
    """
    kept = motions[-MEASURED:]
    rates = torch.stack([_numbers(motion) for motion in kept], dim=1) / seconds[:, -len(kept) :, None]
    known = torch.cat([rates, rates.new_ones(len(rates), len(kept), 1)], dim=2)
    return torch.cat([known.new_zeros(len(known), MEASURED - len(kept), RATES), known], dim=1)


def as_prior(prior: Any) -> CameraPrior:
    """A `CameraPrior` of that, or of its first parts."""
    return prior if isinstance(prior, CameraPrior) else CameraPrior(*prior)


def _numbers(motion: RigidMotion) -> torch.Tensor:
    """[B, 6]: the rotation vector of a small rotation, 2 sign(w) v / |q|, and the translation."""
    w, vector = motion.quaternion.split([1, 3], dim=1)
    length = torch.linalg.vector_norm(motion.quaternion, dim=1, keepdim=True).clamp(min=1e-8)
    return torch.cat([2 * torch.where(w < 0, -vector, vector) / length, motion.translation], dim=1)


def _motion(numbers: torch.Tensor) -> RigidMotion:
    """[B, 6] -> the rotation exp(r), as (cos |r| / 2, r / 2 sinc(|r| / 2)), and the translation."""
    turn, shift = numbers.split(3, dim=1)
    angle = torch.linalg.vector_norm(turn, dim=1, keepdim=True)
    return RigidMotion(torch.cat([(angle / 2).cos(), turn / 2 * torch.sinc(angle / (2 * torch.pi))], dim=1), shift)

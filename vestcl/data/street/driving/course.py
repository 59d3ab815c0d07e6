"""A street's way through the plane: straights, arcs, and clothoids between them, on which curvature is linear.

A course is measured by s, metres along its middle line from where it passes the origin along +z. Its heading theta, the
radians from +z towards +x, has the derivative kappa(s), the curvature: positive to the right. In the world's x and z,
c'(s) = (sin theta, cos theta).
"""

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: A bend's radius is that share of the smallest radius for the design speed, log-uniform.
RADIUS_FACTORS: Final = (1.0, 3.0)

#: Side friction and superelevation that the smallest radius counts on, v^2 / (g (e + f)): for 30 to 70 km/h in towns
#: f is 0.28 to 0.15, e 0 to 0.04 (AASHTO, A Policy on Geometric Design of Highways and Streets, 7th ed. 2018, 3.3).
SIDE_FRICTION: Final = 0.22

#: m/s^2.
GRAVITY: Final = 9.81

#: No radius is below that, metres: houses stand up to 11 m from the middle line. RASt 06 (FGSV, Directives for the
#: Design of Urban Roads, 2006) has 10 m at least for built-up streets of 30 km/h, AASHTO 50 m at 40 km/h.
SMALLEST_RADIUS: Final = 40.0

#: The clothoid's parameter A = sqrt(R L) over the radius: R / 3 <= A <= R (RAS-L, FGSV 1995, 4.3).
CLOTHOID_SHARES: Final = (1 / 3, 1.0)

#: Lateral jerk that a clothoid allows at the design speed, m/s^3: L >= v^3 / (R C); 0.3 to 0.9 m/s^3 is comfortable,
#: 1.2 m/s^3 the most (AASHTO 2018, 3.3.8.3).
LATERAL_JERK: Final = 1.2

#: A bend's whole turn, radians, and the heading that no bend goes beyond: a course never meets itself.
TURNS: Final = (np.radians(8.0), np.radians(60.0))
FARTHEST_HEADING: Final = np.radians(62.0)

#: Straights between bends, in seconds at the design speed; the shorter half are reverse curves.
STRAIGHTS: Final = (0.0, 8.0)

#: Metres between the points that are kept, and of course that is laid out at once.
STEP: Final = 1.0
REACH: Final = 2048

#: Nodes and weights of Gauss and Legendre's quadrature on [0, 1].
_NODES: Final = (1 + np.polynomial.legendre.leggauss(4)[0]) / 2
_WEIGHTS: Final = np.polynomial.legendre.leggauss(4)[1] / 2

#: Streams of random numbers: one for each direction.
_PURPOSE: Final = 40

#: Newton's steps to the nearest point of a course.
_NEWTON: Final = 12


@dataclass(frozen=True)
class Course:
    """Endless in both directions, straight at s = 0."""

    seed: int
    speed: float
    """Design speed, m/s: faster streets bend less."""

    def curvature(self, s: ArrayLike) -> Array:
        """kappa, 1/m, at s [...]: piecewise linear."""
        s = np.asarray(s, np.float64)
        knots, kappa, _ = self._knots(s)
        return np.interp(s, knots, kappa)

    def heading(self, s: ArrayLike) -> Array:
        """theta, radians, at s [...]: the integral of the curvature, in closed form."""
        s = np.asarray(s, np.float64)
        knots, kappa, theta = self._knots(s)
        index = np.clip(np.searchsorted(knots, s, "right") - 1, 0, len(knots) - 2)
        along = s - knots[index]
        slope = (kappa[index + 1] - kappa[index]) / (knots[index + 1] - knots[index])
        return theta[index] + along * (kappa[index] + along * slope / 2)

    def at(self, s: ArrayLike) -> Array:
        """[..., 3] x and z in metres and heading in radians, at s [...]."""
        s = np.asarray(s, np.float64)
        points = _points(self, _reach(s))
        index = np.clip(np.floor(s / STEP).astype(np.intp) + len(points) // 2, 0, len(points) - 1)
        start = (index - len(points) // 2) * STEP
        rest = s - start
        theta = self.heading(start[..., None] + rest[..., None] * _NODES)
        x = points[index, 0] + rest * _mean(np.sin(theta))
        z = points[index, 1] + rest * _mean(np.cos(theta))
        return np.stack([x, z, self.heading(s)], axis=-1)

    def nearest(self, x: float, z: float) -> float:
        """s of the point that is nearest to (x, z), of a point closer to the course than its centres of curvature."""
        points = _points(self, _reach(np.asarray(1.3 * abs(z) / np.cos(FARTHEST_HEADING))))
        s = float(np.interp(z, points[:, 1], STEP * (np.arange(len(points)) - len(points) // 2)))
        for _ in range(_NEWTON):
            cx, cz, theta = self.at(s)
            ahead = (x - cx) * np.sin(theta) + (z - cz) * np.cos(theta)
            aside = (x - cx) * np.cos(theta) - (z - cz) * np.sin(theta)
            s += float(ahead / max(1 - self.curvature(s) * aside, 0.2))
        return s

    def _knots(self, s: Array) -> tuple[Array, Array, Array]:
        return _knots(self, _reach(s))


def _reach(s: Array) -> int:
    """The smallest REACH 2^k that holds all s."""
    farthest, reach = float(np.max(np.abs(s), initial=0.0)) + 2 * STEP, REACH
    while reach < farthest:
        reach *= 2
    return reach


def _mean(values: Array) -> Array:
    """Over [0, 1], of values [..., nodes]; written out, as a product's last bits depend on how many there are."""
    return np.asarray(sum(values[..., i] * weight for i, weight in enumerate(_WEIGHTS)), np.float64)


@functools.lru_cache(maxsize=16)
def _points(course: Course, reach: int) -> Array:
    """[2 reach / STEP + 1, 2] x and z at s = -reach ... reach."""
    starts = np.arange(0.0, reach, STEP)
    halves = []
    for sign in (-1, 1):
        theta = course.heading(sign * (starts[:, None] + STEP * _NODES))
        steps = sign * STEP * np.stack([_mean(np.sin(theta)), _mean(np.cos(theta))], axis=1)
        halves.append(np.cumsum(steps, axis=0))
    return np.concatenate([halves[0][::-1], np.zeros((1, 2)), halves[1]])


@functools.lru_cache(maxsize=16)
def _knots(course: Course, reach: int) -> tuple[Array, Array, Array]:
    """s, kappa and theta where straights, clothoids and arcs meet, to ``reach`` and beyond on either side."""
    (back, back_kappa), (ahead, ahead_kappa) = (_half(course, side, reach) for side in (0, 1))
    s = np.concatenate([-back[::-1], ahead[1:]])
    kappa = np.concatenate([back_kappa[::-1], ahead_kappa[1:]])
    turns = (kappa[1:] + kappa[:-1]) / 2 * np.diff(s)
    here = len(back) - 1  # summed from s = 0 on, so that a farther reach changes no bit
    return s, kappa, np.concatenate([-np.cumsum(turns[:here][::-1])[::-1], [0.0], np.cumsum(turns[here:])])


def _half(course: Course, side: int, reach: int) -> tuple[Array, Array]:
    """Distances from the origin and curvatures of the knots on one side."""
    rng = np.random.default_rng([course.seed, _PURPOSE, side])
    s, kappa, heading = [0.0], [0.0], 0.0
    while s[-1] <= reach:
        straight, *bend = _bend(rng, course.speed, heading)
        radius, clothoid, arc, sign = bend
        for length, bent in ((straight, 0.0), (clothoid, 1.0), (arc, 1.0), (clothoid, 0.0)):
            s.append(s[-1] + max(length, 0.01))
            kappa.append(bent * sign / radius)
        heading += sign * (clothoid + max(arc, 0.01)) / radius
    return np.array(s), np.array(kappa)


def _bend(rng: np.random.Generator, speed: float, heading: float) -> tuple[float, float, float, float, float]:
    """A straight and the bend after it: its length; radius, length of a clothoid, length of the arc, side."""
    straight = rng.uniform(*STRAIGHTS) * speed
    least = max(speed**2 / (GRAVITY * SIDE_FRICTION), SMALLEST_RADIUS)
    radius = float(least * np.exp(rng.uniform(*np.log(RADIUS_FACTORS))))
    clothoid = max(radius * rng.uniform(*CLOTHOID_SHARES) ** 2, speed**3 / (radius * LATERAL_JERK))
    turn = max(rng.uniform(*TURNS), clothoid / radius)
    side = float(rng.choice([-1.0, 1.0]))
    if abs(heading + side * turn) > FARTHEST_HEADING:
        side = -float(np.sign(heading))
    return straight, radius, clothoid, turn * radius - clothoid, side

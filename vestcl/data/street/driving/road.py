"""How a car drives along a course: a driver who slows for bends and stops, and a body on springs over a rough road.

All of it is a function of time: the same drive at another frame rate has the same poses at the same times. The driver
is Treiber's intelligent driver model (Treiber, Hennecke and Helbing 2000, Congested traffic states), with limited jerk:

    dv/dt = a (1 - (v / v0)^4 - ((S0 + v T + v^2 / (2 sqrt(a b))) / gap)^2)

where v0 is the desired speed, within sqrt(lateral / |kappa|) in bends and braked for at b before them, and gap the
distance to the next stop. Pitch, roll and height are damped oscillators,

    x'' + 2 z w x' + w^2 x = w^2 g a + 2 z w u' + w^2 u

with the car's longitudinal or lateral acceleration a, its gain g, and the road u below the axles.
"""

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.data.street.driving.course import GRAVITY, Course
from vestcl.data.street.driving.profile import ROUGHNESS, TRACK, profile

Array = NDArray[np.float64]

#: Desired speeds, m/s: 25 to 80 km/h.
SPEEDS: Final = (7.0, 22.0)

#: Acceleration, comfortable deceleration and lateral acceleration of drivers, m/s^2. Treiber et al. 2000 have 0.73 and
#: 1.67; ISO 15622:2018 lets adaptive cruise control accelerate at 2.0; AASHTO 2018 (3.2.2) takes 3.4 to be comfortable
#: for most. Lateral: 1.5 to 4 in bends at 10 to 20 m/s (Reymond et al. 2001, Role of lateral acceleration in curve
#: driving, Human Factors 43).
ACCELERATIONS: Final = (0.8, 2.0)
DECELERATIONS: Final = (1.2, 3.4)
LATERAL: Final = (1.5, 3.0)

#: Jerk of drivers and of adaptive cruise control, m/s^3 (ISO 15622:2018: 2.5 when braking above 20 m/s).
JERK: Final = 2.5

#: Time headway in seconds and distance at standstill in metres of the model (Treiber et al. 2000: 1.6 and 2).
HEADWAY, STANDSTILL = 1.5, 2.0

#: Metres between two stops or slow stretches, the share that are stops, seconds of a stop; metres of a slow stretch and
#: the share of the desired speed there. Chosen: a signal or a hindrance every two blocks or so.
EVENTS: Final = (90.0, 320.0)
STOPS: Final = 0.3
DWELLS: Final = (1.0, 6.0)
SLOW_LENGTHS: Final = (5.0, 50.0)
SLOW_SHARES: Final = (0.3, 0.8)

#: Undamped frequencies of passenger cars' bodies in Hz, damping ratio, degrees of pitch and roll per g of acceleration:
#: Gillespie 1992, Fundamentals of Vehicle Dynamics, chapters 5 and 6 (ride 1 to 1.5 Hz, damping 0.2 to 0.4); roll 3
#: to 7 and pitch 1 to 3 degrees per g (Milliken and Milliken 1995, Race Car Vehicle Dynamics, chapter 16).
RIDE_HERTZ: Final = (1.0, 1.6)
DAMPING: Final = (0.2, 0.4)
PITCH_DEGREES: Final = (1.0, 3.0)
ROLL_DEGREES: Final = (3.0, 7.0)

#: Wheelbase, metres, of a compact car.
WHEELBASE: Final = 2.65

#: (wavelength in m, amplitude in m) of the wander in the lane: a standard deviation of 0.15 m; 0.15 to 0.25 m in tests
#: on roads (O'Hanlon et al. 1982, Diazepam impairs lateral position control in highway driving, Science 217).
WANDER: Final = ((190.0, 0.17), (83.0, 0.11), (47.0, 0.04))

#: Seconds: of the driver's time step, of a stretch that is simulated at once, and when the first one begins.
TICK: Final = 0.05
STRETCH: Final = 60.0
BEGINNING: Final = -120.0

#: Seconds: of the body's time step, of its stretches, and of the settling before each, after which exp(-8 z w) of the
#: start is left, some 1e-5.
BODY_TICK: Final = 0.01
BODY_STRETCH: Final = 10.0
SETTLING: Final = 8.0

#: Metres between the points of the desired speed, and beyond a stretch's farthest end.
GRID: Final = 2.0
PREVIEW: Final = 300.0

#: Purpose of the random numbers of a drive.
_EVENTS, _WANDER, _DRAWN = 50, 53, 54


@dataclass(frozen=True)
class RoadDrive:
    """A car's drive along a course."""

    course: Course
    seed: int
    """Seed of stops, of the road's profile and of the wander in the lane."""
    speed: float
    """Desired on straights, m/s."""
    acceleration: float
    """m/s^2, as all of these."""
    deceleration: float
    lateral: float
    roughness: float
    """Gd(n0), m^3."""
    ride_hertz: float
    damping: float
    pitch_gain: float
    """Radians per m/s^2, as the roll's."""
    roll_gain: float
    stops: bool = True
    """Whether there are stops and slow stretches."""
    direction: float = 1.0
    """-1 drives the course from its other end: s metres along it are -s of the course's own."""

    @classmethod
    def drawn(cls, seed: int) -> "RoadDrive":
        """A course and a car on it, uniform in the ranges above; equal seeds give equal drives."""
        rng = np.random.default_rng([seed, _DRAWN])

        def drawn(span: tuple[float, float]) -> float:
            return float(rng.uniform(*span))

        speed = drawn(SPEEDS)
        return cls(
            course=Course(seed, speed),
            seed=seed,
            speed=speed,
            acceleration=drawn(ACCELERATIONS),
            deceleration=drawn(DECELERATIONS),
            lateral=drawn(LATERAL),
            roughness=float(np.exp(rng.uniform(*np.log(ROUGHNESS)))),
            ride_hertz=drawn(RIDE_HERTZ),
            damping=drawn(DAMPING),
            pitch_gain=float(np.radians(drawn(PITCH_DEGREES))) / GRAVITY,
            roll_gain=float(np.radians(drawn(ROLL_DEGREES))) / GRAVITY,
        )

    def at(self, t: ArrayLike) -> Array:
        """[..., 6] at times ``t`` [...] in seconds, see `street_drive`; yaw is from the course's heading."""
        t = np.asarray(t, np.float64)
        s, body = self.travelled(t), self._body(t)
        aside, slope, _ = self._wander(s)
        yaw = np.arctan2(slope, 1 - self.course.curvature(s) * aside)
        return np.stack([s, aside, -body[..., 2], yaw, body[..., 0], body[..., 1]], axis=-1)

    def travelled(self, t: ArrayLike) -> Array:
        """Metres along the course at times ``t`` in seconds."""
        return self.state(t)[..., 0]

    def state(self, t: ArrayLike) -> Array:
        """[..., 3] metres along the course, m/s and m/s^2 at times ``t`` [...] in seconds; speed is continuous."""
        t = np.asarray(t, np.float64)
        number = np.maximum(np.floor((t - BEGINNING) / STRETCH), 0).astype(np.intp)
        result = np.empty((*t.shape, 3))
        for stretch in np.unique(number):
            here = number == stretch
            since = t[here] - (BEGINNING + stretch * STRETCH)
            rows = _stretch(self, int(stretch))[0]
            index = np.maximum(np.floor(since / TICK), 0).astype(np.intp)
            s, v, a = rows[np.minimum(index, len(rows) - 1)].T
            rest = since - index * TICK
            a = np.where(rest < 0, 0.0, a)  # before the beginning at a constant speed
            result[here] = np.stack([s + rest * (v + rest * a / 2), v + rest * a, a], axis=-1)
        return result

    def time_at(self, s: float) -> float:
        """The first time at which ``s`` metres along the course are reached, seconds; to 1e-6 s."""
        low, high = BEGINNING, BEGINNING + STRETCH
        while self.travelled(low) > s:
            low -= 2 * STRETCH
        while self.travelled(high) < s:
            high += 2 * STRETCH
        while high - low > 1e-6:
            middle = (low + high) / 2
            low, high = (middle, high) if self.travelled(middle) < s else (low, middle)
        return high

    def _wander(self, s: Array) -> tuple[Array, Array, Array]:
        """Metres to the right of the lane's middle, and its first and second derivative by s."""
        phases = np.random.default_rng([self.seed, _WANDER]).uniform(0, 2 * np.pi, len(WANDER))
        wave = np.array([2 * np.pi / length for length, _ in WANDER])
        size = np.array([amplitude for _, amplitude in WANDER])
        angle = s[..., None] * wave + phases
        return np.sin(angle) @ size, np.cos(angle) @ (size * wave), -np.sin(angle) @ (size * wave**2)

    def _body(self, t: Array) -> Array:
        """[..., 3] pitch up and roll clockwise, radians, and height, metres, at ``t`` [...]; cubic between ticks."""
        number = np.floor(t / BODY_STRETCH).astype(np.intp)
        result = np.empty((*t.shape, 3))
        for stretch in np.unique(number):
            here = number == stretch
            place = (t[here] - stretch * BODY_STRETCH) / BODY_TICK + 1  # a tick before
            rows = _body_stretch(self, int(stretch))
            index = np.clip(np.floor(place).astype(np.intp), 1, len(rows) - 3)
            x = (place - index)[..., None]
            before, a, b, after = (rows[index + k] for k in (-1, 0, 1, 2))
            slope_a, slope_b = (b - before) / 2, (after - a) / 2
            result[here] = a + x * x * (3 - 2 * x) * (b - a) + x * (1 - x) * ((1 - x) * slope_a - x * slope_b)
        return result


# ---------------------------------------------------------------- the driver


@dataclass(frozen=True)
class _Driver:
    """Where a stretch ends, and the next begins."""

    s: float
    v: float
    a: float
    event: int
    """The next stop."""
    waited: float
    """Seconds that have passed there."""


@functools.lru_cache(maxsize=64)
def _stretch(drive: RoadDrive, number: int) -> tuple[Array, _Driver]:
    """[STRETCH / TICK, 3] s, v and a at each tick, a constant within it; and the state at the end."""
    if number == 0:
        start = BEGINNING * drive.speed
        speed = _desired(drive, start, start + GRID)[0]
        driver = _Driver(start, float(speed), 0.0, _event_after(start), 0.0)
    else:
        driver = _stretch(drive, number - 1)[1]
    s, v, a, event, waited = driver.s, driver.v, driver.a, driver.event, driver.waited
    desired = _desired(drive, s, s + STRETCH * drive.speed * 1.2 + PREVIEW).tolist()
    rows, origin = [], s
    stop, dwell = _stop(drive, event)
    brake = 2 * (drive.acceleration * drive.deceleration) ** 0.5
    for _ in range(round(STRETCH / TICK)):
        while s > stop + STANDSTILL or waited > dwell:
            event, waited = event + 1, 0.0
            stop, dwell = _stop(drive, event)
        place = (s - origin) / GRID
        k = int(place)
        v0 = desired[k] + (place - k) * (desired[k + 1] - desired[k])
        gap = max(stop - s + STANDSTILL, 0.5)
        wanted = STANDSTILL + v * HEADWAY + v * v / brake
        target = drive.acceleration * (1 - (v / v0) ** 4 - (wanted / gap) ** 2)
        target = min(max(target, -1.3 * drive.deceleration), drive.acceleration)
        a += min(max(target - a, -JERK * TICK), JERK * TICK)
        a = max(a, -v / TICK)
        rows.append((s, v, a))
        s, v = s + TICK * (v + TICK * a / 2), max(v + TICK * a, 0.0)
        waited += TICK if v < 0.2 and stop - s < 2 * STANDSTILL else 0.0
    return np.array(rows), _Driver(s, v, a, event, waited)


def _desired(drive: RoadDrive, start: float, end: float) -> Array:
    """Speeds, m/s, every GRID metres from ``start``: bends and slow stretches, braked for in time."""
    s = np.arange(start, end + PREVIEW, GRID)
    kappa = np.abs(drive.course.curvature(drive.direction * s))
    v = np.minimum(drive.speed, np.sqrt(drive.lateral / np.maximum(kappa, 1e-6)))
    if drive.stops:
        for event in range(_event_after(start - EVENTS[1]), _event_after(end + PREVIEW) + 1):
            middle, length, share, is_stop = _event(drive.seed, event)
            if not is_stop:
                v[np.abs(s - middle) < length / 2] *= share
    squares = v**2
    for i in range(len(s) - 2, -1, -1):
        squares[i] = min(squares[i], squares[i + 1] + 2 * 0.7 * drive.deceleration * GRID)
    return np.sqrt(squares)


def _event_after(s: float) -> int:
    return int(np.ceil(s / (sum(EVENTS) / 2)))


@functools.lru_cache(maxsize=1024)
def _event(seed: int, number: int) -> tuple[float, float, float, bool]:
    """Where, metres; of a slow stretch its length and the share of the speed; whether it is a stop instead."""
    rng = np.random.default_rng([seed, _EVENTS, 2 * abs(number) + (number < 0)])
    spacing = sum(EVENTS) / 2
    middle = (number + rng.uniform(-0.28, 0.28)) * spacing
    return middle, rng.uniform(*SLOW_LENGTHS), rng.uniform(*SLOW_SHARES), bool(rng.random() < STOPS)


def _stop(drive: RoadDrive, event: int) -> tuple[float, float]:
    """Where the event's stop is, and for how long; -1 where it is none."""
    if not drive.stops:
        return np.inf, np.inf
    middle, _, _, is_stop = _event(drive.seed, event)
    if not is_stop:
        return middle, -1.0
    rng = np.random.default_rng([drive.seed, _EVENTS, 2 * abs(event) + (event < 0), 1])
    return middle, rng.uniform(*DWELLS)


# ---------------------------------------------------------------- the body


@functools.lru_cache(maxsize=16)
def _body_stretch(drive: RoadDrive, number: int) -> Array:
    """[BODY_STRETCH / BODY_TICK + 4, 3] pitch, roll and height; the first row is a tick before the stretch."""
    from scipy import signal  # type: ignore[import-untyped]  # loads scipy.stats, which no other input needs

    start = number * BODY_STRETCH
    ticks = np.arange(-round(SETTLING / BODY_TICK) - 1, round(BODY_STRETCH / BODY_TICK) + 3)
    s, v, a = drive.state(start + ticks * BODY_TICK).T
    front, apart = profile(drive.seed, drive.roughness, s + WHEELBASE / 2)
    rear, apart_behind = profile(drive.seed, drive.roughness, s - WHEELBASE / 2)
    bend = drive.course.curvature(s) + drive._wander(s)[2]
    inertia = np.stack([drive.pitch_gain * a, -drive.roll_gain * v**2 * bend, np.zeros_like(a)])
    road = np.stack([(front - rear) / WHEELBASE, (apart + apart_behind) / 2 / TRACK, (front + rear) / 2])
    w = 2 * np.pi * drive.ride_hertz
    poles = [1.0, 2 * drive.damping * w, w * w]
    result = np.zeros_like(road)
    for zeros, given in (([w * w], inertia), ([2 * drive.damping * w, w * w], road)):
        b, coefficients = signal.bilinear(zeros, poles, 1 / BODY_TICK)
        rest = signal.lfilter_zi(b, coefficients)[:, None] * given[:, 0]
        result += signal.lfilter(b, coefficients, given, axis=1, zi=rest.T)[0]
    return result[:, round(SETTLING / BODY_TICK) :].T

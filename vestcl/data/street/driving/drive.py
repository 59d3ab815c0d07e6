"""How the street's camera drives: a smooth sway, the wobble of a real recording, or as cars do.

A drive is six numbers at every time: metres along the road, to the right of the lane's middle and below the camera's
usual height, and the radians yaw (right), pitch (up) and roll (clockwise) of world_from_camera = Ry Rx Rz. Of a
`RoadDrive` (street_road.py) they are relative to its course, which may bend.
"""

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.data.street.camera import check_pose
from vestcl.data.street.driving.road import RoadDrive

Array = NDArray[np.float64]
Wave = tuple[float, float]

#: Frames per second of a recorded trajectory, as KITTI's.
RECORDED_FPS: Final = 10.0

#: Half the window of the smoothing that takes turns, hills and lane changes out of a recording, in frames: over these
#: 4 s a parabola follows a turn to within a lane's room, and what is faster than about 0.25 Hz is left.
HALF_WINDOW: Final = 20

#: Bounds on what is left: metres to the side (the lane has 0.6 m next to a car) and down, then radians of yaw, pitch
#: and roll. They touch little: 99 % of KITTI odometry 00 and 06 stays within 0.24 m, 0.05 m, 3.3, 1.0 and 1.1 degrees.
LIMITS: Final = (0.4, 0.15, np.radians(4.0), np.radians(2.0), np.radians(2.0))

#: (amplitude, hertz) of the waves that make up the sway. Their root mean squares and frequencies lie between those of
#: KITTI odometry 00 and 06 on straight road: pitch 0.15 and 0.31 degrees, half of it above 0.6 and 0.9 Hz; roll 0.13
#: and 0.29, half above 0.5 Hz; yaw 0.27 and 0.48, at 0.3 Hz; height 7 and 13 mm. Speed changes at half the recorded
#: 1 m/s^2, for there is no crossing to stop at.
SPEED_WAVES: Final[tuple[Wave, ...]] = ((1.8, 0.027), (0.8, 0.084), (0.4, 0.154))
LATERAL_WAVES: Final[tuple[Wave, ...]] = ((0.22, 0.072), (0.04, 0.31))
HEIGHT_WAVES: Final[tuple[Wave, ...]] = ((0.010, 0.36), (0.007, 0.57), (0.003, 1.31))
YAW_WAVES: Final[tuple[Wave, ...]] = ((np.radians(0.30), 0.28), (np.radians(0.22), 0.41), (np.radians(0.06), 0.93))
PITCH_WAVES: Final[tuple[Wave, ...]] = (
    (np.radians(0.18), 0.44),
    (np.radians(0.19), 0.87),
    (np.radians(0.14), 1.43),
    (np.radians(0.07), 2.30),
)
ROLL_WAVES: Final[tuple[Wave, ...]] = ((np.radians(0.18), 0.33), (np.radians(0.16), 0.53), (np.radians(0.09), 1.17))

#: What `Sway.drawn` draws from: mean speeds in towns, m/s; wobble from half of KITTI's calmer drive to its wilder one's
#: (see above), and as much faster or slower.
SPEEDS: Final = (2.0, 15.0)
AMPLITUDES: Final = (0.3, 2.0)
PACES: Final = (0.6, 1.5)

#: The speed waves' sum, m/s, rounded up: an amplitude below speed / MAX_CHANGE never drives backwards.
MAX_CHANGE: Final = 3.2


def _wave(waves: tuple[Wave, ...], phase: float, t: Array) -> Array:
    """Sum of a sin(2 pi f t + k phase), k counting from 1."""
    return np.sum([a * np.sin(2 * np.pi * f * t + k * phase) for k, (a, f) in enumerate(waves, 1)], axis=0)


def _slope(waves: tuple[Wave, ...], phase: float, t: Array) -> Array:
    """Its derivative by t."""
    rates = [(2 * np.pi * f * a, f) for a, f in waves]
    return np.sum([a * np.cos(2 * np.pi * f * t + k * phase) for k, (a, f) in enumerate(rates, 1)], axis=0)


@dataclass(frozen=True)
class Sway:
    """Endless smooth driving: every number is a sum of sines."""

    speed: float
    """Mean, metres per second."""
    phase: float
    """Radians; where all the waves are at time 0."""
    amplitude: float = 1.0
    """All waves times that."""
    pace: float = 1.0
    """All waves' frequencies times that."""

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Sway":
        """Driving at random in the ranges of real cars in towns: what networks are trained on.

        SPEEDS, AMPLITUDES and PACES are uniform; slow cars sway less, so that none drives backwards.
        """
        speed = rng.uniform(*SPEEDS)
        amplitude = rng.uniform(AMPLITUDES[0], min(AMPLITUDES[1], speed / MAX_CHANGE))
        return cls(speed, rng.uniform(0, 2 * np.pi), amplitude, rng.uniform(*PACES))

    def at(self, t: ArrayLike) -> Array:
        """[..., 6] at times ``t`` [...] in seconds; see the module."""
        t = np.asarray(t, np.float64)
        phase, s, size = self.phase, self.pace * t, self.amplitude
        speed = self.speed + size * _wave(SPEED_WAVES, phase, s)
        aside = size * self.pace * _slope(LATERAL_WAVES, phase, s)
        numbers = (
            self.travelled(t),
            size * _wave(LATERAL_WAVES, phase, s),
            size * _wave(HEIGHT_WAVES, phase, s),
            np.arctan2(aside, speed) + size * _wave(YAW_WAVES, phase, s),
            size * _wave(PITCH_WAVES, phase, s),
            size * _wave(ROLL_WAVES, phase, s),
        )
        return np.stack(numbers, axis=-1)

    def travelled(self, t: ArrayLike) -> Array:
        """Metres along the road at times ``t`` in seconds: speed t + the integral of the speed's waves."""
        t = np.asarray(t, np.float64)
        distance = self.speed * t
        for k, (wave, hertz) in enumerate(SPEED_WAVES, 1):
            a, f = self.amplitude * wave, self.pace * hertz
            distance += a / (2 * np.pi * f) * (np.cos(k * self.phase) - np.cos(2 * np.pi * f * t + k * self.phase))
        return distance


@dataclass(frozen=True)
class Recording:
    """The wobble and the speed of a recorded trajectory on a straight road; played forwards and backwards in turn."""

    frames: tuple[tuple[float, ...], ...]
    """[N][6], RECORDED_FPS per second; see the module."""

    @classmethod
    def from_trajectory(cls, trajectory: ArrayLike) -> "Recording":
        """What is left of a drive when its turns, hills and lane changes are taken out.

        Along the road: the sum of the steps along the camera's own axis, none backwards. The others: the recorded
        side, height, yaw, pitch and roll minus their smooth course (a parabola fitted to 2 HALF_WINDOW + 1 frames,
        Savitzky and Golay 1964), bounded by x -> L tanh(x / L), L of LIMITS.

        Args:
            trajectory: [N, 4, 4] world_from_cam in metres, RECORDED_FPS per second, N of 2 or more.

        Raises:
            ValueError: another shape, or a matrix that is not a rigid motion.
        """
        poses = np.asarray(trajectory, np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) < 2:
            raise ValueError(f"`trajectory` must be [N, 4, 4] with N of 2 or more, got {list(poses.shape)}")
        for index, pose in enumerate(poses):
            check_pose(f"trajectory[{index}]", pose)
        rotations, positions = poses[:, :3, :3], poses[:, :3, 3]
        ahead = (rotations[1:, :, 2] + rotations[:-1, :, 2]) / 2
        steps = np.maximum(np.sum(np.diff(positions, axis=0) * ahead, axis=1), 0)
        angles, smooth = _angles(rotations), _smoothed(_angles(rotations))
        off = positions - _smoothed(positions)
        side = off[:, 0] * np.cos(smooth[:, 0]) - off[:, 2] * np.sin(smooth[:, 0])
        wobble = np.concatenate([side[:, None], off[:, 1:2], angles - smooth], axis=1)
        limits = np.array(LIMITS)
        rows = np.concatenate([np.append(0, np.cumsum(steps))[:, None], limits * np.tanh(wobble / limits)], axis=1)
        return cls(tuple(map(tuple, rows.tolist())))

    @functools.cached_property
    def _knots(self) -> Array:
        return np.array(self.frames)

    @functools.cached_property
    def _slopes(self) -> Array:
        """Per frame; zero for the end, where the recording turns round."""
        slopes = np.gradient(self._knots, axis=0)
        slopes[[0, -1], 1:] = 0
        return slopes

    def at(self, t: ArrayLike) -> Array:
        """[..., 6] at times ``t`` [...] in seconds; see the module. Cubic between frames, exact at them."""
        last = len(self.frames) - 1
        period, phase = np.divmod(np.asarray(t, np.float64) * RECORDED_FPS, 2 * last)
        backwards = phase > last
        frame = np.where(backwards, 2 * last - phase, phase)
        index = np.minimum(frame.astype(np.int64), last - 1)
        s = (frame - index)[..., None]
        a, b, slope_a, slope_b = (
            self._knots[index],
            self._knots[index + 1],
            self._slopes[index],
            self._slopes[index + 1],
        )
        values = a + s * s * (3 - 2 * s) * (b - a) + s * (1 - s) * ((1 - s) * slope_a - s * slope_b)
        length = self._knots[-1, 0]
        values[..., 0] = 2 * length * period + np.where(backwards, 2 * length - values[..., 0], values[..., 0])
        return values

    def travelled(self, t: ArrayLike) -> Array:
        """Metres along the road at times ``t`` in seconds."""
        return self.at(t)[..., 0]

    @property
    def speed(self) -> float:
        """Mean, metres per second."""
        return self.frames[-1][0] / (len(self.frames) - 1) * RECORDED_FPS


Drive = Sway | Recording | RoadDrive


def world_from_camera(x: float, y: float, z: float, yaw: float, pitch: float, roll: float) -> Array:
    """[4, 4]: Ry(yaw) Rx(pitch) Rz(roll) at (x, y, z); radians and metres."""
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    turn = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    nod = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    tilt = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn @ nod @ tilt, (x, y, z)
    return pose


def _angles(rotations: Array) -> Array:
    """[N, 3] yaw, pitch and roll of [N, 3, 3] = Ry Rx Rz, without jumps of a whole turn."""
    yaw = np.arctan2(rotations[:, 0, 2], rotations[:, 2, 2])
    pitch = np.arcsin(np.clip(-rotations[:, 1, 2], -1, 1))
    roll = np.arctan2(rotations[:, 1, 0], rotations[:, 1, 1])
    return np.unwrap(np.stack([yaw, pitch, roll], axis=1), axis=0)


def _smoothed(values: Array) -> Array:
    """The middle of the parabola through each window of [N, C]; the ends are mirrored in their end points."""
    half = min(HALF_WINDOW, len(values) - 1)
    t = np.arange(-half, half + 1.0)
    kernel = np.linalg.pinv(np.stack([np.ones_like(t), t, t * t], axis=1))[0]
    before, after = 2 * values[0] - values[half:0:-1], 2 * values[-1] - values[-2 : -half - 2 : -1]
    padded = np.concatenate([before, values, after])
    return np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)

"""`vestcl bench camera`: a camera's forecast motion against pose files, by time ahead, bends and straights apart."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.progress import track
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from vestcl.bench.common.estimate import announced
from vestcl.bench.common.options import JsonOption
from vestcl.bench.common.results import console, describe, plain, settings, write_json
from vestcl.bench.common.table import Measurement, Section, show_grid
from vestcl.data.readers.trajectories import KITTI_FPS, read_trajectory
from vestcl.scene.motion.camera_forecast import CameraForecaster

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Errors as tables show them.
_COLUMNS: Final = (("rotation_deg", "rotation (deg)", ".3f"), ("translation_percent", "translation (%)", ".2f"))

Errors = dict[str, dict[str, dict[str, Any]]]
"""By part of a drive ("all", "bends", "straights") and method ("forecast", "constant velocity"): "rotation_deg",
"translation_percent" (standstill left out) and the number of "frames"."""

#: Motions before the first forecast that is scored.
_FIRST: Final = 16

#: A bend turns by more than so many degrees a second from t on; below so many metres a second is a standstill.
BEND: Final = 10.0
STANDSTILL: Final = 1.0


@dataclass(frozen=True)
class CameraBench(JsonOption):
    """Forecast the camera of recorded drives, and compare with where it went.

    Motions are measured with noise. The peer is constant velocity: yaw and translation of the last two motions' mean.
    """

    files: tyro.conf.Positional[tuple[Path, ...]]
    """Pose files: KITTI's format (3 x 4 world_from_cam) or TUM's (time, position, quaternion)."""
    ahead: tuple[float, ...] = (0.1, 0.3, 0.5, 1.0)
    """Seconds; each is rounded to whole frames."""
    fps: float = KITTI_FPS
    """Frames a second of KITTI's format."""
    history: int | None = None
    """Motions that each forecast starts from; without it all before the frame."""
    noise_deg: float = 0.03
    """Standard deviation of the measured rotations, degrees an axis."""
    noise_length: float = 0.01
    """Standard deviation of the measured lengths, as a share."""
    seeds: int = 20
    """Of the noise; errors are means over them."""

    def __post_init__(self) -> None:
        if not self.files or self.seeds < 1 or not self.ahead or min(self.ahead) <= 0:
            raise ValueError(
                "`files` must be one or more, --seeds 1 or more and --ahead positive, "
                f"got {len(self.files)} files, {self.seeds}, {self.ahead}"
            )
        if self.history is not None and not 1 <= self.history <= _FIRST:
            raise ValueError(f"--history must be 1 to {_FIRST}, got {self.history}")


def main(config: CameraBench) -> None:
    """Measure and print a table for each file."""
    results, screen = dict[str, Any](), console()
    for path in config.files:
        drive = read_trajectory(path, config.fps)
        interval = float(np.median(np.diff(drive.seconds)))
        steps = sorted({max(1, round(seconds / interval)) for seconds in config.ahead})
        found = evaluate(drive.world_from_cam, drive.seconds, steps, config)
        rows = [row for step in steps for row in _rows(f"{step * interval:g} s", found[step])]
        show_grid(Section(path.name, rows, ("ratio: to constant velocity",)).grid(), screen)
        results[str(path)] = {f"{step * interval:g} s": found[step] for step in steps}
    if config.json is not None:
        write_json(config.json, plain({"machine": describe(), "config": settings(config), "errors": results}))


def _rows(ahead: str, parts: Errors) -> Iterator[Measurement]:
    for part, methods in parts.items():
        ours, constant, row = methods["forecast"], methods["constant velocity"], f"{ahead}, {part}"
        yield Measurement(row, "frames", str(ours["frames"]))
        for name, column, digits in _COLUMNS:
            yield Measurement(row, column, ours[name], digits=digits)
            yield Measurement(row, f"{column.split()[0]} ratio", ours[name] / constant[name], digits=".2f")


def evaluate(world_from_cam: Array, seconds: Array, steps: Sequence[int], config: CameraBench) -> dict[int, Errors]:
    """Errors by step.

    Args:
        world_from_cam: [N, 4, 4] m.
        seconds: [N].
        steps: frames ahead, rising.
        config: noise, seeds and history.

    Raises:
        ValueError: a drive too short for its steps.
    """
    frames = np.arange(_FIRST, len(seconds) - steps[-1])
    if not len(frames):
        raise ValueError(f"a drive must have more than {_FIRST + steps[-1]} poses, got {len(seconds)}")
    measured = _measured(world_from_cam, config)
    methods = {
        "forecast": _forecasts(measured, seconds, frames, steps, config.history),
        "constant velocity": _constant(measured, seconds, frames, steps),
    }
    result = {}
    for index, step in enumerate(steps):
        truth = np.linalg.inv(world_from_cam[frames + step]) @ world_from_cam[frames]
        time = seconds[frames + step] - seconds[frames]
        bends = np.degrees(Rotation.from_matrix(truth[:, :3, :3]).magnitude()) > BEND * time
        moves = np.linalg.norm(truth[:, :3, 3], axis=1) > STANDSTILL * time
        parts = {"all": np.ones_like(bends), "bends": bends, "straights": ~bends}
        result[step] = {
            part: {name: _errors(future[index], truth, where, moves) for name, future in methods.items()}
            for part, where in parts.items()
        }
    return result


def _measured(world_from_cam: Array, config: CameraBench) -> Array:
    """cur_from_prev [seeds, N - 1, 4, 4] with noise."""
    rng, count = np.random.default_rng(0), len(world_from_cam) - 1
    motions = np.tile(np.linalg.inv(world_from_cam[1:]) @ world_from_cam[:-1], (config.seeds, 1, 1, 1))
    turns = np.radians(config.noise_deg) * rng.standard_normal((config.seeds, count, 3))
    noise = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape[:2], 3, 3)
    motions[..., :3, :3] = noise @ motions[..., :3, :3]
    motions[..., :3, 3] *= 1 + config.noise_length * rng.standard_normal((config.seeds, count, 1))
    return motions


def _forecasts(measured: Array, seconds: Array, frames: Indices, steps: Sequence[int], history: int | None) -> Array:
    """future_from_cur [steps, seeds, frames, 4, 4], each from the ``history`` motions before its frame or from all."""
    intervals = np.diff(seconds)
    ahead = [step * float(np.median(intervals)) for step in steps]
    future = np.zeros((len(steps), len(measured), len(frames), 4, 4))
    if history is None:
        forecaster = CameraForecaster(len(measured))
        passed = announced(range(frames[-1]), console(), "frames")
        for index in track(passed, "drive", int(frames[-1]), transient=True):
            forecaster.measure(measured[:, index], intervals[index])
            if index + 1 >= frames[0]:
                future[:, :, index + 1 - frames[0]] = forecaster.forecast(ahead)
        return future
    noises = announced(list(measured), console(), "seeds")
    for seed, motions in enumerate(track(noises, "seeds", len(measured), transient=True)):
        forecaster = CameraForecaster(len(frames))
        for back in range(history, 0, -1):
            forecaster.measure(motions[frames - back], float(np.median(intervals)))
        future[:, seed] = forecaster.forecast(ahead)
    return future


def _constant(measured: Array, seconds: Array, frames: Indices, steps: Sequence[int]) -> Array:
    """The same at constant velocity."""
    turn = Rotation.from_matrix(measured[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*measured.shape[:2], 3)
    numbers = np.concatenate([turn * [0, 1, 0], measured[..., :3, 3]], axis=-1) / np.diff(seconds)[:, None]
    velocity = (numbers[:, frames - 1] + numbers[:, frames - 2]) / 2 * np.median(np.diff(seconds))
    motion = np.tile(np.eye(4), (*velocity.shape[:2], 1, 1))
    motion[..., :3, :3] = (
        Rotation.from_rotvec(velocity[..., :3].reshape(-1, 3)).as_matrix().reshape(motion[..., :3, :3].shape)
    )
    motion[..., :3, 3] = velocity[..., 3:]
    return np.stack([np.linalg.matrix_power(motion, step) for step in steps])


def _errors(future: Array, truth: Array, where: Array, moves: Array) -> dict[str, Any]:
    """Of future [seeds, frames, 4, 4] in the frames ``where``."""
    if not where.any():
        return {"rotation_deg": np.nan, "translation_percent": np.nan, "frames": 0}
    future, truth, moves = future[:, where], truth[where], moves[where]
    off = future[..., :3, :3] @ truth[:, :3, :3].transpose(0, 2, 1)
    angle = Rotation.from_matrix(off.reshape(-1, 3, 3)).magnitude()
    miss = np.linalg.norm(future[..., :3, 3] - truth[:, :3, 3], axis=-1) / np.linalg.norm(truth[:, :3, 3], axis=-1)
    percent = 100 * miss[:, moves].mean() if moves.any() else np.nan
    return {"rotation_deg": np.degrees(angle.mean()), "translation_percent": percent, "frames": int(where.sum())}

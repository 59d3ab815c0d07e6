"""Where the points of frame t will be: by the forecast motion of the camera, and the candidates that proved best."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl.scene.depth.road_plane import rays_of
from vestcl.scene.motion import backtest
from vestcl.scene.motion.camera_forecast import forecast_camera
from vestcl.scene.perception import Perception

#: The camera is forecast from this many of the last motions. On KITTI odometry 00 four have 0.66 of constant velocity's
#: error of rotation at t+1 and 0.77 of that of translation, all that were before 0.65 and 0.72; each takes a flow and a
#: depth.
_MOTIONS: Final = 4

#: Seconds between frames of a clip without times: KITTI's.
_INTERVAL: Final = 0.1

#: Candidates are tested over one frame, and over two, which distinguish what continues from what stops.
_TESTED: Final = (1, 2)


@dataclass(frozen=True, eq=False)
class Paths:
    """The points of all pixels of a frame, over time."""

    frame: backtest.BacktestFrame
    errors: tuple[NDArray[np.float32], ...] = ()
    """[C, H, W]: how wrong the candidates would have been, for the first step and for all later ones
    (`backtest.by_step`). Without any, points have their objects' velocities."""
    by_flow: bool = False
    """Whether flow itself is a candidate: where depth comes from motion."""

    @functools.cached_property
    def _residual(self) -> NDArray[np.float32]:
        return backtest.residual_flow(self.frame)

    def at(self, ahead: float, future_from_cur: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points [3, H, W] m in the camera after ``ahead`` intervals, which ``future_from_cur`` leads to."""
        if ahead <= 0 or not self.errors:
            rays = rays_of(self.frame.K, *self.frame.depth.shape[1:])
            points = rays * self.frame.depth + ahead * self.frame.velocity
            return np.tensordot(future_from_cur[:3, :3], points, 1) + future_from_cur[:3, 3, None, None]
        positions, depth = backtest.candidates(self.frame, self._residual, future_from_cur, ahead, self.by_flow)
        errors = self.errors[0] if ahead <= 1 else self.errors[-1]
        moving = np.asarray(self.frame.velocity.any(axis=0))
        u, v = backtest.coherent(backtest.mixed(positions, errors), errors, self.frame.image, moving)
        return np.stack([row[0] * u + row[1] * v + row[2] for row in np.linalg.inv(self.frame.K)]) * depth


def point_paths(perception: Perception, index: int) -> Paths:
    """The paths of frame ``index``'s points; candidates are tested on the two frames before it.

    Args:
        perception: of the clip; keeps the result.
        index: the frame, 0 or more.
    """
    return perception.once("backtest", index, lambda: _tested_paths(perception, index))


def _tested_paths(perception: Perception, index: int) -> Paths:
    errors, by_flow = [], perception.is_monocular(index)
    for back in _TESTED:
        first = index - back
        if first < 1 or any(perception.is_lost(i) for i in range(first, index + 1)):
            break
        ahead = sum(perception.clip.elapsed(i) for i in range(first + 1, index + 1))
        camera = forecast_cameras(perception, first, [ahead], back)[0]
        before = perception.frame(first)
        positions, _ = backtest.candidates(before, backtest.residual_flow(before), camera, ahead, by_flow)
        flows = [perception.correspondence(i).flow_uv for i in range(index, first, -1)]
        errors.append(backtest.backtest(positions, before, perception.image(index), flows))
    if index == 1:
        errors = [backtest.untested(perception.frame(index), by_flow)]
    objects = perception.moving(index).instances
    held = [backtest.held_together(each, objects) for each in backtest.by_step(errors, by_flow)]
    return Paths(perception.frame(index), tuple(held), by_flow)


def forecast_cameras(
    perception: Perception, index: int, ahead: Sequence[float], back: int = 0
) -> list[NDArray[np.float64]]:
    """future_from_cur [4, 4] m after each of ``ahead`` intervals, from the last motions up to frame ``index``.

    ``back`` frames later the forecast is made that this one tests: motions before those that it looks at are left out,
    so that nothing has to be looked at only for the test.
    """
    clip, seen = perception.clip, range(max(index + back - _MOTIONS + 1, 1), index + 1)
    motions = [np.linalg.inv(motion) for motion in perception.motions(seen)]
    interval = clip.interval or _INTERVAL
    times = [clip.elapsed(i) * interval for i in seen], [each * interval for each in ahead]
    return forecast_camera(motions, *times, by_flow=perception.is_monocular(index))

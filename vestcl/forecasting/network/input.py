"""What is known of two frames, as the networks take it: layers, the camera, and the motion as measurements extrapolate
it."""

import itertools
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl import geometry
from vestcl.models.networks.camera_correction import INTERVAL, MEASURED, rates_of
from vestcl.models.networks.rigid_motion import RigidMotion
from vestcl.models.steps.prior import MotionPrior
from vestcl.scene import checked
from vestcl.scene.layers import LayerBatch, batch
from vestcl.scene.motion.camera_forecast import forecast_camera
from vestcl.scene.motion.ego_motion import constant_velocity
from vestcl.scene.perceived import PerceivedFrame

#: This many of the last motions count in a path, as in the geometric forecast.
PAST: Final = MEASURED


class CameraPath(NamedTuple):
    """A camera's motion, forecast from those that were measured; `camera_path` makes one."""

    future_from_cur: tuple[NDArray[np.float64], ...]
    """[4, 4] m each, after 1, 2 ... intervals."""
    measured: NDArray[np.float32]
    """[MEASURED, RATES], see `vestcl.models.networks.camera_correction.rates_of`."""
    seconds: float
    """An interval."""


class NetworkInput(NamedTuple):
    """Two frames of one clip, B = 1, float32."""

    frame_prev: LayerBatch
    """At t - 1."""
    frame_cur: LayerBatch
    """At t."""
    K: torch.Tensor
    """[1, 3, 3] px, of both."""
    prior: MotionPrior
    """Where the networks start from."""
    own: torch.Tensor | None = None
    """[1, 1, H, W], 1 where the recording car itself is in either image; None is nowhere."""


def network_input(
    prev: PerceivedFrame, cur: PerceivedFrame, motions: Sequence[NDArray[np.float64]], path: CameraPath | None = None
) -> NetworkInput:
    """Two prepared frames with their motion prior: the camera's motion, and constant velocity of all dynamic objects.

    next_from_cur = constant_velocity(motions) over one interval of the clip, or what ``path`` has for it and for later
    ones; and the last two motions as they are. What moves, moves by its own velocity v in the axes of its frame: the
    networks take it to R (x + n v) + t after n intervals. The recording car's own bonnet does not move in the image, so
    there x = R (x + n v) + t, which gives v = (R^-1 (x - t) - x) / n: n = 1 interval from t, and ``cur.elapsed`` more
    from t - 1.

    Args:
        prev: the frame at t - 1.
        cur: the frame at t, of the same size and camera.
        motions: ``cur_from_prev`` [4, 4] m of the last consecutive frames, oldest first; the last one is from ``prev``
            to ``cur``, over ``cur.elapsed`` intervals, the one before over ``prev.elapsed``, others over one. One or
            two is the default, see `last_motions`.
        path: the camera's forecast motion, from `camera_path`; None is constant velocity.

    Returns:
        The input with B = 1; tensors with their own memory.

    Raises:
        ValueError: frames of different sizes or cameras, no motion, or a matrix that is not finite.

    Source: SPEC section 8; `vestcl.forecasting.geometric.forecast_frames` extrapolates in the same way.
    """
    if prev.layers.image.shape != cur.layers.image.shape:
        sizes = [f"{frame.layers.image.shape[1]}x{frame.layers.image.shape[2]}" for frame in (prev, cur)]
        raise ValueError(f"`prev` and `cur` must be of one size, got {sizes[0]} and {sizes[1]}")
    if not np.allclose(prev.K, cur.K):
        raise ValueError(f"`prev` and `cur` must have one K, got {prev.K.tolist()} and {cur.K.tolist()}")
    motions = [checked.matrix("motions", motion, 4) for motion in motions]
    elapsed = [1.0] * len(motions)
    elapsed[-2:] = [prev.elapsed, cur.elapsed][-len(motions) :]
    next_from_cur = constant_velocity(motions, elapsed) if path is None else path.future_from_cur[0]
    next_from_prev = next_from_cur @ motions[-1]
    if path is None:
        path = CameraPath((next_from_cur,), _measured(motions, [each * INTERVAL for each in elapsed]), INTERVAL)
    prior = MotionPrior(
        as_motion(next_from_cur),
        as_motion(motions[-1]),
        as_motion(motions[-2] if len(motions) > 1 else motions[-1]),
        torch.from_numpy(_velocity(prev, next_from_prev, 1 + cur.elapsed)[None]),
        torch.from_numpy(_velocity(cur, next_from_cur, 1)[None]),
        torch.tensor([1 + cur.elapsed]),
        torch.tensor([True]),
        _later(path.future_from_cur),
        torch.from_numpy(path.measured[None]),
        torch.tensor([path.seconds]),
    )
    own = torch.from_numpy((prev.own | cur.own)[None]).float()
    return NetworkInput(batch([prev.layers]), batch([cur.layers]), torch.from_numpy(cur.K[None]).float(), prior, own)


def camera_path(
    motions: Sequence[NDArray[np.float64]],
    elapsed: Sequence[float],
    seconds: float | None,
    steps: int,
    by_flow: bool = False,
) -> CameraPath:
    """Where a camera will be by `vestcl.scene.motion.camera_forecast`, and the motions that say so.

    Args:
        motions: ``cur_from_prev`` [4, 4] m of the last consecutive frames, oldest first, one or more; `PAST` count. Of
            a single one the path is that motion at constant velocity.
        elapsed: intervals that each took.
        seconds: an interval of the clip; None, where it is not known, is `INTERVAL`.
        steps: intervals to forecast, 1 or more.
        by_flow: whether motions are measured from flow only, without depth.

    Raises:
        ValueError: as `vestcl.scene.motion.camera_forecast.forecast_camera`.
    """
    dt = seconds or INTERVAL
    motions, times = motions[-PAST:], [dt * each for each in elapsed[-PAST:]]
    cameras = forecast_camera(motions, times, [dt * step for step in range(1, steps + 1)], by_flow)
    return CameraPath(tuple(cameras), _measured(motions, times), dt)


def _measured(motions: Sequence[NDArray[np.float64]], seconds: Sequence[float]) -> NDArray[np.float32]:
    """[MEASURED, RATES], see `rates_of`."""
    known = [as_motion(np.asarray(motion, np.float64)) for motion in motions]
    return rates_of(known, torch.tensor([list(seconds)]))[0].numpy()


def _later(future_from_cur: Sequence[NDArray[np.float64]]) -> RigidMotion:
    """The motions of the intervals after the first, [1, n, 4] and [1, n, 3]."""
    pairs = itertools.pairwise(future_from_cur)
    each = [as_motion(np.asarray(later @ np.linalg.inv(before), np.float64)) for before, later in pairs]
    if not each:
        return RigidMotion(torch.zeros(1, 0, 4), torch.zeros(1, 0, 3))
    return RigidMotion(*(torch.stack(parts, dim=1) for parts in zip(*each, strict=True)))


def last_motions(*frames: PerceivedFrame) -> list[NDArray[np.float64]]:
    """``cur_from_prev`` [4, 4] m of each frame that has a ``prev_from_cur``: all but a clip's first, oldest first.

    Args:
        *frames: consecutive ones, oldest first; t - 1 and t give the two motions that `vestcl.forecasting.geometric`
        takes.

    Returns:
        As many motions as frames, or one fewer.
    """
    known = [frame.prev_from_cur for frame in frames if frame.prev_from_cur is not None]
    return [np.asarray(np.linalg.inv(prev_from_cur), np.float64) for prev_from_cur in known]


def as_motion(dst_from_src: NDArray[np.float64]) -> RigidMotion:
    """A rigid [4, 4] m as networks have it: unit quaternion [1, 4] with w >= 0 and translation [1, 3] m, float32."""
    rigid = torch.from_numpy(dst_from_src[None])
    return RigidMotion(geometry.matrix_to_quaternion(rigid[:, :3, :3]).float(), rigid[:, :3, 3].float())


def _velocity(frame: PerceivedFrame, next_from_src: NDArray[np.float64], intervals: float) -> NDArray[np.float32]:
    """[3, H, W] m per interval: the frame's, but the recording car stays where it is in the image."""
    if not frame.own.any():
        return np.array(frame.velocity, np.float32)
    y, x = np.nonzero(frame.own[0])
    rays = np.linalg.inv(frame.K) @ np.stack([x + 0.5, y + 0.5, np.ones(len(x))])
    points = rays * frame.layers.depth[0, y, x]
    src_from_next = np.linalg.inv(next_from_src)
    velocity = np.array(frame.velocity, np.float32)
    velocity[:, y, x] = (src_from_next[:3, :3] @ points + src_from_next[:3, 3:] - points) / intervals
    return velocity

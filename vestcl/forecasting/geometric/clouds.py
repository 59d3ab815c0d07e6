"""The clouds that a forecast shows: of frame t, of the one before, what is remembered, and the background."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.forecasting.geometric.frame_cloud import FrameCloud
from vestcl.forecasting.geometric.memory import SceneMemory
from vestcl.forecasting.geometric.paths import Paths
from vestcl.scene.depth.road_plane import linear, rays_of
from vestcl.scene.exposure import curve_by_flow, nearest
from vestcl.scene.perception import Perception

#: A point hides what lies farther by that factor; nearer to the camera than this many metres nothing is compared.
_IN_FRONT, _NEAREST = 1.1, 0.1

Cameras = Callable[[float], NDArray[np.float64]]
"""``future_from_cur`` [4, 4] m after this many intervals."""


MovingCloud = Callable[[float, Cameras], FrameCloud]
"""A cloud after this many intervals, given the camera's motion; it is asked for that time and one interval before."""


def frame_clouds(
    perception: Perception, index: int, paths: Paths, memory: SceneMemory | None = None
) -> list[MovingCloud]:
    """What the current frame shows; what the one before did; what is remembered; what is behind the foreground.

    Args:
        perception: of the clip; the clouds don't need it once they are made.
        index: the frame t, 1 or more.
        paths: of the points of frame t.
        memory: see `remember`.

    Returns:
        Three or four clouds, as `render_clouds` takes them.
    """
    K = perception.clip[index].K
    cur, prev = perception.seen(index), perception.surface(index - 1)
    cur_from_prev = np.asarray(np.linalg.inv(perception.prev_from_cur(index)), np.float64)
    shown = _shown(paths, cur.own, perception.full_image(index))
    since = cur_from_prev, perception.clip.elapsed(index)
    curve = curve_by_flow(prev.image, cur.layers.image, perception.correspondence(index).flow_uv)
    full = perception.full_image(index - 1)
    scale = np.float32(perception.scale_before(index))
    velocity, full = scale * perception.moving(index - 1).velocity, None if full is None else curve(full)
    depth, kept = scale * prev.depth, ~prev.own
    kept &= ~_refuted(depth, velocity, *since, cur.layers.depth, K)
    before = _cloud(curve(prev.image), depth, kept, K, velocity, *since, full)
    hidden = ~cur.layers.mask & ~cur.own
    behind = _cloud(cur.layers.background_image, cur.layers.background_depth, hidden, K)
    return [shown, before, *([] if memory is None else [_static(memory, K)]), behind]


def _shown(paths: Paths, own: NDArray[np.bool_], full: NDArray[np.float32] | None) -> MovingCloud:
    """All pixels of the current frame; those of the recording car, ``own`` [1, H, W], stay in its camera's axes."""
    frame, (rows, columns) = paths.frame, np.indices(own.shape[1:]).reshape(2, -1)
    z_src = frame.depth.reshape(-1).astype(np.float32)
    now = paths.at(0, np.eye(4))

    def moved(step: float, future_from_cur: NDArray[np.float64]) -> NDArray[np.float32]:
        points = np.where(own, now, paths.at(step, future_from_cur))
        return np.asarray(cv2.transpose(points.astype(np.float32).reshape(3, -1)))

    return _moving(moved, z_src, frame.image, rows, columns, frame.K, full)


def _refuted(
    depth: NDArray[np.float32],
    velocity: NDArray[np.float32],
    cur_from_src: NDArray[np.float64],
    elapsed: float,
    depth_cur: NDArray[np.float32],
    K: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """[1, H, W], True where a point would hide what the current frame, of ``depth_cur``, shows: it can't be there."""
    rays = rays_of(K, *depth.shape[1:])
    points, shift = rays * depth + elapsed * velocity, K @ cur_from_src[:3, 3]
    u, v, z = linear(K @ cur_from_src[:3, :3], points) + shift[:, None, None]
    ahead = np.maximum(z, _NEAREST)
    seen = nearest(depth_cur, np.where(z > _NEAREST, u / ahead - 0.5, np.nan), v / ahead - 0.5)
    return np.asarray(_IN_FRONT * z < seen)


def _cloud(
    image: NDArray[np.float32],
    depth: NDArray[np.float32],
    which: NDArray[np.bool_],
    K: NDArray[np.float64],
    velocity: NDArray[np.float32] | None = None,
    cur_from_src: NDArray[np.float64] | None = None,
    elapsed: float = 0.0,
    full: NDArray[np.float32] | None = None,
) -> MovingCloud:
    """The pixels of ``which`` [1, H, W] as points of the current camera, at constant velocity.

    ``elapsed`` intervals have gone by since the frame, whose camera ``cur_from_src`` brings to the current one.
    """
    y, x = np.nonzero(which[0])
    z = depth[0, y, x].astype(np.float64)
    points = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], axis=1) @ np.linalg.inv(K).T * z[:, None]
    speed = np.zeros((1, 3)) if velocity is None else velocity[:, y, x].T.astype(np.float64)
    if cur_from_src is not None:
        points = _transform(cur_from_src, points + elapsed * speed)
        speed = speed @ cur_from_src[:3, :3].T
    z_src = z.astype(np.float32)
    return _moving(lambda k, camera: _transform(camera, points + k * speed), z_src, image, y, x, K, full)


def _static(memory: SceneMemory, K: NDArray[np.float64]) -> MovingCloud:
    """What is remembered, at rest in the world."""
    pixels = memory.rows, memory.columns
    return _moving(lambda k, camera: _transform(camera, memory.points_xyz), memory.z_src, memory.image, *pixels, K)


def _moving(
    moved: Callable[[float, NDArray[np.float64]], NDArray[np.floating]],
    z_src: NDArray[np.float32],
    image: NDArray[np.float32],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    K: NDArray[np.float64],
    full: NDArray[np.float32] | None = None,
) -> MovingCloud:
    """A cloud whose points [N, 3] are ``moved(step, future_from_cur)``: a step's are the next one's points before.

    ``K`` is that of ``image``.
    """
    kept: dict[float, NDArray[np.floating]] = {}

    def points_at(step: float, future_from_cur: NDArray[np.float64]) -> NDArray[np.floating]:
        if step not in kept:
            for other in [k for k in kept if not step - 1 <= k <= step + 1]:
                del kept[other]
            kept[step] = moved(step, future_from_cur)
        return kept[step]

    def at(step: float, camera: Cameras) -> FrameCloud:
        there, before = (points_at(k, camera(k)) for k in (step, step - 1))
        step_xyz = (there - before).astype(np.float32)
        return FrameCloud(there.astype(np.float32), z_src, image, step_xyz, rows, columns, full, float(K[0, 0]))

    return at


def _transform(dst_from_src: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, 3]: R x + t."""
    if not len(points):
        return points
    return np.asarray(cv2.transform(points[:, None], dst_from_src[:3]), np.float64)[:, 0]

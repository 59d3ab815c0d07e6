"""Future frames from new views: the camera by its forecast motion, each point by what proved best for it.

Velocities are per interval of the clip (`Clip.interval`), whatever the time between the frames they are measured in.
"""

import time
from collections.abc import Callable, Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.data.sample import Clip
from vestcl.forecasting.geometric.frame_cloud import FrameCloud
from vestcl.forecasting.geometric.memory import MEMORY, SceneMemory, remember
from vestcl.forecasting.geometric.paths import Paths, forecast_cameras, point_paths
from vestcl.forecasting.geometric.render import Shown, holes, rendered, show
from vestcl.forecasting.progress import Progress, by_stage
from vestcl.forecasting.result import Forecast, Rendered, View
from vestcl.scene.exposure import as_exposed
from vestcl.scene.inpainting.holes import deep_holes, fill_holes
from vestcl.scene.inpainting.inpainters import Inpainter
from vestcl.scene.perception import Perception

#: The name of this method in tables and files.
METHOD: Final = "geometric"

#: The source camera looks along the road, whose vanishing point a view shows unless it is turned away from it: by 60
#: degrees.
_AHEAD: Final = 0.5


def forecast_clip(
    clip: Clip,
    index: int,
    steps: int,
    views: Sequence[View],
    *,
    inpaint: Inpainter | None = None,
    memory: int = MEMORY,
    progress: Progress | None = None,
) -> Forecast:
    """Forecast the frames after ``index`` of a clip, from its frames up to ``index`` only.

    Args:
        clip: at its own size; its later frames and poses are not looked at.
        index: the current frame t, 1 or more.
        steps: frames to forecast, 1 or more.
        views: cameras to show each from.
        inpaint: how the background behind the foreground is filled, see `Perception`.
        memory: see `forecast_frames`.
        progress: called with the stage and the share of the work that is done.

    Returns:
        The forecast, of the clip's height and width.

    Raises:
        ValueError: no such frame or none before it, no steps, no views, or a clip without a source of depth.
    """
    report = by_stage(progress, _stages(index, memory) + steps * len(views))
    return forecast_frames(Perception(clip, report, inpaint=inpaint), index, steps, views, memory=memory, report=report)


def _stages(index: int, memory: int) -> int:
    """Results that a forecast asks `Perception` for: six of each frame, and the image before them."""
    return 6 * min(index + 1, 2 + max(memory, 0)) + 1


def forecast_frames(
    perception: Perception,
    index: int,
    steps: int,
    views: Sequence[View],
    *,
    future_from_cur: Sequence[NDArray[np.float64]] | None = None,
    paths: Paths | None = None,
    memory: int = MEMORY,
    report: Callable[[str], None] = lambda stage: None,
) -> Forecast:
    """`forecast_clip` on a `Perception` that may have seen earlier frames already, and keeps what it sees.

    Args:
        perception: of the clip.
        index: the current frame t.
        steps: frames to forecast.
        views: cameras to show each from.
        future_from_cur: [4, 4] m per step, the camera's motion from t, in place of the forecast one.
        paths: of the points of frame t; None is `point_paths`.
        memory: frames before t-1 whose static scene is shown where t and t-1 leave something open, 0 or more.
        report: called with the stage before each view.

    Raises:
        ValueError: as `forecast_clip`.
    """
    clip = perception.clip
    if not 1 <= index < len(clip):
        raise ValueError(f"`index` must be 1 ... {len(clip) - 1}, a frame of {clip.name} with one before, got {index}")
    if steps < 1 or not views:
        raise ValueError(f"`steps` and `views` must be 1 or more, got {steps} and {len(views)}")
    ahead, remembered = range(1, steps + 1), remember(perception, index, memory)
    cameras = forecast_cameras(perception, index, ahead) if future_from_cur is None else list(future_from_cur)
    if len(cameras) < steps:
        raise ValueError(f"`future_from_cur` must be of {steps} steps or more, got {len(cameras)}")
    clouds = frame_clouds(perception, index, paths or point_paths(perception, index), remembered)
    start, frames, size = time.perf_counter(), list[dict[str, Rendered]](), (clip[0].height, clip[0].width)
    for step in ahead:
        moved = [cloud(step, _by_step(cameras)) for cloud in clouds]
        frames.append({})
        for view in views:
            report("render")
            frames[-1][view.name] = render_clouds(moved, clip[index].K if view.K is None else view.K, view, *size)
    seconds = perception.seconds | {"render": time.perf_counter() - start}
    return Forecast(METHOD, cameras[:steps], frames, seconds, notes=input_notes(perception, index))


def input_notes(perception: Perception, index: int) -> tuple[str, ...]:
    """Lines on what forecasts from frame ``index`` lack: `gap_notes`, and labels that only some frames have."""
    labelled = sum(sample.labels is not None for sample in perception.clip)
    if perception.has_labels or not labelled:
        return gap_notes(perception, index)
    partly = f"{labelled} of {len(perception.clip)} frames have labels: masks of all are from motion"
    return (*gap_notes(perception, index), partly)


def gap_notes(perception: Perception, index: int) -> tuple[str, ...]:
    """A line on the gap in time before frame ``index``, if it is too long for the frames to be matched."""
    if not perception.is_lost(index):
        return ()
    clip = perception.clip
    gap = clip.elapsed(index) * (clip.interval or 1.0)
    names = f"{clip[index - 1].name} and {clip[index].name}"
    return (f"frames {names} are {gap:.3g} s apart, too far to be matched: motion continues as before the gap",)


def show_frame(
    perception: Perception, index: int, views: Sequence[View], *, memory: int = MEMORY
) -> dict[str, Rendered]:
    """A frame itself as other cameras see it, at the same time.

    Args:
        perception: of the clip.
        index: the frame t, 1 or more.
        views: cameras at t, ``tgt_from_next`` from the source camera there.
        memory: as in `forecast_frames`.

    Returns:
        By the views' names.

    Raises:
        ValueError: a clip without a source of depth.
    """
    clip = perception.clip
    remembered, paths = remember(perception, index, memory), Paths(perception.frame(index))
    clouds = [cloud(0, lambda step: np.eye(4)) for cloud in frame_clouds(perception, index, paths, remembered)]
    K, size = clip[index].K, (clip[0].height, clip[0].width)
    return {view.name: render_clouds(clouds, K if view.K is None else view.K, view, *size) for view in views}


Cameras = Callable[[float], NDArray[np.float64]]
"""``future_from_cur`` [4, 4] m after this many intervals."""


def _by_step(cameras: Sequence[NDArray[np.float64]]) -> Cameras:
    """Of whole steps: ``cameras`` from step 1 on."""
    return lambda step: np.eye(4) if step == 0 else cameras[round(step) - 1]


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
    shown = _shown(paths, cur.own)
    since = cur_from_prev, perception.clip.elapsed(index)
    image_prev = as_exposed(prev.image, cur.layers.image, perception.correspondence(index).flow_uv)
    scale = np.float32(perception.scale_before(index))
    velocity = scale * perception.moving(index - 1).velocity
    before = _cloud(image_prev, scale * prev.depth, ~prev.own, K, velocity, *since)
    hidden = ~cur.layers.mask & ~cur.own
    behind = _cloud(cur.layers.background_image, cur.layers.background_depth, hidden, K)
    return [shown, before, *([] if memory is None else [_static(memory)]), behind]


def _shown(paths: Paths, own: NDArray[np.bool_]) -> MovingCloud:
    """All pixels of the current frame; those of the recording car, ``own`` [1, H, W], stay in its camera's axes."""
    frame, (rows, columns) = paths.frame, np.indices(own.shape[1:]).reshape(2, -1)
    z_src = frame.depth.reshape(-1).astype(np.float32)
    now = paths.at(0, np.eye(4))

    def moved(step: float, future_from_cur: NDArray[np.float64]) -> NDArray[np.float32]:
        points = np.where(own, now, paths.at(step, future_from_cur))
        return np.asarray(cv2.transpose(points.astype(np.float32).reshape(3, -1)))

    return _moving(moved, z_src, frame.image, rows, columns)


def _cloud(
    image: NDArray[np.float32],
    depth: NDArray[np.float32],
    which: NDArray[np.bool_],
    K: NDArray[np.float64],
    velocity: NDArray[np.float32] | None = None,
    cur_from_src: NDArray[np.float64] | None = None,
    elapsed: float = 0.0,
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
    return _moving(lambda k, camera: _transform(camera, points + k * speed), z_src, image, y, x)


def _static(memory: SceneMemory) -> MovingCloud:
    """What is remembered, at rest in the world."""
    pixels = memory.rows, memory.columns
    return _moving(lambda k, camera: _transform(camera, memory.points_xyz), memory.z_src, memory.image, *pixels)


def _moving(
    moved: Callable[[float, NDArray[np.float64]], NDArray[np.floating]],
    z_src: NDArray[np.float32],
    image: NDArray[np.float32],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
) -> MovingCloud:
    """A cloud whose points [N, 3] are ``moved(step, future_from_cur)``: a step's are the next one's points before."""
    kept: dict[float, NDArray[np.floating]] = {}

    def points_at(step: float, future_from_cur: NDArray[np.float64]) -> NDArray[np.floating]:
        if step not in kept:
            for other in [k for k in kept if not step - 1 <= k <= step + 1]:
                del kept[other]
            kept[step] = moved(step, future_from_cur)
        return kept[step]

    def at(step: float, camera: Cameras) -> FrameCloud:
        there, before = (points_at(k, camera(k)) for k in (step, step - 1))
        return FrameCloud(there.astype(np.float32), z_src, image, (there - before).astype(np.float32), rows, columns)

    return at


def _transform(dst_from_src: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, 3]: R x + t."""
    if not len(points):
        return points
    return np.asarray(cv2.transform(points[:, None], dst_from_src[:3]), np.float64)[:, 0]


def render_clouds(
    clouds: Sequence[FrameCloud], K: NDArray[np.float64], view: View, height: int, width: int
) -> Rendered:
    """What was seen, in its holes what is remembered, then what is behind the foreground, then what surrounds them.

    Args:
        clouds: of the current frame, of the one before, remembered ones (may be left out), and the background.
        K: [3, 3] px, of the view.
        view: where it is; its own ``K`` is not looked at.
        height: px.
        width: px.

    The inpainted background is a guess, and only wanted where the foreground has moved away: cracks, and what enters
    the image from outside, are better guessed from the side. On kitti_clip's traffic that is worth 3 dB.
    """
    seen_from = K, view.tgt_from_next, height, width
    shown = show(list(clouds[:2]), *seen_from)
    hole = holes(shown)
    if len(clouds) > 3 and hole.any():
        shown = _filled(shown, show(list(clouds[2:3]), *seen_from, where=hole), hole)
        hole = holes(shown)
    coverage, deep = shown.coverage, deep_holes(hole)
    if deep.any():
        behind = show(list(clouds[-1:]), *seen_from, where=deep)
        deep &= ~holes(behind)
        shown, hole = Shown(_filled(shown, behind, deep).planes, coverage), hole & ~deep
    ahead = K @ view.tgt_from_next[:3, 2]
    vanishing_uv = ahead[:2] / ahead[2] if ahead[2] > _AHEAD else None
    return rendered(shown, fill_holes(shown.planes[:3], shown.planes[3:4], hole, vanishing_uv))


def _filled(shown: Shown, other: Shown, where: NDArray[np.bool_]) -> Shown:
    """``other`` in place of ``shown`` at ``where`` [1, H, W]."""
    return Shown(np.where(where, other.planes, shown.planes), np.where(where, other.coverage, shown.coverage))

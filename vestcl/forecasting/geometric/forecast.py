"""Future frames from new views: the camera by its forecast motion, each point by what proved best for it.

Velocities are per interval of the clip (`Clip.interval`), whatever the time between the frames they are measured in.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vestcl.constants import WORK_WIDTH
from vestcl.data.sample import Clip
from vestcl.forecasting.full_size import without
from vestcl.forecasting.geometric.clouds import Cameras, frame_clouds
from vestcl.forecasting.geometric.frame_cloud import FrameCloud
from vestcl.forecasting.geometric.memory import MEMORY, remember
from vestcl.forecasting.geometric.paths import Paths, forecast_cameras, point_paths
from vestcl.forecasting.geometric.render import Shown, holes, rendered, show
from vestcl.forecasting.progress import Progress, by_stage
from vestcl.forecasting.result import Forecast, Rendered, View
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
    work_width: int | None = WORK_WIDTH,
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
        work_width: px, the largest width that scenes are perceived and splatted at; colours are those of the clip at
            its own size. None is the clip's own.
        progress: called with the stage and the share of the work that is done.

    Returns:
        The forecast, of the clip's height and width.

    Raises:
        ValueError: no such frame or none before it, no steps, no views, a width that is too small, or a clip without a
            source of depth.
    """
    report = by_stage(progress, _stages(index, memory) + steps * len(views))
    perception = Perception(clip, report, inpaint=inpaint, work_width=work_width)
    return forecast_frames(perception, index, steps, views, memory=memory, report=report)


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
        memory: frames before t-1 whose static scene is shown where t and t-1 leave something open, 0 or more.
        report: called with the stage before each view.

    Raises:
        ValueError: as `forecast_clip`.
    """
    how: dict[str, Any] = {"future_from_cur": future_from_cur, "memory": memory, "report": report}
    return at_recorded_size(working_frames(perception, index, steps, views, **how), perception)


def working_frames(
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
    """`forecast_frames` at the working size, for `at_recorded_size`.

    ``paths`` are of the points of frame t; None is `point_paths`.
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
    start, frames = time.perf_counter(), list[dict[str, Rendered]]()
    for step in ahead:
        moved = [cloud(step, _by_step(cameras)) for cloud in clouds]
        frames.append({})
        for view in views:
            report("render")
            frames[-1][view.name] = _render(moved, perception, index, view)
    seconds = perception.seconds | {"render": time.perf_counter() - start}
    return Forecast(METHOD, cameras[:steps], frames, seconds, notes=input_notes(perception, index))


def _render(clouds: Sequence[FrameCloud], perception: Perception, index: int, view: View) -> Rendered:
    """The view at the working size."""
    shown, sample = working_view(perception, view), perception.clip[index]
    K = sample.K if shown.K is None else shown.K
    return render_clouds(clouds, K, shown, perception.clip[0].height, perception.clip[0].width)


def working_view(perception: Perception, view: View) -> View:
    """A view of the recorded size at the working size: diag(sx, sy, 1) K, where it has a K of its own."""
    if perception.recorded is perception.clip:
        return view
    recorded, sample = perception.recorded[0], perception.clip[0]
    return view.resized((recorded.height, recorded.width), (sample.height, sample.width))


def at_recorded_size(forecast: Forecast, perception: Perception) -> Forecast:
    """``forecast`` at the clip's own size; the time that takes counts as "render"."""
    if perception.recorded is perception.clip:
        return forecast
    start, size = time.perf_counter(), (perception.recorded[0].height, perception.recorded[0].width)
    frames = [{name: rendered.at_size(*size) for name, rendered in frame.items()} for frame in forecast.frames]
    spent = forecast.seconds.get("render", 0.0) + time.perf_counter() - start
    work = f"perceived and splatted at {perception.clip[0].width} px, shown at {size[1]} px (--work-width)"
    seconds, notes = forecast.seconds | {"render": spent}, (*forecast.notes, work)
    return replace(forecast, frames=frames, seconds=seconds, notes=notes)


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
    clip = perception.recorded
    remembered, paths = remember(perception, index, memory), Paths(perception.frame(index))
    clouds = [cloud(0, lambda step: np.eye(4)) for cloud in frame_clouds(perception, index, paths, remembered)]
    size = clip[0].height, clip[0].width
    return {view.name: _render(clouds, perception, index, view).at_size(*size) for view in views}


def _by_step(cameras: Sequence[NDArray[np.float64]]) -> Cameras:
    """Of whole steps: ``cameras`` from step 1 on."""
    return lambda step: np.eye(4) if step == 0 else cameras[round(step) - 1]


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
        shown, hole = replace(_filled(shown, behind, deep), coverage=coverage), hole & ~deep
    ahead = K @ view.tgt_from_next[:3, 2]
    vanishing_uv = ahead[:2] / ahead[2] if ahead[2] > _AHEAD else None
    return rendered(shown, fill_holes(shown.planes[:3], shown.planes[3:4], hole, vanishing_uv))


def _filled(shown: Shown, other: Shown, where: NDArray[np.bool_]) -> Shown:
    """``other`` in place of ``shown`` at ``where`` [1, H, W]."""
    planes = np.where(where, other.planes, shown.planes)
    return Shown(planes, np.where(where, other.coverage, shown.coverage), without(shown.lookups, where[0]))

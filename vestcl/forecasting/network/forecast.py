"""Forecasts by a trained network, asked for and answered as those of `vestcl.forecasting.geometric` are."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl.constants import WORK_WIDTH
from vestcl.data.sample import Clip
from vestcl.forecasting.geometric.forecast import at_recorded_size, input_notes, working_frames, working_view
from vestcl.forecasting.geometric.paths import point_paths
from vestcl.forecasting.network.backtest import choose_parts
from vestcl.forecasting.network.input import NetworkInput
from vestcl.forecasting.network.learned import REFINEMENT, CorrectedPaths, Learned, chosen_motion, given_input, refined
from vestcl.forecasting.progress import Progress, by_stage
from vestcl.forecasting.result import Forecast, Rendered, SkippedWork, View
from vestcl.models.config import ModelConfig
from vestcl.models.forecaster import Forecaster, Mode, Perceive, RenderedView
from vestcl.models.inference.skipping import Count, Tally, count_skips
from vestcl.models.inference.stage_times import watching, with_rest
from vestcl.scene.inpainting.inpainters import Inpainter
from vestcl.scene.perception import Perception

#: Stages of a forecast that `Perception` reports: results for two frames, and the image before them.
_STAGES = 13


def forecast_clip(
    clip: Clip,
    index: int,
    steps: int,
    views: Sequence[View],
    model: Forecaster,
    *,
    mode: Mode | None = None,
    perceive: Perceive | None = None,
    inpaint: Inpainter | None = None,
    learned: Learned = "tested",
    work_width: int | None = WORK_WIDTH,
    progress: Progress | None = None,
) -> Forecast:
    """Forecast the frames after ``index`` of a clip, from its frames up to ``index`` only.

    Args:
        clip: at its own size; its later frames and poses are not looked at.
        index: the current frame t, 1 or more.
        steps: frames to forecast, 1 or more.
        views: cameras to show each from.
        model: a trained network, see `Forecaster.load`.
        mode: how steps after the first are made, see `Forecaster.forecast`; None is the model's default.
        perceive: how forecast frames become inputs of mode "feedback", see `Forecaster.forecast`.
        inpaint: how the background behind the foreground of recorded frames is filled, see `Perception`.
        learned: see `forecast_frames`.
        work_width: see `vestcl.forecasting.geometric.forecast_clip`; networks run at it, too.
        progress: called with the stage and the share of the work that is done.

    Returns:
        The forecast, of the clip's height and width.

    Raises:
        ValueError: no such frame or none before it, no steps, no views, or a clip without a source of depth.
    """
    composed = _is_composed(model.config, mode, learned)
    report = by_stage(progress, _STAGES + (steps * len(views) if composed else 0))
    how: dict[str, Any] = {"mode": mode, "perceive": perceive, "learned": learned, "report": report}
    perception = Perception(clip, report, inpaint=inpaint, work_width=work_width)
    return forecast_frames(perception, model, index, steps, views, **how)


def forecast_frames(
    perception: Perception,
    model: Forecaster,
    index: int,
    steps: int,
    views: Sequence[View],
    *,
    mode: Mode | None = None,
    perceive: Perceive | None = None,
    learned: Learned = "tested",
    report: Callable[[str], None] = lambda stage: None,
) -> Forecast:
    """`forecast_clip` on a `Perception` that may have seen earlier frames already, and keeps what it sees.

    A network that starts from measurements corrects the geometric forecast: its camera's motion, its objects'
    velocities, and its image. Each of these parts is used where it wins a test on frames up to t
    (`vestcl.forecasting.network.backtest`); without any, the result is the geometric forecast. A network that starts
    from rest, and mode "feedback", have all parts and no test.

    Args:
        perception: of the clip.
        model: the network.
        index: the current frame t.
        steps: frames to forecast.
        views: cameras to show each from.
        mode: see `forecast_clip`.
        perceive: see `forecast_clip`.
        learned: "all" is the network's own forecast, as `Forecaster.forecast` has it, without a test.
        report: called with the stage before the networks run.

    Raises:
        ValueError: as `forecast_clip`.
    """
    clip = perception.clip
    if not 1 <= index < len(clip):
        raise ValueError(f"`index` must be 1 ... {len(clip) - 1}, a frame of {clip.name} with one before, got {index}")
    if steps < 1 or not views:
        raise ValueError(f"`steps` and `views` must be 1 or more, got {steps} and {len(views)}")
    if learned not in get_args(Learned):
        raise ValueError(f'`learned` must be "tested" or "all", got {learned!r}')
    if _is_composed(model.config, mode, learned):
        return at_recorded_size(_composed(perception, model, index, steps, views, report), perception)
    views = [working_view(perception, view) for view in views]
    given, note = _given(perception, index, model.config, steps)
    report("network")
    start = time.perf_counter()
    with torch.inference_mode(), watching() as watch, count_skips() as tally:
        done = model.forecast(
            given.frame_prev, given.frame_cur, given.K, steps, cameras(views, given), mode, perceive,
            prior=given.prior if model.config.start == "prior" else None, own=given.own,
        )  # fmt: skip
    names = [view.name for view in views]
    frames = [dict(zip(names, map(_rendered, step.views), strict=True)) for step in done]
    motions = [step.future_from_cur[0].double().numpy() for step in done]
    whole = time.perf_counter() - start
    profile = with_rest(watch.take(), whole)
    skipped = what_was_skipped(tally, profile)
    seconds = perception.seconds | {"network": whole}
    notes = (*input_notes(perception, index), *([] if note is None else [note]))
    made = Forecast(
        model.config.name, motions, frames, seconds, profile, skipped, notes, mode or model.config.default_mode
    )
    return at_recorded_size(made, perception)


def _is_composed(config: ModelConfig, mode: Mode | None, learned: Learned) -> bool:
    """Whether the network corrects the geometric forecast, in place of making one of its own."""
    return learned == "tested" and config.start == "prior" and (mode or config.default_mode) == "compose"


def _composed(
    perception: Perception,
    model: Forecaster,
    index: int,
    steps: int,
    views: Sequence[View],
    report: Callable[[str], None],
) -> Forecast:
    """The geometric forecast with the learned parts that pass the test."""
    note = interval_note(perception.clip, index, model.config)
    known = note is None and interval_note(perception.clip, max(index - 1, 1), model.config) is None
    paths = point_paths(perception, index)
    perception.seen(index - 1)
    report("network")
    clock = _Clock(perception)
    with torch.inference_mode(), watching() as watch, count_skips() as tally:
        with clock:
            parts = choose_parts(perception, model, index, known)
            motion = chosen_motion(perception, model, index, steps, parts)
        moved = CorrectedPaths(paths.frame, paths.errors, paths.by_flow, motion.velocity_cur if motion.moves else None)
        geometric = working_frames(
            perception, index, steps, views, future_from_cur=motion.cameras, paths=moved, report=report
        )
        frames = geometric.frames
        if REFINEMENT in parts and parts[REFINEMENT].used:
            with clock:
                shown = [working_view(perception, view) for view in views]
                frames = refined(perception, model, index, motion, shown, frames)
    stages = watch.take()
    whole = max(clock.seconds, sum(stages.values()))  # another thread's perception is not in the networks' time
    profile = with_rest(stages, whole)
    seconds = geometric.seconds | perception.seconds | {"network": whole}
    notes = (*geometric.notes, *([] if note is None else [note]))
    skipped = what_was_skipped(tally, profile)
    return Forecast(model.config.name, list(motion.cameras), frames, seconds, profile, skipped, notes, "compose", parts)


class _Clock:
    """Seconds of the networks: of all blocks that it is entered for, minus the time of perception in them."""

    def __init__(self, perception: Perception) -> None:
        self.seconds = 0.0
        self._perception = perception

    def __enter__(self) -> None:
        self.seconds -= self._now()

    def __exit__(self, *error: object) -> None:
        self.seconds += self._now()

    def _now(self) -> float:
        return time.perf_counter() - sum(self._perception.seconds.values())


def what_was_skipped(tally: Tally, profile: Mapping[str, float]) -> dict[str, SkippedWork]:
    """Counters with what they saved: t n_skipped / n_computed, t of the stage that would have done it.

    Encoding a frame and its background counts as encoding as many pixels; a view is splatted and refined. What a point
    costs the splatter depends on where it is, so there is no estimate of "covered"; nor is there one where nothing of
    the kind was computed, and so nothing timed.

    Args:
        tally: of a forecast.
        profile: seconds by stage, of the same one.

    Returns:
        By switch.
    """
    of_view, pixels = profile["splat"] + profile["refine"], tally.counts.get("background", Count(0, 0, "px"))
    timed = {"seen": profile["encode"], "background": profile["encode"], "objects": profile["OMF"], "views": of_view}
    skipped = {}
    for switch, count in tally.counts.items():
        computed = count.of - count.skipped + (pixels.of if switch == "background" else 0)
        saved = timed[switch] * count.skipped / computed if switch in timed and computed else None
        skipped[switch] = SkippedWork(*count, saved)
    return skipped


def show_frame(perception: Perception, model: Forecaster, index: int, views: Sequence[View]) -> dict[str, Rendered]:
    """A frame itself as other cameras see it, at the same time; arguments and answer as
    `vestcl.forecasting.geometric.show_frame`.

    Args:
        perception: of the clip.
        model: the network.
        index: the frame t, 1 or more.
        views: cameras at t, ``tgt_from_next`` from the source camera there.
    """
    given, _ = _given(perception, index, model.config, 1)
    prior = given.prior if model.config.start == "prior" else None
    views, size = [working_view(perception, view) for view in views], perception.recorded[0]
    with torch.inference_mode():
        shown = model.present(given.frame_prev, given.frame_cur, given.K, cameras(views, given), prior, given.own)
    frames = (_rendered(view).at_size(size.height, size.width) for view in shown)
    return dict(zip((view.name for view in views), frames, strict=True))


def _given(perception: Perception, index: int, config: ModelConfig, steps: int) -> tuple[NetworkInput, str | None]:
    """The two frames, and a line on the interval where it is another one than the network learned at."""
    given, note = given_input(perception, index, config.prior, steps), interval_note(perception.clip, index, config)
    return given._replace(prior=given.prior._replace(corrected=torch.tensor([note is None]))), note


def interval_note(clip: Clip, index: int, config: ModelConfig) -> str | None:
    """Why motion networks are not used at this frame: they learned at another interval than the clip's, or than the one
    from t - 1 to t. None where they are used.

    Args:
        clip: of the frame; without timestamps its interval counts as the network's.
        index: of the frame t, 1 or more.
        config: of the network; with ``start`` "rest" its motion can't be left out, and is only doubtful.
    """
    if clip.interval is None:
        return None
    gap = clip.interval * clip.elapsed(index)
    wrong = next((seconds for seconds in (gap, clip.interval) if not config.knows(seconds)), None)
    if wrong is None:
        return None
    if config.start == "prior":
        consequence = "its corrections of the camera's and the objects' motion are left out"
    else:
        consequence = "its motion may be wrong"
    what = "frames t-1 and t are" if wrong == gap != clip.interval else "frames are"
    return f"{what} {wrong:.3g} s apart, {config.name} learned at {config.learned_at}: {consequence}"


def cameras(views: Sequence[View], given: NetworkInput) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """``views`` as `Forecaster.forecast` takes them: (tgt_from_next [1, 4, 4], K [1, 3, 3])."""
    return [(_tensor(view.tgt_from_next), given.K if view.K is None else _tensor(view.K)) for view in views]


def _tensor(matrix: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(np.array(matrix, np.float32))[None]


def _rendered(view: RenderedView) -> Rendered:
    image, depth, coverage, motion_xyz = (
        np.ascontiguousarray(plane[0].float().numpy())
        for plane in (view.image.clamp(0, 1), view.depth, view.coverage, view.motion_xyz)
    )
    return Rendered(image, depth, coverage, motion_xyz)

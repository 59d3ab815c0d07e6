"""How a method moves the points of a frame and its camera, and what a network adds to the image."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from vestcl.data import calibration
from vestcl.forecasting.geometric.forecast import METHOD
from vestcl.forecasting.geometric.paths import Paths, forecast_cameras, point_paths
from vestcl.forecasting.result import Rendered, View
from vestcl.scene.perception import Perception

if TYPE_CHECKING:
    from vestcl.models.forecaster import Forecaster

Matrix = NDArray[np.float64]

Refine = Callable[[Rendered, int, View], Rendered]
"""What a network makes of a rendered view (second: intervals ahead) at that view."""

#: Intervals that the viewer looks ahead.
MOST_AHEAD: Final = 10

#: Times ahead are multiples of 1 / TICKS interval.
TICKS: Final = 10


def on_tick(ahead: float) -> float:
    """The nearest time ahead that the viewer shows, in intervals."""
    return round(ahead * TICKS) / TICKS


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion from a frame on."""

    method: str
    paths: Paths
    """Of the frame's points."""
    cameras: dict[int, Matrix]
    """``future_from_cur`` [4, 4] m, by ticks ahead."""
    refine: Refine | None = None
    """None changes nothing."""
    notes: tuple[str, ...] = field(default=())
    """Lines for the user."""

    def camera(self, ahead: float) -> Matrix:
        """``future_from_cur`` [4, 4] m after ``ahead`` intervals, rounded to ticks, from -2 to `MOST_AHEAD`."""
        return self.cameras[round(ahead * TICKS)]


def geometric_motion(perception: Perception, index: int) -> Motion:
    """The motion of the geometric forecast from frame ``index`` on.

    Args:
        perception: of the clip.
        index: the frame t, 1 or more.
    """
    future = forecast_cameras(perception, index, range(1, MOST_AHEAD + 1))
    cameras = _seen(perception, index) | _between([np.eye(4), *future])
    return Motion(METHOD, point_paths(perception, index), cameras)


def network_motion(perception: Perception, index: int, model: "Forecaster") -> Motion:
    """The geometric forecast's motion with the learned parts of ``model`` that pass their test at frame ``index``.

    Args:
        perception: of the clip.
        index: the frame t, 1 or more.
        model: that corrects the geometric forecast, see `check_model`.
    """
    import torch

    from vestcl.forecasting.network import learned
    from vestcl.forecasting.network.backtest import choose_parts
    from vestcl.forecasting.network.forecast import interval_note

    clip, paths = perception.clip, point_paths(perception, index)
    note = interval_note(clip, index, model.config)
    known = note is None and interval_note(clip, max(index - 1, 1), model.config) is None
    perception.seen(index - 1)
    with torch.inference_mode():
        parts = choose_parts(perception, model, index, known)
        motion = learned.chosen_motion(perception, model, index, MOST_AHEAD, parts)
    moved = learned.CorrectedPaths(
        paths.frame, paths.errors, paths.by_flow, motion.velocity_cur if motion.moves else None
    )
    cameras = _seen(perception, index) | _between([np.eye(4), *motion.cameras])
    used = [name for name, part in parts.items() if part.used]
    notes = (f"learned parts used: {', '.join(used) or 'none'}", *([] if note is None else [note]))

    def refine(rendered: Rendered, ahead: int, view: View) -> Rendered:
        frames = [{view.name: rendered}]
        with torch.inference_mode():
            return learned.refined(perception, model, index, motion, [view], frames, [ahead])[0][view.name]

    refines = learned.REFINEMENT in used
    return Motion(model.config.name, moved, cameras, refine if refines else None, notes)


def check_model(model: "Forecaster", name: str) -> None:
    """Refuse a network that forecasts by itself: the viewer shows those that correct the geometric forecast.

    Raises:
        ValueError: it starts from rest, or sees its own forecasts.
    """
    if model.config.start != "prior" or model.config.default_mode != "compose":
        raise ValueError(
            f"`model` must correct the geometric forecast, as vest-s does, got {name}, which forecasts by itself; "
            f"`vestcl forecast --model {name}` shows it"
        )


def _seen(perception: Perception, index: int) -> dict[int, Matrix]:
    """The measured motion backwards, at constant velocity: by ticks from -2 intervals to 0."""
    prev_from_cur, elapsed = perception.prev_from_cur(index), perception.clip.elapsed(index)
    return {tick: calibration.power(prev_from_cur, -tick / TICKS / elapsed) for tick in range(-2 * TICKS, 1)}


def _between(cameras: Sequence[Matrix]) -> dict[int, Matrix]:
    """``future_from_cur`` after 0, 1, 2 ... intervals, at constant velocity in between: by ticks."""
    found = {}
    for number, (first, second) in enumerate(itertools.pairwise(cameras)):
        step = second @ np.linalg.inv(first)
        for tick in range(TICKS):
            found[number * TICKS + tick] = calibration.power(step, tick / TICKS) @ first
    return found | {(len(cameras) - 1) * TICKS: cameras[-1]}

"""The geometric forecast with what a network learned on top of it.

A network's learned parts are the correction of the camera's motion (EMF), that of the objects' velocities (OMF), and
what refinement adds to the image. Points, depth and colour are the geometric forecast's: without any part that is what
comes out. `vestcl.forecasting.network.backtest` chooses the parts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl import geometry
from vestcl.forecasting.geometric.paths import Paths
from vestcl.forecasting.network.input import PAST, CameraPath, NetworkInput, camera_path, last_motions, network_input
from vestcl.forecasting.network.planes import forecast_planes
from vestcl.forecasting.result import LearnedPart, Rendered, View
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.stage_times import watching
from vestcl.models.steps.render import looks_of
from vestcl.scene.perception import Perception

Learned = Literal["tested", "all"]
"""Which learned parts a forecast has: those that pass the test, or all of them."""

#: The parts, in the order that they are tested in.
PARTS: Final = ("camera", "objects", "refinement")
CAMERA, OBJECTS, REFINEMENT = PARTS

Array = NDArray[np.float32]
Matrix = NDArray[np.float64]


class Corrections(NamedTuple):
    """What a network's motion has beyond its prior."""

    cameras: tuple[Matrix, ...]
    """``future_from_cur`` [4, 4] m, after 1, 2 ... intervals: the prior's, corrected."""
    velocity_prev: Array
    """[3, H, W] m per interval, to be added to that of what each pixel of t - 1 shows, in that camera's axes."""
    velocity_cur: Array
    """The same of t."""

    @property
    def moves(self) -> bool:
        """Whether any velocity is corrected."""
        return bool(self.velocity_cur.any() or self.velocity_prev.any())


@dataclass(frozen=True, eq=False)
class CorrectedPaths(Paths):
    """Paths of points whose objects have corrected velocities: R n v more after n intervals."""

    more: Array | None = None
    """v [3, H, W] m per interval, in the axes of the frame's camera; None is 0."""

    def at(self, ahead: float, future_from_cur: Matrix) -> Matrix:
        """As `Paths.at`."""
        points = super().at(ahead, future_from_cur)
        if self.more is None:
            return points
        return np.asarray(points + np.tensordot(future_from_cur[:3, :3], ahead * self.more, 1), np.float64)


def given_input(perception: Perception, index: int, prior: str, steps: int = 1, back: int = 0) -> NetworkInput:
    """Frames ``index`` - 1 and ``index`` as a network takes them.

    Args:
        perception: of the clip.
        index: the frame t, 1 or more.
        prior: `vestcl.models.config.ModelConfig.prior`.
        steps: intervals that the camera's motion is forecast for.
        back: frames after ``index`` that are looked at anyway: as many of the last motions are left out.
    """
    prev, cur = perception.seen(index - 1), perception.seen(index)
    path = forecast_path(perception, index, steps, back) if prior == "forecast" else None
    return network_input(prev, cur, last_motions(prev, cur), path)


def forecast_path(perception: Perception, index: int, steps: int, back: int = 0) -> CameraPath:
    """The camera's motion as the geometric forecast has it; arguments as of `given_input`."""
    clip, seen = perception.clip, range(max(index + back - PAST + 1, 1), index + 1)
    motions = [np.asarray(np.linalg.inv(motion), np.float64) for motion in perception.motions(seen)]
    return camera_path(motions, list(map(clip.elapsed, seen)), clip.interval, steps, perception.is_monocular(index))


def given_motion(perception: Perception, index: int, path: CameraPath) -> NetworkInput:
    """`given_input` with another motion of the camera, ``path``."""
    prev, cur = perception.seen(index - 1), perception.seen(index)
    return network_input(prev, cur, last_motions(prev, cur), path)


def corrections(model: Forecaster, given: NetworkInput, steps: int) -> Corrections:
    """The motion by ``model``, without rendering."""
    done = model.forecast(
        given.frame_prev, given.frame_cur, given.K, steps, [], "compose", prior=given.prior, own=given.own
    )
    motion, span = done[0].motion, given.prior.span
    both = zip(
        (motion.objects.flow - motion.start).split(3, dim=1),
        (motion.next_from_prev, motion.next_from_cur),
        (span, 1.0),
        strict=True,
    )
    velocities = [
        torch.einsum("bji,bjhw->bihw", geometry.quaternion_to_matrix(rigid.quaternion), moved / intervals)[0].numpy()
        for moved, rigid, intervals in both
    ]
    cameras = tuple(step.future_from_cur[0].double().numpy() for step in done)
    return Corrections(cameras, *velocities)


def chosen_motion(
    perception: Perception, model: Forecaster, index: int, steps: int, parts: Mapping[str, LearnedPart]
) -> Corrections:
    """The motion from frame ``index`` on: the geometric forecast's, corrected by those of ``parts`` that are used."""
    cameras = forecast_path(perception, index, steps).future_from_cur
    still = np.zeros((3, *perception.image(index).shape[1:]), np.float32)
    used = {part for part in (CAMERA, OBJECTS) if part in parts and parts[part].used}
    if not used:
        return Corrections(cameras, still, still)
    found = corrections(model, given_input(perception, index, model.config.prior, steps), steps)
    velocities = found[1:] if OBJECTS in used else (still, still)
    return Corrections(found.cameras if CAMERA in used else cameras, *velocities)


def refined(
    perception: Perception,
    model: Forecaster,
    index: int,
    motion: Corrections,
    views: Sequence[View],
    frames: Sequence[Mapping[str, Rendered]],
    steps: Sequence[int] | None = None,
) -> list[dict[str, Rendered]]:
    """``frames`` of the geometric forecast, under ``motion``, with what refinement adds to their images.

    They are of ``steps``, rising; None is 1, 2, ...
    """
    shown = range(1, len(frames) + 1) if steps is None else steps
    if model.refine.of_forecast:
        return [
            {name: retouched(model, rendered, ahead, perception.clip.interval) for name, rendered in frame.items()}
            for ahead, frame in zip(shown, frames, strict=True)
        ]
    path = forecast_path(perception, index, 1)._replace(future_from_cur=motion.cameras)
    given = given_motion(perception, index, path)
    added = added_by_refinement(model, given, motion, views, shown)
    done = []
    for frame, by_view in zip(frames, added, strict=True):
        images = {name: change + (frame[name].image if adds else 0) for name, (change, adds) in by_view.items()}
        done.append({name: replace(frame[name], image=image.clip(0, 1)) for name, image in images.items()})
    return done


def retouched(model: Forecaster, rendered: Rendered, ahead: int, interval: float | None) -> Rendered:
    """A frame of a geometric forecast with what a refinement of such forecasts adds; arguments as of `forecast_planes`.

    Args:
        model: with `RefineConfig.refines` "forecast".
        rendered: the frame.
        ahead: frame intervals ahead.
        interval: seconds.
    """
    added = model.retouch(torch.from_numpy(forecast_planes(rendered, ahead, interval))[None])[0].float().numpy()
    return replace(rendered, image=(rendered.image + added).clip(0, 1))


def added_by_refinement(
    model: Forecaster, given: NetworkInput, chosen: Corrections, views: Sequence[View], shown: Sequence[int]
) -> list[dict[str, tuple[Array, bool]]]:
    """What refinement adds to the image it is given, under a motion that is chosen.

    Args:
        model: the network.
        given: the frames.
        chosen: the motion; the network corrects it no further.
        views: cameras.
        shown: steps to show.

    Returns:
        For each of ``shown`` by view: [3, H, W], and whether that is to be added; else it is the image itself, of a
        network that predicts RGB directly.
    """
    prior = given.prior._replace(
        velocity_prev=given.prior.velocity_prev + torch.from_numpy(chosen.velocity_prev),
        velocity_cur=given.prior.velocity_cur + torch.from_numpy(chosen.velocity_cur),
        corrected=torch.tensor([False]),
    )
    adds, found = model.refine.base != "none", list[Array]()
    different = {_key(view, given): view for view in views}
    sides: list[Any] = []

    def seen(stage: str, result: Any) -> None:
        if stage == "splat":
            sides[:] = result
        elif stage == "refine":
            looks = [looks_of(side, model.config.render.normalised) for side in sides] if adds else []
            found.append((result - model.refine.base_of(looks) if adds else result)[0].float().numpy())

    targets = [
        (_tensor(view.tgt_from_next), given.K if view.K is None else _tensor(view.K)) for view in different.values()
    ]
    with watching(seen):
        model.forecast(
            given.frame_prev, given.frame_cur, given.K, max(shown), targets, "compose",
            prior=prior, own=given.own, shown=shown,
        )  # fmt: skip
    rows = [found[start : start + len(different)] for start in range(0, len(found), len(different))]
    by_key = [dict(zip(different, row, strict=True)) for row in rows]
    return [{view.name: (of_step[_key(view, given)], adds) for view in views} for of_step in by_key]


def _key(view: View, given: NetworkInput) -> bytes:
    K = given.K[0].numpy() if view.K is None else np.asarray(view.K, np.float32)
    return np.asarray(view.tgt_from_next, np.float32).tobytes() + K.astype(np.float32).tobytes()


def _tensor(matrix: Matrix) -> torch.Tensor:
    return torch.from_numpy(np.array(matrix, np.float32))[None]

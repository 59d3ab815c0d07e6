"""Which learned parts of a network a forecast has: each must win tests on frames already seen.

A test forecasts frame t from t - h and before, with the part and without it; no later frame is read. For a pixel p of
t - h that is forecast to be at q in t, with what refinement adds there, a(q):

    e = mean min(|I_(t-h)(p) + a(q) - I_t(q)|^2, MOST)  over a grid of pixels that are in the image either way

Camera first, then objects under the camera's result, then refinement under both, at t from t - 1. What wins there is
tested at t - 1 from t - 2, as one frame says little about the next; and motion at t from t - 2, as it is extrapolated
further. What can't be tested is left out. A test takes the networks on two frames once, of which a sequence has encoded
all already, and for refinement one view. A refinement of geometric forecasts is tested on such a forecast of t itself,
pixel by pixel; what earlier frames are remembered for is not in it.

Source: SPEC section 12.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vestcl.forecasting.geometric.forecast import working_frames
from vestcl.forecasting.geometric.paths import point_paths
from vestcl.forecasting.network.learned import (
    CAMERA,
    OBJECTS,
    PARTS,
    REFINEMENT,
    Array,
    CorrectedPaths,
    Corrections,
    Matrix,
    added_by_refinement,
    corrections,
    forecast_path,
    given_input,
    given_motion,
    retouched,
)
from vestcl.forecasting.result import LearnedPart, View
from vestcl.models.forecaster import Forecaster
from vestcl.scene.depth.road_plane import rays_of
from vestcl.scene.exposure import curve_by_flow
from vestcl.scene.flow.correspondence import sample
from vestcl.scene.perception import Perception
from vestcl.times import is_same

#: A part must lower the error by this share: of two forecasts that are equally good, chance picks one.
MARGIN: Final = 0.02

#: Squared errors beyond are of something else, as in `vestcl.scene.motion.backtest`.
MOST: Final = 0.05

#: The grid has about this many pixels, whatever the image's size.
_PIXELS: Final = 60_000

#: Fewer pixels than that are no test.
_FEWEST: Final = 200

#: Metres per interval that an object's velocity is corrected by at least, for a pixel to count in the test of objects.
_MOVED: Final = 1e-3

#: Metres; nearer points are not divided by their depth.
_NEAREST: Final = 0.1

_SOURCE: Final = View("source", np.eye(4))


def choose_parts(perception: Perception, model: Forecaster, index: int, known_interval: bool) -> dict[str, LearnedPart]:
    """The parts of ``model`` for a forecast from frame ``index``, whether each is used, and why.

    Args:
        perception: of the clip; only frames up to ``index`` are looked at.
        model: that starts from a prior.
        index: the frame t, 1 or more.
        known_interval: whether the network learned at the clip's interval; else its motion is not tested.

    Returns:
        By name; a part that the network lacks, or that changes nothing, is not in it.
    """
    chosen, tested = {}, _present(model)
    if CAMERA in tested and model.config.prior != "forecast":
        chosen[CAMERA] = LearnedPart(False, "it was trained to correct constant velocity, not the forecast motion")
    if not known_interval:
        reason = f"it learned at {model.config.learned_at} from frame to frame"
        chosen |= {part: LearnedPart(False, reason) for part in tested if part != REFINEMENT}
    tested = [part for part in tested if part not in chosen]
    for at in (index, index - 1):
        if fault := _untestable(perception, at):
            return chosen | {part: LearnedPart(False, fault) for part in tested}
    found = _tested(perception, model, index - 1, 1, 1, tested)
    for start, ahead, parts in ((index - 2, 1, PARTS), (index - 2, 2, (CAMERA, OBJECTS))):
        won = [part for part in parts if part in found and found[part].used]
        again = _tested(perception, model, start, ahead, index - start, won) if won else {}
        for part in won:
            other = again.get(part, LearnedPart(False, "nothing to test at the frame before"))
            found[part] = found[part]._replace(used=other.used, why=f"{found[part].why}; {other.why}")
    return chosen | found


def _tested(
    perception: Perception, model: Forecaster, start: int, ahead: int, back: int, parts: Sequence[str]
) -> dict[str, LearnedPart]:
    """``parts`` in the forecast from frame ``start``, ``back`` frames before t, of that ``ahead`` frames after it."""
    test, chosen = _Test.of(perception, start, ahead), dict[str, LearnedPart]()
    path = forecast_path(perception, start, ahead, back)
    camera, velocities = path.future_from_cur[-1], [np.zeros_like(test.image_prev)] * 2
    if {CAMERA, OBJECTS} & set(parts):
        found = corrections(model, given_input(perception, start, model.config.prior, ahead, back), ahead)
        if CAMERA in parts:
            chosen[CAMERA] = test.verdict(test.positions(camera), test.positions(found.cameras[-1]))
            camera = found.cameras[-1] if chosen[CAMERA].used else camera
        moved = np.linalg.norm(found.velocity_cur, axis=0) > _MOVED
        if OBJECTS in parts and moved.any():
            pair = test.positions(camera), test.positions(camera, found.velocity_cur)
            chosen[OBJECTS] = test.verdict(*pair, where=moved)
            if chosen[OBJECTS].used:
                velocities = [found.velocity_prev, found.velocity_cur]
    motion = Corrections((camera,), *velocities)
    if REFINEMENT in parts and model.refine.of_forecast:
        chosen[REFINEMENT] = test.verdict_on_images(*_with_and_without(perception, model, start, motion))
    elif REFINEMENT in parts:
        given = given_motion(perception, start, path._replace(future_from_cur=(camera,)))
        ((added, adds),) = (shown["source"] for shown in added_by_refinement(model, given, motion, [_SOURCE], [1]))
        at = test.positions(camera, velocities[1])
        chosen[REFINEMENT] = test.verdict(at, at, added=added, adds=adds)
    return chosen


def _with_and_without(
    perception: Perception, model: Forecaster, start: int, motion: Corrections
) -> tuple[Array, Array]:
    """Frame ``start`` + 1 [3, H, W] by geometry under ``motion``, without refinement and with it."""
    paths = point_paths(perception, start)
    moved = CorrectedPaths(paths.frame, paths.errors, paths.by_flow, motion.velocity_cur if motion.moves else None)
    frames = working_frames(
        perception, start, 1, [_SOURCE], future_from_cur=motion.cameras, paths=moved, memory=0
    ).frames
    rendered = frames[0]["source"]
    return rendered.image, retouched(model, rendered, 1, perception.clip.interval).image


def _present(model: Forecaster) -> list[str]:
    """The parts that change something."""
    camera, objects = model.ego_motion, model.object_motion
    still = camera is None or (camera.bounded is not None and camera.bounded.changes_nothing)
    unmoved = objects is None or objects.changes_nothing or model.options.blocks == 0
    return [*([] if still else [CAMERA]), *([] if unmoved else [OBJECTS]), REFINEMENT]


def _untestable(perception: Perception, index: int) -> str | None:
    """Why frame ``index`` is not a test; None where it is one."""
    if index < 2:
        return "there are too few frames before to test it on"
    if perception.is_lost(index) or perception.is_lost(index - 1):
        return "a gap before the last frames leaves none to test it on"
    if not (is_same(perception.clip.elapsed(index), 1) and is_same(perception.clip.elapsed(index - 1), 1)):
        return "the last frames are not evenly spaced, so that they are no test"
    return None


class _Test(NamedTuple):
    """A frame, as it is forecast from an earlier one."""

    name: str
    image: Array
    """[3, H, W], of the frame."""
    image_prev: Array
    """[3, H, W], of the earlier one, exposed as the frame is."""
    depth: Array
    """[1, H, W] m, of the earlier one."""
    velocity: Array
    """[3, H, W] m per interval."""
    counts: NDArray[np.bool_]
    """[H, W], where the recording car is not."""
    K: Matrix
    ahead: int
    """Intervals between the two."""
    stride: int

    @classmethod
    def of(cls, perception: Perception, start: int, ahead: int) -> "_Test":
        before, image_prev = perception.frame(start), perception.image(start)
        for at in range(start + 1, start + ahead + 1):
            pair = perception.image(at - 1), perception.image(at), perception.correspondence(at).flow_uv
            image_prev = curve_by_flow(*pair)(image_prev)
        image = perception.image(start + ahead)
        stride = max(1, round(math.sqrt(image[0].size / _PIXELS)))
        known = before.depth, before.velocity, ~perception.seen(start).own[0], before.K, ahead, stride
        return cls(perception.clip[start + ahead].name, image, image_prev, *known)

    def positions(self, future_from_cur: Matrix, velocity: Array | None = None) -> Matrix:
        """[2, h, w] px in the frame of a grid of earlier pixels, with ``velocity`` [3, H, W] more than they had."""
        grid = np.s_[:, :: self.stride, :: self.stride]
        speed = self.velocity[grid] if velocity is None else self.velocity[grid] + velocity[grid]
        points = rays_of(self.K, *self.depth.shape[1:])[grid] * self.depth[grid] + self.ahead * speed
        moved = np.tensordot(future_from_cur[:3, :3], points, 1) + future_from_cur[:3, 3, None, None]
        q = np.tensordot(self.K, moved, 1)
        return np.asarray(q[:2] / np.maximum(q[2], _NEAREST), np.float64)

    def verdict(
        self,
        without: Matrix,
        with_it: Matrix,
        *,
        where: NDArray[np.bool_] | None = None,
        added: Array | None = None,
        adds: bool = True,
    ) -> LearnedPart:
        """Whether the error with a part is less by `MARGIN`.

        Args:
            without: [2, h, w] px, `positions`.
            with_it: the same with the part.
            where: [H, W], the pixels that the part changes; None is all.
            added: [3, H, W], what the part makes of the image.
            adds: whether that is added to it.
        """
        grid = np.s_[:: self.stride, :: self.stride]
        counts = self.counts[grid] if where is None else self.counts[grid] & where[grid]
        old = self.image_prev[(slice(None), *grid)]
        new = old
        if added is not None:
            new = sample(added, with_it[0] - 0.5, with_it[1] - 0.5) + (old if adds else np.float32(0))
        return self._of_errors(self._errors(without, old), self._errors(with_it, new), counts)

    def verdict_on_images(self, without: Array, with_it: Array) -> LearnedPart:
        """Whether the error of the frame itself is less by `MARGIN` with a part: [3, H, W], of forecasts of it."""
        before, after = (
            np.minimum(np.square(one - self.image).mean(axis=0), np.float32(MOST)) for one in (without, with_it)
        )
        return self._of_errors(before, after, self.counts)

    def _of_errors(self, without: Array, with_it: Array, counts: NDArray[np.bool_]) -> LearnedPart:
        """The choice by squared errors of pixels, of which those of ``counts`` count."""
        errors = without, with_it
        counts = counts & np.isfinite(errors[0]) & np.isfinite(errors[1])
        if counts.sum() < _FEWEST:
            return LearnedPart(False, "what it changes is too small to be tested")
        before, after = (float(error[counts].mean()) for error in errors)
        psnr = [-10 * math.log10(max(error, 1e-10)) for error in (after, before)]
        how = "" if self.ahead == 1 else f" from {self.ahead} frames before"
        why = f"{psnr[0]:.2f} dB at frame {self.name}{how} with it, {psnr[1]:.2f} dB without"
        return LearnedPart(after < (1 - MARGIN) * before, why, *psnr)

    def _errors(self, at: Matrix, image: Array) -> Array:
        """[h, w], min(|image - I_t|^2, MOST), NaN outside of t."""
        found = sample(self.image, at[0] - 0.5, at[1] - 0.5, outside=np.nan)
        return np.minimum(np.square(found - image.clip(0, 1)).mean(axis=0), np.float32(MOST))

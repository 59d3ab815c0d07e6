"""Candidate motions of each pixel's point, weighted by how well they would have forecast the frame already seen.

A candidate c says where a pixel p of frame t - h is in the image k intervals on, q_c(p, k). Those of t - h forecast
frame t from what was known at t - h, the camera's motion included: e_c = |I_(t-h)(p) - I_t(q_c(p, h))|^2, smoothed.
The candidates of t are trusted as far as those before were right: q = sum_c w_c q_c, w_c = e_c^-g / sum e^-g.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.scene import checked
from vestcl.scene.depth.completion import smooth
from vestcl.scene.depth.road_plane import linear
from vestcl.scene.exposure import as_exposed
from vestcl.scene.flow.correspondence import sample
from vestcl.scene.flow.parallax import epipolar, moved_pixels, pixel_centres

Array = NDArray[np.float32]

#: The power g: 2 mixes more, 4 picks; on windows of six real clips 3 loses to neither by more than 0.1 dB.
_SHARPNESS: Final = 3.0

#: Flow has its own noise, which rest and objects' velocities lack: to count equally its errors must be less by this.
#: Of 1 and 1.25, 1.25 gains 0.6 dB where the camera rests (kitti_tracking_0006) and loses 0.3 in kitti_clip, at t+1.
_FLOW_MARGIN: Final = 1.25

#: Squared errors beyond are of something else, and noise of the camera that all have: 0.3 % of white.
_MOST, _NOISE = 0.05, 1e-5

#: Errors are smoothed over this many pixels of an image 832 wide (standard deviations): before they are brought to t
#: along the flow, so that it need not be exact, and then.
_WIDTH, _BEFORE, _AFTER = 832, 2.0, 8.0

#: Errors of flow itself grow with this power of their mean over the least of the other candidates.
_WHOLE: Final = 6.0

#: Flow that leaves the rigid motion by more pixels per interval than that is a wrong match.
_LARGEST: Final = 40.0

#: From that squared error on a pixel's motion is more its surroundings' than its own. On five windows of kitti_clip at
#: full size it gains .05, .19 and .28 dB at t+1, t+3 and t+5; 0 gains .05 more at t+5, but loses .15 on highway at t+1.
_UNEXPLAINED: Final = 1e-3

#: Metres; nearer points are not divided by their depth.
_NEAREST: Final = 0.1


class BacktestFrame(NamedTuple):
    """A frame and how its pixels came from the one before."""

    image: Array
    """[3, H, W] RGB in [0, 1]."""
    depth: Array
    """[1, H, W] m, above 0."""
    velocity: Array
    """[3, H, W] m an interval of the clip, of the object that a pixel shows."""
    flow_uv: Array
    """[2, H, W] px, to the frame before."""
    prev_from_cur: NDArray[np.float64]
    """[4, 4] m, the camera's motion."""
    K: NDArray[np.float64]
    """[3, 3] px."""
    elapsed: float = 1.0
    """Intervals since the frame before."""


def residual_flow(frame: BacktestFrame) -> Array:
    """r [2, H, W] px per interval, forward: what flow shows beyond the camera's motion, (p' - (p + flow)) / elapsed.

    p' is where the point would have been in the frame before at rest. 0 where the difference is a wrong match, not
    motion.
    """
    there = _brought(frame, frame.prev_from_cur)
    residual = (_pixels(there) - moved_pixels(frame.flow_uv)) / frame.elapsed
    believed = (there[2] > _NEAREST) & (np.hypot(*residual) < _LARGEST)
    return np.where(believed, residual, 0).astype(np.float32)


def candidates(
    frame: BacktestFrame, residual: Array, future_from_cur: NDArray[np.float64], ahead: float, by_flow: bool = False
) -> tuple[Array, Array]:
    """Where each pixel's point may be after ``ahead`` intervals.

    The candidates: its object's velocity; rest in the world; rest and ``ahead`` times the residual flow r; rest and r
    followed from position to position, as objects that come to the end of where r was seen slow down in the mean. With
    ``by_flow`` also, last, flow itself, p - ahead flow / elapsed: it uses no depth, which may be far off where it
    comes from motion.

    Args:
        frame: that is looked at.
        residual: its `residual_flow`, r.
        future_from_cur: [4, 4] m, the camera's forecast motion over that time.
        ahead: intervals of the clip, above 0.
        by_flow: whether flow itself is one of them.

    Returns:
        [C, 2, H, W] px, and [H, W] m, the depth there by the first candidate.
    """
    at_rest = _brought(frame, future_from_cur)
    moved = at_rest + linear(frame.K @ future_from_cur[:3, :3], ahead * frame.velocity)
    z, rest = moved[2], _pixels(at_rest)
    found = [_pixels(moved), rest, rest + ahead * residual, rest + _followed(residual, ahead)]
    if by_flow:
        found.append(pixel_centres(*frame.depth.shape[1:]) - frame.flow_uv * (ahead / frame.elapsed))
    return np.stack(found).astype(np.float32), np.maximum(z, _NEAREST).astype(np.float32)


def backtest(positions: Array, before: BacktestFrame, after: Array, flows: Sequence[Array]) -> Array:
    """Errors e_c at t of candidates that knew nothing of t.

    Args:
        positions: [C, 2, H, W] px, where the pixels of an earlier frame were forecast to be at t.
        before: that frame.
        after: [3, H, W], the image at t, which may be exposed differently.
        flows: [2, H, W] px each, from t to the frame before and so on until the earlier frame.

    Returns:
        [C, H, W], above 0.
    """
    start = np.asarray(pixel_centres(*after.shape[1:]) - 0.5, np.float32)
    x, y = start
    for flow_uv in flows:
        along = sample(flow_uv, x, y, outside=0.0)
        x, y = x + along[0], y + along[1]
    image_before = as_exposed(before.image, after, np.stack([x, y]) - start)
    errors = []
    for u, v in positions:
        found = sample(after, u - 0.5, v - 0.5, outside=np.nan)
        error = np.nan_to_num(np.square(found - image_before).mean(0), nan=_MOST)
        smooth = _smooth(np.minimum(error, np.float32(_MOST)), _BEFORE)
        brought = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        errors.append(_smooth(np.asarray(brought, np.float32), _AFTER) + np.float32(_NOISE))
    return np.stack(errors)


def untested(frame: BacktestFrame, by_flow: bool = False) -> Array:
    """Errors [C, H, W] where nothing could be tested, as there are two frames only: velocity and residual flow mix.

    Args:
        frame: that is looked at.
        by_flow: as in `candidates`.
    """
    prior = np.array([1, 1e3, 1, 1e3, *[1e3] * by_flow], np.float32) * np.float32(1e-4)
    return np.broadcast_to(prior[:, None, None], (len(prior), *frame.depth.shape[1:])).copy()


def by_step(errors: Sequence[Array], by_flow: bool = False) -> tuple[Array, ...]:
    """Errors that count for the first step, and for all later ones: there the geometric mean over all tests.

    Those of candidates by flow are raised by `_FLOW_MARGIN`.
    Flow itself, with ``by_flow`` the last candidate, has its errors raised if it was worse than another over the whole
    image in any test: by chance it does as well in some regions, and it forecasts what comes nearer worse with every
    step.

    Args:
        errors: of `backtest`, over one frame, over two ...
        by_flow: as in `candidates`.
    """
    if by_flow:
        means = [error.mean(axis=(1, 2)) for error in errors]
        worse = max([1.0, *(float(mean[-1] / mean[:-1].min()) for mean in means)])
        errors = [np.concatenate([error[:-1], error[-1:] * np.float32(worse**_WHOLE)]) for error in errors]
    margin = np.array([1.0, 1.0, *[_FLOW_MARGIN] * (len(errors[0]) - 2 if errors else 0)], np.float32)
    errors = [error * margin[:, None, None] for error in errors]
    later = [np.exp(np.mean(np.log(errors), axis=0))] if len(errors) > 1 else []
    return (*errors[:1], *later)


def held_together(errors: Array, objects: NDArray[np.int32]) -> Array:
    """sqrt(e m m / min m) [C, H, W], m the geometric mean of e over the object of a pixel, min m of its best candidate.

    Neighbours that mixed their candidates each in its own way would tear it; and where all candidates look alike, as on
    a smooth side, the object decides.

    Args:
        errors: e [C, H, W], above 0.
        objects: [H, W], 0 = background, which keeps its errors.
    """
    logs, number = np.log(errors), objects.ravel()
    count = np.maximum(np.bincount(number), 1)
    means = np.stack([(np.bincount(number, plane.ravel()) / count)[objects] for plane in logs])
    decided = (logs - means.min(axis=0)) / 2 + means
    return np.where(objects > 0, np.exp(decided), errors).astype(np.float32)


def mixed(positions: Array, errors: Array) -> Array:
    """sum_c w_c q_c [2, H, W] of ``positions`` [C, 2, H, W], by their ``errors`` [C, H, W]."""
    weights = (errors / errors.min(axis=0)) ** -_SHARPNESS
    weights /= weights.sum(axis=0)
    return np.asarray((weights[:, None] * positions).sum(axis=0), np.float32)


def coherent(positions: Array, errors: Array, image: Array, moving: NDArray[np.bool_]) -> Array:
    """Positions on objects that no candidate explains follow those around: p + (1 - t) d + t G(w d) / G(w), d = q - p.

    t = G(m) e / (e + UNEXPLAINED) and w = 1 / (e + 1e-4), with e the least error of the candidates, m = 1 where
    something moves, and G a smoother that keeps to the image's edges. Windows and roofs, of which scans and stereo know
    no depth and flow nothing reliable, so stay with their car.

    Args:
        positions: q [2, H, W] px, from `mixed`.
        errors: [C, H, W].
        image: [3, H, W] RGB in [0, 1], of the frame that is moved.
        moving: [H, W], what is not static.

    Returns:
        [2, H, W] px.
    """
    centres, least = pixel_centres(*image.shape[1:]), errors.min(axis=0)
    way, guide, weight = (positions - centres).astype(np.float32), checked.pixels(image), 1 / (least + np.float32(1e-4))
    share = np.maximum(smooth(guide, weight), np.float32(1e-6))
    around = np.stack([smooth(guide, weight * part) / share for part in way])
    alive = smooth(guide, moving.astype(np.float32)).clip(0, 1)
    unexplained = alive * least / (least + np.float32(_UNEXPLAINED))
    return np.asarray(positions + unexplained * (around - way), np.float32)


def _brought(frame: BacktestFrame, dst_from_src: NDArray[np.float64]) -> NDArray[np.float64]:
    """K (R x + t) [3, H, W] of the points x that the pixels show: z m and, over it, px in another camera."""
    start, shift = epipolar(frame.K, dst_from_src, *frame.depth.shape[1:])
    start *= frame.depth
    start += shift[:, None, None]
    return start


def _pixels(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """[2, H, W] px of q [3, H, W]."""
    return q[:2] / np.maximum(q[2], _NEAREST)


def _followed(residual: Array, ahead: float) -> Array:
    """[2, H, W] px: the way along ``residual`` px per interval, looked up again after each interval or less."""
    x, y = np.asarray(pixel_centres(*residual.shape[1:]) - 0.5, np.float32)
    steps = max(math.ceil(ahead - 1e-6), 1)
    way = np.zeros_like(residual)
    for _ in range(steps):
        at = x + way[0], y + way[1]
        there = [cv2.remap(plane, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in residual]
        way = np.asarray(way + np.stack(there) * np.float32(ahead / steps), np.float32)
    return way


def _smooth(plane: Array, sigma: float) -> Array:
    return np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma * plane.shape[1] / _WIDTH), np.float32)

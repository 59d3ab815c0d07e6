"""One window of `vestcl bench forecast`: what every method shows of the next frames, and how good it is.

Pictures are made at the clip's own size. They and the truth are then resized to the size that is scored, and quantised
to 8 bit. A window has frames t-1 and t in sight, and t+1 to t+steps as truth.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl import baselines, metrics
from vestcl.compare import FLOW, REPEAT
from vestcl.data.resize import resize_image
from vestcl.data.sample import Clip
from vestcl.forecast import Forecast, View
from vestcl.geometric import Perception, forecast_frames
from vestcl.models.trunks import Trunk
from vestcl.perceptual import _squared_difference
from vestcl.views import seen_by

#: The methods beside the baselines, as tables and files call them.
GEOMETRIC: Final = "geometric"
TRUE_POSES: Final = "geometric, true poses"

#: What baselines have in sight of where they are judged from another camera than their own.
OTHER_CAMERA: Final = ", left camera"
ORACLE: Final = f"{FLOW}, right camera's past (oracle)"

#: Metrics in the order of tables.
METRICS: Final = ("psnr", "ssim", "ms_ssim", "squeeze", "psnr_seen")

#: A pixel counts as seen by the source camera from this coverage on.
SEEN: Final = 0.5

SOURCE: Final = "source"

Pictures = Sequence[NDArray[np.float32]]
"""[3, H, W] RGB in [0, 1], a step each."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """One method's pictures of one view."""

    pictures: Pictures
    seconds: float
    """That the method took for the window, all views together."""


Predictions = dict[str, dict[str, Prediction]]
"""By view and method."""


@dataclass(frozen=True)
class Record:
    """How good one method's pictures of one view of one window are."""

    clip: str
    frame: str
    index: int
    """Of the current frame t in the clip."""
    view: str
    method: str
    seconds: float
    scores: dict[str, list[float]]
    """By metric, a number a step."""


class _Look(NamedTuple):
    """A picture as it is scored."""

    picture: torch.Tensor
    """[1, 3, h, w], 8 bit."""
    maps: list[torch.Tensor]
    """SqueezeNet's, [1, C_l, h_l, w_l]; none without a trunk."""


class Truth:
    """What the cameras of a clip really saw, kept while windows need it.

    Args:
        clip: at its own size.
        size: (height, width) that is scored, px.
        trunk: SqueezeNet 1.0, or None.
    """

    def __init__(self, clip: Clip, size: tuple[int, int], trunk: Trunk | None) -> None:
        self.clip, self.size, self.trunk = clip, size, trunk
        self._full: dict[tuple[str, int], NDArray[np.float32]] = {}
        self._looks: dict[tuple[str, int], _Look] = {}

    def full(self, view: View, index: int) -> NDArray[np.float32]:
        """[3, H, W] of frame ``index``, at the size of the camera.

        Raises:
            ValueError: no camera stood at ``view``.
        """
        key = view.name, index
        if key not in self._full:
            camera = seen_by(view, self.clip[index])
            if camera is None:
                raise ValueError(f"{self.clip.name}: frame {self.clip[index].name} has no picture from {view.name}")
            self._full[key] = camera.read_image()
        return self._full[key]

    def look(self, view: View, index: int) -> _Look:
        """The same as it is scored."""
        key = view.name, index
        if key not in self._looks:
            self._looks[key] = look([self.full(view, index)], self.size, self.trunk)[0]
        return self._looks[key]

    def forget(self, index: int) -> None:
        """Drop frames before ``index``: windows come in order."""
        for kept in (self._full, self._looks):
            for key in [key for key in kept if key[1] < index]:
                del kept[key]


def look(pictures: Pictures, size: tuple[int, int], trunk: Trunk | None) -> list[_Look]:
    """Resize, quantise, and take the trunk's maps of all pictures in one go."""
    resized = np.stack([resize_image(picture, *size) for picture in pictures])
    batch = metrics.quantise(torch.from_numpy(resized))
    with torch.no_grad():
        # Convolutions are as fast in either layout, pooling and norms over channels twice as fast in this one.
        maps = [] if trunk is None else trunk(batch.contiguous(memory_format=torch.channels_last))
    return [_Look(batch[i : i + 1], [one[i : i + 1] for one in maps]) for i in range(len(batch))]


def predict(
    perception: Perception,
    truth: Truth,
    index: int,
    steps: int,
    views: Sequence[View],
    future_from_cur: Sequence[NDArray[np.float64]] | None = None,
) -> tuple[Predictions, Forecast]:
    """All methods on one window.

    The baselines see the source camera alone, as the forecast does, and are held against every view. Of another view
    optical flow is shown once more with that camera's own past, which no forecast from the source camera has.

    Args:
        perception: of the clip; what it has seen for the window before is not computed again.
        truth: of the clip.
        index: the current frame t.
        steps: frames to forecast.
        views: cameras to judge from, each one of the rig's.
        future_from_cur: the true motion of the camera a step, [4, 4] m, for a forecast that is told it.

    Returns:
        The pictures, and the geometric forecast.
    """
    forecasts = _geometric(perception, index, steps, views, future_from_cur)
    source = View(SOURCE, np.eye(4))
    plain = _baselines(truth.full(source, index - 1), truth.full(source, index), steps)
    predictions: Predictions = {}
    for view in views:
        is_source = view.name == SOURCE
        of_view = {name + ("" if is_source else OTHER_CAMERA): each for name, each in plain.items()}
        if not is_source:
            of_view[ORACLE] = _flow(truth.full(view, index - 1), truth.full(view, index), steps)
        for name, (forecast, seconds) in forecasts.items():
            of_view[name] = Prediction([frame[view.name].image for frame in forecast.frames], seconds)
        predictions[view.name] = of_view
    return predictions, forecasts[GEOMETRIC][0]


def score(
    truth: Truth, index: int, views: Sequence[View], predictions: Predictions, forecast: Forecast
) -> list[Record]:
    """Every prediction of one window beside the truth, step by step.

    Args:
        truth: of the clip.
        index: the current frame t.
        views: as in ``predictions``.
        predictions: see `predict`.
        forecast: its coverage tells which pixels the source camera has seen ("psnr_seen").

    Returns:
        A record a view and method.
    """
    scores: dict[tuple[str, str], dict[str, list[float]]] = {}
    known: dict[int, _Look] = {}
    for step in range(len(forecast.frames)):
        shown = {v: {m: each.pictures[step] for m, each in of.items()} for v, of in predictions.items()}
        known = _looks((picture for of in shown.values() for picture in of.values()), known, truth)
        for view in views:
            looks = [known[id(picture)] for picture in shown[view.name].values()]
            coverage = resize_image(forecast.frames[step][view.name].coverage, *truth.size)
            of_view = _scores(looks, truth.look(view, index + 1 + step), torch.from_numpy(coverage >= SEEN)[None])
            for row, method in enumerate(shown[view.name]):
                of_method = scores.setdefault((view.name, method), {name: [] for name in of_view})
                for name, values in of_view.items():
                    of_method[name].append(float(values[row]))
    where = truth.clip.name, truth.clip[index].name, index
    return [Record(*where, *key, predictions[key[0]][key[1]].seconds, of) for key, of in scores.items()]


def _looks(pictures: Iterable[NDArray[np.float32]], known: Mapping[int, _Look], truth: Truth) -> dict[int, _Look]:
    """By the pictures' ids. Some occur twice, in several views or, the last frame, in every step; they are looked at
    once."""
    wanted = {id(picture): picture for picture in pictures}
    new = {key: picture for key, picture in wanted.items() if key not in known}
    found = look(list(new.values()), truth.size, truth.trunk) if new else []
    return {key: known[key] for key in wanted if key in known} | dict(zip(new, found, strict=True))


def _scores(looks: Sequence[_Look], wanted: _Look, seen: torch.Tensor) -> dict[str, torch.Tensor]:
    """Of M pictures, all metrics that the size allows, [M] each."""
    pictures = torch.cat([each.picture for each in looks])
    target = wanted.picture.expand_as(pictures)
    side = min(pictures.shape[2:])
    scores = {"psnr": metrics.psnr(pictures, target)}
    if side >= metrics.WINDOW:
        scores["ssim"] = metrics.ssim(pictures, target)
    if side >= metrics.MS_SSIM_SIDE:
        scores["ms_ssim"] = metrics.ms_ssim(pictures, target)
    if wanted.maps:
        scores["squeeze"] = torch.cat([_distance(each.maps, wanted.maps) for each in looks])
    scores["psnr_seen"] = metrics.psnr(pictures, target, seen.expand(len(pictures), -1, -1, -1))
    return scores


def _distance(maps: Sequence[torch.Tensor], wanted: Sequence[torch.Tensor]) -> torch.Tensor:
    """`perceptual.squeeze_distance` of maps that are there already: [1]."""
    layers = [_squared_difference(f, g).sum(dim=1).mean(dim=(1, 2)) for f, g in zip(maps, wanted, strict=True)]
    return torch.stack(layers).sum(dim=0)


def _geometric(
    perception: Perception,
    index: int,
    steps: int,
    views: Sequence[View],
    future_from_cur: Sequence[NDArray[np.float64]] | None,
) -> dict[str, tuple[Forecast, float]]:
    """Forecasts and their seconds. The second one uses what the first has seen, and is charged for it, too."""
    start = time.perf_counter()
    plain = forecast_frames(perception, index, steps, views)
    seconds = time.perf_counter() - start
    forecasts = {GEOMETRIC: (plain, seconds)}
    if future_from_cur is not None:
        start = time.perf_counter()
        told = forecast_frames(perception, index, steps, views, future_from_cur=future_from_cur)
        looking = max(seconds - plain.seconds["render"], 0.0)
        forecasts[TRUE_POSES] = told, looking + time.perf_counter() - start
    return forecasts


def _baselines(previous: NDArray[np.float32], current: NDArray[np.float32], steps: int) -> dict[str, Prediction]:
    return {REPEAT: Prediction([current] * steps, 0.0), FLOW: _flow(previous, current, steps)}


def _flow(previous: NDArray[np.float32], current: NDArray[np.float32], steps: int) -> Prediction:
    start = time.perf_counter()
    before, now = (torch.from_numpy(np.ascontiguousarray(image))[None] for image in (previous, current))
    pictures = list(baselines.flow_extrapolation(before, now, steps)[0].numpy())
    return Prediction(pictures, time.perf_counter() - start)

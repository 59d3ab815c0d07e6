"""Images next to the truth: what every method shows of a window's next frames, and how good it is."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from vestcl.data.resize import resize_image
from vestcl.data.sample import Clip
from vestcl.evaluation import metrics
from vestcl.evaluation.border import blacken_border
from vestcl.evaluation.perceptual import Lpips, StLpips, squared_difference
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.forecasting import baselines
from vestcl.forecasting.result import Forecast, View
from vestcl.forecasting.views import seen_by

#: The forecast without weights, as tables and files call it.
GEOMETRIC: Final = "geometric"

#: The baselines.
REPEAT: Final = "repeat last"
FLOW: Final = "optical flow"

#: What baselines have in sight of where they are judged from another camera than their own.
OTHER_CAMERA: Final = ", left camera"
ORACLE: Final = f"{FLOW}, right camera's past (oracle)"

#: A pixel counts as seen by the source camera from this coverage on.
SEEN: Final = 0.5

#: The rig's cameras, as views are called.
SOURCE: Final = "source"
RIGHT: Final = "right"

Pictures = Sequence[NDArray[np.float32]]
"""[3, H, W] RGB in [0, 1], a step each."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """One method's images of one view."""

    pictures: Pictures
    seconds: float
    """That the method took for the window, all views together."""


Predictions = dict[str, dict[str, Prediction]]
"""By view and method."""


@dataclass(frozen=True, eq=False)
class Timed:
    """A forecast and how long it took."""

    forecast: Forecast
    seconds: float


Forecasts = Mapping[str, Timed]
"""By method."""


@dataclass(frozen=True)
class Record:
    """How good one method's images of one view of one window are."""

    clip: str
    frame: str
    index: int
    """Index of the current frame t in the clip."""
    view: str
    method: str
    seconds: float
    scores: dict[str, list[float]]
    """By metric, a number per step."""
    first: int = 1
    """The first of these steps: 0 is the current frame itself."""


class Look(NamedTuple):
    """An image as it is scored."""

    picture: torch.Tensor
    """[1, 3, h, w], 8 bit."""
    maps: list[torch.Tensor]
    """SqueezeNet's, [1, C_l, h_l, w_l]; none without a trunk."""
    lpips_maps: list[torch.Tensor]
    """The same of LPIPS's trunk."""
    st_lpips_maps: list[torch.Tensor] = []  # noqa: RUF012 (a default of a tuple's field, never changed)
    """The same of ST-LPIPS's trunk."""


class Truth:
    """What the cameras of a clip really saw, kept while windows need it.

    Args:
        clip: at its own size.
        size: (height, width) that is scored, px.
        trunk: SqueezeNet 1.0, or None.
        lpips: or None.
        st_lpips: or None.
        border: share of each side's outer pixels that are scored as black, in the truth and in what is compared with
            it (`vestcl.evaluation.border.blacken_border`); SSIM's windows then reach beyond the image, as in VEST-MPI.
    """

    def __init__(
        self,
        clip: Clip,
        size: tuple[int, int],
        trunk: Trunk | None = None,
        lpips: Lpips | None = None,
        st_lpips: StLpips | None = None,
        border: float = 0.0,
    ) -> None:
        self.clip, self.size, self.trunk, self.lpips, self.st_lpips = clip, size, trunk, lpips, st_lpips
        self.border = border
        self._full: dict[tuple[str, int], NDArray[np.float32]] = {}
        self._looks: dict[tuple[str, int], Look] = {}

    def full(self, view: View, index: int) -> NDArray[np.float32]:
        """[3, H, W] of frame ``index``, at the size of the camera.

        Raises:
            ValueError: no camera at ``view``.
        """
        key = view.name, index
        if key not in self._full:
            camera = seen_by(view, self.clip[index])
            if camera is None:
                raise ValueError(f"{self.clip.name}: frame {self.clip[index].name} has no image from {view.name}")
            self._full[key] = camera.read_image().copy()
        return self._full[key]

    def look(self, view: View, index: int) -> Look:
        """The same as it is scored."""
        key = view.name, index
        if key not in self._looks:
            self._looks[key] = self.look_at([self.full(view, index)])[0]
        return self._looks[key]

    def look_at(self, pictures: Pictures) -> list[Look]:
        """`look` at the size and with the trunks of this truth."""
        return look(pictures, self.size, self.trunk, self.lpips, self.st_lpips, self.border)

    def forget(self, index: int) -> None:
        """Drop frames before ``index``: windows come in order."""
        for kept in (self._full, self._looks):
            for key in [key for key in kept if key[1] < index]:
                del kept[key]


def look(
    pictures: Pictures,
    size: tuple[int, int],
    trunk: Trunk | None = None,
    lpips: Lpips | None = None,
    st_lpips: StLpips | None = None,
    border: float = 0.0,
) -> list[Look]:
    """Resize, quantise, and take the trunks' maps of all images in one go.

    Args:
        images: [3, H, W] each.
        size: (height, width) px.
        trunk: SqueezeNet 1.0, or None.
        lpips: or None.
        st_lpips: or None.
        border: as `Truth` has it.

    Raises:
        ValueError: images too small for a trunk.
    """
    resized = np.stack([resize_image(picture, *size) for picture in pictures])
    batch = metrics.quantise(torch.from_numpy(resized))
    if border:
        batch = blacken_border(batch, border)
    trunks = (trunk, *(None if trained is None else trained.trunk for trained in (lpips, st_lpips)))
    with torch.no_grad():
        # Convolutions are as fast in either layout, pooling and norms over channels twice as fast in this one.
        maps = [[] if one is None else one(batch.contiguous(memory_format=torch.channels_last)) for one in trunks]
    return [Look(batch[i : i + 1], *([level[i : i + 1] for level in one] for one in maps)) for i in range(len(batch))]


def predictions(truth: Truth, index: int, steps: int, views: Sequence[View], forecasts: Forecasts) -> Predictions:
    """What the baselines and ``forecasts`` show of one window.

    The baselines see only the source camera, as the forecasts do, and are compared with every view. Of another view
    optical flow is shown once more with that camera's own past, which no forecast from the source camera has.

    Args:
        truth: of the clip.
        index: the current frame t, 1 or more.
        steps: frames that were forecast.
        views: cameras to judge from, each one of the rig's.
        forecasts: of all views, ``steps`` frames or more.

    Raises:
        ValueError: no camera at a view.
    """
    source = View(SOURCE, np.eye(4))
    current = truth.full(source, index)
    elapsed = truth.clip.elapsed(index)
    flow = _flow(truth.full(source, index - 1), current, steps, elapsed)
    plain = {REPEAT: Prediction([current] * steps, 0.0), FLOW: flow}
    shown: Predictions = {}
    for view in views:
        is_source = view.name == SOURCE
        of_view = {name + ("" if is_source else OTHER_CAMERA): each for name, each in plain.items()}
        if not is_source:
            of_view[ORACLE] = _flow(truth.full(view, index - 1), truth.full(view, index), steps, elapsed)
        for name, made in forecasts.items():
            pictures = [frame[view.name].image for frame in made.forecast.frames[:steps]]
            of_view[name] = Prediction(pictures, made.seconds)
        shown[view.name] = of_view
    return shown


def score(
    truth: Truth,
    index: int,
    views: Sequence[View],
    predictions: Predictions,
    forecast: Forecast,
    first: int = 1,
    later: Sequence[int] | None = None,
    report: Callable[[float], None] | None = None,
) -> list[Record]:
    """Every prediction of one window compared with the truth, step by step.

    Args:
        truth: of the clip.
        index: the current frame t.
        views: as in ``predictions``.
        predictions: by view and method, an image per step.
        forecast: its coverage shows which pixels the source camera has seen ("psnr_seen").
        first: the step that ``forecast`` begins with, 0 for the current frame itself.
        later: the true frame of each step; None takes one after the other from ``index + first`` on.
        report: is given the share of the steps that are done, 0 to 1.

    Returns:
        A record per view and method.
    """
    scores: dict[tuple[str, str], dict[str, list[float]]] = {}
    known: dict[int, Look] = {}
    for step in range(len(forecast.frames)):
        shown = {v: {m: each.pictures[step] for m, each in of.items()} for v, of in predictions.items()}
        known = _looks((picture for of in shown.values() for picture in of.values()), known, truth)
        for view in views:
            looks = [known[id(picture)] for picture in shown[view.name].values()]
            coverage = resize_image(forecast.frames[step][view.name].coverage, *truth.size)
            at = index + first + step if later is None else later[step]
            wanted, seen = truth.look(view, at), torch.from_numpy(coverage >= SEEN)[None]
            of_view = _scores(looks, wanted, seen, truth)
            for row, method in enumerate(shown[view.name]):
                of_method = scores.setdefault((view.name, method), {name: [] for name in of_view})
                for name, values in of_view.items():
                    of_method[name].append(float(values[row]))
        if report is not None:
            report((step + 1) / len(forecast.frames))
    where = truth.clip.name, truth.clip[index].name, index
    seconds = {(view, name): each.seconds for view, of in predictions.items() for name, each in of.items()}
    return [Record(*where, *key, seconds[key], of, first) for key, of in scores.items()]


def _looks(pictures: Iterable[NDArray[np.float32]], known: Mapping[int, Look], truth: Truth) -> dict[int, Look]:
    """By the images' ids. Some occur twice, in several views or, the last frame, in every step; they are looked at
    once."""
    wanted = {id(picture): picture for picture in pictures}
    new = {key: picture for key, picture in wanted.items() if key not in known}
    found = truth.look_at(list(new.values())) if new else []
    return {key: known[key] for key in wanted if key in known} | dict(zip(new, found, strict=True))


def _scores(looks: Sequence[Look], wanted: Look, seen: torch.Tensor, truth: Truth) -> dict[str, torch.Tensor]:
    """All metrics of M images that the size allows, [M] each."""
    pictures = torch.cat([each.picture for each in looks])
    target = wanted.picture.expand_as(pictures)
    side = min(pictures.shape[2:])
    scores = {"psnr": metrics.psnr(pictures, target)}
    if side >= metrics.WINDOW:
        beyond = [metrics.WINDOW // 2] * 4 if truth.border else [0] * 4
        scores["ssim"] = metrics.ssim(functional.pad(pictures, beyond), functional.pad(target, beyond))
    if side >= metrics.MS_SSIM_SIDE:
        scores["ms_ssim"] = metrics.ms_ssim(pictures, target)
    if wanted.maps:
        scores["squeeze"] = torch.cat([distance(each.maps, wanted.maps) for each in looks])
    if truth.lpips is not None:
        heads = list(truth.lpips.heads)
        scores["lpips"] = torch.cat([distance(each.lpips_maps, wanted.lpips_maps, heads) for each in looks])
    if truth.st_lpips is not None:
        heads = list(truth.st_lpips.heads)
        scores["st_lpips"] = torch.cat([distance(each.st_lpips_maps, wanted.st_lpips_maps, heads) for each in looks])
    if truth.border:
        seen = blacken_border(seen, truth.border)
    scores["psnr_seen"] = metrics.psnr(pictures, target, seen.expand(len(pictures), -1, -1, -1))
    return scores


def distance(
    maps: Sequence[torch.Tensor], wanted: Sequence[torch.Tensor], heads: Sequence[torch.Tensor] | None = None
) -> torch.Tensor:
    """`vestcl.evaluation.perceptual.squeeze_distance`, or with ``heads`` `Lpips` or `StLpips`, of maps that are there:
    [1].

    Args:
        maps: [1, C_l, h_l, w_l] a layer.
        wanted: the same of the truth.
        heads: [C_l] a layer.
    """
    squares = [squared_difference(f, g) for f, g in zip(maps, wanted, strict=True)]
    if heads is None:
        layers = [square.sum(dim=1) for square in squares]
    else:
        pairs = zip(squares, heads, strict=True)
        layers = [torch.einsum("bchw,c->bhw", square, head) for square, head in pairs]
    return torch.stack([layer.mean(dim=(1, 2)) for layer in layers]).sum(dim=0)


def _flow(previous: NDArray[np.float32], current: NDArray[np.float32], steps: int, elapsed: float) -> Prediction:
    start = time.perf_counter()
    before, now = (torch.from_numpy(np.ascontiguousarray(image))[None] for image in (previous, current))
    pictures = list(baselines.flow_extrapolation(before, now, steps, elapsed=elapsed)[0].numpy())
    return Prediction(pictures, time.perf_counter() - start)

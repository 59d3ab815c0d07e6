"""A forecast step timed on one scene: nothing skipped, each switch alone and all, in turns with peers and a copy."""

import copy
import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl.bench.common import timing as _timing
from vestcl.bench.common.timing import Spread
from vestcl.bench.pipeline.splatter import counting
from vestcl.bench.pipeline.traffic import EMPTY, JAM, TRAFFIC, Drive, Window
from vestcl.evaluation import metrics
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.skipping import NOTHING, Count, Skip, count_skips
from vestcl.models.inference.stage_times import watching, with_rest
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork
from vestcl.opencl import trace
from vestcl.scene.layers import build_layers

#: What else is timed beside the variants: the peer, a copy of the frames' layers, and what a new frame needs before.
PEER, COPY, INPAINT = "DMVFN", "copy", "inpaint"

NONE, ALL = "nothing skipped", "all skipped"

#: Nothing skipped, where a camera is asked for twice: what "views" is compared with.
TWICE: Final = "nothing skipped, the view twice"

#: Of `Skip`, in the order of a forecast.
SWITCHES: Final = ("seen", "background", "objects", "covered", "views")


@dataclass(frozen=True)
class Variant:
    """A way to make the same forecast."""

    name: str
    skip: Skip
    twice: bool = False
    """Whether the view is asked for twice."""
    base: str | None = None
    """The variant that it is compared with."""
    switch: str | None = None
    """The one that is on, where it is one alone."""


def variants(skip: Skip) -> list[Variant]:
    """Nothing skipped, each switch alone, and all that ``skip`` has on."""
    nothing = dataclasses.replace(NOTHING, margin=skip.margin, still=skip.still)
    found = [Variant(NONE, nothing), Variant(TWICE, nothing, twice=True)]
    for switch in SWITCHES:
        twice = switch == "views"
        alone = dataclasses.replace(nothing, **{switch: True})
        found.append(Variant(f"{switch} alone", alone, twice, TWICE if twice else NONE, switch))
    return [*found, Variant(ALL, skip, base=NONE)]


@dataclass(frozen=True)
class Pictures:
    """What skipping changes, mean over a drive, dB PSNR; `inf` where nothing does."""

    against_nothing: float
    """Of the forecast with all skipped, against the one with nothing skipped."""
    truth_nothing: float | None
    """Of the forecast with nothing skipped, against the true frame; None without one."""
    truth_all: float | None

    @property
    def loss(self) -> float | None:
        """dB that skipping costs against the truth."""
        return None if self.truth_nothing is None or self.truth_all is None else self.truth_nothing - self.truth_all


@dataclass(frozen=True)
class SceneTimes:
    """One scene's figures. Steps that begin a drive, with no frame known, don't count."""

    name: str
    foreground: float
    """Share of the pixels."""
    seconds: dict[str, Spread]
    """By variant, PEER, COPY and INPAINT."""
    saved: dict[str, Spread]
    """By variant that has a base: s a step, each against the base's step in the same round."""
    saved_share: dict[str, Spread]
    """The same as a share of the base's step."""
    stages: dict[str, dict[str, Spread]]
    """By variant and stage, s."""
    counts: dict[str, Count]
    """What each switch skipped, by switch, over the drive."""
    splatter: dict[str, Count]
    """What the splatter itself left out with all skipped, which has no switch: points that make no fragment, tiles
    without points, pixels that nothing shines through any more."""
    of_peer: Spread | None
    """The step with all skipped as a multiple of PEER's, round by round; None where PEER did not run."""
    of_copy: Spread
    """The same of COPY's."""
    pictures: Pictures
    others_cores: float | None
    """That other processes kept busy meanwhile."""


class Stepper:
    """One variant's forecast steps, window after window, round and round."""

    def __init__(self, model: Forecaster, variant: Variant, drive: Drive) -> None:
        self.variant, self._drive = variant, drive
        self._model = copy.deepcopy(model)  # each variant remembers its own frames
        self._model.skip = variant.skip
        self._windows = itertools.cycle(enumerate(drive.windows))
        self.stages: list[dict[str, float]] = []
        self.places: list[int] = []

    def step(self) -> torch.Tensor:
        """Forecast; the image [1, 3, H, W]."""
        place, window = next(self._windows)
        self.places.append(place)
        return self._forecast(window)

    def _forecast(self, window: Window) -> torch.Tensor:
        given = window.given
        prior = given.prior if self._model.config.start == "prior" else None
        views = [(window.tgt_from_next, given.K)] * (2 if self.variant.twice else 1)
        start = time.perf_counter()
        with trace.stage(self.variant.name), watching() as watch:
            done = self._model.forecast(*window.frames, given.K, 1, views, prior=prior, own=given.own)
        self.stages.append(with_rest(watch.seconds, time.perf_counter() - start))
        return done[0].views[0].image

    def look(self) -> tuple[list[torch.Tensor], dict[str, Count]]:
        """The images of the steps that count, and what was skipped for them."""
        windows, warm = self._drive.windows, self._drive.warm
        for window in (windows[-1], *windows[:warm]):  # so that it does not matter where the rounds ended
            self._forecast(window)
        with count_skips() as tally:
            images = [self._forecast(window) for window in windows[warm:]]
        return images, tally.counts

    def splatter(self) -> dict[str, Count]:
        """What the splatter left out of the drive's last step."""
        with counting(self._model.effort.min_transmittance) as found:
            self._forecast(self._drive.windows[-1])
        points, tiles, pixels = (sum(getattr(one, name) for one in found) for name in ("points", "tiles", "pixels"))
        return {
            "points without fragments": Count(sum(one.culled for one in found), points, "points"),
            "empty tiles": Count(sum(one.empty_tiles for one in found), tiles, "tiles"),
            "saturated pixels": Count(sum(one.saturated_pixels for one in found), pixels, "px"),
        }


def measure_scene(model: Forecaster, drive: Drive, seconds: float, threads: int, peer: bool) -> SceneTimes:
    """Time a scene.

    Args:
        model: with the precision and effort that all variants have, and the switches that "all" has.
        drive: the scene.
        seconds: about how long it takes.
        threads: of the copy; torch's are as they are.
        peer: whether DMVFN runs, too.

    Returns:
        The figures.
    """
    steppers = {variant.name: Stepper(model, variant, drive) for variant in variants(model.skip)}
    tasks: dict[str, _timing.Task] = {name: stepper.step for name, stepper in steppers.items()}
    planes = torch.cat([plane for frame in drive.windows[0].frames for plane in frame], dim=1)
    tasks[COPY] = _timing.copies_of_forward(planes, threads)["torch copy_"]
    tasks[INPAINT] = _inpaint(drive)
    if peer:
        tasks[PEER] = _peer(drive)
    with torch.inference_mode(), _timing.recycling_allocator(), _timing.watching_others() as others:
        times = _timing.interleave(tasks, seconds, least=drive.warm + _timing.LEAST_ROUNDS)
    count = len(times[NONE])  # before those, tasks ran to get warm
    counted = np.array(steppers[NONE].places[-count:]) >= drive.warm
    times = {name: found[counted] for name, found in times.items()}
    stages = {name: _spreads(stepper.stages[-count:], counted) for name, stepper in steppers.items()}
    with torch.inference_mode():
        looks = {name: stepper.look() for name, stepper in steppers.items()}
        splatter = steppers[ALL].splatter()
    kinds = [stepper.variant for stepper in steppers.values()]
    bases = [(kind.name, times[kind.name], times[kind.base]) for kind in kinds if kind.base]
    return SceneTimes(
        drive.name,
        drive.foreground,
        {name: Spread.of(found) for name, found in times.items()},
        {name: Spread.of(base - own) for name, own, base in bases},
        {name: Spread.of(1 - own / base) for name, own, base in bases},
        stages,
        _counts(steppers, looks),
        splatter,
        Spread.of(times[ALL] / times[PEER]) if peer else None,
        Spread.of(times[ALL] / times[COPY]),
        _pictures(drive, looks[NONE][0], looks[ALL][0]),
        others.cores,
    )


def _counts(steppers: dict[str, Stepper], looks: dict[str, tuple[Any, dict[str, Count]]]) -> dict[str, Count]:
    """Of each switch, by its own variant."""
    found = {}
    for name, stepper in steppers.items():
        switch = stepper.variant.switch
        if switch is not None and switch in looks[name][1]:
            found[switch] = looks[name][1][switch]
    return found


def _spreads(runs: Sequence[dict[str, float]], counted: NDArray[np.bool_]) -> dict[str, Spread]:
    kept = [run for run, counts in zip(runs, counted, strict=True) if counts]
    return {name: Spread.of(np.array([run[name] for run in kept])) for name in kept[0]}


def _inpaint(drive: Drive) -> Callable[[], object]:
    """The layers of one new frame, from its picture, depth and mask."""
    frames = itertools.cycle([window.frames[1] for window in drive.windows])

    def build() -> object:
        frame = next(frames)
        picture, depth, mask = (plane[0].numpy() for plane in (frame.image, frame.depth, frame.mask))
        return build_layers(picture, depth, mask > 0)

    return build


def _peer(drive: Drive) -> Callable[[], object]:
    """DMVFN's network on the same frames, all of its blocks."""
    windows, network = itertools.cycle(drive.windows), VoxelFlowNetwork().eval()

    def forecast() -> object:
        prev, cur = next(windows).frames
        with trace.stage(PEER):
            return network(prev.image, cur.image)

    return forecast


def _pictures(drive: Drive, nothing: list[torch.Tensor], skipped: list[torch.Tensor]) -> Pictures:
    truths = [window.truth for window in drive.windows[drive.warm :]]

    def mean(found: Sequence[torch.Tensor], wanted: Sequence[torch.Tensor | None]) -> float | None:
        pairs = [(one, other) for one, other in zip(found, wanted, strict=True) if other is not None]
        known = [metrics.psnr(one.clamp(0, 1), other.clamp(0, 1)).item() for one, other in pairs]
        return float(np.mean(known)) if known else None

    against = mean(skipped, nothing)
    assert against is not None
    return Pictures(against, mean(nothing, truths), mean(skipped, truths))


#: Scene -> what the step may take as a multiple of PEER's, and what share of it skipping must save at least.
OF_PEER: Final = {EMPTY: 0.25, TRAFFIC: 0.5, JAM: 0.5}
SAVED: Final = {EMPTY: 0.4, TRAFFIC: 0.2}

#: dB PSNR against the truth that skipping may cost, and share of a step where there is nothing to skip.
MOST_LOSS: Final = 0.1
MOST_COST: Final = 0.02

"""A forecast step on one scene: nothing skipped, each switch by itself and all, in turns with a peer and a copy."""

import copy
import dataclasses
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl.bench.common import timing as _timing
from vestcl.bench.common.timing import Spread, Task
from vestcl.bench.pipeline.traffic import Drive, Window
from vestcl.evaluation import metrics
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.options import InferenceOptions
from vestcl.models.inference.skipping import Count, count_skips
from vestcl.models.inference.stage_times import watching, with_rest
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork
from vestcl.opencl import trace
from vestcl.scene.layers import build_layers

#: Also timed, in turns with the variants: the peer, a copy of the frames' layers, and what a new frame needs before.
PEER, COPY, INPAINT = "DMVFN", "copy", "inpaint"

NONE, ALL = "nothing skipped", "all skipped"

#: Of `InferenceOptions`, in the order of a forecast.
SWITCHES: Final = ("seen", "background", "objects", "covered")


def variants(options: InferenceOptions) -> dict[str, InferenceOptions]:
    """By name: nothing skipped, each of SWITCHES by itself, and all that ``options`` have on."""
    nothing = options.without_skips()
    alone = {f"{name} alone": dataclasses.replace(nothing, **{name: True}) for name in SWITCHES}  # type: ignore[arg-type]
    return {NONE: nothing, **alone, ALL: options}


class Stepper:
    """One variant's forecast steps, window after window, round and round."""

    def __init__(self, model: Forecaster, name: str, options: InferenceOptions, drive: Drive) -> None:
        self._name, self._drive = name, drive
        self._model = copy.deepcopy(model)  # each variant remembers its own frames
        self._model.options = options
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
        views = [(window.tgt_from_next, given.K)]
        start = time.perf_counter()
        with trace.stage(self._name), watching() as watch:
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


@dataclass(frozen=True)
class Measured:
    """A scene; times are of the same rounds, an element each, in seconds."""

    name: str
    foreground: float
    """Share of the pixels."""
    times: dict[str, NDArray[np.float64]]
    """By variant, COPY, INPAINT and, if it ran, PEER."""
    stages: dict[str, dict[str, Spread]]
    """By variant and stage."""
    counts: dict[str, Count]
    """By variant with one switch on: what was skipped."""
    against_nothing: float
    """Mean PSNR over the drive of all skipped against nothing skipped, dB."""
    truth: tuple[float, float] | None
    """The same of nothing skipped and of all skipped against the truth, if that is known."""


def measure_scene(model: Forecaster, drive: Drive, seconds: float, threads: int, peer: bool) -> Measured:
    """Time a scene. Steps that begin a drive, with no frame known, don't count.

    Args:
        model: with the precision and effort that all variants have, and the switches that "all" has.
        drive: the scene.
        seconds: about how long it takes.
        threads: of the copy; torch's are as they are.
        peer: whether DMVFN runs, too.
    """
    every = variants(model.options)
    steppers = {name: Stepper(model, name, options, drive) for name, options in every.items()}
    tasks: dict[str, Task] = {name: stepper.step for name, stepper in steppers.items()}
    planes = torch.cat([plane for frame in drive.windows[0].frames for plane in frame], dim=1)
    tasks |= {COPY: _timing.memcpy(threads, planes), INPAINT: _inpaint(drive)}
    tasks |= {PEER: _peer(drive)} if peer else {}
    with torch.inference_mode(), _timing.recycling_allocator():
        times = _timing.interleave(tasks, seconds, least=drive.warm + _timing.LEAST_ROUNDS)
    count = len(times[NONE])  # before those, tasks ran to get warm
    counted = np.array(steppers[NONE].places[-count:]) >= drive.warm
    stages = {
        name: Spread.of_each([run for run, counts in zip(one.stages[-count:], counted, strict=True) if counts])
        for name, one in steppers.items()
    }
    with torch.inference_mode():
        looks = {name: stepper.look() for name, stepper in steppers.items()}
    truths = [window.truth for window in drive.windows[drive.warm :]]
    nothing, skipped = looks[NONE][0], looks[ALL][0]
    return Measured(
        drive.name,
        drive.foreground,
        {name: found[counted] for name, found in times.items()},
        stages,
        {f"{of} alone": looks[f"{of} alone"][1][of] for of in SWITCHES if of in looks[f"{of} alone"][1]},
        _psnr(skipped, nothing),
        None if None in truths else (_psnr(nothing, truths), _psnr(skipped, truths)),
    )


def _inpaint(drive: Drive) -> Task:
    """The layers of one new frame, from its image, depth and mask."""
    frames = itertools.cycle([window.frames[1] for window in drive.windows])

    def build() -> object:
        frame = next(frames)
        image, depth, mask = (plane[0].numpy() for plane in (frame.image, frame.depth, frame.mask))
        return build_layers(image, depth, mask > 0)

    return build


def _peer(drive: Drive) -> Task:
    """DMVFN's network on the same frames, all of its blocks."""
    windows, network = itertools.cycle(drive.windows), VoxelFlowNetwork().eval()

    def forecast() -> object:
        prev, cur = next(windows).frames
        with trace.stage(PEER):
            return network(prev.image, cur.image)

    return forecast


def _psnr(found: Sequence[torch.Tensor], wanted: Sequence[torch.Tensor | None]) -> float:
    """Mean over a drive, dB."""
    pairs = [
        (one.clamp(0, 1), other.clamp(0, 1)) for one, other in zip(found, wanted, strict=True) if other is not None
    ]
    return float(np.mean([metrics.psnr(one, other).item() for one, other in pairs]))

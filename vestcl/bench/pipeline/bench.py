"""`vestcl bench pipeline`: a complete forecast step in empty streets and full ones, and what skipping saves of it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Literal

from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common.options import Options
from vestcl.bench.common.plots import bars
from vestcl.bench.common.results import X_COPY
from vestcl.bench.common.table import Measurement, Section, verdict
from vestcl.bench.common.timing import Spread
from vestcl.bench.pipeline.measure import ALL, COPY, INPAINT, NONE, PEER, Measured, measure_scene
from vestcl.bench.pipeline.traffic import EMPTY, EVERYTHING, JAM, LEAST_FRAMES, TRAFFIC, drive
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference import quality
from vestcl.models.inference.fast import accelerate
from vestcl.models.inference.skipping import Count
from vestcl.models.networks import voxel_flow
from vestcl.opencl import trace

#: Scene -> what the step may take as a multiple of PEER's, and what share of it skipping must save at least.
OF_PEER: Final = {EMPTY: 0.25, TRAFFIC: 0.5, JAM: 0.5}
SAVED: Final = {EMPTY: 0.4, TRAFFIC: 0.2}

#: dB PSNR against the truth that skipping may cost, and share of a step where there is nothing to skip.
MOST_LOSS: Final = 0.1
MOST_COST: Final = 0.02

#: Of a street whose traffic is ordinary, and that no network was trained on.
SEED: Final = 1100


@dataclass(frozen=True)
class PipelineBench(Options):
    """Time a forecast step, with depth and masks given, in an empty road, in traffic and in a jam."""

    model: str = "vest-s"
    """A trained network: a name that ships with vestcl, a file or a checkpoint's folder."""
    scenes: tuple[Literal["empty road", "traffic", "jam", "everything"], ...] = (EMPTY, TRAFFIC, JAM, EVERYTHING)
    """"everything" needs all of a step: there skipping only costs."""
    height: int = 256
    """Pixels, a multiple of 16."""
    width: int = 832
    """Pixels, a multiple of 16."""
    frames: int = 8
    """Of a drive, which the step slides over."""
    seed: int = SEED
    """Of the street."""
    seconds: float = 60.0
    """About how long each scene takes."""
    quality: Literal["exact", "balanced", "fast"] = "balanced"
    """Of the forecast, with everything skipped and with nothing alike: see `vestcl.models.inference.quality`."""
    precision: Literal["float32", "bfloat16"] | None = None
    """That encoder and refinement compute in; None is the quality's, where the processor has it."""
    accelerated: bool = True
    """The network as `vestcl.models.inference.fast.accelerate` lays it out."""
    peers: bool = True
    """Also DMVFN's network on the same frames."""


def main(config: PipelineBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size, number or time that is too small, a size that is no multiple of 16, or no such model.
        DeviceError: no such device.
    """
    _check(config)
    scenes = len(set(config.scenes))
    _results.run("pipeline", config, partial(_sections, config, load(config)), lambda seconds, _: seconds * scenes)


def load(config: PipelineBench) -> Forecaster:
    """The network as it is to run.

    Raises:
        ValueError: no such model.
    """
    model = quality.apply(Forecaster.from_pretrained(config.model), config.quality)
    if config.precision is not None:
        precision = None if config.precision == "float32" else config.precision
        model.options = replace(model.options, autocast=precision)
    if not config.accelerated:
        return model
    return accelerate(model, "bfloat16" if model.options.autocast else "float32")


def _check(config: PipelineBench) -> None:
    _results.check_positive(config, "height", "width", "seconds", "threads")
    for name in ("height", "width"):
        if getattr(config, name) % voxel_flow.MULTIPLE:
            raise ValueError(f"`{name}` must be a multiple of {voxel_flow.MULTIPLE} px, got {getattr(config, name)}")
    if config.frames < LEAST_FRAMES:
        raise ValueError(f"`frames` must be {LEAST_FRAMES} or more, got {config.frames}")
    if not config.scenes:
        raise ValueError("`scenes` must be one or more, got none")


def _sections(config: PipelineBench, model: Forecaster, _: opencl.Session, console: Console) -> Iterator[Section]:
    """All scenes on one device, as they come, and tables of all of them."""
    targets, stages = list[Measurement](), list[Measurement]()
    for name in dict.fromkeys(config.scenes):
        with console.status(name), trace.stage(name):
            scene = drive(name, config.height, config.width, config.frames, config.seed)
            one = measure_scene(model, scene, config.seconds, config.threads, config.peers)
        size = f"{model.config.name}, {config.height}x{config.width}"
        title = f"forecast step, {name} ({one.foreground:.0%} foreground), {size}"
        notes = (
            f"{INPAINT}: a new frame's background, before the step. {COPY}: of both frames' layers.",
            f"{len(one.times[NONE])} rounds.",
        )
        targets += _target_rows(one)
        yield Section(title, list(_scene_rows(one)), notes)
        stages += _stage_rows(one)
    plot = partial(bars, stacked=True)
    yield Section("stages with nothing and with all skipped, ms", stages, ("Medians.",), {"pipeline": plot})
    yield Section("targets", targets, ("PSNR: means over the drives' steps; inf: the same.",))


def _scene_rows(scene: Measured) -> Iterator[Measurement]:
    """A variant each: its time, what that saves in the same round, and what is skipped."""
    for name, times in scene.times.items():
        figure = f"{scene.name}: {name}"
        yield Measurement(name, "ms (quartiles)", Spread.of(times), "s", name=figure)
        if name in scene.stages and name != NONE:
            share = Spread.of(1 - times / scene.times[NONE])
            yield Measurement(name, "saved", share, "1", "+.1%", f"{figure}: saved", "higher")
        if name in scene.counts:
            yield Measurement(name, "skipped", counted(scene.counts[name]))


def _stage_rows(scene: Measured) -> Iterator[Measurement]:
    for variant in (NONE, ALL):
        column = f"{scene.name}, {'nothing' if variant == NONE else 'all'}"
        for stage, spread in scene.stages[variant].items():
            yield Measurement(stage, column, spread, "s", ".1f", f"{scene.name}: {variant}: {stage}")
    if PEER in scene.times:
        yield Measurement(PEER, f"{scene.name}, {PEER}", Spread.of(scene.times[PEER]), "s", ".1f")


def _target_rows(scene: Measured) -> Iterator[Measurement]:
    """The step with all skipped against the peer and a copy, what skipping saves, and what it changes."""
    name, step = scene.name, scene.times[ALL]
    of_peer = Spread.of(step / scene.times[PEER]) if PEER in scene.times else None
    saved = Spread.of(1 - step / scene.times[NONE])
    loss = None if scene.truth is None else scene.truth[0] - scene.truth[1]
    if of_peer is not None:
        yield Measurement(name, f"of {PEER}'s", of_peer, digits=".2f", name=f"{name}: {ALL}, x {PEER}")
    yield Measurement(name, "x copy", Spread.of(step / scene.times[COPY]), digits=".0f", name=f"{name}: {ALL}{X_COPY}")
    yield Measurement(name, "saved", saved, digits=".1%")
    yield Measurement(name, "PSNR against nothing skipped", scene.against_nothing, "dB", ".2f")
    if scene.truth is not None:
        known = scene.truth[1]
        yield Measurement(name, "PSNR, all skipped", known, "dB", ".2f", f"{name}: {ALL} against truth", "higher")
    if loss is not None:
        yield Measurement(name, "PSNR drop", loss, "dB", ".2f", f"{name}: lost")
    ratio = None if of_peer is None else of_peer.median
    for what, text in verdicts(name, ratio, saved.median, loss).items():
        yield Measurement(name, what, text)


def verdicts(name: str, of_peer: float | None, saved: float, loss: float | None) -> dict[str, str]:
    """Every target that a scene has figures for: what, and "<= 0.5 reached"."""
    found = {}
    if name in OF_PEER and of_peer is not None:
        most = OF_PEER[name]
        found[f"target of {PEER}'s"] = f"<= {most:g} {verdict(of_peer <= most)}"
    if name in SAVED:
        found["target saved"] = f">= {SAVED[name]:.0%} {verdict(saved >= SAVED[name])}"
    if name == EVERYTHING:
        found["target saved"] = f">= {-MOST_COST:.0%} {verdict(-saved <= MOST_COST)}"
    if loss is not None:
        found["target drop"] = f"<= {MOST_LOSS:g} {verdict(loss <= MOST_LOSS, timed=False)}"
    return found


def counted(count: Count) -> str:
    """ "73 % of 1,277,952 px"."""
    return f"{count.skipped / count.of if count.of else 0.0:.0%} of {count.of:,} {count.unit}"

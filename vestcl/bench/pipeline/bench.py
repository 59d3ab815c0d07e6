"""`vestcl bench pipeline`: a complete forecast step in empty streets and full ones, and what skipping saves of it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Literal

from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common.options import Options
from vestcl.bench.common.results import X_COPY
from vestcl.bench.common.table import Measurement, Section, busy
from vestcl.bench.common.timing import peak_gigabytes
from vestcl.bench.pipeline.measure import ALL, COPY, INPAINT, NONE, PEER, Record, measure_scene
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
    _results.run("pipeline", config, partial(_sections, config, load(config)))


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
    """All scenes on one device, as they come."""
    size, scenes = f"{config.height}x{config.width}", []
    for name in dict.fromkeys(config.scenes):
        with console.status(name), trace.stage(name):
            scene = drive(name, config.height, config.width, config.frames, config.seed)
            scenes.append(measure_scene(model, scene, config.seconds, config.threads, config.peers))
        yield scene_section(scenes[-1], f"{model.config.name}, {size}")
    yield from sections(scenes)
    counts = {
        scene["name"]: {key: count._asdict() for key, count in (scene["counts"] | scene["splatter"]).items()}
        for scene in scenes
    }
    about = model.options.as_dict()
    about |= {"scenes": {scene["name"]: scene for scene in scenes}, "counts": counts}
    yield Section("", [], details=about | {"peak_gigabytes": peak_gigabytes()})


# ---------------------------------------------------------------- targets and tables


def verdicts(scene: Record) -> Iterator[dict[str, object]]:
    """Every target that a scene has figures for. "quiet": whether a missed one proves anything."""
    name, cores, saved = scene["name"], scene["others_cores"], scene["saved_share"][ALL].median
    loss = _loss(scene)
    found: list[tuple[str, str, str, bool]] = []
    if name in OF_PEER and scene["of_peer"] is not None:
        ratio, most = scene["of_peer"].median, OF_PEER[name]
        found.append((f"step / {PEER}", f"<= {most:g}", f"{ratio:.2f}", ratio <= most))
    if name in SAVED:
        found.append(("skipping saves", f">= {SAVED[name]:.0%}", f"{saved:.0%}", saved >= SAVED[name]))
    if name == EVERYTHING:
        found.append(("skipping costs", f"<= {MOST_COST:.0%}", f"{-saved:.1%}", -saved <= MOST_COST))
    if loss is not None:
        found.append(("dB PSNR lost", f"<= {MOST_LOSS:g}", f"{loss:.3f}", loss <= MOST_LOSS))
    for what, wanted, got, reached in found:
        quiet = what == "dB PSNR lost" or not busy(cores)
        yield {"what": f"{name}: {what}", "wanted": wanted, "got": got, "reached": reached, "quiet": quiet}


def word(target: dict[str, object]) -> str:
    """What became of it."""
    return "reached" if target["reached"] else "missed" if target["quiet"] else "can't tell"


def _loss(scene: Record) -> float | None:
    """dB that skipping costs against the truth."""
    truths = scene["pictures"]["truth_nothing"], scene["pictures"]["truth_all"]
    return None if None in truths else truths[0] - truths[1]


def scene_section(scene: Record, size: str) -> Section:
    """Times and counters of one scene; ``size`` of the images, for the title."""
    notes = [
        f"{INPAINT}: a new frame's background, before the step. {COPY}: of both frames' layers.",
        f"{scene['seconds'][NONE].runs} rounds.",
    ]
    if scene["of_peer"] is not None:
        notes.append(f"The step with all skipped takes {scene['of_peer'].median:.2f} of {PEER}'s time.")
    notes.append(f"The step with all skipped takes {scene['of_copy'].median:.0f} copies of both frames' layers.")
    title = f"forecast step, {scene['name']} ({scene['foreground']:.0%} foreground), {size}"
    return Section(title, list(_scene_rows(scene)), (*notes, *busy(scene["others_cores"])))


def _scene_rows(scene: Record) -> Iterator[Measurement]:
    prefix = f"{scene['name']}: "
    for name, spread in scene["seconds"].items():
        yield Measurement(name, "ms (quartiles)", spread, "s", name=prefix + name)
        if name in scene["saved"]:
            share = scene["saved_share"][name]
            yield Measurement(name, "saved, ms", scene["saved"][name], "s", "+.1f")
            yield Measurement(name, "saved", share, "1", "+.1%", f"{prefix}{name}: saved", "higher")
        if name.removesuffix(" alone") in scene["counts"]:
            yield Measurement(name, "skipped", counted(scene["counts"][name.removesuffix(" alone")]))
    yield Measurement(ALL, "", scene["of_copy"], name=f"{prefix}{ALL}{X_COPY}")
    if scene["of_peer"] is not None:
        yield Measurement(ALL, "", scene["of_peer"], name=f"{prefix}{ALL}, x {PEER}")


def sections(scenes: Sequence[Record]) -> Iterator[Section]:
    """Tables of all scenes together: stages, images, splatter, targets."""
    stages = [
        Measurement(stage, f"{one['name']}, {'nothing' if variant == NONE else 'all'}", spread, "s", ".1f", name)
        for one in scenes
        for variant in (NONE, ALL)
        for stage, spread in one["stages"][variant].items()
        for name in [f"{one['name']}: {variant}: {stage}"]
    ]
    stages += [
        Measurement(PEER, f"{one['name']}, {PEER}", one["seconds"][PEER], "s", ".1f")
        for one in scenes
        if PEER in one["seconds"]
    ]
    yield Section("stages with nothing and with all skipped, ms", stages, ("Medians.",), stacked=True)
    images = [row for one in scenes for row in _image_rows(one)]
    yield Section("images, dB PSNR", images, ("Means over the drives' steps; inf: the same.",))
    left_out = [
        Measurement(what, one["name"], counted(count)) for one in scenes for what, count in one["splatter"].items()
    ]
    note = "Of the drives' last steps, with all skipped. It can't be switched off."
    yield Section("what the splatter leaves out", left_out, (note,))
    targets = [target for one in scenes for target in verdicts(one)]
    cells = [
        Measurement(str(target["what"]), column, str(text))
        for target in targets
        for column, text in (("wanted", target["wanted"]), ("got", target["got"]), ("verdict", word(target)))
    ]
    yield Section("targets" if cells else "", cells, details={"targets": targets})


def _image_rows(scene: Record) -> Iterator[Measurement]:
    name, images, loss = scene["name"], scene["pictures"], _loss(scene)
    yield Measurement(name, f"{ALL} against {NONE}", images["against_nothing"], "dB", ".2f")
    if loss is not None:
        yield Measurement(name, f"{NONE} against truth", images["truth_nothing"], "dB", ".2f")
        truth = images["truth_all"]
        yield Measurement(name, f"{ALL} against truth", truth, "dB", ".2f", f"{name}: {ALL} against truth", "higher")
        yield Measurement(name, "lost", loss, "dB", ".2f", f"{name}: lost")


def counted(count: Count) -> str:
    """ "73 % of 1,277,952 px"."""
    return f"{count.skipped / count.of if count.of else 0.0:.0%} of {count.of:,} {count.unit}"

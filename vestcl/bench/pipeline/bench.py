"""`vestcl bench pipeline`: a complete forecast step in empty streets and full ones, and what skipping saves of it."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

import torch
from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common.options import Options
from vestcl.bench.common.table import Section
from vestcl.bench.common.timing import peak_gigabytes
from vestcl.bench.pipeline import report as _report
from vestcl.bench.pipeline.measure import measure_scene
from vestcl.bench.pipeline.traffic import EMPTY, EVERYTHING, JAM, LEAST_FRAMES, TRAFFIC, drive
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference import pretrained, quality
from vestcl.models.inference.fast import accelerate
from vestcl.models.networks import voxel_flow
from vestcl.opencl import trace

#: Of a street whose traffic is ordinary, and that no network was trained on.
SEED: Final = 1100


@dataclass(frozen=True)
class PipelineBench(Options):
    """Time a forecast step, with depth and masks given, in an empty road, in traffic and in a jam."""

    model: str = "vest-s"
    """A trained network: a name that ships with vestcl, a file or a checkpoint's folder."""
    scenes: tuple[Literal["empty road", "traffic", "jam", "everything"], ...] = (EMPTY, TRAFFIC, JAM, EVERYTHING)
    """"everything" needs all of a step: there skipping can but cost."""
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
    """Beside DMVFN's network on the same frames, too."""


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
    model = quality.apply(pretrained.load_model(config.model), config.quality)
    if config.precision is not None:
        model.autocast = torch.bfloat16 if config.precision == "bfloat16" else None
    if not config.accelerated:
        return model
    return accelerate(model, "float32" if model.autocast is None else "bfloat16")


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
        yield _report.scene_section(scenes[-1], f"{model.config.name}, {size}")
    yield from _report.sections(scenes)
    counts = {
        scene["name"]: {key: count._asdict() for key, count in (scene["counts"] | scene["splatter"]).items()}
        for scene in scenes
    }
    about = {"skip": model.skip, "effort": model.effort, "autocast": model.autocast and str(model.autocast)}
    about |= {"scenes": {scene["name"]: scene for scene in scenes}, "counts": counts}
    yield Section("", [], details=about | {"peak_gigabytes": peak_gigabytes()})

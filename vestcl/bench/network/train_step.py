"""`vestcl bench train-step`: a training step by stage, what gradients cost that nobody asks for, and torch's splat."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common.options import Options
from vestcl.bench.common.table import Measurement, Section, busy
from vestcl.bench.common.timing import peak_gigabytes
from vestcl.bench.network.bench import made
from vestcl.bench.network.train_measure import (
    ADAM,
    BACKWARD,
    EVERYTHING_LEARNS,
    FORWARD,
    OURS,
    TWIN,
    Batch,
    Record,
    measure_steps,
    measure_twin,
    stacked,
)
from vestcl.bench.pipeline.bench import SEED
from vestcl.bench.pipeline.traffic import LEAST_FRAMES, TRAFFIC, drive
from vestcl.models import ModelConfig, configuration
from vestcl.models.forecaster import Forecaster

#: (height, width) at which torch's splat takes part in a step: it is thousands of times slower at full size.
TWIN_SIZE: Final = (32, 112)


@dataclass(frozen=True)
class TrainStepBench(Options):
    """Time a training step, forward, backward and Adam, on streets with true depth and labels."""

    model: str = "vest-s"
    """A configuration: "vest-paper", "vest-s+joint", ...; its weights are random."""
    height: int = 128
    """Pixels."""
    width: int = 416
    """Pixels."""
    batch: int = 4
    """Windows of one drive a step."""
    seed: int = SEED
    """Of the street and the weights."""
    seconds: float = 40.0
    """About how long the measurement takes."""
    twin: bool = True
    """A small step with torch's splat in place of OpenCL's, too."""


def main(config: TrainStepBench) -> None:
    """Measure, print and write.

    Raises:
        ValueError: a size, number or time that is not positive, or a model that isn't known.
        DeviceError: no such device.
    """
    _results.check_positive(config, "height", "width", "batch", "seconds", "threads")
    _results.run("train-step", config, partial(_sections, config, configuration(config.model)))


def _sections(
    config: TrainStepBench, model_config: ModelConfig, _: opencl.Session, console: Console
) -> Iterator[Section]:
    """Everything on one device: variants, stages, and torch's splat."""
    model = made(Forecaster, model_config, config.seed).train()
    with console.status("training steps"):
        steps = measure_steps(model, _batch(config, config.height, config.width, config.batch), config.seconds)
    size = f"{config.model}, {config.height}x{config.width}, batch {config.batch}"
    notes = (
        f"{steps[0]['whole'].runs} rounds. OpenCL's share of a step is a part of {FORWARD} and {BACKWARD}.",
        *busy(steps[0]["others_cores"]),
    )
    rows = [row for step in steps for row in _variant_rows(step)]
    yield Section(f"training step, {size}", rows, notes, {"steps": steps, "twin": None, "twin_size": TWIN_SIZE})
    note = "Medians. A stage's backward lasts from the gradient of its first result to that of an earlier stage's."
    rows = [
        Measurement(stage, f"{step['name']}, {way}", spread, "s", ".1f", f"{step['name']}: {way}: {stage}")
        for step in steps
        for way in (FORWARD, BACKWARD)
        for stage, spread in step[way].items()
    ]
    yield Section("stages, ms", rows, (note,), stacked=True)
    if config.twin:
        with console.status("a step with torch's splat"):
            twin = measure_twin(model, _batch(config, *TWIN_SIZE, 1), config.seconds / 4)
        yield _twin_section(twin)
    yield Section("", [], details={"peak_gigabytes": peak_gigabytes()})


def _batch(config: TrainStepBench, height: int, width: int, count: int) -> Batch:
    return stacked(drive(TRAFFIC, height, width, max(LEAST_FRAMES, count + 2), config.seed).windows[:count])


def _variant_rows(step: Record) -> Iterator[Measurement]:
    name = step["name"]
    yield Measurement(name, "parameters", f"{step['parameters']:,}")
    yield Measurement(name, "step, ms (quartiles)", step["whole"], "s", name=name)
    if name != EVERYTHING_LEARNS:
        yield Measurement(name, "saved", step["saved_share"], "1", "+.1%", f"{name}: saved", "higher")
    for part in (FORWARD, BACKWARD, ADAM):
        yield Measurement(name, f"{part}, ms", step["parts"][part], "s", name=f"{name}: {part}")
    yield Measurement(name, "", step["opencl"], "s", name=f"{name}: OpenCL")
    yield Measurement(name, "OpenCL's share", f"{step['opencl'].median / step['whole'].median:.1%}")


def _twin_section(twin: Record) -> Section:
    ratio, worst = twin["splat"][TWIN].median / twin["splat"][OURS].median, twin["gradient_difference"]
    rows = [Measurement("", "", worst, name="small step: gradients' difference")]
    for by in (OURS, TWIN):
        row, name = f"splat by {by}", f"small step, splat by {by}"
        rows.append(Measurement(row, "step, ms (quartiles)", twin["whole"][by], "s", name=name))
        rows.append(Measurement(row, "splat, both passes, ms", twin["splat"][by], "s", name=f"{name}: splat"))
    notes = (
        f"The stage takes {ratio:.1f} times as long in torch.",
        f"Gradients of the weights differ by {worst:.0e} of the largest.",
    )
    size = "x".join(map(str, TWIN_SIZE))
    return Section(f"training step with torch's splat, {size}, batch 1", rows, notes, {"twin": twin})

"""Evaluate models by the paper's protocols: `python -m train.evaluate PROTOCOL --model FILE --data FOLDER`.

Next to each model there are: the last frame repeated, optical flow at constant velocity, and the geometric forecast,
which needs no weights. All get the same frames at the same size, and models the geometric forecast's depth and masks;
every table names where these come from.
`train.evaluation.protocols` says what is evaluated, `train.evaluation.windows` how one window is,
`train.evaluation.report` what comes out.

A killed evaluation continues where it was: what is done lies in OUT/clips, by settings, models and vestcl's version
(not its code: delete the folder when that has changed). Several processes share the work with
--shard 0/4 ... 3/4, or under torchrun; the one that finds all parts done makes the tables, and so does --merge.
"""

import dataclasses
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from train.command import ERRORS, failed
from train.evaluation import report
from train.evaluation.inputs import Preprocessing, check_prepared, check_stereo, plain
from train.evaluation.key import about_run, key_of
from train.evaluation.leaks import training_overlap
from train.evaluation.options import Evaluation, check_options, models_of
from train.evaluation.protocols import NOW_NOTE, PROTOCOLS, Protocol, Source, Where
from train.evaluation.setup import Setup
from train.evaluation.sheets import write_sheets
from train.evaluation.windows import ShardPart, plan, read_inputs, read_part, run_part
from train.run.ranks import Ranks, local_rank
from vestcl import __version__, interrupt, opencl
from vestcl.bench.common import results as _results
from vestcl.cli import command_line, options
from vestcl.cli.prepare import shard
from vestcl.cli.progress import progress_bar
from vestcl.data.street import input as street_input
from vestcl.evaluation.metrics import MS_SSIM_SIDE
from vestcl.evaluation.perceptual import Lpips, StLpips
from vestcl.evaluation.scores import GEOMETRIC, Record
from vestcl.evaluation.tables import to_rich
from vestcl.evaluation.trunks.trunks import load_trunk
from vestcl.forecasting import peer
from vestcl.io.atomic import write_bytes
from vestcl.models.forecaster import Forecaster
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork
from vestcl.scene.inputs import Inputs

#: What of a protocol its published figures depend on.
_PUBLISHED: Final = ("size", "steps", "first", "last")


@interrupt.command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command; what a user can correct is reported in one line, with exit code 2."""
    config = command_line.parsed(Evaluation, "python -m train.evaluate", __doc__, arguments)
    try:
        evaluate(config)
    except ERRORS as error:
        return failed(options.as_typed(str(error), config))
    return 0


def evaluate(config: Evaluation) -> None:
    """Do this process's share; if then all is done, make the tables.

    Args:
        config: what to evaluate.

    Raises:
        ValueError: a setting out of range, clips that are missing or too short, a file that is not a model.
        FileNotFoundError: no such model or weights.
        DeviceError: no such device.
    """
    rank, ranks = shard(config.shard, os.environ)
    protocol = protocol_of(config)
    setup, out = setup_of(config, protocol), config.out or Path("out") / config.protocol
    sources = protocol.sources(_where(config, protocol))
    if config.prepared is not None:
        for source in sources:
            check_prepared(source.opens(), protocol)
    about = about_run(config, protocol)
    parts = plan(sources, protocol, setup.steps, config.every, out / "clips", key_of(about))
    console = _results.console()
    device = config.device or Ranks(local=local_rank()).device()
    with opencl.use(device) as session:
        if not config.merge:
            _run(parts[rank::ranks], setup, console)
        done = [read_part(part) for part in parts]
        records = [record for part in done if part is not None for record in part]
        if missing := done.count(None):
            state = f"{len(parts) - missing} of {len(parts)} parts are done in {out / 'clips'}"
            if config.merge:
                raise ValueError(f"`merge` needs all of them: {state}")
            console.print(f"{state}; the process that does the last makes the tables", highlight=False, soft_wrap=True)
            return
        results = _results_of(config, setup, parts, records)
        models = {name: model | setup.later[name].settings for name, model in about["models"].items()}
        _write(out, results, about | {"models": models, "machine": _results.describe(session)}, console)
        if config.sheets:
            _sheets(out, sources, setup, results, console)


# ---------------------------------------------------------------- settings


def protocol_of(config: Evaluation) -> Protocol:
    """The protocol as the options change it.

    Raises:
        ValueError: a number out of range.
    """
    for name in ("height", "width", "steps", "first", "samples", "every"):
        value = getattr(config, name)
        if value is not None and value < 1:
            raise ValueError(f"`{name}` must be 1 or more, got {value}")
    default = PROTOCOLS[config.protocol]
    check_stereo(default, config.stereo)
    check_options(config)
    steps = config.steps or default.steps
    shown = config.horizons or tuple(k for k in default.shown if k <= steps) or (steps,)
    if not all(1 <= k <= steps for k in shown):
        raise ValueError(f"`horizons` must be steps, 1 ... {steps}, got {shown}")
    size = config.height or default.size[0], config.width or default.size[1]
    first = default.first if config.first is None else config.first
    last = config.last
    if last is None and default.last is not None:
        last = max(default.last, first or 0)
    return dataclasses.replace(default, size=size, steps=steps, shown=tuple(sorted(shown)), first=first, last=last)


def setup_of(config: Evaluation, protocol: Protocol) -> Setup:
    """Models and weights, loaded.

    Raises:
        ValueError: two models of one name, or a file that holds something else.
        FileNotFoundError: no such file.
    """
    models = {name: Forecaster.load(path) for name, path in models_of(config).items()}
    trunk = None if config.squeeze is None else load_trunk("squeezenet1_0", config.squeeze)
    lpips = None if config.lpips is None else Lpips.load("alexnet", *config.lpips)
    shift_tolerant = None if config.st_lpips is None else StLpips.load(config.st_lpips)
    flow = None if config.peer is None else VoxelFlowNetwork.load(config.peer)
    size, steps = protocol.size, protocol.steps
    how = Preprocessing.load(config.depth_model, config.mask_model, config.inpaint)
    networks = trunk, lpips, shift_tolerant, flow
    setup = Setup(
        protocol, size, steps, models, config.mode, config.stereo, *networks, how, config.perceive, config.learned
    )
    _ = setup.later  # refuses what can't be perceived, before the work begins
    return setup


def _where(config: Evaluation, protocol: Protocol) -> Where:
    frames = max(protocol.first or 1, protocol.last or 1) + 1 + protocol.steps
    first, last = config.seeds
    if first > last:
        raise ValueError(f"`seeds` must be from a lower to a higher one, got {config.seeds}")
    seeds = range(first, last + 1)
    fps = None if config.street_fps is None else street_input.rate(str(config.street_fps), "`street_fps`")
    driven = street_input.Driven(None if config.drive == "usual" else config.drive, fps)
    return Where(
        config.data, seeds, protocol.size, frames, config.samples, config.prepared, config.accumulated_depth, driven
    )


def _caveats(config: Evaluation, setup: Setup) -> list[str]:
    """What was not measured, and what differs from what is published."""
    protocol, remarks = setup.protocol, list[str]()
    names = {"lpips": "LPIPS (--lpips)", "st_lpips": "ST-LPIPS (--st-lpips)", "squeeze": "squeeze distance (--squeeze)"}
    if absent := [name for option, name in names.items() if getattr(config, option) is None]:
        remarks.append(f"Without weights, not measured: {', '.join(absent)}.")
    if min(setup.size) < MS_SSIM_SIDE:
        remarks.append(f"MS-SSIM needs {MS_SSIM_SIDE} pixels per side, got {setup.size[0]} x {setup.size[1]}.")
    if config.peer is not None:
        remarks.append(f"{peer.METHOD} ({config.peer.name}): {peer.ABOUT}")
    default = PROTOCOLS[config.protocol]
    changed = [f"{name} {getattr(protocol, name)}" for name in _PUBLISHED
               if getattr(protocol, name) != getattr(default, name)]  # fmt: skip
    changed += [f"every {config.every}"] if config.every > 1 else []
    composed = [name for name, mode in setup.modes.items() if mode == "compose"]
    if default.paper and composed and protocol.steps > 1:
        remarks.append(
            f"Mode compose, where the paper's models forecast recursively (feedback): {', '.join(composed)}."
        )
    if default.paper and changed:
        remarks.append(f"Not the published protocol: {', '.join(changed)}.")
    return remarks + [NOW_NOTE] * protocol.now


# ---------------------------------------------------------------- work and results


def _run(parts: Sequence[ShardPart], setup: Setup, console: Console) -> None:
    with progress_bar(console, counted=True) as bar:
        task = bar.add_task("windows", total=sum(len(part.indices) for part in parts))
        for part in parts:
            bar.update(task, description=part.source.name)
            if read_part(part) is None:
                run_part(part, setup, lambda: bar.advance(task))
            else:
                bar.advance(task, len(part.indices))


def _results_of(
    config: Evaluation, setup: Setup, parts: Sequence[ShardPart], records: Sequence[Record]
) -> report.EvaluationResults:
    """What the tables are made of."""
    inputs: dict[str, Mapping[str, Inputs]] = {part.source.name: read_inputs(part) or {} for part in parts}
    models = models_of(config)
    leaks, unknown = training_overlap([*models.values()], parts, setup.steps, [*models])
    perceived = {name: later.perceived for name, later in setup.later.items() if later.perceived is not None}
    names, notes = tuple(setup.models), (*_caveats(config, setup), *unknown)
    shown = setup.protocol.shown
    return report.EvaluationResults(setup.protocol, records, shown, names, notes, leaks, setup.modes, perceived, inputs)


def _write(out: Path, results: report.EvaluationResults, about: dict[str, Any], console: Console) -> None:
    machine = about["machine"]
    models = [
        f"{name}: sha256 {model['sha256'][:16]}, mode {model['mode']}"
        + (f", perceive {model['perceive']}" if model["perceive"] else "")
        for name, model in about["models"].items()
    ]
    lines = [f"vestcl {__version__}, {machine['device']}, {machine['cores']} cores, {machine['date']}", *models]
    settings = ", ".join(f"{name} {value}" for name, value in about["settings"].items() if value is not None)
    for grid in report.short_grids(results):
        console.print(to_rich(grid))
    for line in results.remarks:
        console.print(line, highlight=False, soft_wrap=True)
    content = {
        "results.json": json.dumps(report.as_json(results, about), indent=1) + "\n",
        "results.csv": report.table_of_windows(results.records),
        "results.md": report.markdown(results, [*lines, settings]),
    }
    for name, text in content.items():
        write_bytes(out / name, text.encode())
        console.print(f"wrote {out / name}", soft_wrap=True, highlight=False)


def _sheets(
    out: Path, sources: Sequence[Source], setup: Setup, results: report.EvaluationResults, console: Console
) -> None:
    wanted = next(iter(setup.models), GEOMETRIC)
    judged = next(r for r in results.records if plain(r.method) == wanted and "psnr" in r.scores)
    own: list[Record] = [r for r in results.records if (r.view, r.method) == (judged.view, judged.method)]
    for path in write_sheets(out, sources, setup, own, report.headline(own)[0], results.horizons):
        console.print(f"wrote {path}", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    sys.exit(main())

"""Evaluate models by the paper's protocols: `python -m train.evaluate PROTOCOL --model FILE --data FOLDER`.

Beside each model stand: the last frame repeated, optical flow at constant velocity, and the geometric forecast, which
needs no weights. All get the same frames at the same size, and models the geometric forecast's depth and masks.
`train.protocols` says what is evaluated, `train.evaluate_windows` how one window is, `train.evaluate_report` what
comes out.

A killed evaluation goes on where it was: what is done lies in OUT/clips, by settings, models and vestcl's version (not
its code: delete the folder when that has changed). Several processes share the work with
--shard 0/4 ... 3/4, or under torchrun; the one that finds all parts done makes the tables, and so does --merge.
"""

import dataclasses
import hashlib
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from train import evaluate_report as report
from train.command import ERRORS, failed
from train.evaluate_inputs import check_stereo, depths, known_of, plain
from train.evaluate_leaks import training_overlap
from train.evaluate_sheets import write_sheets
from train.evaluate_windows import PART_WINDOWS, Part, Setup, plan, prepared, read_part, run_part
from train.protocols import HELD_OUT, NOW_NOTE, PROTOCOLS, Name, Protocol, Source, Where
from train.ranks import Ranks, local_rank
from vestcl import __version__, command_line, interrupt, peer, runtime, st_lpips
from vestcl.bench import _results
from vestcl.io.atomic import write_bytes
from vestcl.metrics import MS_SSIM_SIDE
from vestcl.models.forecaster import Forecaster, Mode
from vestcl.models.trunks import load_trunk
from vestcl.models.voxel_flow import VoxelFlowNetwork
from vestcl.perceptual import Lpips, StLpips
from vestcl.prepare_command import shard
from vestcl.progress import Bar
from vestcl.scoring import GEOMETRIC, Record, to_rich
from vestcl.st_lpips import Option as StLpipsOption

#: Columns where tables don't go to a terminal.
WIDTH: Final = 200

#: Settings that scores do not depend on, or that stand in the key as the content of files.
_NOT_IN_KEY: Final = (
    "model",
    "squeeze",
    "lpips",
    "st_lpips",
    "peer",
    "out",
    "shard",
    "merge",
    "device",
    "horizons",
    "sheets",
)

#: Of the scores' files: raised when what a window is given or how it is scored changes.
_SCORING: Final = 2

#: What of a protocol its published figures depend on.
_PUBLISHED: Final = ("size", "steps", "first", "last")


@dataclass(frozen=True)
class Evaluation:
    """Score models and baselines on every window of a protocol."""

    protocol: tyro.conf.Positional[Name]
    """Which clips, windows, cameras and size."""
    model: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """A model's file, *.safetensors; more than one may be told. Tables call it by the file's stem."""
    data: Path | None = None
    """The data set's root, or for `clip` what `vestcl forecast` opens. `street` needs none."""
    out: Path | None = None
    """Folder for results and for what is done so far; without it out/PROTOCOL."""
    squeeze: Path | None = None
    """SqueezeNet 1.0 weights, for the distance in its features."""
    lpips: tuple[Path, Path] | None = None
    """Weights of AlexNet (torchvision) and of LPIPS's heads (v0.1)."""
    st_lpips: StLpipsOption = None
    """Measure ST-LPIPS, by the weights FILE or those inside an installed stlpips-pytorch."""
    peer: Path | None = None
    """Weights of the learned 2D baseline (`python -m train.peer` writes peer.safetensors)."""
    height: int | None = None
    """Pixels; without it the protocol's."""
    width: int | None = None
    """Pixels; without it the protocol's."""
    steps: int | None = None
    """Frames to forecast; without it the protocol's."""
    horizons: tuple[int, ...] = ()
    """Steps that tables show; without it the protocol's."""
    every: int = 1
    """Take every such window."""
    first: int | None = None
    """The first current frame t of a clip, from 0; without it the protocol's."""
    last: int | None = None
    """The last one."""
    mode: Mode | None = None
    """How models make steps after the first: compose the first motion, or feed each forecast frame back (feedback).
    Without it each as it is meant to: feedback for models that start from rest, compose for vest-s."""
    stereo: bool = False
    """Take depth from stereo pairs even where clips have depth (laser scans, or a street's true depth). Rows that do
    end in "stereo pair"; where the right camera's future is judged they come next to monocular ones."""
    seeds: tuple[int, int] = (HELD_OUT[0], HELD_OUT[-1])
    """Of streets: the first and the last."""
    samples: int = 2
    """Rays a pixel and direction, of streets."""
    shard: str | None = None
    """I/N, 0 <= I < N: do this share of the windows. Without it RANK and WORLD_SIZE tell, as torchrun sets them."""
    merge: bool = False
    """Forecast nothing: make the tables of what is done, which must be everything."""
    sheets: bool = True
    """Write contact sheets of the best, the median and the worst window."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name."""


@interrupt.command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command; what a user can put right is told in one line, with exit code 2."""
    config = command_line.parsed(Evaluation, "python -m train.evaluate", __doc__, arguments)
    try:
        evaluate(config)
    except ERRORS as error:
        return failed(error)
    return 0


def evaluate(config: Evaluation) -> None:
    """Do this process's share; if then all is done, make the tables.

    Args:
        config: what to evaluate.

    Raises:
        ValueError: a setting out of range, clips that are missing or too short, a file that is no model.
        FileNotFoundError: no such model or weights.
        DeviceError: no such device.
    """
    rank, ranks = shard(config.shard, os.environ)
    protocol = protocol_of(config)
    setup, out = setup_of(config, protocol), config.out or Path("out") / config.protocol
    sources = protocol.sources(_where(config, protocol))
    about = _about(config, protocol)
    parts = plan(sources, protocol, setup.steps, config.every, out / "clips", _key(about))
    console = _results.console(WIDTH)
    device = config.device or Ranks(local=local_rank()).device()
    with runtime.use(device) as session:
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
        first = prepared(sources[0].opens(), setup)
        notes = (known_of(first, depths(first, protocol, config.stereo)), *_caveats(config, setup))
        leaks, unknown = training_overlap(config.model, parts, setup.steps)
        names = tuple(setup.models)
        results = report.Results(protocol, records, protocol.shown, names, notes + unknown, leaks, setup.modes)
        models = {name: told | {"mode": setup.modes[name]} for name, told in about["models"].items()}
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
    names = [path.stem for path in config.model]
    if twice := sorted({name for name in names if names.count(name) > 1 or name == GEOMETRIC}):
        raise ValueError(f"`model` must have files with a stem of their own each, got {', '.join(twice)} again")
    models = {path.stem: Forecaster.load(path) for path in config.model}
    trunk = None if config.squeeze is None else load_trunk("squeezenet1_0", config.squeeze)
    lpips = None if config.lpips is None else Lpips.load("alexnet", *config.lpips)
    shift_tolerant = None if config.st_lpips is None else StLpips.load(config.st_lpips)
    flow = None if config.peer is None else VoxelFlowNetwork.load(config.peer)
    size, steps = protocol.size, protocol.steps
    return Setup(protocol, size, steps, models, config.mode, config.stereo, trunk, lpips, shift_tolerant, flow)


def _where(config: Evaluation, protocol: Protocol) -> Where:
    frames = max(protocol.first or 1, protocol.last or 1) + 1 + protocol.steps
    first, last = config.seeds
    if first > last:
        raise ValueError(f"`seeds` must be from a lower to a higher one, got {config.seeds}")
    return Where(config.data, range(first, last + 1), protocol.size, frames, config.samples)


def _about(config: Evaluation, protocol: Protocol) -> dict[str, Any]:
    """What the scores depend on, as results.json tells it."""
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_IN_KEY}
    changed = {"data": None if config.data is None else str(config.data.resolve())}
    effective = {k: getattr(protocol, k) for k in ("size", "steps", "first", "last")}
    weights = {"squeeze": config.squeeze} | dict(zip(("alexnet", "lpips"), config.lpips or (), strict=False))
    weights |= {"peer": config.peer, "st_lpips": config.st_lpips and st_lpips.find_weights(config.st_lpips)}
    return {
        "vestcl": __version__,
        "settings": settings | changed | effective,
        "models": {path.stem: {"file": str(path), "sha256": _sha256(path)} for path in config.model},
        "weights": {name: _sha256(path) for name, path in weights.items() if path is not None},
    }


def _key(about: dict[str, Any]) -> str:
    hashes = {name: model["sha256"] for name, model in about["models"].items()}
    content = json.dumps(
        about | {"models": hashes, "part": PART_WINDOWS, "scoring": _SCORING}, sort_keys=True, default=str
    )
    return hashlib.sha256(content.encode()).hexdigest()[:12]


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _caveats(config: Evaluation, setup: Setup) -> list[str]:
    """What was not measured, and what differs from what is published."""
    protocol, told = setup.protocol, list[str]()
    names = {"lpips": "LPIPS (--lpips)", "st_lpips": "ST-LPIPS (--st-lpips)", "squeeze": "squeeze distance (--squeeze)"}
    if absent := [name for option, name in names.items() if getattr(config, option) is None]:
        told.append(f"Without weights, not measured: {', '.join(absent)}.")
    if min(setup.size) < MS_SSIM_SIDE:
        told.append(f"MS-SSIM needs {MS_SSIM_SIDE} pixels a side, got {setup.size[0]} x {setup.size[1]}.")
    if config.peer is not None:
        told.append(f"{peer.METHOD} ({config.peer.name}): {peer.ABOUT}")
    default = PROTOCOLS[config.protocol]
    changed = [f"{name} {getattr(protocol, name)}" for name in _PUBLISHED
               if getattr(protocol, name) != getattr(default, name)]  # fmt: skip
    changed += [f"every {config.every}"] if config.every > 1 else []
    composed = [name for name, mode in setup.modes.items() if mode == "compose"]
    if default.paper and composed and protocol.steps > 1:
        told.append(f"Mode compose, where the paper's models forecast recursively (feedback): {', '.join(composed)}.")
    if default.paper and changed:
        told.append(f"Not the published protocol: {', '.join(changed)}.")
    return told + [NOW_NOTE] * protocol.now


# ---------------------------------------------------------------- work and results


def _run(parts: Sequence[Part], setup: Setup, console: Console) -> None:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    bar = Bar(*columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal)
    with bar:
        task = bar.add_task("windows", total=sum(len(part.indices) for part in parts))
        for part in parts:
            bar.update(task, description=part.source.name)
            if read_part(part) is None:
                run_part(part, setup, lambda: bar.advance(task))
            else:
                bar.advance(task, len(part.indices))


def _write(out: Path, results: report.Results, about: dict[str, Any], console: Console) -> None:
    machine = about["machine"]
    models = [f"{name}: sha256 {told['sha256'][:16]}, mode {told['mode']}" for name, told in about["models"].items()]
    lines = [f"vestcl {__version__}, {machine['device']}, {machine['cores']} cores, {machine['date']}", *models]
    settings = ", ".join(f"{name} {value}" for name, value in about["settings"].items() if value is not None)
    for grid in report.short_grids(results):
        console.print(to_rich(grid))
    for line in results.told:
        console.print(line, highlight=False, soft_wrap=True)
    content = {
        "results.json": json.dumps(report.as_json(results, about), indent=1) + "\n",
        "results.csv": report.table_of_windows(results.records),
        "results.md": report.markdown(results, [*lines, settings]),
    }
    for name, text in content.items():
        write_bytes(out / name, text.encode())
        console.print(f"wrote {out / name}", soft_wrap=True, highlight=False)


def _sheets(out: Path, sources: Sequence[Source], setup: Setup, results: report.Results, console: Console) -> None:
    wanted = next(iter(setup.models), GEOMETRIC)
    judged = next(r for r in results.records if plain(r.method) == wanted and "psnr" in r.scores)
    own: list[Record] = [r for r in results.records if (r.view, r.method) == (judged.view, judged.method)]
    for path in write_sheets(out, sources, setup, own, report.headline(own)[0], results.horizons):
        console.print(f"wrote {path}", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    sys.exit(main())

"""`vestcl bench stability`: float32 against float64 at the extremes of what vestcl computes, with bounds that it keeps.

Each case runs twice on the same numbers, in float32 and in float64, forward and backward. The error of an array is
    max |a - b| / max |b|,   a in float32, b in float64:
the maximum norm, over image or coverage (or displacement), and over the gradient of each input separately. Its bounds
are from vestcl.bench.stability.bounds, and the errors of others from vestcl.bench.stability.peers.
"""

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common.options import Options
from vestcl.bench.common.plots import Curve, curves, file_name
from vestcl.bench.common.table import Measurement, Section
from vestcl.bench.common.timing import Spread
from vestcl.bench.stability.bounds import UNIT, bounds_of
from vestcl.bench.stability.cases import FAMILIES, Case, Family
from vestcl.bench.stability.peers import LEFT_OUT, peers_of
from vestcl.bench.stability.programs import OPERATORS, Errors, evaluate, relative_errors

Row = dict[str, Any]
"""A case: "kept", "broken", "family", "knob", "errors", "bounds", and "peers" (errors by name)."""

_NORM: Final = "Errors are max |float32 - float64| / max |float64| over each array; shown is the worst array's."

NOTES: Final = {
    "dividing": "dividing: the same, in float32, by a backward that divides by 1 - alpha + 1e-9, as PyTorch3D's does.",
    "clamping": "clamping: alpha <= 0.99, T by division, as in 3D Gaussian Splatting; grad_backgrounds left out.",
    "R x + t - x": "R x + t - x: the rigid flow as the difference that it is.",
}

_KINDS: Final = {"outputs": "output", "gradients": "gradient"}

#: Errors below and above are drawn there: a tenth of float32's rounding, and neither a digit nor the size is right.
_LIMITS: Final = (6e-9, 1e1)


@dataclass(frozen=True)
class StabilityBench(Options):
    """Compare float32 with float64, and with the bounds of its rounding errors, at extreme inputs."""

    families: tuple[str, ...] = ()
    """Which inputs go to their extremes (depth, layers, opacity, ...); without it all."""
    quick: bool = False
    """Fewer and smaller cases."""
    peers: bool = True
    """Compare with backwards that divide by 1 - alpha, and with a flow that subtracts, too."""
    seed: int = 0
    """Of all random numbers."""


def main(config: StabilityBench) -> int:
    """Measure, print and write.

    Returns:
        The exit status: 1 if a bound is broken, else 0.

    Raises:
        ValueError: an unknown family, or a number of threads that is not positive.
        DeviceError: no such device, or none with float64 for the truth.
    """
    _results.check_positive(config, "threads")
    known = {family.name: family for family in FAMILIES}
    for name in config.families:
        if name not in known:
            raise ValueError(f"`families` must be of {', '.join(known)}, got {name}")
    families = [known[name] for name in config.families] or list(FAMILIES)

    def measure(_: opencl.Session, console: Console) -> Iterator[Section]:
        for family in families:
            with console.status(family.name):
                rows = [measure_case(case, config.peers) for case in family.cases(config.seed, config.quick)]
            yield section(family, rows)

    results = _results.run("stability", config, measure)
    for number, result in enumerate(results):
        if config.plots is not None:
            draw(result.details["rows"], config.plots, f"{number} " if len(results) > 1 else "")
    console, rows = _results.console(), [row for result in results for row in result.details["rows"]]
    broken = [f"{row['family']} {row['knob']:g}: {', '.join(row['broken'])}" for row in rows if row["broken"]]
    for line in broken:
        console.print(f"[red]bound broken[/]: {line}", soft_wrap=True, highlight=False)
    if not broken:
        console.print(f"[green]all bounds kept[/] in {len(rows)} cases", highlight=False)
    return 1 if broken else 0


def measure_case(case: Case, peers: bool = True) -> Row:
    """Errors of one case on the current device, their bounds, and the peers' errors."""
    with _float64():
        truth = evaluate(case, OPERATORS, torch.float64)
        bounds = bounds_of(case, truth)
    others = peers_of(case) if peers else {}
    errors, *of_peers = (
        relative_errors(evaluate(case, operators, torch.float32), truth) for operators in (OPERATORS, *others.values())
    )
    broken, peers_errors = broken_bounds(errors, bounds), dict(zip(others, of_peers, strict=True))
    for name, left_out in LEFT_OUT.items():
        peers_errors.get(name, {"gradients": {}})["gradients"].pop(left_out, None)
    found = {"errors": errors, "bounds": bounds, "peers": peers_errors}
    return {"kept": not broken, "broken": broken, "family": case.family, "knob": case.knob, **found}


def broken_bounds(errors: Errors, bounds: Errors) -> list[str]:
    """Outputs, and gradients as "grad_NAME", whose error is above its bound, or NaN."""
    prefixes = {"outputs": "", "gradients": "grad_"}
    return [
        f"{prefixes[kind]}{name}"
        for kind, arrays in errors.items()
        for name, error in arrays.items()
        if not error <= bounds[kind][name]
    ]


@contextlib.contextmanager
def _float64() -> Iterator[None]:
    """Run operators on the current device where it has float64, else on the default one, else on any that has."""
    info = opencl.current().info
    if info.float64:
        yield
        return
    able = [other for other in (opencl.select(), *opencl.devices()) if other.float64]
    if not able:
        raise opencl.DeviceError("no OpenCL device has float64, which the truth needs: see `vestcl devices`")
    with opencl.use(able[0].index):
        yield


def section(family: Family, rows: Sequence[Row]) -> Section:
    """One family's table."""
    cells = [cell for row in rows for cell in _cells(row)]
    notes = (_NORM, *(NOTES[name] for name in dict.fromkeys(name for row in rows for name in row["peers"])))
    details = {"norm": _NORM, "unit_roundoff": UNIT, "rows": list(rows)}
    return Section(f"{family.name}: relative error of float32 over the {family.knob}", cells, notes, details)


def _cells(row: Row) -> Iterator[Measurement]:
    knob = f"{row['knob']:.4g}"
    for kind, label in _KINDS.items():
        array = worst(row["errors"][kind])
        name = f"{row['family']} {row['knob']:g}, {label}"
        yield Measurement(knob, label, row["errors"][kind][array], digits=".1e", name=name)
        if kind == "gradients":
            yield Measurement(knob, "of", array)
        yield Measurement(knob, f"{label} bound", row["bounds"][kind][array], digits=".1e")
    yield Measurement(knob, "bounds", "broken" if row["broken"] else "kept")
    for peer, errors in row["peers"].items():
        for kind, label in _KINDS.items():
            yield Measurement(knob, f"{peer} {label}", errors[kind][worst(errors[kind])], digits=".1e")


def worst(errors: Mapping[str, float | None]) -> str:
    """The array with the largest error; None is infinity, as JSON has it."""
    return max(errors, key=lambda name: math.inf if (error := errors[name]) is None else error)


def draw(rows: Sequence[Mapping[str, Any]], folder: Path, prefix: str = "") -> None:
    """Write a PNG a family: errors, bounds and peers over the knob; a knob of 0 is a tenth of the least other one.

    Args:
        rows: of the results' ``details["rows"]``.
        folder: made where it does not exist.
        prefix: of the files' names.

    Raises:
        ValueError: the folder can't be made.
    """
    for family in FAMILIES:
        own = [row for row in rows if row["family"] == family.name]
        zero = min((row["knob"] for row in own if row["knob"]), default=1.0) / 10
        values: dict[str, list[Spread]] = {}
        for row in own:
            for kind, label in _KINDS.items():
                array = worst(row["errors"][kind])
                found = {"vestcl": row["errors"][kind][array], "bound": row["bounds"][kind][array]}
                found |= {peer: errors[kind][worst(errors[kind])] for peer, errors in row["peers"].items()}
                for name, error in found.items():
                    values.setdefault(f"{name}, {label}", []).append(_spread(error))
        if own:
            knobs = [row["knob"] or zero for row in own]
            lines = [Curve(name, knobs, of, dashed=not name.startswith("vestcl")) for name, of in values.items()]
            title = f"{family.name}: relative error of float32 against float64, maximum norm"
            label = f"{family.knob}{f' (0 is drawn at {zero:.2g})' if zero in knobs else ''}"
            curves(folder / file_name(f"{prefix}{family.name}"), title, label, "relative error", lines)


def _spread(error: float | None) -> Spread:
    """An error as it is drawn; None is infinity, as JSON has it."""
    value = _LIMITS[1] if error is None else min(max(error, _LIMITS[0]), _LIMITS[1])
    return Spread(value, value, value, 1)

"""`vestcl bench stability`: float32 against float64 at the extremes of what vestcl computes, with bounds that it keeps.

Each case runs twice on the same numbers, in float32 and in float64, forward and backward. The error of an array is
    max |a - b| / max |b|,   a in float32, b in float64:
the maximum norm, over image or coverage (or displacement), and over the gradient of each input by itself. What is held
against it is in vestcl.bench.stability.bounds, and what others make of the same case in vestcl.bench.stability.peers.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import torch
from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.results import Measure, Results
from vestcl.bench.stability import plots as _stability_plots
from vestcl.bench.stability.bounds import UNIT, Bounds, bounds_of
from vestcl.bench.stability.cases import FAMILIES, Case, Family
from vestcl.bench.stability.peers import LEFT_OUT, peers_of
from vestcl.bench.stability.programs import OPERATORS, Operators, Outcome, evaluate, relative_error
from vestcl.evaluation.tables import Grid, to_rich

_NORM: Final = "Errors are max |float32 - float64| / max |float64| over each array; shown is the worst array's."

NOTES: Final = {
    "dividing": "dividing: the same, in float32, by a backward that divides by 1 - alpha + 1e-9, as PyTorch3D's does.",
    "clamping": "clamping: alpha <= 0.99, T by division, as in 3D Gaussian Splatting; grad_backgrounds left out.",
    "PyTorch3D": "PyTorch3D: its rasteriser and alpha compositor, without a background; grad_backgrounds left out.",
    "R x + t - x": "R x + t - x: the rigid flow as the difference that it is.",
}


@dataclass(frozen=True)
class StabilityBench:
    """Hold float32 against float64, and against the bounds of its rounding errors, at extreme inputs."""

    families: tuple[str, ...] = ()
    """Which inputs go to their extremes (depth, layers, opacity, ...); without it all."""
    quick: bool = False
    """Fewer and smaller cases."""
    peers: bool = True
    """Beside backwards that divide by 1 - alpha, and PyTorch3D where it is installed, too."""
    seed: int = 0
    """Of everything that is drawn."""
    threads: int = 2
    """Of torch."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices`, a part of its name, or all."""
    json: Path | None = None
    """File for the results."""
    markdown: Path | None = None
    """File for the tables."""
    plots: Path | None = None
    """Folder for a picture of each device's errors."""


@dataclass(frozen=True)
class Errors:
    """Relative errors in the maximum norm, by output and by input."""

    outputs: dict[str, float]
    gradients: dict[str, float]

    @classmethod
    def between(cls, got: Outcome, truth: Outcome) -> "Errors":
        """Array by array."""
        return cls(
            {name: relative_error(got.outputs[name], of) for name, of in truth.outputs.items()},
            {name: relative_error(got.gradients[name], of) for name, of in truth.gradients.items()},
        )


@dataclass(frozen=True)
class Row:
    """What came of one case."""

    family: str
    knob: float
    errors: Errors
    bounds: Bounds
    peers: dict[str, Errors] = field(default_factory=dict)

    @property
    def broken(self) -> list[str]:
        """Outputs, and gradients as "grad_NAME", whose error is above its bound."""
        pairs = {name: (error, self.bounds.outputs[name]) for name, error in self.errors.outputs.items()}
        pairs |= {f"grad_{name}": (error, self.bounds.gradients[name]) for name, error in self.errors.gradients.items()}
        return [name for name, (error, bound) in pairs.items() if not error <= bound]

    @property
    def output(self) -> str:
        """The output with the largest error."""
        return max(self.errors.outputs, key=self.errors.outputs.__getitem__)

    @property
    def gradient(self) -> str:
        """The input whose gradient has the largest error."""
        return max(self.errors.gradients, key=self.errors.gradients.__getitem__)


def main(config: StabilityBench) -> int:
    """Measure, print and write.

    Returns:
        The exit status: 1 if a bound is broken, else 0.

    Raises:
        ValueError: a family that isn't known, or a number of threads that is not positive.
        DeviceError: no such device, or none with float64 for the truth.
    """
    families = _chosen(config)
    console = _results.console()
    rows: list[list[Row]] = []

    def measure(session: opencl.Session) -> Results:
        _results.show_machine(_results.describe(session), console)
        with _timing.torch_threads(config.threads):
            found = list(measure_rows(families, config, console))
        result = report(session, config, found)
        rows.append(found)
        return result

    results = _results.measure_each(config.device, measure, console)
    _results.save(results, config.json, config.markdown)
    if config.plots is not None:
        for session_rows, result in zip(rows, results, strict=True):
            path = _stability_plots.draw(session_rows, families, result.machine["device"], config.plots)
            _results.tell_written(console, path)
    broken = [f"{row.family} {row.knob:g}: {', '.join(row.broken)}" for of in rows for row in of if row.broken]
    for line in broken:
        console.print(f"[red]bound broken[/]: {line}", soft_wrap=True, highlight=False)
    if not broken:
        console.print(f"[green]all bounds kept[/] in {sum(map(len, rows))} cases", highlight=False)
    return 1 if broken else 0


def _chosen(config: StabilityBench) -> list[Family]:
    _results.check_positive(config, "threads")
    known = {family.name: family for family in FAMILIES}
    for name in config.families:
        if name not in known:
            raise ValueError(f"`families` must be of {', '.join(known)}, got {name}")
    return [known[name] for name in config.families] or list(FAMILIES)


def measure_rows(families: list[Family], config: StabilityBench, console: Console) -> Iterator[Row]:
    """Run all cases on the current device, and print each family's table."""
    for family in families:
        rows = []
        for case in family.cases(config.seed, config.quick):
            with console.status(case.name):
                rows.append(measure_case(case, config.peers))
        console.print(to_rich(grid(family, rows)))
        yield from rows


def measure_case(case: Case, peers: bool = True) -> Row:
    """Errors of one case on the current device, their bounds, and the peers' errors."""
    with _float64():
        truth = evaluate(case, OPERATORS, torch.float64)
        bounds = bounds_of(case, truth)
    errors = _errors(case, OPERATORS, truth)
    others = {
        name: _errors(case, of, truth, LEFT_OUT.get(name)) for name, of in (peers_of(case) if peers else {}).items()
    }
    return Row(case.family, case.knob, errors, bounds, others)


def _errors(case: Case, operators: Operators, truth: Outcome, left_out: str | None = None) -> Errors:
    errors = Errors.between(evaluate(case, operators, torch.float32), truth)
    return Errors(errors.outputs, {name: of for name, of in errors.gradients.items() if name != left_out})


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


# ---------------------------------------------------------------- report


def report(session: opencl.Session, config: StabilityBench, rows: list[Row]) -> Results:
    """Of one device."""
    measures = []
    for row in rows:
        for kind, value in (
            ("output", row.errors.outputs[row.output]),
            ("gradient", row.errors.gradients[row.gradient]),
        ):
            measures.append(Measure(f"{row.family} {row.knob:g}, {kind}", "1", value, value, value))
    by_family = {family: [row for row in rows if row.family == family.name] for family in FAMILIES}
    grids = [grid(family, own) for family, own in by_family.items() if own]
    details = {"norm": _NORM, "unit_roundoff": UNIT, "rows": [_as_details(row) for row in rows]}
    return Results("stability", _results.describe(session), _results.settings(config), measures, grids, details)


def _as_details(row: Row) -> dict[str, Any]:
    return {"kept": not row.broken, "broken": row.broken, **vars(row)}


def grid(family: Family, rows: list[Row]) -> Grid:
    """The table of one family."""
    names = list(dict.fromkeys(name for row in rows for name in row.peers))
    peers = [f"{name} {kind}" for name in names for kind in ("output", "gradient")]
    heading = ("", "output", "its bound", "gradient", "of", "its bound", "", *peers)
    lines = []
    for row in rows:
        beside = [cell for name in names for cell in _peer_cells(row.peers.get(name))]
        output, gradient = row.output, row.gradient
        ours = (f"{row.knob:.4g}", _cell(row.errors.outputs[output]), _cell(row.bounds.outputs[output]))
        back = (_cell(row.errors.gradients[gradient]), gradient, _cell(row.bounds.gradients[gradient]))
        lines.append((*ours, *back, "broken" if row.broken else "kept", *beside))
    notes = (_NORM, *(NOTES[name] for name in names))
    return Grid(f"{family.name}: relative error of float32 over the {family.knob}", heading, tuple(lines), notes)


def _peer_cells(errors: Errors | None) -> tuple[str, str]:
    if errors is None:
        return "-", "-"
    return _cell(max(errors.outputs.values())), _cell(max(errors.gradients.values()))


def _cell(value: float) -> str:
    return f"{value:.1e}" if value else "0"

"""`vestcl bench stability`: float32 against float64 at the extremes of what vestcl computes, with bounds that it keeps.

Each case runs twice on the same numbers, in float32 and in float64, forward and backward. The error of an array is
    max |a - b| / max |b|,   a in float32, b in float64:
the maximum norm, over image or coverage (or displacement), and over the gradient of each input separately. Its bounds,
and others' operators, are from vestcl.bench.stability.operators.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pandas as pd  # type: ignore[import-untyped]
import torch
from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common.estimate import announced
from vestcl.bench.common.options import Options
from vestcl.bench.common.plots import Curve, curves
from vestcl.bench.common.table import Measurement, Section
from vestcl.bench.stability import measured
from vestcl.bench.stability.cases import FAMILIES, Case, Family, Inputs
from vestcl.bench.stability.operators import OPERATORS, Operators, noisy_operators, peers_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Runs with noise, and the bound in units of the worst of them: a maximum differs less from draw to draw.
_DRAWS: Final = 3
_SAFETY: Final = 3.0

Outcome = dict[str, Inputs]
"""What a program computes: "outputs" ("image" and "coverage", or "displacement_xyz") and "gradients" by input."""

Errors = dict[str, dict[str, float]]
"""A relative error for each array of an `Outcome`."""


Row = dict[str, Any]
"""A case: "broken" (arrays), "errors", "bounds", and "peers" (errors by name)."""

_NORM: Final = "Errors are max |float32 - float64| / max |float64| over each array; shown is the worst array's."

_ABOUT: Final = {
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
    keep: Path | None = None
    """File for the largest errors of five seeds on each device: bounds follow from
    vestcl/bench/stability/measured.json."""


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
    broken = dict[str, list[str]]()

    def measure(session: opencl.Session, console: Console) -> Iterator[Section]:
        families = [known[name] for name in config.families] or list(FAMILIES)
        for family in announced(families, console, "families of inputs"):
            with console.status(family.name):
                rows = {case: measure_case(case, config.peers) for case in family.cases(config.seed, config.quick)}
            broken.update({case.name: row["broken"] for case, row in rows.items()})
            cells = [cell for case, row in rows.items() for cell in _cells(case, row)]
            title = f"{family.name}: relative error of float32 over the {family.knob}"
            notes = (
                _NORM,
                *(_ABOUT[name] for name in dict.fromkeys(name for row in rows.values() for name in row["peers"])),
            )
            yield Section(title, cells, notes, {family.name: partial(draw, family)})
        if config.keep is not None:
            with console.status(f"errors of {len(measured.SEEDS)} seeds"):
                name = f"{session.info.name}, {session.info.platform}"
                measured.keep(config.keep, name, _errors_by_seed(families))

    _results.run("stability", config, measure)
    console = _results.console()
    for name, arrays in broken.items():
        if arrays:
            console.print(f"[red]bound broken[/]: {name}: {', '.join(arrays)}", soft_wrap=True, highlight=False)
    if not any(broken.values()):
        console.print(f"[green]all bounds kept[/] in {len(broken)} cases", highlight=False)
    return 1 if any(broken.values()) else 0


def measure_case(case: Case, peers: bool = True) -> Row:
    """Errors of one case on the current device, their bounds, and the peers' errors."""
    with _float64():
        truth = evaluate(case, OPERATORS, torch.float64)
        bounds = bounds_of(case, truth)
    errors, *of_others = (
        relative_errors(evaluate(case, operators, torch.float32), truth)
        for operators in (OPERATORS, *(dict(peers_of(case.program)).values() if peers else ()))
    )
    others = dict(zip(dict(peers_of(case.program)), of_others, strict=False))
    # The background that "clamping" lets through is not a matter of precision.
    others.get("clamping", {"gradients": {}})["gradients"].pop("backgrounds", None)
    return {"broken": broken_bounds(errors, bounds), "errors": errors, "bounds": bounds, "peers": others}


def _errors_by_seed(families: list[Family]) -> dict[str, list[Errors]]:
    """By case, the errors for each of `measured.SEEDS` on the current device."""
    found: dict[str, list[Errors]] = {}
    for case in (case for family in families for seed in measured.SEEDS for case in family.cases(seed, quick=False)):
        with _float64():
            truth = evaluate(case, OPERATORS, torch.float64)
        errors = relative_errors(evaluate(case, OPERATORS, torch.float32), truth)
        found.setdefault(case.name, []).append(errors)
    return found


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


def _cells(case: Case, row: Row) -> Iterator[Measurement]:
    knob = f"{case.knob:.4g}"
    for kind, label in _KINDS.items():
        array = worst(row["errors"][kind])
        yield Measurement(knob, label, row["errors"][kind][array], digits=".1e", name=f"{case.name}, {label}")
        if kind == "gradients":
            yield Measurement(knob, "of", array)
        yield Measurement(knob, f"{label} bound", row["bounds"][kind][array], digits=".1e")
    yield Measurement(knob, "bounds", "broken" if row["broken"] else "kept")
    for peer, errors in row["peers"].items():
        for kind, label in _KINDS.items():
            yield Measurement(knob, f"{peer} {label}", errors[kind][worst(errors[kind])], digits=".1e")


def worst(errors: Mapping[str, float]) -> str:
    """The array with the largest error."""
    return max(errors, key=lambda name: errors[name])


def draw(family: Family, frame: pd.DataFrame, _: str) -> "Figure":
    """Errors, bounds and peers over the knob; a knob of 0 is drawn at a tenth of the least other one."""
    knobs = frame["row"].astype(float)
    zero = knobs[knobs > 0].min() / 10
    own = frame.assign(x=knobs.mask(knobs == 0, zero), y=frame["median"].clip(*_LIMITS))
    label = f"{family.knob}{f' (0 is drawn at {zero:.2g})' if (knobs == 0).any() else ''}"
    title = f"{family.name}: relative error of float32 against float64, maximum norm"
    lines = [
        Curve(str(name), [*of["x"]], [*of["y"]], "o-" if name in _KINDS.values() else "o--")
        for name, of in own.dropna(subset="median").groupby("column", sort=False)
    ]
    return curves(title, label, {"relative error": lines})


# ---------------------------------------------------------------- programs


def evaluate(case: Case, operators: Operators, dtype: torch.dtype) -> Outcome:
    """Run a case forward and backward.

    Args:
        case: whose inputs are rounded to ``dtype``.
        operators: that compute.
        dtype: float32 or float64.

    Returns:
        Outputs, and gradients of the sum of outputs times weights that are uniform in [-1, 1] and exact in float32.
    """
    inputs = {name: value.to(dtype) for name, value in case.inputs.items()}
    for name in case.differentiated:
        inputs[name].requires_grad_()
    outputs = _PROGRAMS[case.program](case, operators, inputs)
    generator = torch.Generator().manual_seed(case.seed)
    gradients = torch.autograd.grad(
        list(outputs.values()),
        [inputs[name] for name in case.differentiated],
        [(2 * torch.rand(of.shape, generator=generator).double() - 1).to(dtype) for of in outputs.values()],
        allow_unused=True,
        materialize_grads=True,
    )
    values = {name: output.detach() for name, output in outputs.items()}
    return {"outputs": values, "gradients": dict(zip(case.differentiated, gradients, strict=True))}


def bounds_of(case: Case, truth: Outcome) -> Errors:
    """The largest errors that roundings of float32 explain, array by array, and no more than `measured` allows.

    Args:
        case: whose program ran.
        truth: its outcome in float64.
    """
    operators = noisy_operators(torch.Generator().manual_seed(case.seed))
    draws = [relative_errors(evaluate(case, operators, torch.float64), truth) for _ in range(_DRAWS)]
    rounding = {
        kind: {name: _SAFETY * max(draw[kind][name] for draw in draws) for name in arrays}
        for kind, arrays in truth.items()
    }
    return measured.tightened(case.name, rounding)


def relative_errors(got: Outcome, truth: Outcome) -> Errors:
    """`relative_error` array by array."""
    return {kind: {name: relative_error(got[kind][name], of) for name, of in truth[kind].items()} for kind in truth}


def relative_error(got: torch.Tensor, wanted: torch.Tensor) -> float:
    """max |got - wanted| / max |wanted| over a whole array: the maximum norm.

    Args:
        got: of any precision.
        wanted: of the same shape.

    Returns:
        The error; 0 where both are equal, infinity where only ``wanted`` is 0 or ``got`` is not finite.
    """
    difference = (got.double() - wanted.double()).abs().max().item() if got.numel() else 0.0
    if difference == 0:
        return 0.0
    scale = wanted.double().abs().max().item()
    return difference / scale if scale > 0 and difference < float("inf") else float("inf")


def _splat(case: Case, operators: Operators, inputs: Inputs) -> Inputs:
    looks = (inputs[name] for name in ("radii", "opacities", "features"))
    background = inputs["backgrounds"]
    image, coverage = operators.splat(inputs["points_uv"], inputs["z"], *looks, case.height, case.width, background)
    return {"image": image, "coverage": coverage}


def _view(case: Case, operators: Operators, inputs: Inputs) -> Inputs:
    """Unproject, move step by step, project, splat, in the order of the source depths."""
    points_xyz = operators.unproject(inputs["depth"], inputs["source_K"])
    steps = list(zip(inputs["quaternion"].split(1), inputs["translation"].split(1), strict=True))
    for quaternion, translation in steps[:-1]:
        points_xyz = operators.add(points_xyz, operators.rigid_flow(points_xyz, quaternion, translation))
    displacement_xyz = operators.rigid_flow(points_xyz, *steps[-1])
    points_uv, _ = operators.displace(points_xyz, displacement_xyz, inputs["K"], inputs["tgt_from_src"])
    return _splat(case, operators, inputs | {"points_uv": points_uv, "z": inputs["depth"].detach().reshape(1, -1)})


def _flow(case: Case, operators: Operators, inputs: Inputs) -> Inputs:
    return {"displacement_xyz": operators.rigid_flow(*(inputs[name] for name in case.differentiated))}


_PROGRAMS: Final[dict[str, Callable[[Case, Operators, Inputs], dict[str, Any]]]] = {
    "splat": _splat,
    "view": _view,
    "flow": _flow,
}

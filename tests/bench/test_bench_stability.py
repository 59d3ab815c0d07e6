"""`vestcl bench stability`: truth, bounds and peers, and what the command prints and writes."""

import dataclasses
import decimal
import json
import math
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest
import torch

from vestcl import constants, opencl, reference
from vestcl.bench.common import results as _results
from vestcl.bench.stability import bench as stability
from vestcl.bench.stability import measured
from vestcl.bench.stability.bench import (
    Errors,
    StabilityBench,
    bounds_of,
    broken_bounds,
    evaluate,
    relative_error,
    relative_errors,
    worst,
)
from vestcl.bench.stability.cases import FAMILIES, SIZE, Case, clear_radii, projected
from vestcl.bench.stability.operators import OPERATORS, UNIT, Operators, growth, list_layers

REFERENCE = Operators(reference.unproject, reference.rigid_flow, reference.displace, reference.splat)

#: Roundings of float64 are so much smaller than float32's.
FINER = 2.0**-53 / UNIT


def cases(*names: str) -> list[Case]:
    chosen = [family for family in FAMILIES if not names or family.name in names]
    return [fewer(case) for family in chosen for case in family.cases(0, quick=True)]


def fewer(case: Case, count: int = 100) -> Case:
    """Of points that each reach all pixels, the first: they show as much as all."""
    if case.inputs.get("radii", torch.zeros(1)).min() < 10 * max(SIZE):
        return case
    kept = {name: value if name == "backgrounds" else value[:, :count] for name, value in case.inputs.items()}
    return dataclasses.replace(case, inputs=kept)


def case_at(family: str, knob: float) -> Case:
    return next(case for case in cases(family) if case.knob == knob)


def misses(errors: Errors, bounds: Errors, factor: float = 1.0) -> list[str]:
    """Arrays whose errors are above ``factor`` times their bounds."""
    wider = {kind: {name: factor * bound for name, bound in arrays.items()} for kind, arrays in bounds.items()}
    return [name.removeprefix("grad_") for name in broken_bounds(errors, wider)]


def with_splat(splat: Any) -> Operators:
    return dataclasses.replace(OPERATORS, splat=splat)


# ---------------------------------------------------------------- truth and bounds


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_float32_keeps_the_bounds_and_float64_tighter_ones(case: Case) -> None:
    """The truth, against the reference in float64, keeps bounds that are 2^29 times tighter, for two that round.

    Rigid flows are compared with 50 digits: the reference takes their difference, which the truth does not.
    """
    row = stability.measure_case(case, peers=False)
    assert not row["broken"]
    truth = evaluate(case, OPERATORS, torch.float64)
    if case.program == "flow":
        few = {"outputs": {"displacement_xyz": error_of_motion(case, truth["outputs"]["displacement_xyz"])}}
    else:
        few = relative_errors(evaluate(case, REFERENCE, torch.float64), truth)
    assert not misses(few, row["bounds"], 2 * FINER)


def error_of_motion(case: Case, displacement_xyz: torch.Tensor, count: int = 20) -> float:
    """Of the first points' displacement, against R x + t - x in 50 decimal digits."""
    with decimal.localcontext(decimal.Context(prec=50)):
        points, quaternion, translation = (
            [[Decimal(number) for number in row] for row in case.inputs[name].reshape(-1, width)[:count].tolist()]
            for name, width in (("points_xyz", 3), ("quaternion", 4), ("translation", 3))
        )
        length = max(sum(number**2 for number in quaternion[0]).sqrt(), Decimal(repr(constants.QUATERNION_FLOOR)))
        w, x, y, z = (number / length for number in quaternion[0])
        R = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
             [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
             [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
        wanted = [
            [float(sum(R[i][j] * p[j] for j in range(3)) + translation[0][i] - p[i]) for i in range(3)] for p in points
        ]
    return relative_error(displacement_xyz[0, :count], torch.tensor(wanted, dtype=torch.float64))


@pytest.mark.parametrize("case", cases("layers", "opacity", "angle", "recursion"), ids=lambda case: case.name)
def test_every_mapping_keeps_the_bounds(mapped_session: opencl.Session, case: Case) -> None:
    assert stability.measure_case(case, peers=False)["broken"] == []


@pytest.mark.parametrize("family", ["depth range", "layers", "opacity", "size", "recursion"])
def test_bounds_are_no_wider_than_a_thousand_errors(family: str) -> None:
    """Else they would prove nothing: every case's largest error comes within three digits of its bound."""
    for case in cases(family):
        row = stability.measure_case(case, peers=False)
        for kind, errors in row["errors"].items():
            assert row["bounds"][kind][worst(errors)] < 1e3 * errors[worst(errors)]


@pytest.mark.parametrize("case", cases("layers", "opacity", "angle"), ids=lambda case: case.name)
def test_bounds_are_at_most_eight_times_what_was_measured(case: Case) -> None:
    """On any device; an error below one rounding counts as one."""
    kept = [device[case.name] for device in measured.read(measured.FILE).values()]
    assert len(kept) >= 2
    for kind, bounds in bounds_of(case, evaluate(case, OPERATORS, torch.float64)).items():
        for name, bound in bounds.items():
            assert bound <= 8 * max(UNIT, *(errors[kind][name] for errors in kept))


def test_what_is_kept_only_falls(tmp_path: Path) -> None:
    path = tmp_path / "measured.json"

    def of(error: float) -> Errors:
        return {"outputs": {"image": error, "coverage": 1e-7}}

    measured.keep(path, "a", {"opacity 0": [of(1e-6), of(3e-6)], "opacity 1": [of(1.0)]})
    measured.keep(path, "b", {"opacity 0": [of(5e-6)]})
    measured.keep(path, "a", {"opacity 0": [of(4e-6)]})
    assert measured.read(path)["a"]["opacity 0"]["outputs"] == {"image": 3e-6, "coverage": 1e-7}
    measured.keep(path, "a", {"opacity 0": [of(2e-6)]})
    assert measured.read(path)["a"]["opacity 0"]["outputs"]["image"] == 2e-6
    assert measured.read(path)["a"]["opacity 1"]["outputs"]["image"] == 1.0
    assert measured.read(path)["b"]["opacity 0"]["outputs"]["image"] == 5e-6


@pytest.mark.parametrize("name", ["features", "opacities", "radii", "points_uv"])
def test_half_of_float32s_digits_break_a_bound(name: str) -> None:
    """splat of one input in bfloat16's neighbourhood: 12 bits instead of 24."""
    case = case_at("radius", 1.5)
    truth = evaluate(case, OPERATORS, torch.float64)
    blunt = dict(case.inputs)
    blunt[name] = case.inputs[name] * (1 + 2.0**-12)
    errors = relative_errors(evaluate(dataclasses.replace(case, inputs=blunt), OPERATORS, torch.float32), truth)
    assert misses(errors, bounds_of(case, truth))


def test_a_motion_computed_by_subtraction_breaks_its_bound() -> None:
    row = stability.measure_case(case_at("angle", 1e-6))
    assert not row["broken"]
    assert misses(row["peers"]["R x + t - x"], row["bounds"]) == ["displacement_xyz", "points_xyz"]


def test_bounds_are_the_same_every_time() -> None:
    case = case_at("recursion", 5)
    truth = evaluate(case, OPERATORS, torch.float64)
    assert bounds_of(case, truth) == bounds_of(case, truth)


def test_growth() -> None:
    assert [growth(n) for n in (1, 4, 9, 16, 100)] == [1, 4, 9, 12, 30]


@pytest.mark.parametrize(
    ("got", "wanted", "error"),
    [
        ([1.0, -4.5], [1.0, -4.0], 0.125),
        ([0.0, 0.0], [0.0, 0.0], 0.0),
        ([1e-30, 0.0], [0.0, 0.0], math.inf),
        ([math.nan, 1.0], [1.0, 1.0], math.inf),
        ([math.inf, 1.0], [1.0, 1.0], math.inf),
        ([], [], 0.0),
    ],
)
def test_relative_error(got: list[float], wanted: list[float], error: float) -> None:
    assert relative_error(torch.tensor(got), torch.tensor(wanted)) == error


# ---------------------------------------------------------------- inputs


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_float32_holds_every_input(case: Case) -> None:
    for value in case.inputs.values():
        assert value.dtype == torch.float64 and torch.equal(value, value.float().double())


@pytest.mark.parametrize("wanted", [0.5, 1.8, 8.0, 100.0])
def test_radii_keep_clear_of_pixel_centres(wanted: float) -> None:
    points_uv = torch.rand(50, 2).double() * torch.tensor([52, 36])
    radii = clear_radii(points_uv, wanted, *SIZE)
    y, x = torch.meshgrid(torch.arange(36) + 0.5, torch.arange(52) + 0.5, indexing="ij")
    distances = (torch.stack([x, y], -1).reshape(-1, 1, 2) - points_uv).norm(dim=-1)
    assert (distances / radii - 1).abs().min() > 1e-4
    assert ((radii / wanted - 1).abs() <= 0.15).all()


def test_a_view_is_where_its_radii_were_chosen() -> None:
    """The operators project to the points that radii keep clear of."""
    seen: list[torch.Tensor] = []

    def looking(points_uv: torch.Tensor, *others: Any) -> tuple[torch.Tensor, torch.Tensor]:
        seen.append(points_uv.detach()[0])
        return OPERATORS.splat(points_uv, *others)

    case = case_at("recursion", 5)
    evaluate(case, with_splat(looking), torch.float64)
    torch.testing.assert_close(seen[0], projected(case.inputs), rtol=1e-12, atol=1e-10)


def test_layers_by_hand() -> None:
    """Two points on 3 x 1 pixels: the far one comes first in memory and reaches all, the near one only the middle."""
    uv, z, radii = torch.tensor([[1.5, 0.5], [1.5, 0.5]]), torch.tensor([4.0, 2.0]), torch.tensor([2.0, 0.5])
    layers = list_layers(uv, z, radii, 1, 3)
    found = [sorted(zip(layers.pixels[s].tolist(), layers.points[s].tolist(), strict=True)) for s in layers.slices]
    assert found == [[(0, 0), (1, 1), (2, 0)], [(1, 0)]]
    assert layers.centres[:, 0].tolist() == (layers.pixels + 0.5).tolist() and set(layers.centres[:, 1].tolist()) == {
        0.5
    }


# ---------------------------------------------------------------- peers


@pytest.mark.parametrize("name", ["dividing", "clamping"])
def test_peers_splat_as_well_as_vestcl_where_nothing_is_opaque(name: str) -> None:
    for case in (case_at("opacity", 0.5), case_at("layers", 100), case_at("size", 64)):
        row = stability.measure_case(case)
        assert not misses(row["peers"][name], row["bounds"])


def test_a_dividing_backward_loses_what_is_behind_opaque_points() -> None:
    """Its image is right, the gradients through alpha are not; at 1 - 2^-24 one in a hundred is already lost."""
    opaque = stability.measure_case(case_at("opacity", 0))
    peer = opaque["peers"]["dividing"]
    assert not opaque["broken"]
    assert not set(misses(peer, opaque["bounds"])) & {"image", "coverage", "features"}
    assert peer["gradients"]["opacities"] > 0.5
    nearly = stability.measure_case(case_at("opacity", 2.0**-24))
    assert not nearly["broken"] and nearly["peers"]["dividing"]["gradients"]["opacities"] > 5e-3


def test_clamping_changes_the_image() -> None:
    peer = stability.measure_case(case_at("opacity", 0))["peers"]["clamping"]
    assert 1e-3 < peer["outputs"]["image"] < 2e-2
    assert peer["gradients"]["opacities"] > 1e-3
    assert "backgrounds" not in peer["gradients"]


# ---------------------------------------------------------------- the command


def test_a_run_writes_and_prints_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {name: tmp_path / "new" / f"stability.{name}" for name in ("json", "markdown")}
    config = StabilityBench(quick=True, families=("opacity", "angle"), plots=tmp_path / "plots", **files)
    assert stability.main(config) == 0
    printed, content = capsys.readouterr().out, json.loads(files["json"].read_text(encoding="utf-8"))
    figures = [row["name"] for row in content["devices"][0]["measures"] if row["name"]]
    chosen = cases("opacity", "angle")
    assert figures == [f"{case.name}, {kind}" for case in chosen for kind in ("output", "gradient")]
    (loaded,) = _results.load(files["json"])
    columns = loaded.frame.groupby("table")["column"].agg(set)
    assert {"dividing gradient", "clamping output", "gradient bound"} <= columns.iloc[1]
    assert {"R x + t - x output"} <= columns.iloc[0] and "dividing output" not in columns.iloc[0]
    markdown = files["markdown"].read_text(encoding="utf-8")
    for text in ("opacity: relative error", "angle: relative error", "dividing gradient", "kept"):
        assert text in markdown
    assert "all bounds kept in 5 cases" in printed
    plots = {path.name: path.read_bytes() for path in (tmp_path / "plots").iterdir()}
    assert set(plots) == {"opacity.png", "angle.png"} and all(of.startswith(b"\x89PNG") for of in plots.values())


def test_a_broken_bound_is_told_and_counts(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def nothing_allowed(case: Case, truth: Any) -> Errors:
        return {kind: dict.fromkeys(truth[kind], bound) for kind, bound in (("outputs", 0.0), ("gradients", 1.0))}

    monkeypatch.setattr(stability, "bounds_of", nothing_allowed)
    assert stability.main(StabilityBench(quick=True, families=("angle",), peers=False)) == 1
    printed = capsys.readouterr().out
    assert "bound broken: angle 1e-06: displacement_xyz" in printed and "grad_" not in printed


def test_a_nan_breaks_a_bound() -> None:
    errors = {"outputs": {"image": 0.0}, "gradients": {"depth": math.nan}}
    assert broken_bounds(errors, {"outputs": {"image": 0.0}, "gradients": {"depth": 1.0}}) == ["grad_depth"]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("families", ("depths",), "`families` must be of depth, .*, got depths"), ("threads", 0, "`threads` .* got 0")],
)
def test_what_it_refuses(name: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        stability.main(StabilityBench(quick=True, **{name: value}))


def test_without_float64_there_is_no_truth(monkeypatch: pytest.MonkeyPatch, session: opencl.Session) -> None:
    info = dataclasses.replace(session.info, float64=False)
    monkeypatch.setattr(session, "info", info)
    monkeypatch.setattr(opencl, "select", lambda: info)
    monkeypatch.setattr(opencl, "devices", lambda: [info])
    with pytest.raises(opencl.DeviceError, match="no OpenCL device has float64"):
        stability.measure_case(case_at("angle", 1e-6))

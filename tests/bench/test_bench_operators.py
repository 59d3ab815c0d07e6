"""`vestcl bench operators`: that it runs, counts and writes what it should. No time is judged."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common.timing import LEAST_ROUNDS
from vestcl.bench.splat import kernels, operators, roofline
from vestcl.bench.splat.operators import PASSES, OperatorsBench

#: Nothing runs longer than its least number of rounds.
TINY: dict[str, Any] = {"height": 16, "width": 24, "channels": 5, "seconds": 1e-3}

NAMES = ["unproject", "rigid_flow", "displace", "splat"]


def test_a_run_writes_and_prints_everything(
    session: opencl.Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    files = {name: tmp_path / "new" / f"results.{name}" for name in ("json", "markdown", "trace")}
    operators.main(OperatorsBench(**TINY, **files, device=session.info.index, plots=tmp_path / "plots"))
    printed = capsys.readouterr().out
    (result,) = _results.load(files["json"])
    assert result.bench == "operators"
    assert result.config["channels"] == 5 and result.config["json"] == str(files["json"])
    assert result.machine["device"].startswith(session.info.index)
    names = [f"{name} {what}" for name in NAMES for what in PASSES]
    endings = ("", _results.X_COPY, ", kernels", ", around kernels", ", twin / vestcl")
    assert [*result.figures["name"]] == [name + ending for name in names for ending in endings]
    for figure in result.figures.itertuples():
        assert figure.low <= figure.median <= figure.high
        assert figure.low > 0 or figure.name.endswith("around kernels"), figure.name
    columns = dict(list(result.frame.groupby("column")))
    assert (columns["ms (quartiles)"]["runs"] >= LEAST_ROUNDS).all()
    assert (columns["kernels ms"]["runs"] == kernels.CALLS).all()
    assert (columns["error"]["median"] < 1e-4).all(), "operator and reference do the same"
    text = files["markdown"].read_text(encoding="utf-8")
    for name in names:
        assert name in printed and f"| {name} |" in text
    assert "x copy" in printed and "GB/s" in printed and f"wrote {tmp_path / 'plots'}" in printed
    assert len(list((tmp_path / "plots").glob("*.png"))) == 2
    assert_trace_shows(json.loads(files["trace"].read_text(encoding="utf-8"))["traceEvents"])


def assert_trace_shows(events: list[dict[str, Any]]) -> None:
    """Each operator's stage, its calls in it, and a call's kernels in the call."""
    spans = [event for event in events if event["ph"] == "X"]
    ends = {id(event): event["ts"] + event["dur"] for event in spans}

    def inside(outer: dict[str, Any], kind: str) -> list[str]:
        first, last = outer["ts"], ends[id(outer)]
        return [e["name"] for e in spans if e["cat"] == kind and first <= e["ts"] and ends[id(e)] <= last]

    stages = {event["name"]: event for event in spans if event["cat"] == "stage"}
    for name in NAMES:
        assert inside(stages[name], "stage").count(f"{name} {PASSES[0]}, vestcl") >= LEAST_ROUNDS
    assert inside(stages[f"unproject {PASSES[0]}, vestcl"], "kernel") == ["unproject"]
    assert inside(stages[f"unproject {PASSES[1]}, vestcl"], "kernel") == ["unproject", "unproject_backward"]
    assert inside(stages[f"unproject {PASSES[1]}, reference"], "kernel") == []


def test_the_roofline_is_an_option(
    session: opencl.Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(roofline, "CALLS", 1)
    path = tmp_path / "results.json"
    size = {"height": 32, "width": 48}  # few points have kernels of their own, which no roof is for
    operators.main(
        OperatorsBench(**TINY | size, roofline=True, device=session.info.index, json=path, plots=tmp_path / "plots")
    )
    (result,) = _results.load(path)
    names = [*result.figures["name"]]
    assert "splat forward" in names and "roofline bandwidth, radius 1" in names and len(names) == len({*names})
    assert (result.frame["column"] == "bound by").sum() >= 6
    assert "Roofline, 32x48, C = 5, radius 1 px" in capsys.readouterr().out
    assert len(list((tmp_path / "plots").glob("*.png"))) == 3


def test_bytes_are_those_of_the_arrays() -> None:
    by_name = {operator.name: operator for operator in operators.operators(OperatorsBench(**TINY))}
    assert list(by_name) == NAMES
    points, real = 16 * 24, 4
    forward = {
        "unproject": (points + 9) + 3 * points,
        "rigid_flow": (3 * points + 4 + 3) + 3 * points,
        "displace": (6 * points + 9) + 3 * points,
        "splat": (2 + 1 + 1 + 1 + 5) * points + (5 + 1) * points,
    }
    backward = {
        "unproject": 3 * points + points,
        "rigid_flow": 3 * points + (3 * points + 7) + (3 * points + 7),
        "displace": 3 * points + (6 * points + 9) + 6 * points,
        "splat": 6 * points + 10 * points + (2 + 1 + 1 + 5) * points,
    }
    for name, operator in by_name.items():
        moved = operators._moved_bytes(operator, operator.run(operator.ours))
        assert moved == {PASSES[0]: real * forward[name], PASSES[1]: real * (forward[name] + backward[name])}


def test_passes_leave_the_arguments_alone() -> None:
    for operator in operators.operators(OperatorsBench(**TINY)):
        before = [value.clone() for value in operator.arguments if isinstance(value, torch.Tensor)]
        outputs = operator.run(operator.ours)
        assert not any(output.requires_grad for output in outputs)
        grads = operator.run_both(operator.ours, tuple(map(torch.ones_like, outputs)))
        assert [grad.shape for grad in grads] == [operator.arguments[i].shape for i in operator.differentiated]
        after = [value for value in operator.arguments if isinstance(value, torch.Tensor)]
        assert all(torch.equal(one, two) and not two.requires_grad for one, two in zip(before, after, strict=True))


@pytest.mark.parametrize("name", ["height", "width", "channels", "radius", "seconds", "threads"])
def test_mistakes(name: str) -> None:
    with pytest.raises(ValueError, match=f"`{name}` must be positive, got 0"):
        operators.main(OperatorsBench(**{**TINY, name: 0}))

"""`vestcl bench compare`: what counts as a change, what is told, and how it ends."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from vestcl.bench.common import compare
from vestcl.bench.common import results as _results
from vestcl.bench.common.compare import CompareBench
from vestcl.bench.common.results import X_COPY, Results
from vestcl.bench.common.table import Measurement, Section
from vestcl.bench.common.timing import Spread
from vestcl.cli import main as cli


def measure(name: str, median: float, spread: float = 0.1, unit: str = "s", better: str = "lower") -> Measurement:
    values = Spread(median, median * (1 - spread), median * (1 + spread), 1)
    return Measurement(name, "", values, unit, name=name, better=better)  # type: ignore[arg-type]


def frame(measures: Sequence[Measurement]) -> pd.DataFrame:
    return Section("", measures).frame if measures else pd.DataFrame(columns=_results.COLUMNS)


def results(*measures: Measurement, bench: str = "splat", **machine: str) -> Results:
    return Results(bench, {"device": "0:0 a", "date": "x", **machine}, {"height": 8}, frame(measures))


@pytest.fixture(autouse=True)
def _wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.setattr(_results, "WIDTH", 300)


@pytest.fixture
def files(tmp_path: Path) -> Any:
    """Writes two runs; their files' names."""

    def write(before: Results | list[Results], after: Results | list[Results]) -> list[str]:
        paths = [tmp_path / "before.json", tmp_path / "after.json"]
        for path, run in zip(paths, (before, after), strict=True):
            _results.save(run if isinstance(run, list) else [run], path, None)
        return [str(path) for path in paths]

    return write


def verdicts(before: list[Measurement], after: list[Measurement]) -> list[str]:
    return list(compare.compare(frame(before), frame(after))["verdict"])


def changes(before: list[Measurement], after: list[Measurement]) -> list[Any]:
    return list(compare.compare(frame(before), frame(after)).itertuples())


# ---------------------------------------------------------------- what counts as a change


@pytest.mark.parametrize(
    ("after", "better", "verdict"),
    [
        *((1.0, "lower", "noise"), (1.15, "lower", "noise"), (1.3, "lower", "worse"), (0.8, "lower", "better")),
        *((1.15, "higher", "noise"), (1.3, "higher", "better"), (0.8, "higher", "worse")),
    ],
)
def test_ranges_that_do_not_overlap_are_a_change(after: float, better: str, verdict: str) -> None:
    (change,) = changes([measure("a", 1.0, better=better)], [measure("a", after, better=better)])
    assert change.verdict == verdict and change.percent == pytest.approx(100 * (after - 1))
    assert (change.loss > 0) == (verdict == "worse") or verdict == "noise"


def test_what_has_no_noise_changes_by_any_difference() -> None:
    assert verdicts([measure("a", 100.0, 0, "B")], [measure("a", 101.0, 0, "B")]) == ["worse"]
    assert verdicts([measure("a", 100.0, 0, "B")], [measure("a", 100.0, 0, "B")]) == ["noise"]


@pytest.mark.parametrize(
    ("ratio", "expected"), [(4.0, ["machine", "noise"]), (8.0, ["worse", "worse"]), (2.0, ["machine", "better"])]
)
def test_a_time_changes_only_with_its_ratio_to_the_copy(ratio: float, expected: list[str]) -> None:
    before = [measure("a", 1.0), measure("a" + X_COPY, 4.0, unit="1")]
    assert verdicts(before, [measure("a", 2.0), measure("a" + X_COPY, ratio, unit="1")]) == expected


def test_a_ratio_in_one_run_alone_counts_for_nothing() -> None:
    before = [measure("a", 1.0), measure("a" + X_COPY, 4.0, unit="1")]
    assert verdicts(before, [measure("a", 2.0)]) == ["worse"]
    assert verdicts(before[:1], [measure("a", 2.0), before[1]]) == ["worse"]


def test_unknown_numbers_and_zeros() -> None:
    unknown = measure("a", math.nan)
    (change,) = changes([measure("a", 1.0)], [unknown])
    assert change.verdict == "noise" and math.isnan(change.percent)
    (change,) = changes([measure("a", 0.0, 0, "B")], [measure("a", 5.0, 0, "B")])
    assert change.verdict == "worse" and math.isnan(change.percent) and math.isnan(change.loss)


def test_units_must_agree() -> None:
    with pytest.raises(ValueError, match="`after` must have a in 's', got 'B'"):
        verdicts([measure("a", 1.0)], [measure("a", 1.0, unit="B")])


# ---------------------------------------------------------------- the command


@pytest.mark.parametrize(("limit", "code"), [(None, 0), (20.0, 1), (60.0, 0)])
def test_the_exit_code_tells_of_losses_above_the_limit(
    files: Any, capsys: pytest.CaptureFixture[str], limit: float | None, code: int
) -> None:
    before = results(measure("forward", 1.0), measure("peer", 4.0, unit="1", better="higher"))
    after = results(measure("forward", 1.5), measure("peer", 8.0, unit="1", better="higher"))
    limits = [] if limit is None else ["--fail-above", str(limit)]
    assert cli.main(["bench", "compare", *files(before, after), *limits]) == code
    printed = capsys.readouterr().out
    assert "1000 (900-1100)" in printed and "1500 (1350-1650)" in printed and "+50.0" in printed
    assert "worse" in printed and "better" in printed
    assert ("forward: worse by 50.0 %, more than 20 %" in printed) == bool(code)


def test_noise_and_the_machine_never_fail(files: Any) -> None:
    before = results(measure("noisy", 1.0, 0.9), measure("slow", 1.0), measure("slow" + X_COPY, 4.0, unit="1"))
    after = results(measure("noisy", 3.0, 0.9), measure("slow", 9.0), measure("slow" + X_COPY, 4.0, unit="1"))
    assert cli.main(["bench", "compare", *files(before, after), "--fail-above", "0"]) == 0


def test_what_else_differs_is_told(files: Any, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    before = results(measure("gone", 1.0), measure("both", 1.0), torch="1")
    after = results(measure("both", 1.0), measure("new", 1.0), torch="2", device="1:0 b", date="y", pocl="3")
    after = dataclasses.replace(after, config={"height": 9, "json": "other.json"})
    markdown = tmp_path / "new" / "changes.md"
    assert cli.main(["bench", "compare", *files(before, after), "--markdown", str(markdown)]) == 0
    printed = capsys.readouterr().out
    for text in (
        "torch differs: 1 before, 2 after",
        "device differs: 0:0 a before, 1:0 b after",
        "pocl differs: None before, 3 after",
        "height differs: 8 before, 9 after",
        "only before: gone",
        "only after: new",
    ):
        assert f"warning: {text}\n" in printed
    assert printed.count("warning") == 6, "neither the date nor files are told"
    assert "| both |" in markdown.read_text(encoding="utf-8")


def test_devices_are_compared_with_themselves(files: Any, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = results(measure("a", 1.0)), results(measure("b", 1.0), device="1:0 b")
    assert cli.main(["bench", "compare", *files([first, second], [second])]) == 0
    printed = capsys.readouterr().out
    assert "1:0 b" in printed and "0:0 a" not in printed


@pytest.mark.parametrize(
    ("after", "message"),
    [
        (results(bench="operators"), "must be of the same benchmark, got splat and operators"),
        ([results(device="1:0 b"), results(device="2:0 c")], "a device in common, got 0:0 a and 1:0 b, 2:0 c"),
    ],
)
def test_what_can_not_be_compared(files: Any, after: Any, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "compare", *files(results(), after)]) == 2
    assert message in capsys.readouterr().err


def test_mistakes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match=r"`fail_above` must be 0 or more, got -1.0"):
        compare.main(CompareBench(tmp_path / "a.json", tmp_path / "b.json", -1.0))
    assert cli.main(["bench", "compare", str(tmp_path / "a.json"), str(tmp_path / "b.json")]) == 2
    assert "a.json" in capsys.readouterr().err

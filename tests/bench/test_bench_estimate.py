"""How long a bench takes, said before it does; what `--no-reference` leaves out."""

import io
import time
from collections.abc import Iterator

import pytest
from rich.console import Console

from vestcl.bench.common import estimate, timing
from vestcl.bench.splat.bench import SplatBench, _measurements
from vestcl.bench.splat.operators import OperatorsBench
from vestcl.cli import main as cli


def screen() -> Console:
    return Console(file=io.StringIO(), width=80)


def said(console: Console) -> str:
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "about 1 s"), (40.4, "about 40 s"), (99, "about 99 s"), (100, "about 2 min"), (3600, "about 60 min"),
     (5400, "about 90 min"), (7200, "about 2.0 h")],
)  # fmt: skip
def test_durations(seconds: float, words: str) -> None:
    assert estimate.duration(seconds) == words


def test_the_first_measurement_announces_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two tasks of 30 ms: five rounds take less than the 4 s that are asked for; the bench has six measurements."""
    console, tasks = screen(), dict.fromkeys(("a", "b"), lambda: time.sleep(0.03))
    monkeypatch.setattr(timing, "MOST_ROUNDS", 1)
    with estimate.announcing(console, lambda seconds, count: 3 * seconds * count):
        timing.interleave(tasks, 4.0)
        timing.interleave(tasks, 9.0)
    assert said(console) == "takes about 24 s (estimated from the first call)\n"


def test_slow_tasks_take_longer_than_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    console = screen()
    monkeypatch.setattr(timing, "MOST_ROUNDS", 1)
    with estimate.announcing(console):
        timing.interleave({"a": lambda: time.sleep(0.2)}, 0.1, 50)
    assert said(console).startswith("takes about 1")  # 50 rounds of 0.21 s


def test_nothing_is_announced_of_what_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    console = screen()
    monkeypatch.setattr(timing, "MOST_ROUNDS", 1)
    with estimate.announcing(console):
        timing.interleave({"a": int}, 0.5)
    timing.interleave({"a": int}, 900.0)
    assert said(console) == ""


def test_equal_parts_are_announced_after_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    console, clock = screen(), iter((0.0, 2.0))
    monkeypatch.setattr(estimate.time, "perf_counter", lambda: next(clock, 2.0))

    def lines() -> Iterator[str]:
        for _ in estimate.announced(range(216), console, "windows"):
            yield said(console)

    seen = list(lines())
    assert seen[:2] == ["", "takes about 7 min, 216 windows (estimated from the first call)\n"]
    assert seen[-1] == seen[1]
    assert list(estimate.announced([], console, "windows")) == []


def test_measurements_of_splat() -> None:
    assert _measurements(SplatBench(reference=False)) == 2
    assert _measurements(SplatBench(peers=False, scaling=True, channels=True)) == 2 * (1 + 6 + 6)


def test_no_reference(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference is not called, and the tables have no column of it."""
    monkeypatch.setattr(timing, "MOST_ROUNDS", 1)
    arguments = ["--height", "16", "--width", "32", "--seconds", "0.01"]
    assert cli.main(["bench", "operators", *arguments, "--no-reference"]) == 0
    table = capsys.readouterr().out
    assert "reference" not in table and "splat forward" in table
    assert cli.main(["bench", "operators", *arguments]) == 0
    assert "reference" in capsys.readouterr().out
    assert cli.main(["bench", "splat", *arguments, "--radii", "1", "--no-reference"]) == 0
    assert "sparse" not in capsys.readouterr().out
    assert OperatorsBench().reference

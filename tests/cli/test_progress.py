"""Progress bars: a clock that runs, and step, clock and time left in 80 columns."""

import io
import time

import pytest
from rich.console import Console

from vestcl.cli.progress import ProgressBar, progress_bar


def drawn(bar: ProgressBar, width: int = 80) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(bar.get_renderable())
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


def bar_of(counted: bool = True) -> ProgressBar:
    return progress_bar(Console(file=io.StringIO(), force_terminal=True, width=80), counted=counted)


@pytest.mark.parametrize(
    "name", ["frames", "2011_09_26_drive_0060_sync_of_a_clip_with_a_name_that_is_longer_than_the_bar"]
)
def test_step_clock_and_time_left_in_80_columns(name: str) -> None:
    bar = bar_of()
    task = bar.add_task(name, total=1200)
    for _ in range(2):
        bar.advance(task, 5)
        time.sleep(0.02)
    (line,) = drawn(bar).splitlines()
    assert len(line.rstrip()) <= 80
    _, steps, clock, left = line.rstrip().rsplit(maxsplit=3)
    assert steps == "10/1200"
    assert clock.startswith("0:00:0") and left.startswith("0:00:")


def test_the_clock_runs_when_a_task_is_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    """rich's own stops there, though the same task has other stages to come."""
    seconds = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: seconds[0])
    bar = bar_of(counted=False)
    task = bar.add_task("first", total=1.0)
    bar.update(task, completed=1.0)
    seconds[0] += 3723
    assert "1:02:03" in drawn(bar)


def test_nothing_is_drawn_in_a_file() -> None:
    console = Console(file=io.StringIO())
    with progress_bar(console) as bar:
        bar.add_task("frames", total=3)
    assert console.file.getvalue() == ""  # type: ignore[attr-defined]

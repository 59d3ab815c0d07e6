"""Progress bars on the terminal."""

import time
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.table import Column
from rich.text import Text

#: As wide as a stage's name gets: step, clock and time left have space in 80 columns.
_LABEL: Final = 30


class ProgressBar(Progress):
    """rich's bar; a disabled one prints nothing, not even the empty line that rich before 14.3 ends it with."""

    def stop(self) -> None:
        """End the bar, if it was ever shown."""
        if not self.disable:
            super().stop()


class RunningClock(ProgressColumn):
    """The time since the bar was made. rich's own stops when a task is complete, and one task has several stages."""

    max_refresh = 0.5

    def __init__(self) -> None:
        super().__init__()
        self._start = time.monotonic()

    def render(self, task: Task) -> Text:
        """ "0:01:12"."""
        minutes, seconds = divmod(int(time.monotonic() - self._start), 60)
        return Text(f"{minutes // 60}:{minutes % 60:02}:{seconds:02}", style="progress.elapsed")


def progress_bar(console: Console, *, counted: bool = False, hidden: bool = False, stays: bool = False) -> ProgressBar:
    """A bar with the stage, the share, a clock that runs and the time left.

    Args:
        console: nothing is shown where it is not a terminal.
        counted: whether a task has steps, whose number is shown.
        hidden: shows nothing.
        stays: whether the bar is still there when it has ended.
    """
    label = Column(max_width=_LABEL, no_wrap=True, overflow="ellipsis")
    columns: list[ProgressColumn] = [
        TextColumn("{task.description}", table_column=label),
        BarColumn(bar_width=None),
    ]
    columns += [MofNCompleteColumn()] if counted else []
    columns += [RunningClock(), TimeRemainingColumn()]
    hidden = hidden or not console.is_terminal
    return ProgressBar(*columns, console=console, transient=not stays, expand=True, disable=hidden)

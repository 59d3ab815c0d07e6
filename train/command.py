"""How the commands of train end: what a user can correct is one line on stderr, with exit status 2."""

import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, TextIO

from rich.console import Console
from rich.text import Text

from train.run.checkpoint import CheckpointError
from train.run.ranks import LostProcessError
from vestcl import opencl

#: Exit status of a command that could not do what it was asked for.
FAILED: Final = 2

#: What a user can correct: settings, files, the disk, devices, other processes.
ERRORS: Final = (ValueError, OSError, opencl.DeviceError, CheckpointError, LostProcessError)

#: What torch says, anywhere in the main process, when a data loader's process has ended.
_WORKER: Final = re.compile(r"DataLoader worker \(pid\(?s?\)?")


def failed(error: Exception | str) -> int:
    """Print the line of an error; returns the exit status."""
    Console(stderr=True).print(Text(f"error: {error}", style="red"), soft_wrap=True)
    return FAILED


def lost_worker(error: RuntimeError) -> str | None:
    """What to print where ``error`` is torch's about a lost process of a data loader; None where it is not."""
    if not _WORKER.match(str(error)):
        return None
    return "a process that reads data was killed, perhaps for memory; fewer `data.workers` need less"


@contextmanager
def warnings_in_lines() -> Iterator[None]:
    """Inside the ``with`` block a UserWarning is a line on stderr, without the code that raised it."""

    def show(
        message: Warning | str, category: type[Warning], filename: str, lineno: int, file: TextIO | None = None,
        line: str | None = None,
    ) -> None:  # fmt: skip
        if issubclass(category, UserWarning):
            print(f"warning: {message}", file=file or sys.stderr)
        else:
            default(message, category, filename, lineno, file, line)

    default: Any = warnings.showwarning
    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = default

"""Ctrl-C in a command: one line that says what was written, exit status 130, no child process, no temporary file.

A command that reads the process's own arguments owns the process and ends inside the signal handler: an exception may
be swallowed or changed by the code that it is raised in (the import of a C extension, a callback, a destructor). A
command that is called as a function ends by KeyboardInterrupt and returns the status. Nothing is imported here that
takes time, so that the handler is there before anything that does.
"""

import contextlib
import functools
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from pathlib import Path
    from types import FrameType

#: Exit status of a command that Ctrl-C stopped, as a shell has it.
STOPPED: Final = 128 + signal.SIGINT

#: Seconds that child processes get to end after SIGTERM, before SIGKILL.
_PATIENCE: Final = 2.0

_cleanups: list[Callable[[], None]] = []
_summaries: list[Callable[[], str]] = []
_owner: int | None = None


class _Written:
    """How many files were written since the command began, and the folder that has all of them."""

    files = 0
    last: "Path | None" = None
    folder: "Path | None" = None

    def add(self, path: "Path") -> None:
        self.files, self.last = self.files + 1, path
        above = [path.parent, *path.parent.parents]
        self.folder = path.parent if self.folder is None else next((p for p in above if _holds(p, self.folder)), None)

    def __str__(self) -> str:
        if self.files < 2:
            return f"stopped; {self.last} was written" if self.files else "stopped; nothing was written"
        return f"stopped; {self.files} files were written" + (f" to {self.folder}" if self.folder else "")


def _holds(folder: "Path", other: "Path") -> bool:
    return folder == other or folder in other.parents


_written = _Written()


def wrote(path: "Path") -> None:
    """Note that ``path`` is complete; `vestcl.io.atomic` calls it."""
    _written.add(path)


def at_stop(cleanup: Callable[[], None]) -> None:
    """Call ``cleanup`` when a command is stopped; it must be quick, and may find nothing to do."""
    _cleanups.append(cleanup)


@contextlib.contextmanager
def summary(describe: Callable[[], str]) -> Iterator[None]:
    """Inside the ``with`` block the line of a stopped command is ``describe()`` in place of the number of files.

    Args:
        describe: gives the line; an empty one is not printed.
    """
    _summaries.append(describe)
    try:
        yield
    finally:
        # A KeyboardInterrupt is reported after this block: its summary stays for that line.
        if not is_interrupt(sys.exc_info()[1]):
            _summaries.remove(describe)


def command(main: Callable[[Sequence[str] | None], int]) -> Callable[..., int]:
    """Decorates a command's ``main``, which takes its arguments, or None for the process's own; returns the status."""

    @functools.wraps(main)
    def stoppable(arguments: Sequence[str] | None = None) -> int:
        global _written
        _written = _Written()
        _summaries.clear()
        with _handler() if arguments is None else contextlib.nullcontext():
            try:
                return main(arguments)
            except KeyboardInterrupt:
                pass
            except Exception as error:
                if not is_interrupt(error):
                    raise
            if line := _clean_up():
                print(line, file=sys.stderr)
            return STOPPED

    return stoppable


def is_interrupt(error: BaseException | None) -> bool:
    """Whether ``error`` is what other code made of a KeyboardInterrupt, the failed import of a C extension for one."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, KeyboardInterrupt):
            return True
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return False


@contextlib.contextmanager
def shielded() -> Iterator[None]:
    """Processes started inside the ``with`` block don't get SIGINT: a terminal sends it to the parent and its children.

    The parent gets it when the block ends.
    """
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # which unblocks SIGINT when it starts: before, not in the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def guard_imports() -> None:
    """Let SIGINT end this process by one line from here on; for a module that is run, before its other imports."""
    _own()


@contextlib.contextmanager
def _handler() -> Iterator[None]:
    """SIGINT ends the process, if nothing else handles it."""
    before = signal.getsignal(signal.SIGINT)
    owned = _own()
    try:
        yield
    finally:
        if owned:
            signal.signal(signal.SIGINT, before)


def _own() -> bool:
    """Handle SIGINT, if nothing else does; whether it was possible: only the main thread may."""
    global _owner
    if signal.getsignal(signal.SIGINT) not in (signal.default_int_handler, stop_now):
        return False
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, stop_now)
        _owner = os.getpid()
        return True
    return False


def stop_now(number: int = signal.SIGINT, frame: "FrameType | None" = None) -> None:
    """The handler: end children, remove temporary files, print the line, end this process with status `STOPPED`."""
    if os.getpid() != _owner:  # a fork: its parent prints
        os._exit(STOPPED)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # torch's raises where a process that reads data ends
    try:
        with contextlib.suppress(Exception):
            _end_children()
        _release_semaphores()
        line = _clean_up()
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            if sys.stdout.isatty():  # a progress bar hides the cursor and leaves half a line
                os.write(1, b"\r\x1b[K\x1b[?25h")
        os.write(2, f"{line}\n".encode(errors="backslashreplace") if line else b"")
    finally:
        os._exit(STOPPED)


def _clean_up() -> str:
    """Remove what is temporary; the line to print."""
    for cleanup in reversed(_cleanups):
        with contextlib.suppress(Exception):
            cleanup()
    with contextlib.suppress(Exception):
        if _summaries:
            return _summaries[-1]()
    return str(_written)


def _end_children() -> None:
    """SIGTERM, then SIGKILL to this process's children.

    multiprocessing's tracker of shared memory is left out: it ends, and removes what is left, when its parent ends.
    """
    tracker: Any = getattr(sys.modules.get("multiprocessing.resource_tracker"), "_resource_tracker", None)
    children = _children() - {getattr(tracker, "_pid", None)}
    for number in (signal.SIGTERM, signal.SIGKILL):
        for child in children:
            with contextlib.suppress(OSError):
                os.kill(child, number)
        end = time.monotonic() + _PATIENCE
        while children and time.monotonic() < end:
            children = {child for child in children if _runs(child)}
            time.sleep(0.005)


def _release_semaphores() -> None:
    """multiprocessing's, by its own finalizers: its tracker warns of those that are left, on the user's terminal."""
    finalize: Any = getattr(sys.modules.get("multiprocessing.util"), "_run_finalizers", None)
    with contextlib.suppress(Exception):
        if finalize is not None:
            finalize(0)  # without those of lower priority, which wait for threads


def _children() -> set[int]:
    """Process numbers of this process's children, by /proc: the fourth field of a stat file is the parent."""
    found: set[int] = set()
    for process in filter(str.isdecimal, os.listdir("/proc")):  # noqa: PTH208 - pathlib's import may be interrupted
        stat = f"/proc/{process}/stat"
        with contextlib.suppress(OSError, ValueError), open(stat, errors="replace") as file:  # noqa: PTH123
            if int(file.read().rpartition(")")[2].split()[1]) == os.getpid():
                found.add(int(process))
    return found


def _runs(child: int) -> bool:
    try:
        return os.waitpid(child, os.WNOHANG)[0] == 0
    except ChildProcessError:
        return False

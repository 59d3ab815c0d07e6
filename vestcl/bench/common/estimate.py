"""How long a bench will take, reported before it does, from its first call."""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import Final, TypeVar

from rich.console import Console

Total = Callable[[float, int], float]
"""Seconds of a bench, by the seconds of its first measurement and how many tasks that times."""

Item = TypeVar("Item")

#: Seconds; nobody needs a line on less.
_SHORT: Final = 3.0

#: What `first_call` reports to.
_listener: ContextVar[Callable[[float, int], None] | None] = ContextVar("estimate_listener", default=None)


def duration(seconds: float) -> str:
    """ "about 40 s", "about 12 min", "about 1.5 h"."""
    if seconds < 99.5:
        return f"about {max(round(seconds), 1)} s"
    minutes = seconds / 60
    return f"about {minutes:.0f} min" if minutes < 99.5 else f"about {minutes / 60:.1f} h"


def first_call(seconds: float, tasks: int) -> None:
    """Report how long a measurement that begins will take: by `announcing`, if it is the first.

    Args:
        seconds: of the measurement.
        tasks: that it times.
    """
    listener = _listener.get()
    if listener is not None:
        listener(seconds, tasks)


@contextlib.contextmanager
def announcing(console: Console, total: Total | None = None) -> Iterator[None]:
    """Inside the ``with`` block the first `first_call` prints how long all will take.

    Args:
        console: where to.
        total: of the bench; None is one measurement.
    """

    def announce(seconds: float, tasks: int) -> None:
        _listener.set(None)
        _print(console, seconds if total is None else total(seconds, tasks))

    token = _listener.set(announce)
    try:
        yield
    finally:
        _listener.reset(token)


def first_of(count: int, console: Console, unit: str) -> Callable[[], None]:
    """What is to be called after each of ``count`` equal parts: the first call prints how long all will take.

    Args:
        count: of the parts.
        console: where to.
        unit: what they are, "windows".
    """
    start, done = time.perf_counter(), 0

    def part_done() -> None:
        nonlocal done
        done += 1
        if done == 1 and count > 1:
            _print(console, (time.perf_counter() - start) * count, f", {count} {unit}")

    return part_done


def announced(items: Sequence[Item], console: Console, unit: str) -> Iterator[Item]:
    """The items; after the first one's work a line says how long all will take.

    Args:
        items: of about equal work, which is done before the next is asked for.
        console: where to.
        unit: what they are, "windows".
    """
    part_done = first_of(len(items), console, unit)
    for item in items:
        yield item
        part_done()


def _print(console: Console, seconds: float, what: str = "") -> None:
    if seconds >= _SHORT:
        console.print(f"takes {duration(seconds)}{what} (estimated from the first call)", highlight=False)

"""The one clock of stages: seconds by name, for tables; for torch's profiler and for `vestcl.opencl.trace` as well."""

import contextlib
import logging
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Final

_LOG: Final = logging.getLogger(__name__)

Seen = Callable[[str, Any], None]
"""Called with a stage's name and result."""

Recorder = Callable[[str, int, int], object]
"""Called with a span's name, start and end, nanoseconds of time.perf_counter_ns, in the span's thread."""

#: What records spans of all threads: `vestcl.opencl.trace`, one per process.
_recorder: Recorder | None = None


def record_spans(recorder: Recorder | None) -> None:
    """Call ``recorder`` after each `span` that ends from now on; None calls nothing."""
    global _recorder
    _recorder = recorder


@contextlib.contextmanager
def span(name: str) -> Iterator[None]:
    """A named span of the calling thread, for a ``with`` block, as torch's profiler and a recorded trace show it."""
    from torch.profiler import record_function  # importing vestcl must not import torch

    start = time.perf_counter_ns()
    try:
        with record_function(name):
            yield
    finally:
        if _recorder is not None:
            _recorder(name, start, time.perf_counter_ns())


@dataclass
class Clock:
    """Seconds by stage, summed up until `take`."""

    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    """CPU seconds of all threads of the process."""
    seen: Seen | None = None
    """Called after each stage that has a result to show, outside of what is timed."""
    outer: "Clock | None" = field(default=None, repr=False, compare=False)
    """The clock of the ``with`` block around this one's: it runs as well."""
    exclusive: bool = False
    """Whether a stage's time is without the stages of this clock inside it."""
    _inner: tuple[float, float] = field(default=(0.0, 0.0), repr=False, compare=False)
    """Seconds and CPU seconds of the stages inside the current one."""

    @contextlib.contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Time the ``with`` block, whether it ends well or not; it is a `span`, too."""
        around, self._inner = self._inner, (0.0, 0.0)
        start, cpu_start = time.perf_counter(), time.process_time()
        try:
            with span(name):
                yield
        finally:
            wall, cpu = time.perf_counter() - start, time.process_time() - cpu_start
            inner, cpu_inner = self._inner if self.exclusive else (0.0, 0.0)
            self.add(name, wall - inner, cpu - cpu_inner)
            _LOG.debug("%s: %.3f s", name, wall - inner)
            self._inner = around[0] + wall, around[1] + cpu

    def add(self, name: str, seconds: float, cpu_seconds: float) -> None:
        """Add to this clock and to all outer ones."""
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self.cpu_seconds[name] = self.cpu_seconds.get(name, 0.0) + cpu_seconds
        if self.outer is not None:
            self.outer.add(name, seconds, cpu_seconds)

    def show(self, name: str, result: Any) -> None:
        """Call ``seen`` of this clock and of all outer ones."""
        if self.seen is not None:
            self.seen(name, result)
        if self.outer is not None:
            self.outer.show(name, result)

    def take(self) -> dict[str, float]:
        """What was measured since the last time, without the CPU's."""
        taken, self.seconds, self.cpu_seconds = self.seconds, {}, {}
        return taken


_clock: ContextVar[Clock | None] = ContextVar("vestcl_clock", default=None)


@contextlib.contextmanager
def watching(seen: Seen | None = None) -> Iterator[Clock]:
    """Time the stages that this thread runs inside the ``with`` block; other threads do not count.

    Args:
        seen: called with each stage's name and result, outside of what is timed.

    Returns:
        The clock, as the ``with`` block's variable.
    """
    clock = Clock(seen=seen, outer=_clock.get())
    token = _clock.set(clock)
    try:
        yield clock
    finally:
        _clock.reset(token)


def current_clock() -> Clock:
    """The clock of the thread's `watching`; outside of one, a clock that is not read."""
    return _clock.get() or Clock()

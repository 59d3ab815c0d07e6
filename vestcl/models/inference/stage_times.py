"""Where a network's forecast spends its time: a clock for its stages, which leaves the model as it is.

The stages of `vestcl.models.forecaster.Forecaster` are methods with `timed`. They report to the clock of the running
thread (a context variable), so forecasts in several threads, with one model or several, are timed separately::

    with watching() as watch:
        model.forecast(...)
    watch.seconds  # {"encode": 0.31, "EMF": 0.01, ...}

Each stage is also a span of `vestcl.opencl.trace` and a `torch.profiler.record_function`, by the same name.
"""

import contextlib
import functools
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Final, ParamSpec, TypeVar

from torch.profiler import record_function

from vestcl.opencl import trace

#: Method of a `Forecaster` -> its name in tables, in the order that they run in. All other time is REST. What EMF
#: computes from one frame is kept with the frame's features: it counts as "encode".
STAGES: Final = {
    "encode": "encode",
    "move_camera": "EMF",
    "move_objects": "OMF",
    "lift": "lift",
    "splat": "splat",
    "paint": "refine",
}

#: Methods that do the work of a stage in another way: their time is its time.
_OTHER_WAYS: Final = {"retouch": "refine"}

#: Rigid flow of both frames, checks, composing the view.
REST: Final = "rest"

Seen = Callable[[str, Any], None]
"""Called with a stage's name and result."""

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


@dataclass
class Stopwatch:
    """Seconds by stage, summed up until `take`."""

    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    """Of all threads of the process."""
    seen: Seen | None = None
    """Called after each stage, outside of what is timed."""
    outer: "Stopwatch | None" = field(default=None, repr=False, compare=False)
    """The clock of the ``with`` block around this one's: it runs as well."""

    def add(self, name: str, seconds: float, cpu_seconds: float) -> None:
        """Add to this clock and to all outer ones."""
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        self.cpu_seconds[name] = self.cpu_seconds.get(name, 0.0) + cpu_seconds
        if self.outer is not None:
            self.outer.add(name, seconds, cpu_seconds)

    @contextlib.contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Add the time that the ``with`` block takes."""
        start, cpu_start = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self.add(name, time.perf_counter() - start, time.process_time() - cpu_start)

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


_watch: ContextVar[Stopwatch | None] = ContextVar("vestcl_stopwatch", default=None)


@contextlib.contextmanager
def watching(seen: Seen | None = None) -> Iterator[Stopwatch]:
    """Time the stages of all forecasts that this thread makes inside the ``with`` block; other threads do not count.

    Args:
        seen: called with each stage's name and result, outside of what is timed.

    Returns:
        The clock, as the ``with`` block's variable.
    """
    watch = Stopwatch(seen=seen, outer=_watch.get())
    token = _watch.set(watch)
    try:
        yield watch
    finally:
        _watch.reset(token)


def timed(method: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Let a method of STAGES report its time to the thread's `watching`, to `vestcl.opencl.trace` and to torch's
    profiler."""
    name = (STAGES | _OTHER_WAYS)[method.__name__]

    @functools.wraps(method)
    def stage(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        watch = _watch.get()
        with trace.stage(name), record_function(name), contextlib.nullcontext() if watch is None else watch.time(name):
            result = method(*arguments, **named)
        if watch is not None:
            watch.show(name, result)
        return result

    return stage


def with_rest(stages: dict[str, float], whole: float) -> dict[str, float]:
    """All of STAGES in order, 0 s where one did not run, and what is left of ``whole`` as REST."""
    known = {name: stages.get(name, 0.0) for name in STAGES.values()}
    return known | {REST: max(0.0, whole - sum(known.values()))}

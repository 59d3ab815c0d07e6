"""Where a network's forecast spends its time: a clock on each of its stages."""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from vestcl import trace

if TYPE_CHECKING:  # it needs torch, which takes seconds to import
    from vestcl.models.forecaster import Forecaster

#: Method of a `Forecaster` -> what tables call it, in the order that they run in. What no stage has is REST. What EMF
#: sees of a frame by itself is found out, and remembered, with the frame's features: it counts as "encode".
STAGES: Final = {
    "encode": "encode",
    "move_camera": "EMF",
    "move_objects": "OMF",
    "lift": "lift",
    "splat": "splat",
    "paint": "refine",
}

#: Rigid flow of both frames, checks, comparing frames with those seen before, composing the view.
REST: Final = "rest"


@dataclass
class Stopwatch:
    """Seconds by stage, summed up until `take`."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextlib.contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Add what the block takes to ``name``; a trace shows it, too."""
        start = time.perf_counter()
        with trace.stage(name):
            yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def take(self) -> dict[str, float]:
        """What was measured since the last time."""
        taken, self.seconds = self.seconds, {}
        return taken


def watched(model: "Forecaster", seen: Callable[[str, Any], None] = lambda name, result: None) -> Stopwatch:
    """Put a clock on each stage of ``model``, for good.

    Args:
        model: is changed: its methods are wrapped.
        seen: called with each stage's name and result, outside of what is timed.

    Returns:
        The clock.
    """
    watch = Stopwatch()
    for method, name in STAGES.items():
        setattr(model, method, _timed(watch, name, getattr(model, method), seen))
    return watch


@contextlib.contextmanager
def watching(model: "Forecaster") -> Iterator[Stopwatch]:
    """`watched` inside the ``with`` block."""
    try:
        yield watched(model)
    finally:
        for method in STAGES:
            vars(model).pop(method, None)


def with_rest(stages: dict[str, float], whole: float) -> dict[str, float]:
    """All of STAGES in order, 0 s where one did not run, and what is left of ``whole`` as REST."""
    known = {name: stages.get(name, 0.0) for name in STAGES.values()}
    return known | {REST: max(0.0, whole - sum(known.values()))}


def _timed(
    watch: Stopwatch, name: str, method: Callable[..., Any], seen: Callable[[str, Any], None]
) -> Callable[..., Any]:
    def timed(*arguments: Any, **named: Any) -> Any:
        with watch.time(name):
            result = method(*arguments, **named)
        seen(name, result)
        return result

    return timed

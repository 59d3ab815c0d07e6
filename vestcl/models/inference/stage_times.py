"""The stages of a network's forecast, by `vestcl.clock`, which leaves the model as it is.

The stages of `vestcl.models.forecaster.Forecaster` are methods with `timed`. They report to the clock of the running
thread (a context variable), so forecasts in several threads, with one model or several, are timed separately::

    with watching() as clock:
        model.forecast(...)
    clock.seconds  # {"encode": 0.31, "EMF": 0.01, ...}

Each stage is also a span of `vestcl.opencl.trace` and a `torch.profiler.record_function`, by the same name.
"""

import functools
from collections.abc import Callable
from typing import Final, ParamSpec, TypeVar

from vestcl.clock import current_clock, watching

__all__ = ["REST", "STAGES", "timed", "watching", "with_rest"]

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

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def timed(method: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Let a method of STAGES be a stage of the thread's clock."""
    name = (STAGES | _OTHER_WAYS)[method.__name__]

    @functools.wraps(method)
    def stage(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        clock = current_clock()
        with clock.time(name):
            result = method(*arguments, **named)
        clock.show(name, result)
        return result

    return stage


def with_rest(stages: dict[str, float], whole: float) -> dict[str, float]:
    """All of STAGES in order, 0 s where one did not run, and what is left of ``whole`` as REST."""
    known = {name: stages.get(name, 0.0) for name in STAGES.values()}
    return known | {REST: max(0.0, whole - sum(known.values()))}

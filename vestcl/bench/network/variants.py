"""What makes the networks faster on a CPU, and what does not: a section of `vestcl bench network`.

Every choice of `vestcl.models.inference.fast` is timed in turns with the plain network, on the same input, and so are
those that
were left out there because they do not pay: weights in channels-last order, both frames in one pass of the encoder, and
torch.compile (Inductor with the machine's C++ compiler, weights frozen), which has to compile first.
"""

import contextlib
import copy
import dataclasses
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import nn

from vestcl.bench.common import timing as _timing
from vestcl.bench.common.results import Measure
from vestcl.bench.common.timing import Spread
from vestcl.evaluation.tables import Grid
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.fast import accelerate, computes_bfloat16, share_frames
from vestcl.models.inference.skipping import NOTHING
from vestcl.models.networks.object_motion import ObjectMotion, ObjectMotionForecast
from vestcl.models.steps.prior import MotionPrior
from vestcl.scene.layers import LayerBatch

#: What all others of a group are compared with.
PLAIN: Final = "plain"

#: Equal images differ by less than any display, file or metric shows: in tables they are "equal".
_EQUAL_DECIBELS: Final = 120.0

#: That Inductor calls.
_COMPILERS: Final = ("g++", "clang++")


class Section(NamedTuple):
    """What `vestcl.bench.common.results.Results` takes of it."""

    measures: list[Measure]
    grids: list[Grid]
    details: dict[str, Any]


@dataclass(frozen=True)
class Choice:
    """One way to compute the same."""

    name: str
    seconds: Spread
    cpu_seconds: Spread
    """Of all threads; other work on the machine disturbs them less."""
    ratio: Spread
    """Seconds over the plain one's, round by round."""
    cpu_ratio: Spread
    """The same of CPU seconds."""
    psnr: float
    """Decibels against the plain output, of its range; infinite if they are equal."""
    compile_seconds: float | None = None


@dataclass(frozen=True)
class Group:
    """Ways to compute the same, the plain one first."""

    title: str
    choices: list[Choice]


class Pass(NamedTuple):
    """A network and what a forecast gave it."""

    network: nn.Module
    arguments: tuple[Any, ...]


def network_speed(
    model: Forecaster,
    pair: Sequence[LayerBatch],
    K: torch.Tensor,
    prior: MotionPrior | None,
    *,
    runs: int = _timing.LEAST_ROUNDS,
    seconds: float = 0.0,
    compiled: bool = False,
) -> Section:
    """Time all choices: of the whole forecast, with everything computed, and of each network.

    Args:
        model: a plain one; it stays as it is.
        pair: frames at t - 1 and t.
        K: [B, 3, 3] px.
        prior: as `Forecaster.forward` takes it.
        runs: rounds of each group, at least.
        seconds: about how long each group is timed, if that gives more rounds.
        compiled: also torch.compile, which takes a minute or two before anything is timed.

    Returns:
        Measures ("forecast, bfloat16" in seconds, "forecast, bfloat16 / plain" as a ratio, ...), a table a group, and
        in the details the groups themselves.

    Raises:
        ValueError: ``runs`` below 1, or ``compiled`` without a C++ compiler.
    """
    if runs < 1:
        raise ValueError(f"`runs` must be 1 or more, got {runs}")
    if compiled and not any(map(shutil.which, _COMPILERS)):
        raise ValueError(f"`compiled` must be False without a C++ compiler, got none of {', '.join(_COMPILERS)}")
    model = copy.deepcopy(model).eval()
    model.skip = NOTHING
    with torch.no_grad():
        groups = [_forecasts(model, (*pair, K), prior, runs, seconds)]
        with _timing.recycling_allocator() as kept:
            passes = _passes(model, (*pair, K), prior)
            for title, network in passes.items():
                groups.append(_network(title, network, runs, seconds, compiled))
    details = {
        "groups": groups,
        "bfloat16 instructions": computes_bfloat16(),
        "freed memory can be kept": kept,
        "torch threads": torch.get_num_threads(),
    }
    return Section([m for group in groups for m in _measures(group)], [_grid(group) for group in groups], details)


# ---------------------------------------------------------------- what is timed


def _forecasts(
    model: Forecaster, given: tuple[Any, ...], prior: MotionPrior | None, runs: int, seconds: float
) -> Group:
    """The plain forecast with memory returned to the system, and all with memory kept."""
    kept = contextlib.ExitStack()

    def image(one: Forecaster) -> Callable[[], torch.Tensor]:
        return lambda: one(*given, prior=prior).views[0].image

    def ready(one: Forecaster, keep: bool) -> Callable[[], object]:
        def prepare() -> None:  # the first forecast after the change finds memory as the last one left it
            kept.close()
            if keep:
                kept.enter_context(_timing.recycling_allocator())
            one(*given, prior=prior)

        return prepare

    models = {
        PLAIN: (model, False),
        "memory kept": (model, True),
        "accelerated, memory kept": (accelerate(model), True),
        "bfloat16, memory kept": (accelerate(model, "bfloat16"), True),
    }
    tasks = {name: image(one) for name, (one, _) in models.items()}
    with kept:
        return _timed("forecast", tasks, runs, seconds, {name: ready(*how) for name, how in models.items()})


def _passes(model: Forecaster, given: tuple[Any, ...], prior: MotionPrior | None) -> dict[str, Pass]:
    """The networks and their input in a forecast; of the encoder both frames'."""
    seen: dict[str, list[tuple[Any, ...]]] = {}
    networks = {"encoder": model.encoder, "object motion": model.object_motion, "refinement": model.refine}
    hooks = [
        network.register_forward_pre_hook(lambda _, arguments, name=name: seen.setdefault(name, []).append(arguments))
        for name, network in networks.items()
        if network is not None
    ]
    model(*given, prior=prior)
    for hook in hooks:
        hook.remove()
    passes = {name: Pass(network, seen[name][0]) for name, network in networks.items() if network and name in seen}
    images = torch.cat([arguments[0] for arguments in seen["encoder"]])
    return passes | {"encoder": Pass(model.encoder, (images,))}


def _network(title: str, given: Pass, runs: int, seconds: float, compiled: bool) -> Group:
    """One network's choices."""
    network, arguments = given
    tasks: dict[str, Callable[[], Any]] = {PLAIN: lambda: network(*arguments)}
    if title == "encoder":
        halves = arguments[0].chunk(2)
        tasks[PLAIN] = lambda: torch.cat([network(half) for half in halves])
        tasks["both frames in one pass"] = lambda: network(*arguments)
    ordered = copy.deepcopy(network).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    tasks["weights channels-last"] = lambda: ordered(*arguments)
    if isinstance(network, ObjectMotion):
        shared = copy.deepcopy(network)
        if share_frames(shared):
            tasks["frames shared"] = lambda: shared(*arguments)
    else:
        tasks["bfloat16"] = lambda: _autocast(network, arguments)
    if not compiled:
        return _timed(title, tasks, runs, seconds)
    tasks["torch.compile"], took = _compiled(ordered, arguments)
    *others, last = _timed(title, tasks, runs, seconds).choices
    return Group(title, [*others, dataclasses.replace(last, compile_seconds=took)])


def _autocast(network: nn.Module, arguments: tuple[Any, ...]) -> Any:
    with torch.autocast("cpu", torch.bfloat16):
        return network(*arguments)


def _compiled(network: nn.Module, arguments: tuple[Any, ...]) -> tuple[Callable[[], Any], float]:
    """The network by Inductor, and the seconds until its first output."""
    start = time.perf_counter()
    quick = torch.compile(copy.deepcopy(network), dynamic=False, options={"freezing": True})
    quick(*arguments)
    return lambda: quick(*arguments), time.perf_counter() - start


def _timed(
    title: str,
    tasks: Mapping[str, Callable[[], Any]],
    runs: int,
    seconds: float,
    before: Mapping[str, Callable[[], object]] | None = None,
) -> Group:
    """All in turns, the plain one first, each after what has to be done ``before`` it."""
    wall: dict[str, list[float]] = {name: [] for name in tasks}
    cpu: dict[str, list[float]] = {name: [] for name in tasks}
    for task in tasks.values():
        task()
    end = time.perf_counter() + seconds
    for number in range(_timing.MOST_ROUNDS):
        if number >= runs and time.perf_counter() > end:
            break
        for name, task in tasks.items():
            if before is not None:
                before[name]()
            time.sleep(_timing.PAUSE)
            clocks = time.perf_counter(), time.process_time()
            output = task()
            wall[name].append(time.perf_counter() - clocks[0])
            cpu[name].append(time.process_time() - clocks[1])
            del output
    wanted = _tensor(tasks[PLAIN]())
    return Group(title, [_choice(name, wall, cpu, _decibels(_tensor(tasks[name]()), wanted)) for name in tasks])


def _choice(name: str, wall: Mapping[str, list[float]], cpu: Mapping[str, list[float]], psnr: float) -> Choice:
    seconds, busy, plain, plain_busy = (np.array(of) for of in (wall[name], cpu[name], wall[PLAIN], cpu[PLAIN]))
    return Choice(
        name, Spread.of(seconds), Spread.of(busy), Spread.of(seconds / plain), Spread.of(busy / plain_busy), psnr
    )


def _tensor(output: Any) -> torch.Tensor:
    tensor = output.flow if isinstance(output, ObjectMotionForecast) else output
    assert isinstance(tensor, torch.Tensor)
    return tensor.float()


def _decibels(got: torch.Tensor, wanted: torch.Tensor) -> float:
    """PSNR in the range of ``wanted``."""
    error = (got - wanted).square().mean().sqrt()
    return float(20 * ((wanted.max() - wanted.min()) / error).log10()) if error else math.inf


# ---------------------------------------------------------------- tables


def _measures(group: Group) -> list[Measure]:
    measures = []
    for choice in group.choices:
        name = f"{group.title}, {choice.name}"
        measures.append(Measure.of(name, "s", choice.seconds))
        if choice.name != PLAIN:
            measures.append(Measure.of(f"{name} / {PLAIN}", "1", choice.ratio))
            measures.append(Measure.of(f"{name} / {PLAIN}, CPU", "1", choice.cpu_ratio))
    return measures


def _grid(group: Group) -> Grid:
    rows = tuple(
        (
            choice.name,
            f"{choice.seconds.median * 1e3:.1f} ({choice.seconds.low * 1e3:.1f}-{choice.seconds.high * 1e3:.1f})",
            f"{choice.cpu_seconds.median * 1e3:.1f}",
            f"{choice.ratio.median:.2f}",
            f"{choice.cpu_ratio.median:.2f}",
            "equal" if choice.psnr >= _EQUAL_DECIBELS else f"{choice.psnr:.1f}",
            "" if choice.compile_seconds is None else f"{choice.compile_seconds:.0f}",
        )
        for choice in group.choices
    )
    heading = "", "ms (quartiles)", "CPU ms", "of plain", "CPU, of plain", "dB to plain", "s to compile"
    shown = len(heading) - all(choice.compile_seconds is None for choice in group.choices)
    return Grid(group.title, heading[:shown], tuple(row[:shown] for row in rows))

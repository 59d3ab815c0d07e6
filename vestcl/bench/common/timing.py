"""Clocks: tasks timed in turns, so that what slows the machine down slows all of them, and copies as yardsticks."""

import contextlib
import gc
import os
import random
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl.bench.common import estimate
from vestcl.models.inference.fast import keep_freed_memory

Task = Callable[[], object]

#: Rounds of a measurement whatever they take, and at most.
LEAST_ROUNDS: Final = 5
MOST_ROUNDS: Final = 200

#: Seconds between two tasks. OpenMP's threads spin for some milliseconds after a parallel loop of torch's and would
#: take a core from a task whose threads are not OpenMP's.
PAUSE: Final = 0.01

#: The share of the machine that other processes may keep busy before no target counts as reached or missed.
QUIET_SHARE: Final = 0.05

#: Cores that other processes kept busy during measurements, the most since it was set to 0.
busy_cores: Final = ContextVar("busy_cores", default=0.0)


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of some measurements."""

    median: float
    low: float
    high: float
    runs: int

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> "Spread":
        low, median, high = np.percentile(values, [25, 50, 75])
        return cls(float(median), float(low), float(high), len(values))

    @classmethod
    def of_each(cls, runs: Sequence[Mapping[str, float]]) -> "dict[str, Spread]":
        """By name, of runs that all have the same names."""
        return {name: cls.of(np.array([run[name] for run in runs])) for name in runs[0]}


def interleave(tasks: Mapping[str, Task], seconds: float, least: int = LEAST_ROUNDS) -> dict[str, NDArray[np.float64]]:
    """Run ``tasks`` in rounds, C A B, B A C, ..., without garbage collection; the seconds of every run.

    Each round has an order of its own, the same in every call: what ran before leaves caches and memory to a task.

    Args:
        tasks: by name. Each runs twice before anything counts. Releasing what it returns is not timed.
        seconds: about how long the measurement takes.
        least: rounds that are run even if they take longer.
    """
    for task in tasks.values():
        task()
    start = time.perf_counter()
    for task in tasks.values():
        task()
    round_seconds = time.perf_counter() - start + PAUSE * len(tasks)
    estimate.first_call(max(seconds, least * round_seconds), len(tasks))
    times: dict[str, list[float]] = {name: [] for name in tasks}
    shuffle, order = random.Random(0).shuffle, list(tasks.items())
    end = time.perf_counter() + seconds
    collects = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        with watching_others():
            for number in range(MOST_ROUNDS):
                if number >= least and time.perf_counter() > end:
                    break
                shuffle(order)
                for name, task in order:
                    time.sleep(PAUSE)
                    start = time.perf_counter()
                    result = task()
                    times[name].append(time.perf_counter() - start)
                    del result
    finally:
        if collects:
            gc.enable()
    return {name: np.array(values) for name, values in times.items()}


@contextlib.contextmanager
def recycling_allocator() -> Iterator[bool]:
    """Let glibc keep what is freed instead of returning it to the system, which costs torch a third of its time.

    Yields whether it does; other C libraries are left as they are.
    """
    try:
        yield keep_freed_memory()
    finally:
        keep_freed_memory(False)


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch compute with ``count`` threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def peak_gigabytes() -> float:
    """The most memory that the process has had resident, GB."""
    units = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * units / 1e9


def memcpy(threads: int, *sources: torch.Tensor) -> Task:
    """Copy one array, or add two, into memory that is there already, a share a thread: what moving the bytes takes."""
    to, pool = torch.empty_like(sources[0]), ThreadPoolExecutor(threads)
    shares = zip(*(np.array_split(of.numpy().reshape(-1), threads) for of in (to, *sources)), strict=True)
    pairs, operation = list(shares), np.positive if len(sources) == 1 else np.add
    return lambda: list(pool.map(lambda pair: operation(*pair[1:], out=pair[0]), pairs))  # type: ignore[call-overload]


@contextlib.contextmanager
def watching_others() -> Iterator[None]:
    """Measure, until the ``with`` block ends, how many cores other processes keep busy, for `busy_cores`."""
    start, before = time.perf_counter(), _others_seconds()
    yield
    after, seconds = _others_seconds(), time.perf_counter() - start
    if before is not None and after is not None:
        busy_cores.set(max(busy_cores.get(), (after - before) / seconds))


def is_quiet() -> bool:
    """Whether so busy a machine still gives honest ratios: threads that wait for each other suffer more than others."""
    return busy_cores.get() <= QUIET_SHARE * (os.cpu_count() or 1)


def _others_seconds() -> float | None:
    """CPU seconds that other processes have used since the machine started."""
    try:
        fields = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()[1:]
    except OSError:
        return None
    user, nice, system, _, _, irq, softirq, steal = (int(field) for field in fields[:8])
    total = (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")
    return total - time.process_time()

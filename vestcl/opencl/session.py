"""OpenCL devices, programs and launches. The only module that imports pyopencl, and it opens no device on import.

An operator runs as one `Job`: arrays are bound, kernels enqueued, and leaving the ``with`` block waits and
makes the results visible::

    session = runtime.current()
    with session.job() as job:
        job.launch("unproject.cl", "unproject", {"REAL": "float"}, (count,), [np.int32(count), job.read(depth), ...])

An exception may come up between any two bytecodes (KeyboardInterrupt does). What an interrupted job leaves behind, the
next one clears away: it waits for kernels that still run, and only then lets go of their arrays.
"""

import atexit
import contextvars
import ctypes
import functools
import os
import re
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyopencl as cl
import pyopencl.tools

from vestcl import constants
from vestcl.opencl import icd, pocl_cache, pocl_cpu
from vestcl.opencl.robust_lock import Holder, RobustLock, WithBlock

Defines = Mapping[str, str | int]
Buffer = cl.MemoryObjectHolder
Argument = Buffer | np.generic

#: Readings of a device's clock: what delays one of them does not delay the best.
_CLOCK_READINGS: Final = 8


class DeviceError(RuntimeError):
    """No OpenCL device as asked for, or one that can't do what an operator needs. The message names the remedy."""


@dataclass(frozen=True)
class DeviceInfo:
    """What `vestcl devices` prints about one OpenCL device."""

    index: str
    """``platform:device``, a valid value of VESTCL_DEVICE."""
    platform: str
    name: str
    kind: str
    """"CPU", "GPU" or "accelerator"."""
    compute_units: int
    memory_gib: float
    local_memory_kib: float
    float64: bool
    version: str
    driver: str


@dataclass(frozen=True)
class KernelTime:
    """One kernel launch, from its OpenCL event: name, and start and end in nanoseconds of the device's clock."""

    name: str
    start_ns: int
    end_ns: int


@dataclass(frozen=True)
class Launch:
    """One kernel of a `JobTimes`: nanoseconds of the device's clock, but ``enqueued_ns`` of time.perf_counter_ns."""

    name: str
    enqueued_ns: int
    """Before the call that enqueues it."""
    queued_ns: int
    submitted_ns: int
    start_ns: int
    end_ns: int


@dataclass(frozen=True)
class JobTimes:
    """One outermost job that an observer is told of: nanoseconds of time.perf_counter_ns."""

    session: "Session"
    start_ns: int
    end_ns: int
    """When its results were there."""
    launches: tuple[Launch, ...]


# ---------------------------------------------------------------- processes

#: Whether OpenCL's drivers were loaded: their threads run from then on.
_opencl_runs = False
#: Whether this process was forked off one where they ran. Their threads are not in it: whoever waits for them, hangs.
_forked = False


def _refuse_after_fork() -> None:
    if _forked:
        raise DeviceError(
            "OpenCL was used before this process was forked, and does not work after a fork: start processes with the "
            "method 'spawn' or 'forkserver' (multiprocessing.get_context('spawn'), for a DataLoader "
            "multiprocessing_context='spawn'), or use vestcl's devices only after the fork"
        )


def _after_fork() -> None:
    """In the child: refuse what would hang, and never destroy OpenCL's objects, for that may hang, too."""
    global _forked
    if _opencl_runs:
        _forked = True
        for session in _sessions:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(session))


def _before_exit() -> None:
    """Wait for kernels of an interrupted job: their arrays are about to go."""
    for session in () if _forked else tuple(_sessions):
        if session._unfinished:
            session._queue.finish()


_sessions: "weakref.WeakSet[Session]" = weakref.WeakSet()
atexit.register(_before_exit)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


# ---------------------------------------------------------------- devices


@functools.cache
def _all_devices() -> tuple[tuple[DeviceInfo, cl.Device], ...]:
    global _opencl_runs
    _opencl_runs = True
    cache = pocl_cache.ensure()  # PoCL reads where it is when it is loaded
    if pocl_cache.wrappers_cache_fault():
        cl._PYOPENCL_NO_CACHE = True  # of PYOPENCL_NO_CACHE, which is read when pyopencl is imported
    try:
        platforms = cl.get_platforms()
    except cl.LogicError as error:  # the loader's way to say that there are none
        if "PLATFORM_NOT_FOUND" not in str(error):
            raise
        platforms = []
    found = []
    for p, platform in enumerate(platforms):
        try:
            devices = platform.get_devices()
        except cl.Error:  # a platform without devices (rusticl without RUSTICL_ENABLE) is no reason to fail
            continue
        for d, device in enumerate(devices):
            if pocl_cpu.is_unnamed(platform.version, device.version):
                pocl_cpu.name_cpu(device.int_ptr)
            found.append((_describe(f"{p}:{d}", platform, device), device))
    if cache.note and any("PoCL" in info.version for info, _ in found):
        warnings.warn(cache.note, stacklevel=2)
    return tuple(found)


def _describe(index: str, platform: cl.Platform, device: cl.Device) -> DeviceInfo:
    kinds = {cl.device_type.CPU: "CPU", cl.device_type.GPU: "GPU"}
    return DeviceInfo(
        index=index,
        platform=platform.name.strip(),
        name=device.name.strip(),
        kind=next((kind for flag, kind in kinds.items() if device.type & flag), "accelerator"),
        compute_units=device.max_compute_units,
        memory_gib=device.global_mem_size / 2**30,
        local_memory_kib=device.local_mem_size / 2**10,
        float64="cl_khr_fp64" in device.extensions,
        version=device.version.strip(),
        driver=f"{platform.version.strip()} / {device.driver_version.strip()}",
    )


def devices() -> list[DeviceInfo]:
    """Every device of every OpenCL platform, in the loader's order.

    Raises:
        DeviceError: in a process that was forked after OpenCL was used.
    """
    _refuse_after_fork()
    return [info for info, _ in _all_devices()]


def select(selector: str | None = None) -> DeviceInfo:
    """The device that ``selector`` means.

    Args:
        selector: ``"0:1"`` (platform:device), or a part of the platform's, device's or driver's name in any case, such
            as ``"pocl"``, ``"intel"``, ``"nvidia"``. None: the environment variable VESTCL_DEVICE, and without
            it the first PoCL (pip installs one), else the first CPU, else the first device.

    Raises:
        DeviceError: no device fits, and the message lists those that there are; or as in `devices`.
    """
    name, selector = ("`device`", selector) if selector else ("VESTCL_DEVICE", os.environ.get("VESTCL_DEVICE"))
    infos = devices()
    if not infos:
        raise DeviceError(icd.no_device())
    if selector is None:
        return min(infos, key=lambda info: (info.kind != "CPU", "PoCL" not in info.version))
    if re.fullmatch(r"\d+:\d+", selector):
        chosen = [info for info in infos if info.index == selector]
    else:
        text = selector.lower()
        chosen = [i for i in infos if text in f"{i.platform} {i.name} {i.version} {i.driver}".lower()]
    if not chosen:
        known = "; ".join(f"{info.index} {info.platform} / {info.name}" for info in infos)
        raise DeviceError(f"{name} {selector!r} fits none of the OpenCL devices: {known}")
    return chosen[0]


_selected: contextvars.ContextVar["use | None"] = contextvars.ContextVar("vestcl_device", default=None)


class use(WithBlock):  # noqa: N801 - reads as a verb, like contextlib.suppress
    """Run vestcl's operators on another device: from here on, or inside a ``with`` block.

    It holds for the thread that calls it; other threads start with the default device (set VESTCL_DEVICE for all).
    Gradients are computed on the device that their forward ran on.

    Args:
        selector: as in `select`.
        mapping: how work is laid out, "tile" (a work-item a tile, for CPUs) or "pixel" (a work-item a pixel, tile
            lists in local memory, for GPUs); None takes what suits the device's type.

    >>> vestcl.use("pocl")  # doctest: +SKIP
    >>> with vestcl.use("nvidia"):  # doctest: +SKIP
    ...     image, coverage = vestcl.splat(...)
    """

    def __init__(self, selector: str | None = None, mapping: str | None = None) -> None:
        if mapping not in (None, "tile", "pixel"):
            raise ValueError(f"`mapping` must be 'tile', 'pixel' or None, got {mapping!r}")
        info = select(selector)
        self.session = open_session(info, mapping or ("tile" if info.kind == "CPU" else "pixel"))
        self._permanent = False
        self._before = _use()
        if self._before is not None and self._before._permanent:
            self._before._before = None  # which a ``with`` block would go back to
        _selected.set(self)

    def __enter__(self) -> "Session":
        self._enter()
        self._permanent = False
        _selected.set(self)
        return self.session

    def _leave(self, *_: object) -> None:
        _selected.set(self._before)

    def _holds(self) -> bool:
        """Not where it is for a ``with`` block that an interrupt ended."""
        if self._exit is None:  # no ``with`` statement enters it
            self._permanent = True
        return self._permanent or not self.abandoned


def _use() -> use | None:
    """The last one that holds here."""
    chosen = _selected.get()
    while chosen is not None and not chosen._holds():
        chosen = chosen._before
    return chosen


def current() -> "Session":
    """The session that operators run on now; opens the default device on first use."""
    chosen = _use()
    if chosen is not None:
        return chosen.session
    info = select()
    return open_session(info, "tile" if info.kind == "CPU" else "pixel")


@functools.cache
def open_session(info: DeviceInfo, mapping: str) -> "Session":
    device = next(device for known, device in _all_devices() if known == info)
    if "PoCL" in info.version and (fault := icd.linker_fault() or pocl_cache.ensure().fault):
        raise DeviceError(fault)
    return Session(info, mapping, device)


def free_scratch() -> None:
    """`Session.free_scratch` of every open device; a process that was forked has none."""
    for session in () if _forked else tuple(_sessions):
        session.free_scratch()


# ---------------------------------------------------------------- programs


@functools.cache
def kernel_folder() -> Path:
    """Where the .cl files are: vestcl/kernels in a wheel, kernels/ beside the package in a checkout."""
    package = Path(__file__).resolve().parent
    for folder in (package / "kernels", package.parent / "kernels"):
        if (folder / "common.h").is_file():
            return folder
    raise DeviceError(f"vestcl's OpenCL kernels are missing beside {package}: install the package again")


@functools.cache
def source(name: str) -> str:
    """Kernel file ``name`` with its ``#include "..."`` lines inlined, and #line so that errors point home."""
    text = (kernel_folder() / name).read_text()
    parts = [f'#line 1 "{name}"']
    for number, line in enumerate(text.splitlines(), start=1):
        included = re.fullmatch(r'\s*#include "(.+)"\s*', line)
        parts.append(f'{source(included[1])}\n#line {number + 1} "{name}"' if included else line)
    return "\n".join(parts)


# ---------------------------------------------------------------- sessions and jobs


class observe(WithBlock):  # noqa: N801 - reads as a verb, as `use` does
    """Tell ``observer`` of every job, on any device and in any thread, that begins and ends inside the ``with`` block.

    Args:
        observer: called when a job's results are there, in the job's thread, which still holds the session.

    Raises:
        ValueError: there is an observer already.
    """

    def __init__(self, observer: Callable[[JobTimes], None]) -> None:
        self._observer = observer

    def __enter__(self) -> None:
        global _observation
        self._enter()
        if _current_observer() is not None:
            raise ValueError("`observer` must be the only one, got a second")
        _observation = self

    def _leave(self, *_: object) -> None:
        global _observation
        _observation = None


#: One for the process: what is observed runs in threads that the observer does not know.
_observation: observe | None = None


def _current_observer() -> Callable[[JobTimes], None] | None:
    observation = _observation
    return None if observation is None or observation.abandoned else observation._observer


class Session:
    """An open device: its context, queue, compiled programs and scratch memory. Use it from any thread."""

    def __init__(self, info: DeviceInfo, mapping: str, device: cl.Device) -> None:
        self.info = info
        self.mapping = mapping
        #: That jobs took so far, from their first argument to their last result: what a caller waits for OpenCL.
        self.seconds = 0.0
        # Oclgrind calls itself a CPU, but takes memory that it did not copy for uninitialised.
        self.shares_host_memory = info.kind == "CPU" and info.platform != "Oclgrind"
        # Compilers that turn clang's builtins for prefetching and streaming into the instructions.
        self.compiles_builtins = info.platform.startswith(("Portable Computing Language", "Intel"))
        self._context = cl.Context([device])
        self._device = device
        self._plain_queue = self._queue = cl.CommandQueue(self._context)
        self._kernels: dict[tuple[str, tuple[tuple[str, str | int], ...]], dict[str, cl.Kernel]] = {}
        self._pool = cl.tools.MemoryPool(cl.tools.ImmediateAllocator(self._queue))
        self._lock = RobustLock()
        self._job: Job | None = None
        """The innermost one; it may be abandoned."""
        self._unfinished = False
        """From the begin of an outermost job until its kernels are done; left behind by a job that was interrupted."""
        self._bound: list[tuple[cl.Buffer, np.ndarray]] = []
        """What these kernels may use: it has to outlive them."""
        self._profiles: list[_Profile] = []
        self._launched: list[tuple[str, int, cl.Event]] | None = None
        _sessions.add(self)

    def __repr__(self) -> str:
        return f"Session({self.info.index} {self.info.platform} / {self.info.name}, mapping={self.mapping!r})"

    def job(self) -> "Job":
        """A `Job` on this device; ``with session.job() as job`` holds the device until it is done."""
        return Job(self)

    @property
    def scratch_bytes(self) -> int:
        """Device memory that the session's scratch pool holds now, in use or not: it never shrinks by itself."""
        return int(self._pool.managed_bytes)

    def free_scratch(self) -> None:
        """Give scratch memory that nothing uses back to the system, once the jobs that run now are done."""
        with self.job():
            self._pool.free_held()

    def kernel(self, file: str, name: str, defines: Defines) -> cl.Kernel:
        """Kernel ``name`` of ``file`` built with ``defines``; each program is built once and kept."""
        _refuse_after_fork()
        key = (file, tuple(sorted(defines.items())))
        if key not in self._kernels:
            program = self._build(file, defines)
            self._kernels[key] = {kernel.function_name: kernel for kernel in program.all_kernels()}
        return self._kernels[key][name]

    def _build(self, file: str, defines: Defines) -> cl.Program:
        if defines.get("REAL") == "double" and not self.info.float64:
            raise DeviceError(f"{self.info.name} has no float64: pass float32, or choose another of `vestcl devices`")
        if "PoCL" in self.info.version and (fault := pocl_cache.fault_before_build()):
            raise DeviceError(fault)
        options = ["-cl-std=CL1.2", *(f"-D{key}={value}" for key, value in defines.items())]
        # The CPU that name_cpu() gave is not in the key of PoCL's own disk cache: a comment puts it there.
        text = f"// {pocl_cpu.host_key()}\n{source(file)}"
        try:
            return cl.Program(self._context, text).build(options, cache_dir=None)
        except cl.RuntimeError as error:
            raise DeviceError(f"{file} does not build on {self.info.name} with {' '.join(options)}:\n{error}") from None

    def clock_bounds(self) -> tuple[int, int]:
        """By how much the device's clock is ahead of time.perf_counter_ns: at least and at most, nanoseconds.

        Every reading lies between two of the host's clock, whether the device has a call for it (OpenCL 2.1) or it
        takes an event's times.
        """
        with self.job():
            bounds = [self._clock_bounds() for _ in range(_CLOCK_READINGS)]
        return max(low for low, _ in bounds), min(high for _, high in bounds)

    def _clock_bounds(self) -> tuple[int, int]:
        before = time.perf_counter_ns()
        try:
            first = last = self._device.device_and_host_timer()[0]
        except cl.Error:
            before = time.perf_counter_ns()
            event = cl.enqueue_marker(self._timing_queue)
            event.wait()
            first, last = event.profile.queued, event.profile.end
        after = time.perf_counter_ns()
        return last - after, first - before

    @functools.cached_property
    def _timing_queue(self) -> cl.CommandQueue:
        return cl.CommandQueue(self._context, properties=cl.command_queue_properties.PROFILING_ENABLE)

    def profile(self) -> "_Profile":
        """Collect start and end of every kernel that any thread launches here inside the ``with`` block.

        The block gets a list of `KernelTime` in the order of the launches; it is filled when the block ends.
        """
        return _Profile(self)

    def _enclosing(self) -> "Job | None":
        """The innermost job that this thread is in."""
        job = self._job
        while job is not None and job.abandoned:
            job = job._outer
        return job if job is not None and job.thread == threading.get_ident() else None

    def _begin(self) -> None:
        """Before an outermost job: clear away what an interrupted one left."""
        if self._unfinished:
            self._queue.finish()
            self._finished()
        for profile in tuple(self._profiles):
            if profile.abandoned:
                self._profiles.remove(profile)
        self._launched = None if _current_observer() is None else []
        self._unfinished = True

    def _finished(self) -> None:
        """Nothing is enqueued any more."""
        self._bound.clear()
        self._unfinished = False

    def _queue_for(self, timed: bool) -> cl.CommandQueue:
        """The queue of the next launch; the other one is empty, so that changing them changes no order."""
        wanted = self._timing_queue if timed else self._plain_queue
        if wanted is not self._queue:
            self._queue.finish()
            self._queue = wanted
        return wanted


class _Profile(WithBlock):
    """See `Session.profile`."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._times: list[KernelTime] = []
        self.events: list[tuple[str, cl.Event]] = []

    def __enter__(self) -> list[KernelTime]:
        self._enter()
        _refuse_after_fork()
        self._session._profiles.append(self)
        return self._times

    def _leave(self, *_: object) -> None:
        self._session._profiles.remove(self)
        for name, event in () if _forked else self.events:
            event.wait()
            self._times.append(KernelTime(name, event.profile.start, event.profile.end))


class Job(Holder):
    """Arrays and launches of one operator call. See the module's example. Inside another job, only that one waits."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._outer: Job | None = None
        self._outputs: list[tuple[cl.Buffer, np.ndarray]] = []

    def __enter__(self) -> "Job":
        self._enter()
        _refuse_after_fork()
        session = self.session
        self._outer = session._enclosing()
        if self._outer is None:
            session._lock.acquire(self)
            session._begin()
        else:
            self.thread = self._outer.thread
        session._job = self
        self._started = time.perf_counter_ns()
        return self

    def _leave(self, kind: type[BaseException] | None, *_: object) -> None:
        self.session._job = self._outer
        if self._outer is None:
            self._end(kind is not None)
        else:  # the outer job waits for all
            self._outer._outputs += self._outputs

    def _end(self, failed: bool) -> None:
        session = self.session
        try:
            if not failed:
                self.sync()
            elif _forked:
                return
            else:
                session._queue.finish()
            session._finished()
            if session._launched and not failed:
                self._tell(session._launched)
        finally:
            session.seconds += (time.perf_counter_ns() - self._started) / 1e9
            session._lock.release(self)

    def _tell(self, launched: list[tuple[str, int, cl.Event]]) -> None:
        """The observer, of the launches that are done."""
        observer = _current_observer()
        if observer is not None:
            end = time.perf_counter_ns()
            launches = (
                Launch(name, enqueued, e.profile.queued, e.profile.submit, e.profile.start, e.profile.end)
                for name, enqueued, e in launched
            )
            observer(JobTimes(self.session, self._started, end, tuple(launches)))

    def read(self, array: np.ndarray) -> Buffer:
        """``array`` as kernel input; on a CPU device the kernel reads the array itself."""
        assert array.flags.forc and array.size > 0
        where = cl.mem_flags.USE_HOST_PTR if self.session.shares_host_memory else cl.mem_flags.COPY_HOST_PTR
        buffer = cl.Buffer(self.session._context, cl.mem_flags.READ_ONLY | where, hostbuf=array)
        self.session._bound.append((buffer, array))
        return buffer

    def write(self, array: np.ndarray) -> Buffer:
        """``array`` as kernel output, complete after `sync`; on a CPU device the kernel writes into it."""
        assert array.flags.c_contiguous and array.size > 0
        flags = cl.mem_flags.READ_WRITE
        if self.session.shares_host_memory:
            buffer = cl.Buffer(self.session._context, flags | cl.mem_flags.USE_HOST_PTR, hostbuf=array)
        else:
            buffer = cl.Buffer(self.session._context, flags, size=array.nbytes)
        self.session._bound.append((buffer, array))
        self._outputs.append((buffer, array))
        return buffer

    def scratch(self, count: int, dtype: Any) -> Buffer:
        """Uninitialised device memory from the session's pool; it goes back when the last reference does."""
        return self.session._pool.allocate(max(1, count) * np.dtype(dtype).itemsize)

    def launch(
        self,
        file: str,
        name: str,
        defines: Defines,
        global_size: Sequence[int],
        arguments: Sequence[Argument],
        local_size: Sequence[int] | None = None,
    ) -> None:
        """Enqueue kernel ``name``; scalars come as NumPy scalars of the exact C type."""
        session = self.session
        kernel = session.kernel(file, name, defines)
        values: Sequence[Any] = arguments  # pyopencl's type for them leaves out its own pooled buffers
        kernel.set_args(*values)
        local = tuple(local_size) if local_size else (1,) * len(global_size)
        profiles = tuple(session._profiles)
        queue = session._queue_for(timed=bool(profiles) or session._launched is not None)
        enqueued = time.perf_counter_ns()
        event = cl.enqueue_nd_range_kernel(queue, kernel, tuple(global_size), local)
        for profile in profiles:
            profile.events.append((name, event))
        if session._launched is not None:
            session._launched.append((name, enqueued, event))

    def sync(self) -> None:
        """Wait for everything enqueued; afterwards the arrays given to `write` hold their results."""
        _refuse_after_fork()
        queue = self.session._queue
        maps = []
        for buffer, array in self._outputs:
            if self.session.shares_host_memory:
                place = (cl.map_flags.READ, 0, array.shape, array.dtype)
                maps.append(cl.enqueue_map_buffer(queue, buffer, *place, is_blocking=False)[0])
            else:
                cl.enqueue_copy(queue, array, buffer, is_blocking=False)
        queue.finish()
        for mapped in maps:  # not before: rusticl aborts where a map has not come about yet
            mapped.base.release(queue)
        self._outputs.clear()


def defines_for(dtype: np.dtype, **more: str | int) -> dict[str, str | int]:
    """What every kernel file is built with: REAL, REAL_BITS, the constants, and ``more``."""
    double = dtype == np.float64
    return {
        "REAL": "double" if double else "float",
        "REAL_BITS": 64 if double else 32,
        "NEAR": repr(constants.NEAR),
        "TILE": constants.TILE,
        **more,
    }

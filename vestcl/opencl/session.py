"""Sessions and jobs: an open device, and the arrays and launches of one operator call.

An operator runs as one `Job`: arrays are bound, kernels enqueued, and leaving the ``with`` block waits and
makes the results visible::

    session = opencl.current()
    with session.job() as job:
        arguments = {"count": np.int32(count), "depth": job.read(depth), ...}
        job.launch("unproject.cl", "unproject", {"REAL": "float"}, (count,), arguments)

An exception may come up between any two bytecodes (KeyboardInterrupt does). What an interrupted job leaves behind, the
next one clears away: it waits for kernels that still run, and only then lets go of their arrays.
"""

import atexit
import functools
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyopencl as cl
import pyopencl.tools

from vestcl.opencl import forks, pocl_cache, pocl_cpu
from vestcl.opencl.device_list import DeviceInfo
from vestcl.opencl.errors import DeviceError
from vestcl.opencl.forks import refuse_after_fork, was_forked
from vestcl.opencl.parameters import check_arguments, parameters
from vestcl.opencl.programs import Defines, compiler_warnings, source
from vestcl.opencl.robust_lock import Holder, RobustLock, WithBlock

Buffer = cl.MemoryObjectHolder
Argument = Buffer | np.generic
Arguments = Mapping[str, Argument]

_POCL: Final = "Portable Computing Language"

#: Filters of warnings are the process's: one thread at a time changes them.
_building: Final = threading.Lock()

#: Readings of a device's clock: what delays one of them does not delay the best.
_CLOCK_READINGS: Final = 8


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
    """One outermost job that an observer is reported: nanoseconds of time.perf_counter_ns."""

    session: "Session"
    start_ns: int
    end_ns: int
    """When its results were there."""
    launches: tuple[Launch, ...]


_sessions: "weakref.WeakSet[Session]" = weakref.WeakSet()


def sessions() -> "Iterable[Session]":
    """Those of every open device."""
    return tuple(_sessions)


def _before_exit() -> None:
    """Wait for kernels of an interrupted job: their arrays are about to go."""
    for session in () if was_forked() else tuple(_sessions):
        if session._unfinished:
            session._queue.finish()


atexit.register(_before_exit)


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
        self.compiles_builtins = info.platform.startswith((_POCL, "Intel"))
        self._context = cl.Context([device])
        self._device = device
        self._plain_queue = self._queue = cl.CommandQueue(self._context)
        self._kernels: dict[tuple[str, tuple[tuple[str, str | int], ...]], dict[str, cl.Kernel]] = {}
        self._typed_kernels: dict[tuple[Any, ...], tuple[cl.Kernel, tuple[str, ...]]] = {}
        """By file, name and defines in the order they came in; each with the names of its parameters."""
        #: Results are in the arrays of `Job.write` as soon as a kernel is done; else only after `Job.sync`.
        self.writes_host_memory = self.shares_host_memory and info.platform == _POCL and self._fills_host_memory()
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
        forks.hold(self)

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
        refuse_after_fork()
        key = (file, tuple(sorted(defines.items())))
        if key not in self._kernels:
            program = self._build(file, defines)
            self._kernels[key] = {kernel.function_name: kernel for kernel in program.all_kernels()}
        return self._kernels[key][name]

    def _typed_kernel(
        self, file: str, name: str, defines: Defines, arguments: Arguments
    ) -> tuple[cl.Kernel, tuple[str, ...]]:
        """`kernel`, and the names of its parameters; its first launch shows that ``arguments`` fit them.

        Without types pyopencl tries to read each scalar as a buffer first: 9 us each, 2 us for all of them with types.
        """
        refuse_after_fork()
        key = (file, name, *defines.items())
        if key not in self._typed_kernels:
            kernel = self.kernel(file, name, defines)
            wanted = parameters(source(file), name, defines)
            check_arguments(f"kernel {name} of {file}", wanted, arguments)
            kernel.set_scalar_arg_dtypes([parameter.scalar for parameter in wanted])
            self._typed_kernels[key] = kernel, tuple(parameter.name for parameter in wanted)
        return self._typed_kernels[key]

    def _fills_host_memory(self) -> bool:
        """Whether what the device writes to a buffer over an array is in the array as soon as it is done.

        OpenCL promises that only after a map, which takes PoCL 20 us and which its local devices do not need.
        """
        array = np.zeros(1, np.int32)
        buffer = cl.Buffer(self._context, cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR, hostbuf=array)
        cl.enqueue_fill_buffer(self._queue, buffer, np.ones(1, np.int32), 0, array.nbytes)
        self._queue.finish()
        return bool(array[0] == 1)

    def _build(self, file: str, defines: Defines) -> cl.Program:
        if defines.get("REAL") == "double" and not self.info.float64:
            raise DeviceError(f"{self.info.name} has no float64: pass float32, or choose another of `vestcl devices`")
        if "PoCL" in self.info.version and (fault := pocl_cache.fault_before_build()):
            raise DeviceError(fault)
        options = ["-cl-std=CL1.2", *(f"-D{key}={value}" for key, value in defines.items())]
        # The CPU that name_cpu() gave is not in the key of PoCL's own disk cache: a comment puts it there.
        text = f"// {pocl_cpu.host_key()}\n{source(file)}"
        try:
            with _building, warnings.catch_warnings():
                warnings.simplefilter("ignore", cl.CompilerWarning)  # of any log, even if it reports success
                program = cl.Program(self._context, text).build(options, cache_dir=None)
        except cl.RuntimeError as error:
            raise DeviceError(f"{file} does not build on {self.info.name} with {' '.join(options)}:\n{error}") from None
        if found := compiler_warnings(program.get_build_info(self._device, cl.program_build_info.LOG)):
            warnings.warn(f"{file} builds on {self.info.name} with warnings:\n{found}", stacklevel=2)
        return program

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
        refuse_after_fork()
        self._session._profiles.append(self)
        return self._times

    def _leave(self, *_: object) -> None:
        self._session._profiles.remove(self)
        for name, event in () if was_forked() else self.events:
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
        refuse_after_fork()
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
            elif was_forked():
                return
            else:
                session._queue.finish()
            session._finished()
            if session._launched and not failed:
                self._notify(session._launched)
        finally:
            session.seconds += (time.perf_counter_ns() - self._started) / 1e9
            session._lock.release(self)

    def _notify(self, launched: list[tuple[str, int, cl.Event]]) -> None:
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
        # Not READ_ONLY: Intel's runtime copies such an array where it is not aligned to 128 bytes, at every map, too.
        shared, copied = cl.mem_flags.USE_HOST_PTR, cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
        flags = shared if self.session.shares_host_memory else copied
        buffer = cl.Buffer(self.session._context, flags, hostbuf=array)
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
        arguments: Arguments,
        local_size: Sequence[int] | None = None,
    ) -> None:
        """Enqueue kernel ``name``; arguments go by its parameters' names, scalars as NumPy scalars of the exact C type.

        Raises:
            TypeError: at the kernel's first launch, arguments that do not fit it.
        """
        session = self.session
        kernel, names = session._typed_kernel(file, name, defines, arguments)
        values: list[Any] = [arguments[name] for name in names]  # pyopencl's type leaves out its own pooled buffers
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
        refuse_after_fork()
        queue = self.session._queue
        maps = []
        for buffer, array in self._outputs:
            if not self.session.shares_host_memory:
                cl.enqueue_copy(queue, array, buffer, is_blocking=False)
            elif not self.session.writes_host_memory:
                place = (cl.map_flags.READ, 0, array.shape, array.dtype)
                maps.append(cl.enqueue_map_buffer(queue, buffer, *place, is_blocking=False)[0])
        queue.finish()
        for mapped in maps:  # not before: rusticl aborts where a map has not come about yet
            mapped.base.release(queue)
        self._outputs.clear()

"""One time line of Python's stages, the jobs that they give to OpenCL, and the kernels; ui.perfetto.dev opens the file.

A recording sees every thread and every device of the process::

    with trace.record("trace.json"):
        with trace.stage("forecast"), trace.stage("splat"):
            vestcl.splat(...)

A `stage` is a span of `vestcl.clock`, as all timed stages are. Format: Chrome's Trace Event Format, a track for
each Python thread and each device. A device's times come from its OpenCL events: t_host = t_device - d, with d from
`Session`'s clock bounds; no kernel is then before the call that enqueued it, or after the wait for its job.
"""

import contextlib
import json
import os
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from vestcl import opencl
from vestcl._version import __version__
from vestcl.clock import record_spans
from vestcl.clock import span as stage
from vestcl.io import atomic

__all__ = ["record", "stage"]

#: Nanoseconds after which a device's clock is compared with the host's again: clocks drift by tens of ppm, which is
#: some ten microseconds then.
_CLOCK_AGE: Final = 10**9

#: Numbers of the devices' tracks, from here on: beyond every process's and thread's of Linux (2^22 at most).
_DEVICE_TRACKS: Final = 2**24

Event = dict[str, Any]


@dataclass(frozen=True)
class _Span:
    """Something that a Python thread did, nanoseconds of time.perf_counter_ns."""

    name: str
    category: str
    thread: int
    start: int
    end: int


@dataclass(frozen=True)
class _Kernel:
    """A launch with all times on the host's clock, nanoseconds."""

    device: opencl.DeviceInfo
    name: str
    thread: int
    enqueued: int
    queued: int
    submitted: int
    start: int
    end: int


class _Recording:
    """What has happened so far. Lists only grow, by calls that are whole in any thread."""

    def __init__(self) -> None:
        self.began = time.perf_counter_ns()
        self.spans: list[_Span] = []
        self.kernels: list[_Kernel] = []
        self.threads: dict[int, str] = {}
        self._clocks: dict[opencl.Session, tuple[int, int]] = {}

    def span(self, name: str, category: str, start: int, end: int) -> int:
        """Keep a span of the calling thread; the thread's number."""
        thread = threading.get_native_id()
        self.threads[thread] = threading.current_thread().name
        self.spans.append(_Span(name, category, thread, start, end))
        return thread

    def job(self, times: opencl.JobTimes) -> None:
        """Keep a job and its kernels."""
        thread = self.span("OpenCL job", "opencl", times.start_ns, times.end_ns)
        ahead = self._ahead(times)
        for one in times.launches:
            device_times = (t - ahead for t in (one.queued_ns, one.submitted_ns, one.start_ns, one.end_ns))
            self.kernels.append(_Kernel(times.session.info, one.name, thread, one.enqueued_ns, *device_times))

    def _ahead(self, times: opencl.JobTimes) -> int:
        """By how much the device's clock is ahead, nanoseconds: as it was compared, within what the job allows."""
        compared, ahead = self._clocks.get(times.session, (0, 0))
        if not compared or times.end_ns - compared > _CLOCK_AGE:
            ahead = sum(times.session.clock_bounds()) // 2
            self._clocks[times.session] = times.end_ns, ahead
        least = max(one.end_ns for one in times.launches) - times.end_ns
        most = min(one.queued_ns - one.enqueued_ns for one in times.launches)
        # A driver that doesn't report when a kernel was queued allows nothing.
        return min(max(ahead, least), most) if least <= most else ahead


class _Record(opencl.observe):
    """See `record`."""

    def __init__(self, path: str | Path) -> None:
        self.recording = _Recording()
        self._path = path
        super().__init__(self.recording.job)

    def __enter__(self) -> None:
        global _record
        if _record is not None and not _record.abandoned:
            raise ValueError(f"`path` must be the only trace that is recorded, got {self._path} while another one is")
        super().__enter__()
        _record = self
        record_spans(self._stage)

    def _stage(self, name: str, start: int, end: int) -> None:
        """Keep a span; not one of the time before, nor one after an interrupt ended the ``with`` block."""
        if not self.abandoned and start >= self.recording.began:
            self.recording.span(name, "stage", start, end)

    def _leave(self, *_: object) -> None:
        global _record
        _record = None
        record_spans(None)
        super()._leave()
        atomic.write_bytes(self._path, (json.dumps(_content(self.recording)) + "\n").encode())


#: What records. One for the process, because stages of all threads belong to it.
_record: _Record | None = None


def record(path: str | Path | None) -> AbstractContextManager[None]:
    """Record stages and kernels of all threads inside the ``with`` block, and write them when it ends, well or not.

    Args:
        path: JSON file; it is replaced whole. None records nothing.

    Raises:
        ValueError: something records already, or the file's folder can't be made.

    Source: Chrome's "Trace Event Format", as Perfetto reads it.
    """
    return contextlib.nullcontext() if path is None else _Record(path)


# ---------------------------------------------------------------- the file


def _content(recording: _Recording) -> dict[str, Any]:
    """The JSON file's."""
    infos = sorted({kernel.device for kernel in recording.kernels}, key=lambda info: info.index)
    devices = {info: _DEVICE_TRACKS + number for number, info in enumerate(infos)}
    events = list(_names(recording, devices))
    events += sorted(_spans(recording), key=lambda event: (event["ts"], -event["dur"]))
    events += _kernels(recording, devices)
    about = {"vestcl": __version__, "devices": [f"{info.index} {info.name}, {info.driver}" for info in devices]}
    return {"traceEvents": events, "displayTimeUnit": "ms", "otherData": about}


def _names(recording: _Recording, devices: dict[opencl.DeviceInfo, int]) -> Iterator[Event]:
    """Metadata: what tracks are called."""
    process = os.getpid()
    yield _meta("process_name", process, process, name="vestcl")
    yield _meta("process_sort_index", process, process, sort_index=0)
    for thread, name in recording.threads.items():
        yield _meta("thread_name", process, thread, name=name)
    for info, track in devices.items():
        yield _meta("process_name", track, track, name=f"OpenCL {info.index} {info.name}")
        yield _meta("process_sort_index", track, track, sort_index=1)
        yield _meta("thread_name", track, track, name="kernels")


def _meta(kind: str, process: int, thread: int, **arguments: str | int) -> Event:
    return {"ph": "M", "name": kind, "pid": process, "tid": thread, "ts": 0, "args": arguments}


def _spans(recording: _Recording) -> Iterator[Event]:
    for one in recording.spans:
        start = _microseconds(recording, one.start)
        place = {"pid": os.getpid(), "tid": one.thread, "ts": start, "dur": (one.end - one.start) / 1e3}
        yield {"ph": "X", "cat": one.category, "name": one.name, **place}


def _kernels(recording: _Recording, devices: dict[opencl.DeviceInfo, int]) -> Iterator[Event]:
    """Each kernel, and an arrow to it from the job that launched it."""
    ends = dict.fromkeys(devices, 0)
    for number, one in enumerate(sorted(recording.kernels, key=lambda kernel: kernel.start)):
        # A queue runs one kernel at a time, and so does a track; clocks that were compared twice may differ by a bit.
        start = max(one.start, ends[one.device])
        end = ends[one.device] = max(one.end, start)
        track = devices[one.device]
        place = {"pid": track, "tid": track, "ts": _microseconds(recording, start)}
        known = {name: _microseconds(recording, getattr(one, name)) for name in ("enqueued", "queued", "submitted")}
        waited = {"waited, us": (one.start - one.enqueued) / 1e3}
        yield {
            "ph": "X",
            "cat": "kernel",
            "name": one.name,
            **place,
            "dur": (end - start) / 1e3,
            "args": known | waited,
        }
        arrow = {"cat": "launch", "name": "launch", "id": number + 1}
        yield {"ph": "s", **arrow, "pid": os.getpid(), "tid": one.thread, "ts": known["enqueued"]}
        yield {"ph": "f", "bp": "e", **arrow, **place}


def _microseconds(recording: _Recording, time_ns: int) -> float:
    return (time_ns - recording.began) / 1e3

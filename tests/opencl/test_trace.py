"""vestcl.opencl.trace: the file that Perfetto opens, held against its format and against what happened."""

import itertools
import json
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vestcl import opencl
from vestcl.opencl import trace
from vestcl.ops.unproject import unproject

Event = dict[str, Any]

#: Microseconds are written from whole nanoseconds: sums of them round by less.
ROUNDING = 1e-3


def run_kernel(count: int = 64) -> None:
    unproject(np.ones((1, 1, count, count), np.float32), np.eye(3, dtype=np.float32)[None])


def events_of(path: Path) -> list[Event]:
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content["displayTimeUnit"] == "ms" and content["otherData"]["vestcl"]
    return content["traceEvents"]


def spans(events: list[Event], category: str) -> list[Event]:
    return [event for event in events if event["ph"] == "X" and event["cat"] == category]


def lies_in(inner: Event, outer: Event) -> bool:
    return outer["ts"] - ROUNDING <= inner["ts"] and inner["ts"] + inner["dur"] <= outer["ts"] + outer["dur"] + ROUNDING


@pytest.fixture
def traced(session: opencl.Session, tmp_path: Path) -> list[Event]:
    """Two stages with kernels, one in the other, and one next to them in another thread."""

    def elsewhere() -> None:
        with opencl.use(session.info.index), trace.stage("other thread"):
            run_kernel()

    path = tmp_path / "new folder" / "trace.json"
    with trace.record(path):
        with trace.stage("outer"):
            run_kernel()
            with trace.stage("inner"):
                run_kernel()
                run_kernel()
        with trace.stage("nothing"):
            pass
        thread = threading.Thread(target=elsewhere, name="helper")
        thread.start()
        thread.join()
    assert [file.name for file in path.parent.iterdir()] == ["trace.json"]
    return events_of(path)


def test_the_format(traced: list[Event]) -> None:
    for event in traced:
        assert isinstance(event["name"], str) and event["ph"] in "XMsf"
        assert type(event["pid"]) is int and type(event["tid"]) is int and event["pid"] > 0 and event["tid"] > 0
        assert event["ts"] >= 0
        assert event["ph"] != "X" or event["dur"] >= 0
        assert event["ph"] != "M" or set(event["args"]) in ({"name"}, {"sort_index"})
    named = {(event["pid"], event["tid"]) for event in traced if event["name"] == "thread_name"}
    assert {(event["pid"], event["tid"]) for event in traced if event["ph"] == "X"} == named
    assert len({tid for _, tid in named}) == len(named), "Perfetto takes a thread's number for unique"


def test_tracks_are_named(traced: list[Event], session: opencl.Session) -> None:
    names = {kind: {e["args"]["name"] for e in traced if e["name"] == kind} for kind in ("process_name", "thread_name")}
    assert names["process_name"] == {"vestcl", f"OpenCL {session.info.index} {session.info.name}"}
    assert names["thread_name"] == {threading.current_thread().name, "helper", "kernels"}


def test_stages_nest(traced: list[Event]) -> None:
    stages = {event["name"]: event for event in spans(traced, "stage")}
    assert set(stages) == {"outer", "inner", "nothing", "other thread"}
    assert lies_in(stages["inner"], stages["outer"]) and not lies_in(stages["nothing"], stages["outer"])
    assert stages["inner"]["tid"] == stages["outer"]["tid"] != stages["other thread"]["tid"]
    assert {event["pid"] for event in stages.values()} == {os.getpid()}


def test_kernels_lie_in_what_launched_them(traced: list[Event]) -> None:
    stages = {event["name"]: event for event in spans(traced, "stage")}
    kernels = spans(traced, "kernel")
    assert [kernel["name"] for kernel in kernels] == ["unproject"] * 4
    for kernel, own in zip(kernels, ("outer", "inner", "inner", "other thread"), strict=True):
        assert lies_in(kernel, stages[own])
        assert [job for job in spans(traced, "opencl") if lies_in(kernel, job)]
        times = [kernel["args"][name] for name in ("enqueued", "queued", "submitted")]
        assert sorted(times) == pytest.approx(times, abs=ROUNDING) and times[-1] <= kernel["ts"] + ROUNDING
    assert lies_in(kernels[1], stages["outer"]) and not lies_in(kernels[0], stages["inner"])
    for before, after in itertools.pairwise(kernels):
        assert before["ts"] + before["dur"] <= after["ts"] + ROUNDING


def test_an_arrow_leads_from_a_job_to_each_kernel(traced: list[Event]) -> None:
    kernels, jobs = spans(traced, "kernel"), spans(traced, "opencl")
    starts = {event["id"]: event for event in traced if event["ph"] == "s"}
    ends = {event["id"]: event for event in traced if event["ph"] == "f"}
    assert len(starts) == len(kernels) and set(starts) == set(ends)
    for number, end in ends.items():
        assert end["bp"] == "e"
        assert [kernel for kernel in kernels if (kernel["ts"], kernel["tid"]) == (end["ts"], end["tid"])]
        start = starts[number] | {"dur": 0}
        assert [job for job in jobs if job["tid"] == start["tid"] and lies_in(start, job)]


def test_nothing_is_recorded_outside(session: opencl.Session, tmp_path: Path) -> None:
    path = tmp_path / "trace.json"
    with trace.stage("before"):
        run_kernel()
    with trace.record(None), trace.stage("to no file"):
        run_kernel()
    with trace.record(path):
        run_kernel()
    with trace.stage("after"):
        run_kernel()
    assert not spans(events_of(path), "stage") and len(spans(events_of(path), "kernel")) == 1


def test_a_failure_leaves_the_trace_up_to_it(session: opencl.Session, tmp_path: Path) -> None:
    path = tmp_path / "trace.json"
    with pytest.raises(ValueError, match="`K` must be invertible"), trace.record(path), trace.stage("fails"):
        unproject(np.ones((1, 1, 2, 2), np.float32), np.zeros((1, 3, 3), np.float32))
    assert [event["name"] for event in spans(events_of(path), "stage")] == ["fails"]
    with trace.record(path):
        pass
    assert not spans(events_of(path), "stage"), "it can record again"


def test_one_trace_at_a_time(tmp_path: Path) -> None:
    with trace.record(tmp_path / "first.json"):
        with pytest.raises(ValueError, match="`path` must be the only trace"), trace.record(tmp_path / "second.json"):
            pass
        run_kernel()
    assert [file.name for file in tmp_path.iterdir()] == ["first.json"]
    assert len(spans(events_of(tmp_path / "first.json"), "kernel")) == 1


@pytest.mark.parametrize("ahead", [-(10**15), 0, 10**12], ids=["behind", "equal", "ahead"])
def test_a_device_may_count_from_any_time(session: opencl.Session, ahead: int) -> None:
    """Kernels of a made-up clock come back to where they were; what one comparison got wrong, the job's bounds mend."""
    recording = trace._Recording()
    wrong = 1_000_000  # more than the job's bounds allow
    recording._clocks[session] = recording.began, ahead + wrong
    launches = [
        opencl.Launch(name, recording.began + at, *(recording.began + ahead + at + later for later in (1, 2, 10, 40)))
        for name, at in (("first", 100), ("second", 200))
    ]
    recording.job(opencl.JobTimes(session, recording.began + 50, recording.began + 300, tuple(launches)))
    for kernel, at in zip(recording.kernels, (100, 200), strict=True):
        assert kernel.enqueued == recording.began + at <= kernel.queued < kernel.submitted < kernel.start
        assert kernel.end <= recording.began + 300 and kernel.end - kernel.start == 30


def test_a_driver_that_does_not_report_when_kernels_are_queued(session: opencl.Session) -> None:
    recording = trace._Recording()
    recording._clocks[session] = recording.began, 7
    launch = opencl.Launch("kernel", recording.began + 10, 0, 0, recording.began + 27, recording.began + 37)
    recording.job(opencl.JobTimes(session, recording.began, recording.began + 100, (launch,)))
    assert recording.kernels[0].start == recording.began + 20


def test_clocks_are_compared_again_when_they_may_have_drifted(
    session: opencl.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared: list[int] = []
    monkeypatch.setattr(session, "clock_bounds", lambda: (compared.append(1) or 0, 0))
    recording = trace._Recording()
    for end in (10, 20, 10 + trace._CLOCK_AGE, 11 + trace._CLOCK_AGE, 12 + trace._CLOCK_AGE):
        launch = opencl.Launch("kernel", end - 5, end - 4, end - 4, end - 3, end - 2)
        recording.job(opencl.JobTimes(session, end - 6, end, (launch,)))
    assert len(compared) == 2

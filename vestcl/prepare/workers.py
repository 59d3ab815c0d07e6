"""Clips prepared one after the other, here or in separate processes. One clip's failure stops no other."""

import multiprocessing
import os
import queue
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import cv2
import torch

from vestcl import interrupt
from vestcl.prepare.clip import Outcome, Report

#: Seconds between two looks at what other processes report.
_TICK: Final = 0.1


@dataclass(frozen=True)
class Task:
    """A clip to prepare."""

    text: str
    """The input, as the command line has it."""
    folder: Path
    frames: int


@dataclass
class Summary:
    """What the run comes to."""

    computed: int = 0
    kept: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        self.computed += outcome.computed
        self.kept += outcome.kept
        for stage, taken in outcome.seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + taken


Work = Callable[[Task, bool, Report], Outcome | None]
"""Prepares a task's clip, waiting for other processes at it or not; can be pickled."""

Advance = Callable[[], None]


def run_tasks(tasks: Sequence[Task], work: Work, summary: Summary, advance: Advance, workers: int) -> None:
    """First the clips that no other process is at, then the rest.

    Args:
        tasks: one per clip.
        work: what is done for each.
        summary: is added to; a ValueError becomes one of its failures.
        advance: called after each frame.
        workers: 1 works in this process.

    Raises:
        OSError: a frame can't be written, or a process was killed.
    """
    if workers == 1:
        _run_here(tasks, work, summary, advance)
    else:
        _run_apart(tasks, work, summary, advance, workers)


def _run_here(tasks: Sequence[Task], work: Work, summary: Summary, advance: Advance) -> None:
    """First the clips that no other process is at, then the rest."""
    for waits in (False, True):
        later = []
        for task in tasks:
            try:
                outcome = work(task, waits, lambda computed: advance())
            except ValueError as error:
                summary.failures.append(str(error))
                continue
            if outcome is None:
                later.append(task)
            else:
                summary.add(outcome)
        tasks = later


def _run_apart(tasks: Sequence[Task], work: Work, summary: Summary, advance: Advance, workers: int) -> None:
    """The same in separate processes, forked from one that has loaded torch, but used neither it nor OpenCL."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    frames: multiprocessing.Queue[bool] = context.Queue()
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(workers, context, _start_worker, (frames, workers)) as pool:
        try:
            for waits in (False, True):
                with interrupt.shielded():  # which starts the processes
                    futures = {pool.submit(_work, work, task, waits): task for task in tasks}
                tasks = [futures[done] for done in _finished(futures, frames, advance) if _is_busy(done, summary)]
        except BaseException as error:
            if interrupt.is_interrupt(error):  # nobody waits for the clips that are being prepared
                for process in set(multiprocessing.active_children()) - others:
                    process.terminate()
            pool.shutdown(cancel_futures=True)
            raise


def _is_busy(done: "Future[Outcome | None]", summary: Summary) -> bool:
    """Notes what a process came to; whether another one is at its clip."""
    try:
        outcome = done.result()
    except BrokenProcessPool as error:
        raise ChildProcessError("a worker was killed, perhaps for memory; fewer `--workers` need less") from error
    except ValueError as error:
        summary.failures.append(str(error))
        return False
    if outcome is not None:
        summary.add(outcome)
    return outcome is None


def _finished(
    futures: Mapping["Future[Outcome | None]", Task], frames: "multiprocessing.Queue[bool]", advance: Advance
) -> "Iterator[Future[Outcome | None]]":
    """Each when it is; meanwhile frames are counted."""
    pending = set(futures)
    while pending:
        done, pending = wait(pending, _TICK, FIRST_COMPLETED)
        while True:
            try:
                frames.get_nowait()
            except queue.Empty:
                break
            advance()
        yield from done


_reports: "multiprocessing.Queue[bool] | None" = None


def _start_worker(frames: "multiprocessing.Queue[bool]", workers: int) -> None:
    global _reports
    _reports = frames
    threads = max(1, len(os.sched_getaffinity(0)) // workers)
    cv2.setNumThreads(threads)
    torch.set_num_threads(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A pool's processes would wait for ever for work from one that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(work: Work, task: Task, waits: bool) -> Outcome | None:
    assert _reports is not None
    return work(task, waits, _reports.put)

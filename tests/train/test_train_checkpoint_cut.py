"""Processes that die while writing a checkpoint: killed, or out of disk space. Earlier checkpoints stay."""

import itertools
import os
import random
import resource
import shutil
import signal
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest
import torch
from checkpoint_states import state_of, steps
from forecaster_scenes import TINY
from processes import Process

from train.run.checkpoint import CheckpointError, TrainingState, _verified, list_checkpoints, load_latest, save

#: Where a checkpoint's files are changed: calls to the system, and the ways of the standard library to them.
CALLS: Final = (
    *((os, name) for name in ("fsync", "unlink", "rmdir", "mkdir", "replace", "rename")),
    *((Path, name) for name in ("rename", "replace", "write_text", "write_bytes")),
    (shutil, "rmtree"),
)


def save_forever(out: Path, first: int) -> None:
    """Save a state of some 20 MB again and again, and report each step before it begins and after it is done."""
    for step in itertools.count(first):
        weights = {"w": torch.full((1_000_000,), float(step))}
        print("begin", step, flush=True)
        save(out, TrainingState(step, {}, TINY, weights, weights, {"m": [weights["w"] + 1] * 3}, {}), keep=2)
        print("done", step, flush=True)


def save_too_much(out: Path, weights: int, moments: int) -> None:
    """Save a state that fits beneath the file-size limit, and then one that does not."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))

    def state(step: int, weights: int, moments: int) -> TrainingState:
        return TrainingState(step, {}, TINY, {"w": torch.zeros(weights)}, None, {"m": torch.zeros(moments)}, {})

    save(out, state(1, 1000, 1000))
    try:
        save(out, state(2, weights, moments))
    except CheckpointError as error:
        print(error)
        save(out, state(3, 1000, 1000))


def small_state(step: int) -> TrainingState:
    weights = {"w": torch.full((100,), float(step))}
    return TrainingState(step, {}, TINY, weights, weights, {"m": weights["w"] + 1}, {})


def save_and_die(out: Path, number: int) -> None:
    """Save step 4, killed before the ``number``-th of `CALLS`."""
    left = [number]

    def deadly(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            left[0] -= 1
            if left[0] < 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **options)

        return call

    for owner, name in CALLS:
        setattr(owner, name, deadly(getattr(owner, name)))
    save(out, small_state(4), keep=2)
    os._exit(0)


def die_everywhere(folder: Path) -> None:
    """Save step 4 over steps 2 and 3, killed at the first call to the system, in another copy at the second, ..."""
    torch.set_num_threads(1)
    for number in itertools.count():
        out = folder / str(number)
        for step in (2, 3):
            save(out, small_state(step), keep=2)
        child = os.fork()
        if not child:
            save_and_die(out, number)
        ended = os.waitpid(child, 0)[1]
        loaded = load_latest(out)
        assert loaded is not None and loaded.ema is not None and loaded.step in (3, 4)
        assert loaded.model["w"][0] == loaded.ema["w"][0] == loaded.step, number
        assert all(_verified(path) for path in list_checkpoints(out)), number
        print(loaded.step)
        save(out, small_state(5), keep=2)
        assert steps(out)[0] == 5 and len(list(out.glob("checkpoints/*"))) == 2, number
        assert not list(out.glob("checkpoints/.*")), number
        if ended == 0:
            return
        assert ended == signal.SIGKILL


@pytest.mark.parametrize(("weights", "moments"), [(1_000_000, 10), (10, 1_000_000)])
def test_a_file_that_the_system_cuts_short(tmp_path: Path, weights: int, moments: int) -> None:
    """The limit on a file's size is met in the middle of it, as a full disk is."""
    process = Process(tmp_path / "log", save_too_much, tmp_path, weights, moments)
    assert process.wait() == 0, process.output
    assert "step-00000002 could not be written" in process.output and "it takes 4.0 MB" in process.output
    assert steps(tmp_path) == [3, 1] and not list((tmp_path / "checkpoints").glob(".*"))


def test_kill_at_every_step_of_saving(tmp_path: Path) -> None:
    process = Process(tmp_path / "log", die_everywhere, tmp_path)
    assert process.wait() == 0, process.output
    found = process.output.split()
    assert found == sorted(found) and found.count("3") > 5 and found.count("4") > 2


def wait_for_a_beginning(process: Process, folder: Path, first: int) -> None:
    """Until the process has written one checkpoint, and is about the next."""
    process.reports(f"done {first}")
    deadline = time.monotonic() + 60
    while not list(folder.glob(".step-*")) and time.monotonic() < deadline:
        time.sleep(0.001)


def test_kill_in_the_middle_of_saving_leaves_a_loadable_state(tmp_path: Path) -> None:
    """At random moments; whatever was reported as done is there, and what was cut off is cleaned up by the next."""
    moments, first, cut = random.Random(0), 0, 0
    for attempt in range(4):
        process = Process(tmp_path / f"log {attempt}", save_forever, tmp_path, first)
        wait_for_a_beginning(process, tmp_path / "checkpoints", first)
        time.sleep(moments.uniform(0, 0.05))
        process.kill()
        process.wait()
        lines = [line.split() for line in process.output.splitlines()]
        done = [int(step) for word, step in lines if word == "done"]
        cut += bool(list((tmp_path / "checkpoints").glob(".*")))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            loaded = load_latest(tmp_path)
        assert loaded is not None and loaded.step >= done[-1]
        assert (loaded.model["w"] == loaded.step).all() and (loaded.optimiser["m"][0] == loaded.step + 1).all()
        first = loaded.step + 1
    assert cut, "no process was killed while it wrote"
    save(tmp_path, state_of(first), keep=2)
    assert len(list((tmp_path / "checkpoints").iterdir())) == len(steps(tmp_path)) == 2

"""Processes that die while writing a checkpoint: killed, or out of disk space. Earlier checkpoints stay."""

import os
import random
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
from checkpoint_states import state_of, steps

from train.run.checkpoint import load_latest, save

ROOT = Path(__file__).resolve().parents[2]

#: Saves a state of some 20 MB again and again, and reports each step before it begins and after it is done.
SAVES_FOREVER = """
import itertools, sys, torch
from forecaster_scenes import TINY
from train.run.checkpoint import TrainingState, save
for step in itertools.count(int(sys.argv[2])):
    weights = {"w": torch.full((1_000_000,), float(step))}
    print("begin", step, flush=True)
    save(sys.argv[1], TrainingState(step, {}, TINY, weights, weights, {"m": [weights["w"] + 1] * 3}, {}), keep=2)
    print("done", step, flush=True)
"""

#: Saves one that fits beneath the file-size limit, and then one that does not.
SAVES_TOO_MUCH = """
import resource, sys, torch
from forecaster_scenes import TINY
from train.run.checkpoint import CheckpointError, TrainingState, save
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))
def state(step, weights, moments):
    return TrainingState(step, {}, TINY, {"w": torch.zeros(weights)}, None, {"m": torch.zeros(moments)}, {})
save(sys.argv[1], state(1, 1000, 1000))
try:
    save(sys.argv[1], state(2, *map(int, sys.argv[2:])))
except CheckpointError as error:
    print(error)
    save(sys.argv[1], state(3, 1000, 1000))
"""


#: Saves step 4 over steps 2 and 3, killed at the first call to the system, in another copy at the second, and so on.
DIES_EVERYWHERE = """
import os, pathlib, shutil, signal, sys, torch
from forecaster_scenes import TINY
from train.run.checkpoint import TrainingState, _verified, list_checkpoints, load_latest, save
torch.set_num_threads(1)

def state(step):
    weights = {"w": torch.full((100,), float(step))}
    return TrainingState(step, {}, TINY, weights, weights, {"m": weights["w"] + 1}, {})

def deadly(function, calls):
    def call(*arguments, **options):
        calls[0] -= 1
        if calls[0] < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)
    return call

def save_and_die(out, number):
    calls = [number]
    for module, name in (
        (os, "fsync"), (os, "unlink"), (os, "rmdir"), (os, "mkdir"), (os, "replace"), (os, "rename"),
        (pathlib.Path, "rename"), (pathlib.Path, "replace"), (pathlib.Path, "write_text"),
        (pathlib.Path, "write_bytes"), (shutil, "rmtree"),
    ):
        setattr(module, name, deadly(getattr(module, name), calls))
    save(out, state(4), keep=2)
    os._exit(0)

number, ended = 0, None
while ended != 0:
    out = pathlib.Path(sys.argv[1]) / str(number)
    for step in (2, 3):
        save(out, state(step), keep=2)
    child = os.fork()
    if not child:
        save_and_die(out, number)
    ended = os.waitpid(child, 0)[1]
    loaded = load_latest(out)
    assert loaded.step in (3, 4) and loaded.model["w"][0] == loaded.ema["w"][0] == loaded.step, number
    assert all(_verified(path) for path in list_checkpoints(out)), number
    assert ended == 0 or ended == signal.SIGKILL
    print(loaded.step)
    save(out, state(5), keep=2)
    assert load_latest(out).step == 5 and len(list(out.glob("checkpoints/*"))) == 2, number
    assert not list(out.glob("checkpoints/.*")), number
    number += 1
"""


def child(code: str, *arguments: object, **options: Any) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support")])}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, **options)


@pytest.mark.parametrize(("weights", "moments"), [(1_000_000, 10), (10, 1_000_000)])
def test_a_file_that_the_system_cuts_short(tmp_path: Path, weights: int, moments: int) -> None:
    """The limit on a file's size is met in the middle of it, as a full disk is."""
    process = child(SAVES_TOO_MUCH, tmp_path, weights, moments)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    assert "step-00000002 could not be written" in output and "it takes 4.0 MB" in output
    assert steps(tmp_path) == [3, 1] and not list((tmp_path / "checkpoints").glob(".*"))


def test_kill_at_every_step_of_saving(tmp_path: Path) -> None:
    process = child(DIES_EVERYWHERE, tmp_path)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    found = output.split()
    assert found == sorted(found) and found.count("3") > 5 and found.count("4") > 2


def wait_for_a_beginning(process: subprocess.Popen[str], folder: Path) -> None:
    """Until the process has written one checkpoint, and is about the next."""
    assert process.stdout is not None
    for word in ("begin", "done"):
        assert process.stdout.readline().startswith(word)
    deadline = time.monotonic() + 60
    while not list(folder.glob(".step-*")) and time.monotonic() < deadline:
        time.sleep(0.001)


def test_kill_in_the_middle_of_saving_leaves_a_loadable_state(tmp_path: Path) -> None:
    """At random moments; whatever was reported as done is there, and what was cut off is cleaned up by the next."""
    moments, first, cut = random.Random(0), 0, 0
    for _ in range(4):
        process = child(SAVES_FOREVER, tmp_path, first)
        wait_for_a_beginning(process, tmp_path / "checkpoints")
        time.sleep(moments.uniform(0, 0.05))
        process.send_signal(signal.SIGKILL)
        assert process.stdout is not None
        reported = process.stdout.read().split()
        process.stdout.close()
        process.wait(60)
        done = [first, *(int(step) for word, step in zip(reported[::2], reported[1::2], strict=True) if word == "done")]
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

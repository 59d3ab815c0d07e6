"""Threads of commands: the environment before libraries load, `--threads`, and the line of slow commands."""

import os
import subprocess
import sys

import cv2
import pytest
import torch

from vestcl.cli import main as cli
from vestcl.cli import threads


@pytest.mark.parametrize(
    ("arguments", "count", "rest"),
    [
        ("forecast x --threads 3 --out y", 3, "forecast x --out y"),
        ("bench splat --threads=1", 1, "bench splat"),
        ("bench splat", None, "bench splat"),
    ],
)
def test_the_option_is_found_and_taken_out(arguments: str, count: int | None, rest: str) -> None:
    assert threads.asked_for(arguments.split()) == count
    assert threads.without_option(arguments.split()) == rest.split()


@pytest.mark.parametrize("value", ["0", "-1", "many", "1.5"])
def test_no_number_of_threads(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert threads.asked_for(["--threads", value]) is None
    assert cli.main(["bench", "splat", f"--threads={value}"]) == 2
    assert capsys.readouterr().err == f"error: --threads must be 1 or more, got {value}\n"


def test_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*threads.DEFAULTS, *threads.LIMITS):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    threads.settle(["forecast", "x"])
    assert os.environ["OMP_WAIT_POLICY"] == "passive" and os.environ["OPENBLAS_NUM_THREADS"] == "7"
    assert not any(name in os.environ for name in threads.LIMITS)
    threads.settle(["forecast", "x", "--threads", "2"])
    assert {os.environ[name] for name in threads.LIMITS} == {"2"}


def test_a_command_sets_it_before_anything_is_loaded() -> None:
    code = """
import sys
sys.argv = ["vestcl", "devices", "--threads", "1"]
from vestcl.cli import threads
settle = threads.settle
def checked(arguments):
    assert not {"torch", "numpy", "cv2", "pyopencl"} & set(sys.modules)
    settle(arguments)
threads.settle = checked
from vestcl.cli.main import main
status = main()
import os, torch
print(status, torch.get_num_threads(), os.environ["OMP_WAIT_POLICY"])
"""
    environment = {
        name: value for name, value in os.environ.items() if name not in (*threads.DEFAULTS, *threads.LIMITS)
    }
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 1 passive"


def test_as_a_function_it_limits_what_is_loaded() -> None:
    before = torch.get_num_threads(), cv2.getNumThreads()
    try:
        threads.apply(1)
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (1, 1)
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])
    with pytest.raises(ValueError, match="`threads` must be 1 or more, got 0"):
        threads.apply(0)


def test_the_line_of_a_slow_command() -> None:
    line = threads.slow_line(42.0, 4.0)
    assert line is not None and "took 42 s for 4 s of CPU time" in line and "--threads 1" in line
    assert threads.slow_line(42.0, 5.0) is None and threads.slow_line(10.0, 0.1) is None

"""`make gpu-check`: what it finds, prints and exits with, with stand-ins for its steps."""

import dataclasses
import json
import sys
from pathlib import Path

import gpu_check
import pytest
from gpu_check import Step

from vestcl import opencl

MEASURED = [
    {"row": "splat forward", "column": "ms (quartiles)", "text": "1.5 (1.4-1.6)", "median": 0.0015},
    {"row": "splat forward", "column": "error", "text": "6e-08", "median": 6e-8},
]


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> opencl.DeviceInfo:
    info = dataclasses.replace(opencl.select(), index="7:0", name="Stand-in", kind="GPU", driver="1.2.3")
    clover = dataclasses.replace(info, index="8:0", platform="Clover")
    monkeypatch.setattr(opencl, "devices", lambda: [opencl.DeviceInfo(**vars(info) | {"kind": "CPU"}), info, clover])
    return info


def stand_ins(monkeypatch: pytest.MonkeyPatch, *codes: str, measured: object = MEASURED) -> None:
    """Steps that run Python code; a last one that writes the bench's file."""

    def steps(info: opencl.DeviceInfo, results: Path) -> list[Step]:
        content = json.dumps({"devices": [{"measures": measured}]})
        written = f"open({str(results)!r}, 'w').write({content!r})"
        return [Step(f"step {i}", [sys.executable, "-c", code], 2) for i, code in enumerate((*codes, written))]

    monkeypatch.setattr(gpu_check, "steps", steps)


def test_no_gpu_fails_unless_it_is_allowed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(gpu_check, "gpus", list)
    assert gpu_check.main([]) == 1 and "no GPU found" in capsys.readouterr().out
    assert gpu_check.main(["--allow-none"]) == 0 and "no GPU found" in capsys.readouterr().out


def test_a_gpu_that_works(
    gpu: opencl.DeviceInfo, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_ins(
        monkeypatch, "import os; assert os.environ['VESTCL_DEVICE'] == os.environ['VESTCL_TEST_DEVICES'] == '7:0'"
    )
    assert gpu_check.gpus() == [gpu]
    assert gpu_check.main([]) == 0
    printed = capsys.readouterr().out
    assert "7:0 Stand-in" in printed and "driver: 1.2.3" in printed and "7:0: all passed" in printed
    assert "splat forward" in printed and "error 6.0e-08   1.5 (1.4-1.6) ms" in printed


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("print('a test failed'); raise SystemExit(1)", "step 0: FAILED (exit status 1)"),
        ("import time; print('begun', flush=True); time.sleep(60)", "step 0: FAILED (it took too long)"),
    ],
)
def test_a_step_that_fails(
    gpu: opencl.DeviceInfo, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], code: str, message: str
) -> None:
    stand_ins(monkeypatch, code)
    assert gpu_check.main(["--allow-none"]) == 1
    printed = capsys.readouterr().out
    assert message in printed and "step 1: ok" in printed and "7:0: FAILED" in printed
    assert ("a test failed" if "a test" in code else "begun") in printed


@pytest.mark.parametrize("error", [1e-3, float("nan")])
def test_a_large_error_fails(
    gpu: opencl.DeviceInfo, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: float
) -> None:
    stand_ins(monkeypatch, measured=[MEASURED[0], {**MEASURED[1], "median": error}])
    assert gpu_check.main([]) == 1
    assert "(TOO LARGE)" in capsys.readouterr().out


def test_the_steps_are_there_and_take_less_than_five_minutes(tmp_path: Path) -> None:
    """Their files exist; a device has PATIENCE for all."""
    named = [step.name for step in gpu_check.steps(opencl.select(), tmp_path / "operators.json")]
    assert named == ["tests of the operators", "fuzzed scenes", "error and ms of the operators"]
    paths = [
        word for step in gpu_check.steps(opencl.select(), tmp_path) for word in step.command if word.endswith(".py")
    ]
    assert len(paths) == len(gpu_check.TESTS) + 1 and all(Path(path).is_file() for path in paths)
    assert gpu_check.PATIENCE < 300

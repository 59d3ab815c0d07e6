"""What every command prints where something is wrong outside of it: memory, stdout, warnings, files."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from stand_ins import put_module

from vestcl import opencl
from vestcl.cli import main as cli
from vestcl.opencl import pocl_cache

ROOT = Path(__file__).resolve().parents[2]
DEVICES = [sys.executable, "-c", "import sys; from vestcl.cli.main import main; sys.exit(main())", "devices"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(28, "No space left on device", "out/a.exr"), "out/a.exr: No space left on device"),
        (OSError("no luck"), "no luck"),
        (MemoryError("Unable to allocate 7 TiB\nfor an array"), "out of memory: smaller images and fewer steps need"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: 7 bytes"), "out of memory: smaller"),
        (opencl.DeviceError("no [device]"), "no [device]"),
    ],
)
def test_errors_of_the_machine_are_one_line(
    error: Exception, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*_: object) -> None:
        raise error

    put_module(monkeypatch, "vestcl.cli.demo", run=run)
    assert cli.main(["demo"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"error: {line}") and err.count("\n") == 1


def test_vestcls_own_errors_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*_: object) -> None:
        raise RuntimeError("a fault of vestcl")

    put_module(monkeypatch, "vestcl.cli.demo", run=run)
    with pytest.raises(RuntimeError, match="a fault of vestcl"):
        cli.main(["demo"])


def test_a_reader_that_has_seen_enough() -> None:
    with subprocess.Popen(DEVICES, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=ENVIRONMENT) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode in (1, 141)  # rich's, or ours


def test_output_to_a_full_disk() -> None:
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(DEVICES, stdout=full, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT, check=False)
    assert (done.returncode, done.stderr) == (2, "error: No space left on device\n")


def test_a_warning_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    environment = {**ENVIRONMENT, pocl_cache.VARIABLE: str(tmp_path / "file")}
    done = subprocess.run(DEVICES, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0
    assert done.stderr.startswith(f"warning: PoCL's cache {tmp_path / 'file'} can't be used")
    assert done.stderr.count("\n") == 1

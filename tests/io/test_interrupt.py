"""Ctrl-C: one line, exit status 130, nothing half written, no child left; in this process and by real signals."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from stand_ins import put_module

from vestcl import interrupt
from vestcl.cli import main as cli
from vestcl.io.atomic import replacing, write_bytes

ROOT = Path(__file__).resolve().parents[2]
NOTHING = "stopped; nothing was written\n"

#: A command with a child process and a file that is half written, when it says "ready".
BUSY = """
import signal, subprocess, sys, time
from pathlib import Path
from vestcl import interrupt
from vestcl.io.atomic import replacing, write_bytes

def work():
    for _ in range(6000):
        time.sleep(0.01)

@interrupt.command
def main(arguments):
    out = Path(sys.argv[1])
    write_bytes(out / "first", b"whole")
    with replacing(out / "second") as temporary:
        temporary.write_bytes(b"ha")
        if arguments is None:
            signal.signal(signal.SIGCHLD, lambda *_: 1 / 0)  # torch's raises, too
            child = subprocess.Popen(["sleep", "60"])
            print("ready", child.pid, flush=True)
            try:
                work()
            except BaseException:  # what other code may do with an exception that it knows nothing of
                work()
        print("ready", flush=True)
        work()
    return 0

sys.exit(main(None if sys.argv[2] == "own" else []))
"""


def stopped(command: Sequence[str], ready: str, stream: str = "stdout") -> tuple[int, str, str]:
    """SIGINT after the line of ``stream`` that has ``ready``: exit status, that line, and what stderr said then."""
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    read = getattr(process, stream)
    line = next((line for line in read if ready in line), "")
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    return process.returncode, line, said


def is_running(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def test_a_command_that_owns_its_process(tmp_path: Path) -> None:
    status, ready, said = stopped([sys.executable, "-c", BUSY, str(tmp_path), "own"], "ready")
    assert (status, said) == (130, f"stopped; {tmp_path / 'first'} was written\n")
    assert [path.name for path in tmp_path.iterdir()] == ["first"]
    assert not is_running(int(ready.split()[1]))


def test_a_command_that_is_called(tmp_path: Path) -> None:
    status, _, said = stopped([sys.executable, "-c", BUSY, str(tmp_path), "called"], "ready")
    assert (status, said) == (130, f"stopped; {tmp_path / 'first'} was written\n")
    assert [path.name for path in tmp_path.iterdir()] == ["first"]


@pytest.mark.parametrize("module", ["numpy", "tyro"])
def test_while_modules_are_imported(module: str) -> None:
    code = "import sys; from vestcl.cli.main import main; sys.exit(main())"
    command = [sys.executable, "-X", "importtime", "-c", code, "devices"]
    status, _, said = stopped(command, f" {module}\n", "stderr")
    assert status == 130
    assert "".join(line for line in said.splitlines(True) if not line.startswith("import time:")) == NOTHING


def test_while_a_script_of_train_imports() -> None:
    command = [sys.executable, "-X", "importtime", "-m", "train.export", "a", "b"]
    status, _, said = stopped(command, " torch._utils_internal\n", "stderr")
    assert status == 130
    assert "".join(line for line in said.splitlines(True) if not line.startswith("import time:")) == NOTHING


def test_prepare_ends_its_workers(tmp_path: Path) -> None:
    small = ["--frames", "9", "--height", "16", "--width", "64", "--out", str(tmp_path), "--workers", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "vestcl", "prepare", "street:1-4", *small], env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    end = time.monotonic() + 90
    while not list(tmp_path.glob("*/0*.safetensors")) and time.monotonic() < end:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said.startswith("stopped; ") and said.count("\n") == 1
    end = time.monotonic() + 5
    while (left := workers_of(process.pid)) and time.monotonic() < end:
        time.sleep(0.02)  # multiprocessing's tracker ends a moment after its parent
    assert not left


def workers_of(session: int) -> list[int]:
    """Processes of a session that still run; the sixth field of a stat file is the session."""
    numbers = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdecimal()]
    return [number for number in numbers if is_running(number) and session_of(number) == session]


def session_of(process: int) -> int | None:
    try:
        return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[3])
    except OSError:
        return None


# ---------------------------------------------------------------- called as a function


@pytest.mark.parametrize("kind", [KeyboardInterrupt, ImportError])
def test_what_other_code_makes_of_it(
    kind: type[BaseException], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*_: object) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as stop:
            raise kind("numpy.core.multiarray failed to import") from stop

    put_module(monkeypatch, "vestcl.cli.demo", run=run)
    assert cli.main(["demo"]) == 130
    assert capsys.readouterr() == ("", NOTHING)


def test_files_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    @interrupt.command
    def main(arguments: Sequence[str] | None) -> int:
        for name in arguments or ():
            write_bytes(tmp_path / name, b"")
        with replacing(tmp_path / "half"):
            raise KeyboardInterrupt

    def line(*names: str) -> str:
        assert main(names) == 130
        return capsys.readouterr().err

    assert line() == NOTHING
    assert line("a") == f"stopped; {tmp_path / 'a'} was written\n"
    assert line("x/y/a", "x/y/b", "x/c") == f"stopped; 3 files were written to {tmp_path / 'x'}\n"
    assert not list(tmp_path.glob(".*"))


def test_a_command_may_say_more(capsys: pytest.CaptureFixture[str]) -> None:
    @interrupt.command
    def main(arguments: Sequence[str] | None) -> int:
        with interrupt.summary(lambda: "stopped after step 3"):
            if not arguments:
                raise KeyboardInterrupt
        raise KeyboardInterrupt

    assert main([]) == 130
    assert capsys.readouterr().err == "stopped after step 3\n"
    assert main(["after it"]) == 130
    assert capsys.readouterr().err == NOTHING


def test_other_errors_are_not_stops() -> None:
    @interrupt.command
    def main(arguments: Sequence[str] | None) -> int:
        raise ZeroDivisionError

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(ZeroDivisionError):
        main([])
    with pytest.raises(ZeroDivisionError):
        main()
    assert signal.getsignal(signal.SIGINT) is before

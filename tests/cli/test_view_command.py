"""`vestcl view`: refusals in one line, and Ctrl-C."""

import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from vestcl.cli import main as cli

START = "import sys; from vestcl.cli.main import main; sys.exit(main())"


def test_without_viser(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert cli.main(["view", "street:7"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "pip install 'vestcl[viewer]'" in error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("street:7 --quality fast", "--quality is the inference preset of a network; it needs --model"),
        ("street:7 --frame 40", "--frame must be 1 ... 29, to have a frame before it, got 40"),
        ("street:7 --frames 1", "street 7: must have 2 frames or more, got 1"),
        ("street:7 --port 70000", "--port must be 65,535 or less, got 70000"),
        ("street:7 --model nothing", "nothing"),
        ("no-such-clip", "no-such-clip"),
        ("street:7 --depth-scale 256", "it needs --depth"),
    ],
)
def test_refusals(arguments: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("viser", reason="the viewer's tests need viser: pip install 'vestcl[viewer]'")
    assert cli.main(["view", *arguments.split(), "--height", "48", "--width", "160"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and message in error


@contextmanager
def served(*options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A running viewer, and the line that it printed."""
    command = [sys.executable, "-c", START, "view", "street:7", "--frames", "4", "--height", "48", "--width", "160"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen([*command, *options], **pipes)  # type: ignore[call-overload]
    try:
        yield process, process.stdout.readline()
    finally:
        process.kill()
        process.wait()


def test_ctrl_c_closes_it() -> None:
    pytest.importorskip("viser", reason="the viewer's tests need viser: pip install 'vestcl[viewer]'")
    with served("--port", "18300") as (process, line):
        found = re.fullmatch(r"(http://127\.0\.0\.1:\d+) shows street 7; Ctrl-C closes it\n", line)
        assert found, line
        with urllib.request.urlopen(found[1], timeout=10) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=20)
        assert process.returncode == 130 and (out, error) == ("", "the viewer is closed\n")
        with pytest.raises(OSError, match="refused"):
            urllib.request.urlopen(found[1], timeout=5)

"""--quiet and --verbose of every command."""

import logging
from pathlib import Path

import pytest
from forecast_clips import write_clip

from vestcl.cli import main as cli


def test_quiet_prints_errors_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip = write_clip(tmp_path / "clip")
    arguments = ["forecast", str(clip), "--steps", "1", "--no-exr", "--quiet", "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 0
    assert capsys.readouterr().out == ""
    assert (tmp_path / "out" / "forecast.json").is_file()
    assert cli.main([*arguments, "--frame", "99"]) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert said.err.startswith("error: --frame must be")


def test_verbose_prints_stages_and_tracebacks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip, before = write_clip(tmp_path / "clip"), logging.getLogger("vestcl").level
    arguments = ["forecast", str(clip), "--steps", "1", "--no-exr", "--verbose", "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 0
    said = capsys.readouterr()
    assert "open the clip: 0." in said.err and "flow: 0." in said.err
    assert "forecast: geometric" in said.out
    assert cli.main([*arguments, "--frame", "99"]) == 2
    assert "Traceback" in (shown := capsys.readouterr().err) and shown.splitlines()[-1].startswith("error: --frame")
    assert logging.getLogger("vestcl").level == before and cli.main(["devices"]) == 0
    assert capsys.readouterr().err == ""


def test_both_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["devices", "--quiet", "--verbose"]) == 2
    assert "--quiet and --verbose exclude each other" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["forecast", "view", "prepare", "devices", "doctor", "demo"])
def test_every_command_has_them(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    text = capsys.readouterr().out
    assert "--quiet" in text and "--verbose" in text

"""Ranges of options, outputs that can't be written, and options as they are typed."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest
import tyro

from vestcl.bench.forecast.bench import ForecastBench
from vestcl.cli import main as cli
from vestcl.cli import options


@dataclass(frozen=True)
class Some:
    """Options of a command."""

    inputs: tyro.conf.Positional[tuple[str, ...]] = ()
    steps: int = 5
    fov: float | None = None
    view: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    label_ids: str = "trainIds"
    depth: Path | None = None
    height: int = 8
    width: int = 8
    compare: bool = False
    out: Path = Path("out")
    json: Path | None = None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"steps": 0}, "--steps must be 1 or more, got 0"),
        ({"steps": 100000000000}, "--steps must be 1,000 or less, got 100000000000"),
        ({"fov": float("nan")}, "--fov must be finite, got nan"),
        ({"fov": -float("inf")}, "--fov must be finite, got -inf"),
        ({"fov": 180.0}, "--fov must be between 0 and 180, got 180.0"),
        ({"seeds": (1, -1)}, "--seeds must be 0 or more, got -1"),
        ({"seeds": (1 << 63,)}, "--seeds must be 9,223,372,036,854,775,80"),
        ({"height": 10000000}, "--height must be 16,384 or less, got 10000000"),
        ({"height": 16000, "width": 16000}, "--height x --width must be 33,554,432 px or less, got 16000 x 16000"),
        ({"out": Path("file")}, "--out must be a folder, got the file file"),
        ({"out": Path("file/below/it")}, "--out file/below/it: can't be made, since .*file is not a folder"),
        ({"out": Path("n" * 300)}, "--out nn.*: File name too long"),
        ({"json": Path("folder")}, "--json must be a file, got the folder folder"),
        ({"json": Path("file/x.json")}, "--json file/x.json: can't be made, since .*file is not a folder"),
    ],
)
def test_what_is_refused(given: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    Path("folder").mkdir()
    options.check_options(Some())
    with pytest.raises(ValueError, match=f"^{message}"):
        options.check_options(Some(**given))


def test_a_command_may_write_a_file_to_out(tmp_path: Path) -> None:
    @dataclass(frozen=True)
    class Export:
        OUTPUT_FILES: ClassVar = ("out",)
        out: tyro.conf.Positional[Path]

    options.check_options(Export(tmp_path / "file"))
    with pytest.raises(ValueError, match="OUT must be a file, got the folder"):
        options.check_options(Export(tmp_path))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_rights(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(ValueError, match="can't be written"):
        options.check_options(Some(out=tmp_path / "out"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["forecast", "x", "--out", ""], "--out must not be empty, got ''"),
        (["forecast", "x", "--out="], "--out must not be empty, got ''"),
        (["forecast", "x", "--view", " "], "--view must not be empty, got ' '"),
        (["forecast", ""], "an argument must not be empty, got ''"),
        (["forecast", "a\0b"], "an argument must not have a zero byte"),
    ],
)
def test_empty_arguments(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 2
    assert capsys.readouterr().err.startswith(f"error: {message}")
    options.check_arguments(["forecast", "x=", "--view", "0,0,1,name=", "--gif"])


@pytest.mark.parametrize(
    ("message", "typed"),
    [
        ("`steps` must be even, got 3", "--steps must be even, got 3"),
        ("`views` must have a name each", "--view must have a name each"),
        ("`label_ids` needs `depth`, not `K`", "--label-ids needs --depth, not `K`"),
        ("x.png: `steps` must be one of a, b", "x.png: --steps must be one of a, b"),
        ("`inputs` must be one or more", "INPUTS must be one or more"),
        ("`depth` must be finite", "`depth` must be finite"),  # some function's: it was not given
        ("a/camera.json: `steps` must be a number", "a/camera.json: `steps` must be a number"),
        ("camera.json: no such file; write one, or give `fov` in degrees", None),
        ("camera.json: defines the camera; leave out `fov`", "camera.json: defines the camera; leave out --fov"),
        ("x: is a street, which takes height, width, not fov, rig", "x: is a street, which takes --height, --width, "),
        ("x: is a street; it does not take label_ids", "x: is a street; it does not take --label-ids"),
        ("`view` '0,0,0,fov=200': its `fov` must be below 180", "--view '0,0,0,fov=200': its `fov` must be below 180"),
    ],
)
def test_options_are_called_as_they_are_typed(message: str, typed: str | None) -> None:
    given = Some(("a",), steps=3, view=("x",), label_ids="labelIds")
    got = options.as_typed(message, given)
    assert got.startswith(typed) if typed else got.endswith("or give --fov in degrees")
    assert options.as_typed(message, None) == message


def test_inputs_of_commands_are_positional() -> None:
    assert options.positionals(cli.Forecast("x")) == {"input"}
    assert options.positionals(ForecastBench(("x",))) == {"inputs"}


def test_horizons_follow_the_steps() -> None:
    assert ForecastBench(("street:0",), steps=2).shown == (1,)
    assert ForecastBench(("street:0",), steps=9).shown == (1, 3, 5)
    assert ForecastBench(("street:0",), steps=9, horizons=(2, 9)).shown == (2, 9)

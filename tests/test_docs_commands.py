"""Every command of README.md and docs/ either runs here, on small inputs, or is listed as long, with who runs it."""

import os
import re
import shlex
from pathlib import Path
from typing import Final

import posed_scenes
import pytest
from forecast_clips import write_clip
from kitti_trees import drives
from test_docs_pages import commands
from video_files import flat, write_video

from vestcl import opencl
from vestcl.cli.main import main

#: Commands that are not run here, and why.
LONG: Final = {
    r"python3 -m venv|source |pip install|make venv": "an installation: .ci/run and tests/test_packaging.py",
    r"make gpu-check": "minutes, and a GPU; tests/opencl/test_gpu_check.py",
    r"export ": "of the shell, for the command after it",
    r"make (demo|test|tables)": "minutes; tests/cli/test_demo.py and tests/test_docs_tables.py run them small",
    r"vestcl view": "serves until Ctrl-C; tests/viewer and tests/cli/test_view_command.py",
    r"vestcl bench": "minutes to hours; tests/bench",
    r"vestcl doctor": "a process per device; tests/test_doctor.py",
    r"(torchrun .*)?(python )?-m train\.|python -m train\.|torchrun": "minutes to days; tests/train",
    r"python docs/": "tests/test_docs_tables.py, tests/test_docs_pages.py",
    r"vestcl prepare street:2\d{4}": "hours, the data of vest-s; tests/prepare",
}

#: Options that make a command short, by command; the last value of an option counts.
SMALL: Final = {
    "forecast": "--height 48 --width 96 --no-exr",
    "prepare": "--height 32 --width 64 --frames 2 --samples 1",
    "devices": "",
}


def is_long(line: str) -> bool:
    return any(re.match(pattern, line) for pattern in LONG)


RUN: Final = list(dict.fromkeys(line for _, line in commands() if not is_long(line)))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the pages call my_dashcam.mp4, my_clips, my_scene, and a KITTI drive."""
    folder = tmp_path_factory.mktemp("pages")
    write_video(folder / "my_dashcam.mp4", flat(12, 48, 96))
    write_clip(folder / "my_clips" / "first")
    write_video(folder / "my_clips" / "second.mp4", flat(9, 48, 96))
    posed_scenes.write_nerfstudio(folder / "my_scene", posed_scenes.street())
    drives(folder, ("2011_09_26_drive_0060_sync",), 8)
    return folder


def shortened(line: str) -> list[str]:
    """The arguments of `vestcl`, with one street for many, and small images."""
    words = shlex.split(re.sub(r"(street:\d+)-\d+", r"\1", line))[1:]
    return [*words, *SMALL[words[0]].split()] if words[0] in SMALL else words


def test_every_pattern_of_long_commands_is_used() -> None:
    lines = [line for _, line in commands()]
    assert [pattern for pattern in LONG if not any(re.match(pattern, line) for line in lines)] == []


@pytest.mark.parametrize("line", RUN)
def test_a_command_runs(line: str, inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in os.listdir(inputs):  # noqa: PTH208
        (tmp_path / name).symlink_to(inputs / name)
    monkeypatch.chdir(tmp_path)
    variable = re.match(r"(\w+)=(\S+) ", line)
    if variable:
        monkeypatch.setenv(variable[1], opencl.devices()[0].index)
        line = line[variable.end() :]
    assert main(shortened(line)) == 0
    before = shlex.split(line)
    if "--out" in before:
        assert any(path.is_file() for path in (tmp_path / before[before.index("--out") + 1]).rglob("*"))

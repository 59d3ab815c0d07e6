"""Small clips for `vestcl prepare`, and the command in this process or in a separate one."""

import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data_files import write_text
from processes import Process, command

from vestcl.cli import main as cli
from vestcl.cli import prepare as prepare_command
from vestcl.io.images import to_pixels, write_pixels

HEIGHT, WIDTH, FRAMES = 48, 160, 4

SMALL = ("--height", str(HEIGHT), "--width", str(WIDTH), "--frames", str(FRAMES), "--samples", "1")


def options(*inputs: str, **changes: Any) -> cli.Prepare:
    size = {"height": HEIGHT, "width": WIDTH, "frames": FRAMES, "samples": 1}
    return cli.Prepare(inputs, **{**size, **changes})


def write_drive(folder: Path) -> Path:
    """A street as a folder of files: images, depth and labels."""
    clip = prepare_command.open_input("street:5", options())
    for sample in clip:
        write_pixels(folder / "image" / f"{sample.name}.png", to_pixels(sample.read_image()))
        near = np.where(sample.read_depth() < 200, sample.read_depth(), 0)[0]
        write_pixels(folder / "metres" / f"{sample.name}.png", (near * 256).astype(np.uint16))
        write_pixels(folder / "classes" / f"{sample.name}.png", sample.read_labels()[0])
    K = clip[0].K
    camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] - 0.5, "cy": K[1, 2] - 0.5, "fps": 10}
    write_text(folder / "camera.json", json.dumps(camera))
    return folder


def settings_for(folder: Path, **changes: Any) -> cli.Prepare:
    extra = {"depth": folder / "metres", "depth_scale": 256.0, "labels": folder / "classes"}
    return options(str(folder), **{**extra, **changes})


def run(settings: cli.Prepare, capsys: pytest.CaptureFixture[str]) -> tuple[int, int]:
    """Frames computed, frames kept."""
    prepare_command.run(settings)
    return counted(capsys.readouterr().out)


def prepare(log: Path, *arguments: str) -> Process:
    """The command in a separate process, on small clips."""
    return Process(log, command, "prepare", *arguments, *SMALL)


def counted(text: str) -> tuple[int, int]:
    found = re.search(r"(\d+) frames computed, (\d+) kept", text)
    assert found, text
    return int(found[1]), int(found[2])


def contents(cache: Path) -> dict[str, bytes]:
    return {str(path.relative_to(cache)): path.read_bytes() for path in cache.rglob("*.*") if path.is_file()}


# ---------------------------------------------------------------- keys


def until(happens: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not happens():
        assert time.monotonic() < end
        time.sleep(0.005)

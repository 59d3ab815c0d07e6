"""Files have the rights that the umask gives, whoever writes them; so have folders."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from checkpoint_states import state_of
from forecaster_scenes import TINY

from train import export
from train.run import checkpoint
from vestcl import io
from vestcl.data import Street, street_clip
from vestcl.io import depth, exr, images
from vestcl.io.atomic import write_bytes
from vestcl.models.forecaster import Forecaster
from vestcl.prepare.clip import prepare_clip

PICTURE = np.zeros((32, 32, 3), np.uint8)


def export_model(path: Path) -> None:
    torch.manual_seed(0)
    Forecaster(TINY).save(path.with_name("whole.safetensors"))
    assert export.main([str(path.with_name("whole.safetensors")), str(path)]) == 0


WRITERS: dict[str, Callable[[Path], object]] = {
    "bytes": lambda path: write_bytes(path / "file", b"content"),
    "png": lambda path: images.write_pixels(path / "a.png", PICTURE),
    "jpg": lambda path: images.write_pixels(path / "a.jpg", PICTURE),
    "mp4": lambda path: io.write_mp4(path / "a.mp4", [PICTURE] * 2, 10.0),
    "gif": lambda path: io.write_gif(path / "a.gif", [PICTURE] * 2, 10.0),
    "exr": lambda path: exr.write_exr(path / "a.exr", {"R": np.zeros((4, 4), np.float32)}),
    "depth": lambda path: depth.write_depth(path / "a.npy", np.ones((1, 4, 4), np.float32)),
    "model": lambda path: export_model(path / "half.safetensors"),
    "checkpoint": lambda path: checkpoint.save(path, state_of(1)),
    "prepared": lambda path: prepare_clip(street_clip(Street.generate(3), 2, 24, 80, samples=1), path / "clip"),
}


@pytest.fixture(params=[0o022, 0o027, 0o002])
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


@pytest.mark.parametrize("writer", WRITERS.values(), ids=WRITERS.keys())
def test_rights_are_the_umasks(writer: Callable[[Path], object], umask: int, tmp_path: Path) -> None:
    writer(tmp_path / "folder")
    written = list((tmp_path / "folder").rglob("*"))
    assert any(path.is_file() for path in written)
    for path in written:
        wanted = (0o777 if path.is_dir() else 0o666) & ~umask
        assert path.stat().st_mode & 0o777 == wanted, f"{path.name} has {path.stat().st_mode & 0o777:o}"

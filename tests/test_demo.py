"""The demo writes its pictures, and the new view looks like the truth."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from vestcl import demo, geometry
from vestcl.data import Street, intrinsics

PICTURES = ("source", "source_depth", "view", "view_depth", "view_coverage", "truth", "error", "sheet")


def test_writes_pictures_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo.run(tmp_path / "new" / "folder", height=96, width=312, seed=0)
    said = capsys.readouterr().out
    files = sorted(path.name for path in (tmp_path / "new" / "folder").iterdir())
    assert files == sorted(f"{name}.png" for name in PICTURES)
    assert all(name in said.replace("\n", "") for name in files)
    sizes = {}
    for name in PICTURES:
        with Image.open(tmp_path / "new" / "folder" / f"{name}.png") as picture:
            sizes[name] = picture.size
    assert all(size == (312, 96) for name, size in sizes.items() if name != "sheet")
    assert sizes["sheet"][0] > 2 * 312
    psnr = re.search(r"PSNR against the truth: ([\d.]+) dB", said)
    assert psnr is not None
    assert float(psnr[1]) > 22


def test_view_from_the_same_place_is_the_source() -> None:
    street, K = Street.generate(1), intrinsics(96, 312)
    frame = street.render(np.linalg.inv(street.camera_pose(0.0)), K, 96, 312)
    colour, depth = torch.from_numpy(frame.colour), torch.from_numpy(frame.depth)
    still = torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3)
    shown, z, coverage = demo.splat_view(colour, depth, torch.from_numpy(K).float()[None], *still, torch.eye(4)[None])
    # Rounding puts a point next to its pixel's centre, by so little that it hides all but that of what lies behind.
    assert float(coverage.min()) > 0.999
    assert float((shown - colour).abs().max()) < 1e-3
    assert float(((z - depth) / depth).abs().max()) < 1e-3


def test_moves_things_to_the_left_for_a_camera_on_the_right() -> None:
    depth, K = torch.full((1, 1, 32, 64), 10.0), torch.tensor([[[40.0, 0, 32], [0, 40, 16], [0, 0, 1]]])
    colour = torch.zeros(1, 3, 32, 64)
    colour[..., 40] = 1
    tgt_from_next = geometry.compose_rigid(torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[-2.0, 0, 0]]))
    still = torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3)
    shown, _, _ = demo.splat_view(colour, depth, K, *still, tgt_from_next)
    assert int(shown[0, 0, 16].argmax()) == 40 - 8  # f * 2 m / 10 m

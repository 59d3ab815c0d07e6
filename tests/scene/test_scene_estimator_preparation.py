"""What networks see of an image: as transformers' own processors prepare it, and sizes computed by hand."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_networks import IMAGENET, noise_image, pixels, processor

from vestcl.scene.estimators._preparation import Preparation

KITTI = (375, 1242)

PREPARED: dict[str, tuple[dict[str, Any], float]] = {
    "ZoeDepthImageProcessor": ({"size": {"height": 64, "width": 96}, "ensure_multiple_of": 32}, 1e-5),
    "DPTImageProcessor": (
        {"size": {"height": 56, "width": 56}, "keep_aspect_ratio": True, "ensure_multiple_of": 14, "resample": 3}, 0.03,
    ),
    "SegformerImageProcessor": ({"size": {"height": 64, "width": 70}}, 0.03),
    "Mask2FormerImageProcessor": ({"size": {"shortest_edge": 50, "longest_edge": 150}}, 0.03),
}  # fmt: skip


@pytest.mark.parametrize("name", PREPARED)
@pytest.mark.parametrize("size", [(48, 120), (75, 40), (100, 260)])
def test_images_are_prepared_as_transformers_does(tmp_path: Path, name: str, size: tuple[int, int]) -> None:
    """Up to Pillow's rounding to whole steps of 1/255, some 0.02 after the division by the deviation."""
    settings, tolerance = PREPARED[name]
    theirs = processor(name)(**settings)
    theirs.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "preprocessor_config.json").read_text())
    image = noise_image(*size)
    wanted = theirs(pixels(image), return_tensors="pt", input_data_format="channels_first")["pixel_values"]
    ours = Preparation.read(name, config, zoe=name.startswith("Zoe"), size=None)(torch.from_numpy(image)[None])
    torch.testing.assert_close(ours, wanted, rtol=0, atol=tolerance)


def test_sizes_of_published_checkpoints_by_hand() -> None:
    """KITTI, 375 x 1242. ZoeDepth pads by 41 and 74: 457 x 1390, x 384/457 = 384 x 1168, of 32: 384 x 1152."""
    common = {"resample": 2, **IMAGENET}
    zoe = {"size": {"height": 384, "width": 512}, "keep_aspect_ratio": True, "ensure_multiple_of": 32, **common}
    preparation = Preparation.read("zoe", zoe, zoe=True, size=None)
    assert preparation.padding(*KITTI) == (41, 74)
    assert preparation(torch.zeros(1, 3, *KITTI)).shape == (1, 3, 384, 1152)
    anything = {"size": {"height": 518, "width": 518}, "keep_aspect_ratio": True, "ensure_multiple_of": 14, **common}
    assert Preparation.read("", anything, zoe=False, size=None).network_size(*KITTI) == (518, 1722)
    old = {"size": 512, **common}
    assert Preparation.read("", old, zoe=False, size=None).network_size(*KITTI) == (512, 512)
    within = {"size": {"shortest_edge": 800, "longest_edge": 1333}, "size_divisor": 32, **common}
    assert Preparation.read("", within, zoe=False, size=None).network_size(1024, 2048) == (672, 1344)

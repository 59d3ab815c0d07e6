"""`vestcl bench depth`: errors of depth by motion, by a network, and combined."""

import json
from pathlib import Path

import numpy as np
import pytest
from corridor_scenes import K, ahead, drive
from onnx_files import write_mix

from vestcl.bench import depth
from vestcl.bench.depth import DepthBench
from vestcl.cli import main as cli
from vestcl.data.sample import Clip, Sample


def corridor_clip(with_depth: bool = True) -> Clip:
    poses = ahead(frames=3)
    shots = [drive(poses[: i + 1]) for i in range(3)]
    images = shots[-1][0]
    known = [found if with_depth else None for _, found in shots]
    return Clip("drive", "test", tuple(Sample.from_arrays(str(i), images[i], K, depth=known[i]) for i in range(3)))


def test_methods_and_frames() -> None:
    clip = corridor_clip()
    true = clip[2].read_depth()
    scores = depth.evaluate(clip, lambda image: 1.1 * true, DepthBench(("drive",)))
    assert list(scores) == ["motion", "network", "combined"] and all(list(found) == [2] for found in scores.values())
    assert scores["network"][2].abs_rel == pytest.approx(0.1, rel=1e-3)
    assert scores["combined"][2].median_ratio == pytest.approx(1.1, rel=0.02)
    assert list(depth.evaluate(clip, None, DepthBench(("drive",)))) == ["motion"]


def test_the_command_prints_and_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clip = corridor_clip()
    monkeypatch.setattr(depth, "open_sequence", lambda text: clip)
    network = write_mix(tmp_path / "network.onnx", [[0.0] * 3], bias=[7.0], metres=1)
    told = ["bench", "depth", "drive", "--depth-model", str(network), "--json", str(tmp_path / "out.json")]
    assert cli.main(told) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("motion", "network", "combined", "AbsRel", "median ratio"))
    written = json.loads((tmp_path / "out.json").read_text())
    ratio = float(np.median(7 / clip[2].read_depth()))
    assert written["scores"]["drive"]["network"]["2"]["median_ratio"] == pytest.approx(ratio, rel=1e-4)


def test_refusals() -> None:
    with pytest.raises(ValueError, match="must have depth or a right camera to compare with"):
        depth.evaluate(corridor_clip(with_depth=False), None, DepthBench(("drive",)))
    with pytest.raises(ValueError, match="must have a frame from `first` to `last`, got 5 to 2"):
        depth.evaluate(corridor_clip(), None, DepthBench(("drive",), first=5))
    with pytest.raises(ValueError, match="--every and --first 1 or more"):
        DepthBench(("drive",), every=0)

"""The demo forecasts a street from its stereo pairs, and better than its baselines."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vestcl import demo
from vestcl.data import Street
from vestcl.views import parse_view


def test_does_the_whole_job(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "folder"
    demo.run(out, height=96, width=312, seed=4, steps=3)
    said = capsys.readouterr().out.replace("\n", "")
    about = json.loads((out / "forecast.json").read_text(encoding="utf-8"))
    for view in ("source", "right", "beside"):
        files = sorted(path.name for path in (out / view).iterdir())
        assert {"000001.png", "000003.png", "000003.exr", "forecast.mp4"} <= set(files)
        assert str(out / view) in said
    with Image.open(out / "sheet.png") as picture:
        assert picture.size[0] > 3 * 300
    scores = about["scores"] if "scores" in about else about["metrics"]
    for view in ("source", "right", "beside"):
        of = {method: np.mean([step["psnr"] for step in steps]) for method, steps in scores[view].items()}
        assert of["forecast"] > of["repeat last"] + 2
        assert of["forecast"] > of["optical flow"]


def test_the_forecast_gets_no_truth() -> None:
    clip = demo.stereo_only(Street.generate(1).clip(2, 48, 160))
    assert all(sample.depth is None and sample.world_from_cam is None for sample in clip)
    assert all(sample.right is not None for sample in clip)


def test_the_truth_from_a_view_of_the_rig_is_what_the_rig_sees() -> None:
    street = Street.generate(1)
    clip = street.clip(2, 48, 160, start=demo.START, fps=demo.FPS, samples=demo.SAMPLES)
    right = clip[1].right
    assert right is not None
    truth = demo.true_image(street, clip, 1, parse_view("right", clip[1]))
    np.testing.assert_allclose(truth, right.read_image(), atol=1e-6)

"""The demo forecasts a street from its stereo pairs, and better than its baselines; with a network, or without."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vestcl.cli import demo
from vestcl.data import Street, street_clip
from vestcl.forecasting.views import parse_view
from vestcl.models import configuration, shipped
from vestcl.models.forecaster import Forecaster


@pytest.mark.parametrize("model", ["geometric", "vest-s"])
def test_does_the_whole_job(model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "folder"
    demo.run(out, height=64, width=208, seed=4, model=model, steps=3)
    said = capsys.readouterr().out.replace("\n", "")
    about = json.loads((out / "forecast.json").read_text(encoding="utf-8"))
    for view in ("source", "right", "beside"):
        files = sorted(path.name for path in (out / view).iterdir())
        assert {"000001.png", "000003.png", "000003.exr", "forecast.mp4"} <= set(files)
        assert str(out / view) in said
    with Image.open(out / "sheet.png") as image:
        assert image.size[0] > 3 * 200
    scores = about["scores"] if "scores" in about else about["metrics"]
    for view in ("source", "right", "beside"):
        of = {method: np.mean([step["psnr"] for step in steps]) for method, steps in scores[view].items()}
        assert of["forecast"] > of["repeat last"] + 2
        assert of["forecast"] > of["optical flow"]
        assert (set(of) - {"forecast", "repeat last", "optical flow"}) == ({"geometric"} - {model})


def test_the_shipped_network_is_the_default_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shipped, "FOLDER", tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    demo.run(tmp_path / "without", height=48, width=160, seed=4, steps=1)
    assert "forecast without any trained weights" in " ".join(capsys.readouterr().out.split())
    Forecaster(configuration("vest-s")).save(tmp_path / "vest-s.safetensors")
    demo.run(tmp_path / "with", height=48, width=160, seed=4, steps=1)
    said = " ".join(capsys.readouterr().out.split())
    assert "forecast by the network vest-s, mode compose" in said and "geometric, to compare" in said
    without, about = (json.loads((tmp_path / name / "forecast.json").read_text()) for name in ("without", "with"))
    assert (without["method"], about["method"]) == ("geometric", "vest-s")
    assert "mode" not in without and about["mode"] == about["settings"]["mode"] == "compose"
    assert about["settings"]["model_file"] == "vest-s.safetensors"
    for view, scores in about["scores"].items():
        assert list(scores) == ["forecast", "geometric", "repeat last", "optical flow"]
        assert scores["geometric"] == without["scores"][view]["forecast"]
        assert scores["geometric"] == scores["forecast"]  # the network is untrained, and adds nothing


def test_an_unknown_model(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="vest-xl: is not a model"):
        demo.run(tmp_path / "out", height=48, width=160, seed=4, model="vest-xl")
    assert not (tmp_path / "out").exists()


def test_the_forecast_gets_no_truth() -> None:
    clip = demo.stereo_only(street_clip(Street.generate(1), 2, 48, 160))
    assert all(sample.depth is None and sample.world_from_cam is None for sample in clip)
    assert all(sample.right is not None for sample in clip)


def test_the_truth_from_a_view_of_the_rig_is_what_the_rig_sees() -> None:
    street = Street.generate(1)
    clip = street_clip(street, 2, 48, 160, start=demo.START, fps=demo.FPS, samples=demo.SAMPLES)
    right = clip[1].right
    assert right is not None
    truth = demo.true_image(street, clip, 1, parse_view("right", clip[1]))
    np.testing.assert_allclose(truth, right.read_image(), atol=1e-6)

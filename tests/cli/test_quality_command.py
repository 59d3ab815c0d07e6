"""`vestcl forecast --quality`: which level the network gets, and what forecast.json says of it."""

import dataclasses
from pathlib import Path

import pytest
from forecast_clips import Repeater, write_clip
from forecaster_scenes import SMALL
from stand_ins import put_module

from vestcl.cli import main as cli
from vestcl.forecasting.files import read_forecast
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference import quality
from vestcl.models.inference.quality import LEVELS, Quality


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Repeater:
    """In place of the network's forecast."""
    network = Repeater("small", shift=1)
    put_module(monkeypatch, "vestcl.forecasting.network.forecast", forecast_clip=network)
    return network


@pytest.mark.parametrize("level", [None, *LEVELS])
def test_the_network_gets_what_was_asked_for(level: Quality | None, tmp_path: Path, network: Repeater) -> None:
    Forecaster(SMALL).save(tmp_path / "small.safetensors")
    clip, out = write_clip(tmp_path / "clip"), tmp_path / "out"
    arguments = f"forecast {clip} --out {out} --frame 3 --no-exr --model {tmp_path / 'small.safetensors'}".split()
    assert cli.main([*arguments, *([] if level is None else ["--quality", level])]) == 0
    wanted = level or quality.USUAL
    ((model, _),) = network.networks
    autocast = model.options.autocast  # None on processors without bfloat16
    assert model.options == dataclasses.replace(quality.settings(wanted), autocast=autocast)
    settings = read_forecast(out).about["settings"]
    assert {name: settings[name] for name in quality.about(wanted)} == quality.about(wanted)


def test_geometry_has_no_quality(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip = write_clip(tmp_path / "clip")
    assert cli.main(["forecast", str(clip), "--out", str(tmp_path / "out"), "--quality", "fast"]) == 2
    assert "--quality is how exactly a network computes; it needs --model" in capsys.readouterr().err

"""`vestcl forecast --quality`: which level the network gets, and what forecast.json says of it."""

import dataclasses
from pathlib import Path

import pytest
from forecast_clips import Repeater, write_clip
from forecaster_scenes import SMALL
from stand_ins import put_module

from vestcl.cli import main as cli
from vestcl.constants import LEVELS, WORK_WIDTH, WORK_WIDTHS, Quality
from vestcl.forecasting.files import read_forecast
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference import quality


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
    ((model, *_),) = network.networks
    autocast = model.options.autocast  # None on processors without bfloat16
    assert model.options == dataclasses.replace(quality.settings(wanted), autocast=autocast)
    settings = read_forecast(out).about["settings"]
    assert {name: settings[name] for name in quality.about(wanted)} == quality.about(wanted)


@pytest.mark.parametrize(
    ("arguments", "width"),
    [
        ([], WORK_WIDTH),
        *((["--quality", level], width) for level, width in WORK_WIDTHS.items()),
        (["--quality", "realtime", "--work-width", "700"], 700),
        (["--work-width", "0"], None),
    ],
)
def test_the_scene_is_perceived_at_the_presets_width(
    arguments: list[str], width: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    geometric = Repeater("geometric", shift=1)
    put_module(monkeypatch, "vestcl.forecasting.geometric", forecast_clip=geometric)
    clip, out = write_clip(tmp_path / "clip"), tmp_path / "out"
    assert cli.main(f"forecast {clip} --out {out} --frame 3 --no-exr".split() + arguments) == 0
    assert geometric.networks == [() if width == WORK_WIDTH else (width,)]

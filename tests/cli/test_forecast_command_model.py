"""`vestcl forecast --model`: which forecaster runs, what it is compared with, and what the files contain about it."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forecast_clips import Repeater, write_clip
from forecaster_scenes import SMALL, TINY
from stand_ins import put_module

from vestcl.cli import main as cli
from vestcl.data.sample import Clip
from vestcl.evaluation.compare import ORACLE
from vestcl.forecasting.files import read_forecast
from vestcl.models import shipped
from vestcl.models.forecaster import Forecaster


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Repeater:
    """In place of the network, which foresees one frame."""
    network = Repeater("tiny", shift=1)
    put_module(monkeypatch, "vestcl.forecasting.network.forecast", forecast_clip=network)
    monkeypatch.setenv("COLUMNS", "200")
    return network


@pytest.fixture
def geometric(monkeypatch: pytest.MonkeyPatch) -> Repeater:
    geometric = Repeater("geometric")
    put_module(monkeypatch, "vestcl.forecasting.geometric", forecast_clip=geometric)
    return geometric


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_clip(tmp_path / "clip")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.safetensors"
    Forecaster(TINY).save(path)
    return path


def test_the_network_takes_the_geometric_ones_place(
    folder: Path, tmp_path: Path, file: Path, network: Repeater, geometric: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["forecast", str(folder), "--out", str(tmp_path / "out"), "--steps", "1", "--frame", "3", "--no-exr"]
    assert cli.main([*arguments, "--model", str(file)]) == 0
    assert f"forecast: tiny, {file}, mode feedback" in capsys.readouterr().out
    assert not geometric.calls
    ((model, mode),) = network.networks
    assert isinstance(model, Forecaster) and model.config == TINY and not model.training
    assert mode == "feedback"  # it starts from rest
    saved = read_forecast(tmp_path / "out")
    settings = saved.about["settings"]
    assert saved.about["method"] == "tiny"
    assert [settings[key] for key in ("model", "mode", "model_file")] == [str(file), "feedback", str(file)]
    assert settings["model_sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    clip: Clip = network.calls[0][0]
    assert np.array_equal(saved.image(1, "source"), clip[4].read_image())


@pytest.mark.parametrize("start", ["rest", "prior"])
@pytest.mark.parametrize("mode", [None, "compose", "feedback"])
def test_the_mode_of_later_frames(
    folder: Path, tmp_path: Path, network: Repeater, geometric: Repeater, start: str, mode: str | None
) -> None:
    """The option's, or else what the model starts from decides; forecast.json names it."""
    file, wanted = tmp_path / "m.safetensors", mode or {"rest": "feedback", "prior": "compose"}[start]
    Forecaster(TINY if start == "rest" else SMALL).save(file)
    arguments = ["forecast", str(folder), "--out", str(tmp_path), "--no-exr", "--frame", "3", "--model", str(file)]
    assert cli.main([*arguments, *(["--mode", mode] if mode else [])]) == 0
    assert [each[1:] for each in network.networks] == [(wanted,)]
    settings = read_forecast(tmp_path).about["settings"]
    assert settings["mode"] == wanted
    assert settings["perceive"] == ("splatted" if wanted == "feedback" else None)


def test_tables_name_the_mode(
    folder: Path, tmp_path: Path, file: Path, network: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["forecast", str(folder), "--out", str(tmp_path), "--no-exr", "--compare", "--steps", "1"]
    assert cli.main([*arguments, "--model", str(file), "--mode", "compose"]) == 0
    assert "view source, mean over 1; mode compose" in " ".join(capsys.readouterr().out.split())


def test_estimators_see_forecast_frames(
    folder: Path, tmp_path: Path, file: Path, network: Repeater, geometric: Repeater, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a depth model recursion estimates by default; the estimator is loaded once."""
    loaded = []

    def load(name: str) -> Any:
        loaded.append(name)
        return lambda image: np.full_like(image[:1], 7.0)

    monkeypatch.setattr("vestcl.scene.estimators.DepthEstimator.load", load)
    arguments = ["forecast", str(folder), "--no-exr", "--frame", "3", "--model", str(file), "--depth-model", "a/b"]
    for number, options in enumerate(([], ["--perceive", "estimated"], ["--perceive", "splatted"])):
        out = tmp_path / str(number)
        assert cli.main([*arguments, "--out", str(out), *options]) == 0
        given, perceived = network.networks[-1][1:], "splatted" if number == 2 else "estimated"
        assert read_forecast(out).about["settings"]["perceive"] == perceived
        assert given[0] == "feedback" and len(given) == (1 if number == 2 else 2)
        if number < 2:
            image, unknown = torch.rand(1, 3, 8, 12), torch.full((1, 1, 8, 12), 30.0)
            assert (given[1](image, unknown, torch.ones_like(unknown)).depth == 7).all()
    assert loaded == ["a/b"] * 3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--mode", "compose", "--perceive", "splatted"], '--perceive must not be given with mode "compose"'),
        (["--perceive", "estimated"], '--perceive "estimated" needs --depth-model (in metres), --mask-model or both'),
    ],
)
def test_what_cannot_be_perceived(
    folder: Path, tmp_path: Path, file: Path, options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["forecast", str(folder), "--out", str(tmp_path / "out"), "--model", str(file)]
    assert cli.main([*arguments, *options]) == 2
    assert words in capsys.readouterr().err


def test_without_it_geometry_forecasts(folder: Path, tmp_path: Path, network: Repeater, geometric: Repeater) -> None:
    assert cli.main(["forecast", str(folder), "--out", str(tmp_path), "--no-exr", "--compare", "--steps", "1"]) == 0
    about = read_forecast(tmp_path).about
    assert not network.calls and len(geometric.calls) == 1
    assert about["method"] == "geometric" and about["settings"]["model"] is None
    assert set(about["scores"]["source"]) == {"forecast", "repeat last", "optical flow"}
    assert not {"model_file", "model_sha256"} & set(about["settings"])


def test_the_geometric_one_is_scored_next_to_the_networks(
    folder: Path, tmp_path: Path, file: Path, network: Repeater, geometric: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = (
        f"forecast {folder} --out {tmp_path} --no-exr --compare --steps 2 --view source --view right --model {file}"
    )
    assert cli.main(arguments.split()) == 0
    assert [call[1:3] for call in (*network.calls, *geometric.calls)] == [(3, 2), (3, 2)]
    about = read_forecast(tmp_path).about
    assert list(about["scores"]["source"]) == ["forecast", "geometric", "repeat last", "optical flow"]
    left = ["repeat last, left camera", "optical flow, left camera"]
    assert list(about["scores"]["right"]) == ["forecast", "geometric", *left, ORACLE]
    scores = about["scores"]["source"]
    assert scores["forecast"][0]["psnr"] is None  # infinite: this one foresaw the frame
    assert scores["geometric"] == scores["repeat last"]  # as both repeat it
    assert set(about["seconds"]) == {"open the clip", "repeat", "compare", "write the files"}
    rows = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line.strip()]
    at = rows.index("forecast")
    assert rows[at : at + 3] == ["forecast", "geometric", "repeat"]


def test_a_shipped_one_is_identified_by_its_name(
    folder: Path, tmp_path: Path, file: Path, network: Repeater, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.rename(file.with_name("vest-s.safetensors"))
    monkeypatch.setattr(shipped, "FOLDER", tmp_path)
    arguments = ["forecast", str(folder), "--out", str(tmp_path / "out"), "--no-exr", "--frame", "3"]
    assert cli.main([*arguments, "--model", "vest-s"]) == 0
    settings = read_forecast(tmp_path / "out").about["settings"]
    assert (settings["model"], settings["model_file"]) == ("vest-s", "vest-s.safetensors")


def test_missing_or_damaged_files_are_one_line(
    folder: Path, tmp_path: Path, network: Repeater, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(shipped, "FOLDER", tmp_path / "weights")
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"no tensors")
    for model, message in (
        ("vest-s", "vest-s: its weights are missing"),
        (str(damaged), "must be a safetensors file"),
        (str(folder), "clip: must have ema.safetensors or model.safetensors"),
    ):
        assert cli.main(["forecast", str(folder), "--out", str(tmp_path / "out"), "--model", model]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
    assert not network.calls and not (tmp_path / "out").exists()


def test_figures_of_a_right_view_are_whole_in_a_narrow_terminal(
    folder: Path,
    tmp_path: Path,
    geometric: Repeater,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    arguments = f"forecast {folder} --out {tmp_path} --no-exr --compare --steps 2 --view right"
    assert cli.main(arguments.split()) == 0
    table = capsys.readouterr().out.split("forecast: ")[0]
    assert "oracle" in table and "\u2026" not in table

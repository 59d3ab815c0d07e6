"""`vestcl forecast --learned`: which learned parts were left out and why, and where geometry scored better."""

from pathlib import Path

import pytest
from learned_networks import model, stir_all

from vestcl.cli import main as cli
from vestcl.cli.forecast import where_another_is_better
from vestcl.evaluation.compare import Comparison
from vestcl.forecasting.files import read_forecast


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "noisy.safetensors"
    stir_all(model(camera=0.9)).save(path)
    return path


def run(file: Path, out: Path, *options: str) -> str:
    arguments = f"forecast street:3 --height 48 --width 160 --frame 4 --steps 2 --no-exr --out {out} --model {file}"
    return " ".join([arguments, *options])


def test_what_was_left_out_and_why(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In forecast.json with numbers, in the last lines, and by --compare: equal to geometry it is not worse."""
    monkeypatch.setenv("COLUMNS", "200")
    assert cli.main(run(file, tmp_path, "--compare").split()) == 0
    said, about = capsys.readouterr().out, read_forecast(tmp_path).about
    assert about["settings"]["learned"] == "tested"
    assert {"camera", "refinement"} <= set(about["learned"])
    for part, one in about["learned"].items():
        assert set(one) == {"used", "why", "psnr", "psnr_without"} and not one["used"]
        assert f"learned part left out, {part}: {one['why']}" in said
    camera = about["learned"]["camera"]
    assert camera["psnr"] < camera["psnr_without"]
    assert "geometric scored better" not in said
    scores = about["scores"]["source"]
    assert scores["forecast"] == scores["geometric"]


def test_all_parts_untested(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The network's own forecast; where geometry is better, a line has the numbers."""
    monkeypatch.setenv("COLUMNS", "200")
    assert cli.main(run(file, tmp_path, "--compare", "--learned", "all").split()) == 0
    said, about = capsys.readouterr().out, read_forecast(tmp_path).about
    assert about["settings"]["learned"] == "all" and "learned" not in about
    first = {method: about["scores"]["source"][method][0]["psnr"] for method in ("forecast", "geometric")}
    assert first["geometric"] > first["forecast"]
    numbers = f"t+1 ({first['geometric']:.2f} against {first['forecast']:.2f} dB)"
    line = f"view source: geometric scored better than {about['method']} in PSNR at {numbers}"
    assert line in said


def test_it_needs_a_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["forecast", "street:3", "--out", str(tmp_path), "--learned", "all"]) == 2
    assert "--learned is which learned parts of a network count; it needs --model" in capsys.readouterr().err


def test_where_another_is_better() -> None:
    """By 0.01 dB or more, which tables show; two infinite ones are equal."""
    values = {"forecast": [20.0, 21.0, float("inf"), 22.0], "other": [20.5, 21.004, float("inf"), 21.0]}
    scores = {method: [{"psnr": value} for value in steps] for method, steps in values.items()}
    comparison = Comparison("right", {}, [], scores, False)
    wanted = "view right: other scored better than mine in PSNR at t+1 (20.50 against 20.00 dB)"
    assert where_another_is_better(comparison, "mine", "other") == wanted
    assert where_another_is_better(comparison, "mine", "forecast") is None

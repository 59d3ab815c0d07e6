"""`vestcl forecast` from the command line to its files, on small clips and with a forecaster that repeats a frame."""

import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from data_files import write_images, write_text
from forecast_clips import FRAMES, HEIGHT, WIDTH, Repeater, write_clip
from onnx_files import write_mix
from st_lpips_weights import public_state
from stand_ins import put_module

from vestcl import opencl
from vestcl.cli import main as cli
from vestcl.data import Street
from vestcl.data.sample import Clip, Sample
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.forecasting.files import read_forecast
from vestcl.io.video.reading import Video


@pytest.fixture
def repeater(monkeypatch: pytest.MonkeyPatch) -> Repeater:
    repeater = Repeater("repeater")
    put_module(monkeypatch, "vestcl.forecasting.geometric", forecast_clip=repeater)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.delenv("VESTCL_DEVICE", raising=False)
    return repeater


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_clip(tmp_path / "clip")


def test_everything_at_once(
    folder: Path, tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    out, last, before = tmp_path / "out", opencl.devices()[-1].index, opencl.current()
    arguments = f"forecast {folder} --out {out} --steps 2 --view right --view source --view -0.5,0,0,yaw=5,name=side"
    assert cli.main([*arguments.split(), "--compare", "--gif", "--device", last]) == 0
    ((clip, index, steps, views),) = repeater.calls
    assert (len(clip), index, steps, [view.name for view in views]) == (6, 3, 2, ["right", "source", "side"])
    assert repeater.devices == [last]
    assert opencl.current() is before
    saved = read_forecast(out)
    assert np.array_equal(saved.image(2, "side"), clip[3].read_image())
    depth = saved.frame(1, "side").depth
    assert depth is not None and (depth == 10).all()
    assert saved.about["settings"]["view"] == ["right", "source", "-0.5,0,0,yaw=5,name=side"]
    assert set(saved.about["scores"]) == {"right", "source"}
    scores = saved.about["scores"]["source"]
    assert scores["forecast"] == scores["repeat last"]
    assert len(scores["optical flow"]) == 2
    assert list(saved.about["seconds"]) == ["open the clip", "repeat", "compare", "write the files"]
    assert len(Video(out / "source" / "forecast.mp4")) == 4 + 2
    assert sorted(path.name for path in (out / "source").iterdir()) == [
        *("000001.exr", "000001.png", "000002.exr", "000002.png"),
        *("forecast.gif", "forecast.mp4", "sheet.png"),
    ]
    said = capsys.readouterr().out
    for name in ("PSNR, dB", "optical flow", "repeat", "0.25", f"{out}/side/000001.png ... 000002.png"):
        assert name in said
    assert f"{scores['forecast'][0]['psnr']:.2f}" in said
    assert f"{out}/right/sheet.png" in said
    assert saved.about["views"]["side"]["sheet"] == "side/sheet.png"


def test_by_default_the_source_after_the_last_frame(folder: Path, tmp_path: Path, repeater: Repeater) -> None:
    assert cli.main(["forecast", str(folder), "--out", str(tmp_path / "out"), "--no-exr"]) == 0
    ((_, index, steps, views),) = repeater.calls
    assert (index, steps, [view.name for view in views]) == (FRAMES - 1, 5, ["source"])
    about = read_forecast(tmp_path / "out").about
    assert "scores" not in about
    assert set(about["views"]["source"]["frames"][0]) == {"image"}
    assert not list(tmp_path.rglob("*.gif"))


@pytest.mark.parametrize(
    ("arguments", "size"),
    [("--height 48", (48, 80)), ("--width 20", (12, 20)), ("--height 30 --width 20", (30, 20)), ("", (24, 40))],
)
def test_size(arguments: str, size: tuple[int, int], folder: Path, tmp_path: Path, repeater: Repeater) -> None:
    assert cli.main(["forecast", str(folder), "--out", str(tmp_path / "out"), *arguments.split()]) == 0
    clip = repeater.calls[0][0]
    assert (clip[0].height, clip[0].width) == size
    assert clip[0].K[0, 0] == pytest.approx(40 * size[1] / WIDTH)
    assert read_forecast(tmp_path / "out").about["views"]["source"]["width"] == size[1]


@pytest.mark.parametrize(("arguments", "index"), [("--frame 1", 1), ("--frame 4 --compare", 4), ("--frame 5", 5)])
def test_frame(arguments: str, index: int, folder: Path, tmp_path: Path, repeater: Repeater) -> None:
    assert cli.main(["forecast", str(folder), "--out", str(tmp_path / "out"), *arguments.split()]) == 0
    assert repeater.calls[0][1] == index


def test_files_next_to_the_clip_and_options_of_its_layout(tmp_path: Path, repeater: Repeater) -> None:
    bare = tmp_path / "bare"
    write_images(bare, ["a.png", "b.png"], HEIGHT, WIDTH)
    for name in ("a", "b"):
        (tmp_path / "metres").mkdir(exist_ok=True)
        np.save(tmp_path / "metres" / f"{name}.npy", np.full((HEIGHT, WIDTH), 7, np.float32))
    arguments = f"forecast {bare} --out {tmp_path / 'out'} --fov 90 --depth {tmp_path / 'metres'}"
    assert cli.main(arguments.split()) == 0
    clip = repeater.calls[0][0]
    assert clip[0].K[0, 0] == pytest.approx(WIDTH / 2)
    assert (clip[1].read_depth() == 7).all()


def test_estimators_take_the_place_of_files(
    folder: Path, tmp_path: Path, repeater: Repeater, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[Any] = []

    def with_estimates(clip: Clip, depth: str | None = None, segmentation: str | None = None) -> Clip:
        calls.append((depth, segmentation))
        return clip

    def estimator(kind: str) -> type:
        return type("Estimator", (), {"load": staticmethod(lambda name: f"{kind} of {name}")})

    import vestcl.scene  # noqa: F401 - its attribute is put in place below

    members = {"DepthEstimator": estimator("depth"), "SegmentationEstimator": estimator("classes")}
    put_module(monkeypatch, "vestcl.scene.estimators", with_estimates=with_estimates, **members)
    arguments = ["forecast", str(folder), "--out", str(tmp_path / "out"), "--steps", "1"]
    assert cli.main([*arguments, "--depth-model", "zoe", "--mask-model", "former"]) == 0
    assert cli.main([*arguments, "--depth-model", "zoe"]) == 0
    assert cli.main(arguments) == 0
    assert calls == [("depth of zoe", "classes of former"), ("depth of zoe", None)]


def test_onnx_files_are_estimators(folder: Path, tmp_path: Path, repeater: Repeater) -> None:
    """Depth is 10 times the red, and class 1 of two, a car, is where blue exceeds red."""
    depth = write_mix(tmp_path / "depth.onnx", [[1.0, 0.0, 0.0]], metres=10)
    scores = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    classes = write_mix(tmp_path / "classes.onnx", scores, (HEIGHT, WIDTH), classes=[0, 13], std=1)
    arguments = ["forecast", str(folder), "--out", str(tmp_path / "out"), "--steps", "1"]
    assert cli.main([*arguments, "--depth-model", str(depth), "--mask-model", str(classes)]) == 0
    sample = repeater.calls[0][0][1]
    image = sample.read_image()
    assert sample.read_depth().shape == (1, HEIGHT, WIDTH) and sample.read_depth().max() <= 10
    assert ((sample.read_labels() == 13) == (image[2:] > image[:1])).all()


@pytest.mark.parametrize("option", ["--depth-model", "--mask-model"])
def test_networks_that_cannot_be_had_are_one_line(
    option: str, folder: Path, tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["forecast", str(folder), "--out", str(tmp_path / "out"), option]
    (tmp_path / "text.onnx").write_text("no network")
    for value, message in (("missing.onnx", "there is no file"), ("text.onnx", "is not an ONNX file")):
        assert cli.main([*arguments, str(tmp_path / value)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1 and message in error and value in error


def test_a_missing_extra_is_one_line(
    folder: Path,
    tmp_path: Path,
    repeater: Repeater,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def load(name: str) -> None:
        raise ImportError("pip install 'vestcl[estimators]'")

    import vestcl.scene  # noqa: F401 - its attribute is put in place below

    put_module(monkeypatch, "vestcl.scene.estimators", DepthEstimator=types.SimpleNamespace(load=load))
    assert cli.main(["forecast", str(folder), "--out", str(tmp_path / "out"), "--depth-model", "zoe"]) == 2
    assert capsys.readouterr().err == "error: pip install 'vestcl[estimators]'\n"


@pytest.mark.parametrize(
    ("arguments", "frames", "size", "index"),
    [
        ("", 4, (256, 832), 3),
        ("--compare --steps 2", 6, (256, 832), 3),
        ("--frame 9 --height 48 --width 64", 10, (48, 64), 9),
        ("--frame 2 --compare --steps 3", 6, (256, 832), 2),
    ],
)
def test_street(
    arguments: str,
    frames: int,
    size: tuple[int, int],
    index: int,
    tmp_path: Path,
    repeater: Repeater,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wanted = []

    def clip(street: Street, frames: int, height: int, width: int, **_: Any) -> Clip:
        wanted.append((street.seed, frames, (height, width)))
        K = np.array([[40.0, 0, 20], [0, 40, 12], [0, 0, 1]])
        image = np.zeros((3, HEIGHT, WIDTH))
        return Clip("street", "street", tuple(Sample.from_arrays(f"{i}", image, K) for i in range(frames)))

    monkeypatch.setattr("vestcl.data.street.input.street_clip", clip)
    assert cli.main(["forecast", "street:7", "--out", str(tmp_path / "out"), *arguments.split()]) == 0
    assert wanted == [(7, frames, size)]
    assert repeater.calls[0][1] == index


def test_a_long_table_shows_some_steps(
    folder: Path,
    tmp_path: Path,
    repeater: Repeater,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    write_images(folder / "image", [f"{i:04}.png" for i in range(14)], HEIGHT, WIDTH)
    arguments = f"forecast {folder} --out {tmp_path / 'out'} --steps 12 --compare --no-exr"
    assert cli.main(arguments.split()) == 0
    said = capsys.readouterr().out
    heading = next(line for line in said.splitlines() if "t+1" in line)
    assert heading.split() == ["t+1", "t+4", "t+6", "t+9", "t+12", "mean"]
    assert "view source, mean over 12" in said
    scores = read_forecast(tmp_path / "out").about["scores"]["source"]["optical flow"]
    values = [step["psnr"] for step in scores]
    row = next(line for line in said.splitlines() if "optical flow" in line).split()
    assert row[2:] == [f"{value:.2f}" for value in (*(values[step - 1] for step in (1, 4, 6, 9, 12)), np.mean(values))]


def test_weights_of_distances(
    folder: Path, tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.save(Trunk("squeezenet1_0").state_dict(), tmp_path / "squeeze.pth")
    torch.save(public_state(), tmp_path / "st.pth")
    arguments = f"forecast {folder} --out {tmp_path / 'out'} --steps 1 --compare --squeeze {tmp_path / 'squeeze.pth'}"
    assert cli.main([*arguments.split(), "--st-lpips", str(tmp_path / "st.pth")]) == 0
    saved = read_forecast(tmp_path / "out").about
    scores = saved["scores"]["source"]["forecast"][0]
    assert scores["squeeze"] > 0 and scores["st_lpips"] > 0 and "lpips" not in scores
    assert saved["settings"]["st_lpips"] == str(tmp_path / "st.pth")
    assert "ST-LPIPS" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--steps 0", "--steps must be 1 or more, got 0"),
        ("--height 0", "--height must be 1 or more, got 0"),
        ("--frame 0", "--frame must be 1 ... 5, to have a frame before it, got 0"),
        ("--frame 6", "--frame must be 1 ... 5, to have a frame before it, got 6"),
        ("--frame 5 --compare", "must be 1 ... 4, to have a frame before it and one after it to compare with, got 5"),
        ("--compare", "must have 7 frames to compare 5 steps, got 6"),
        ("--compare --steps 1 --view 0,0,1", "--view must have one with a truth to compare with"),
        ("--view above", "--view must be"),
        ("--view right --view right", "got right twice"),
        ("--perceive splatted", "--perceive is how a network sees its own forecast; it needs --model"),
        ("--memory -1", "--memory must be 0 frames or more, got -1"),
        ("--memory 2 --model vest-s", "--memory is of the geometric forecast: it can't be combined with --model"),
        ("--mode feedback", "--mode is how a network continues after its first step; it needs --model"),
        ("--model vest-xl", "vest-xl: is not a model: no file, no checkpoint's folder, and none of vest-s"),
        ("--squeeze x.pth", "--squeeze is a distance to the truth; it needs --compare"),
        ("--squeeze x.pth --compare --steps 1", "no squeezenet1_0 weights at x.pth"),
        ("--st-lpips", "--st-lpips is a distance to the truth; it needs --compare"),
        ("--st-lpips x.pth --compare --steps 1", "no ST-LPIPS weights at x.pth"),
        ("--fov 90", "camera.json: defines the camera; leave out --fov"),
        ("--rig grey", "is folder, which takes --fov, not --rig"),
        ("--depth nowhere", "--depth must be a folder of files with the frames' names, and nowhere does not exist"),
        ("--device abacus", "--device 'abacus' fits none"),
    ],
)
def test_mistakes_are_one_line(
    arguments: str, message: str, folder: Path, tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["forecast", str(folder), "--out", str(tmp_path / "out"), *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert not (tmp_path / "out").exists()


def test_mistakes_with_the_input_are_one_line(
    tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, message in (
        ("nowhere", "nowhere: no such file or folder"),
        ("street:x", "street:x: must be street:SEED"),
        ("street:0 --fov 9 --depth d", "street:0: is a street, which takes --height, --width, not --fov, --depth"),
        ("street:0 --frame 0", "--frame must be 1"),
    ):
        assert cli.main(["forecast", *arguments.split(), "--out", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err


def test_an_out_that_is_a_file_is_one_line(
    folder: Path, tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = write_text(tmp_path / "taken", "mine")
    assert cli.main(["forecast", str(folder), "--out", str(taken)]) == 2
    assert capsys.readouterr().err == f"error: --out must be a folder, got the file {taken}\n"
    assert not repeater.calls
    assert taken.read_text() == "mine\n"


def test_the_number_of_remembered_frames(folder: Path, tmp_path: Path, repeater: Repeater) -> None:
    arguments = ["forecast", str(folder), "--out", str(tmp_path / "out"), "--steps", "1"]
    assert cli.main([*arguments, "--memory", "5"]) == 0 and cli.main(arguments) == 0
    assert repeater.networks == [(5,), ()]

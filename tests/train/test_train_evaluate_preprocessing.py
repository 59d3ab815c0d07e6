"""train.evaluate's inputs in whole runs: estimators, prepared clips, inpainting; what tables and files list of them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, TINY, stir
from kitti_trees import SIZE, drives
from test_train_evaluate import run

from train import evaluate
from train.evaluate import main
from train.evaluation.inputs import PAIR
from train.evaluation.options import Evaluation
from vestcl.cli import main as cli
from vestcl.data import Street, street_clip
from vestcl.data.readers.splits import KITTI_VIEWS_TEST
from vestcl.evaluation.scores import GEOMETRIC
from vestcl.io import write_depth
from vestcl.models.forecaster import Forecaster
from vestcl.prepare.prepared import PreparedClip
from vestcl.scene.inpainting.inpaint import DEFAULT

#: One window of one street, one step.
ONE: dict[str, Any] = {
    "protocol": "street", "height": SIZE[0], "width": SIZE[1], "steps": 1, "horizons": (1,), "samples": 1,
    "seeds": (3, 3), "sheets": False,
}  # fmt: skip


class Estimators:
    """In place of `DepthEstimator.load` and `SegmentationEstimator.load`: 7 m everywhere, cars in the right half."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.loaded: list[str] = []
        self.seen = 0
        monkeypatch.setattr("vestcl.scene.estimators.DepthEstimator.load", self._depth)
        monkeypatch.setattr("vestcl.scene.estimators.SegmentationEstimator.load", self._classes)

    def _depth(self, name: str) -> Any:
        self.loaded.append(name)

        def estimate(image: np.ndarray) -> np.ndarray:
            self.seen += 1
            return np.full_like(image[:1], 7.0)

        return estimate

    def _classes(self, name: str) -> Any:
        self.loaded.append(name)

        def estimate(image: np.ndarray) -> np.ndarray:
            ids = np.zeros((1, *image.shape[1:]), np.uint8)
            ids[..., image.shape[2] // 2 :] = 13
            return ids

        return estimate


@pytest.fixture
def estimators(monkeypatch: pytest.MonkeyPatch) -> Estimators:
    return Estimators(monkeypatch)


def model_file(path: Path, kind: Any = TINY) -> Path:
    torch.manual_seed(0)
    stir(Forecaster(kind)).save(path)
    return path


class _Random(torch.nn.Module):
    """LaMa's inputs and outputs, with random weights."""

    def __init__(self) -> None:
        super().__init__()
        self.paint = torch.nn.Conv2d(4, 3, 3, padding=1)

    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return mask * torch.sigmoid(self.paint(torch.cat([image, mask], 1))) + (1 - mask) * image


@pytest.fixture
def lama(tmp_path: Path) -> str:
    torch.manual_seed(0)
    torch.jit.script(_Random().eval()).save(str(tmp_path / "big-lama.pt"))
    return f"lama:{tmp_path / 'big-lama.pt'}"


def tables(out: Path) -> list[str]:
    """Of results.md, all but the paper's."""
    parts = (out / "results.md").read_text(encoding="utf-8").split("\n**")[1:]
    return [part for part in parts if ", the paper**" not in part.splitlines()[0]]


# ---------------------------------------------------------------- estimators


def test_estimators_replace_the_clips_own(
    tmp_path: Path, estimators: Estimators, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both are named in every table, printed or written, and in results.json; recursion uses them by default."""
    model, plain = model_file(tmp_path / "tiny.safetensors"), run(**ONE, out=tmp_path / "plain")
    capsys.readouterr()
    reported = run(**ONE, model=(model,), depth_model="a/depth", mask_model="b/classes", out=tmp_path / "out")
    assert estimators.loaded == ["a/depth", "b/classes"]
    known = "Depth is from the estimator a/depth, masks are from the classes of b/classes."
    motion = f"Camera motion up to t is from optical flow and depth, inpainting is by {DEFAULT}."
    perceive = "Depth and masks of forecast frames (perceive): tiny estimated."
    assert known in reported["notes"] and motion in reported["notes"]
    (by_label,) = reported["inputs"].values()
    assert by_label == {
        "": {
            "depth": "the estimator a/depth", "masks": "the classes of b/classes", "motion": "optical flow and depth",
            "inpainting": DEFAULT, "stereo": False,
        }
    }  # fmt: skip
    assert (reported["models"]["tiny"]["mode"], reported["models"]["tiny"]["perceive"]) == ("feedback", "estimated")
    written = tables(tmp_path / "out")
    assert len(written) > 3 and all(known in table and motion in table and perceive in table for table in written)
    printed = capsys.readouterr().out
    assert printed.count(known) == printed.count(perceive) >= 3
    before, after = (each["summary"]["source"][GEOMETRIC]["by_horizon"]["psnr"][0] for each in (plain, reported))
    assert before > after + 1, "a wall at 7 m is a worse street than the true one"


def test_forecast_frames_are_perceived_as_asked(tmp_path: Path, estimators: Estimators) -> None:
    model = model_file(tmp_path / "tiny.safetensors")
    settings = {**ONE, "steps": 2, "model": (model,), "depth_model": "a/depth"}
    estimated, splatted = (
        run(**settings, perceive=perceive, out=tmp_path / perceive) for perceive in ("estimated", "splatted")
    )
    (one, other) = (reported["summary"]["source"]["tiny"]["by_horizon"]["psnr"] for reported in (estimated, splatted))
    assert one[0] == other[0] and one[1] != other[1]
    assert splatted["models"]["tiny"]["perceive"] == "splatted"
    assert "Depth and masks of forecast frames (perceive): tiny splatted." in tables(tmp_path / "splatted")[0]
    assert ", mode feedback, perceive splatted" in (tmp_path / "splatted" / "results.md").read_text(encoding="utf-8")


def test_perceive_is_of_models_that_see_their_forecast(tmp_path: Path) -> None:
    """Of two models, one composes: it perceives nothing."""
    files = model_file(tmp_path / "rest.safetensors"), model_file(tmp_path / "prior.safetensors", SMALL)

    def setup(**settings: Any) -> Any:
        config = Evaluation("street", **settings)
        return evaluate.setup_of(config, evaluate.protocol_of(config))

    both = setup(model=files, perceive="splatted")
    assert [later.perceived for later in both.later.values()] == ["splatted", None]
    for settings, message in (
        ({"model": files[1:], "perceive": "splatted"}, '`perceive` must not be given with mode "compose"'),
        ({"model": files, "perceive": "estimated"}, r'"estimated" needs --depth-model \(in metres\), --mask-model or'),
        ({"perceive": "splatted"}, "`perceive` is how a network sees its own forecast; it needs `model`"),
    ):
        with pytest.raises(ValueError, match=message):
            setup(**settings)


# ---------------------------------------------------------------- prepared clips


def prepare(out: Path, *options: str) -> Path:
    size = f"--height {SIZE[0]} --width {SIZE[1]} --samples 1 --frames 4".split()
    assert cli.main(["prepare", "street:3", "--out", str(out), *size, *options]) == 0
    return out


def test_prepared_clips_in_place_of_recorded_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same scores as when frames are preprocessed here, up to the cache's 8 bits; nothing is preprocessed again."""
    cache, model = prepare(tmp_path / "cache"), model_file(tmp_path / "tiny.safetensors")
    reported, plain = (
        run(**ONE, model=(model,), out=tmp_path / name, **given)
        for name, given in (("prepared", {"prepared": cache}), ("plain", {}))
    )
    assert set(reported["summary"]["right"]) == set(plain["summary"]["right"])
    for view, method in (("source", GEOMETRIC), ("source", "tiny"), ("right", GEOMETRIC), ("camera", "tiny")):
        metric = "rotation_degrees" if view == "camera" else "psnr"
        found = [each["summary"][view][method]["by_horizon"] for each in (reported, plain)]
        metric = metric if metric in found[0] else next(iter(found[0]))
        assert found[0][metric][0] == pytest.approx(found[1][metric][0], rel=0.02), (view, method)
    assert (
        reported["inputs"] == plain["inputs"]
        and "Depth is from the street itself, true, masks are from labels." in reported["notes"]
    )
    assert reported["weights"]["prepared"]
    assert main(["street", "--prepared", str(cache), "--seeds", "3", "3", "--out", str(tmp_path / "o")]) == 2
    error = capsys.readouterr().err
    assert "--prepared must have street 3 of `vestcl prepare --height 256 --width 832`" in error


def test_prepared_stereo_depth_is_named(tmp_path: Path) -> None:
    """Its rows are labelled; a cache that lists no inputs is refused."""
    cache = prepare(tmp_path / "cache", "--street-depth", "stereo")
    reported = run(**ONE, prepared=cache, out=tmp_path / "out")
    assert GEOMETRIC + PAIR in reported["summary"]["source"] and GEOMETRIC not in reported["summary"]["source"]
    assert 'Depth is from the stereo pair at t-1 and t (rows ending in "stereo pair")' in reported["notes"][0]
    (file,) = cache.rglob("clip.json")
    about = json.loads(file.read_text())
    del about["inputs"], about["checksum"]
    file.write_text(json.dumps(about))
    assert PreparedClip.open(file.parent).inputs is None
    with pytest.raises(ValueError, match="must list where its depth comes from; run `vestcl prepare` again"):
        run(**ONE, prepared=cache, out=tmp_path / "old")


def test_prepared_from_the_answer_is_refused(tmp_path: Path, estimators: Estimators) -> None:
    """Novel views at t: a KITTI drive prepared from its pair has seen the answer; one estimated has not."""
    data, size = drives(tmp_path / "kitti", KITTI_VIEWS_TEST, 5), ["--height", str(SIZE[0]), "--width", str(SIZE[1])]
    folders = [str(data / name[:10] / name) for name in KITTI_VIEWS_TEST]
    for name, options in (("pair", []), ("estimated", ["--depth-model", "a/depth", "--mask-model", "b/classes"])):
        assert cli.main(["prepare", *folders, "--out", str(tmp_path / name), *size, *options]) == 0
    settings = {"protocol": "kitti-space", "height": SIZE[0], "width": SIZE[1], "steps": 1, "sheets": False}
    with pytest.raises(ValueError, match=r"has depth that was matched against the right camera's image at t, which is"):
        run(**settings, prepared=tmp_path / "pair", out=tmp_path / "out")
    reported = run(**settings, prepared=tmp_path / "estimated", out=tmp_path / "out")
    assert reported["notes"][0] == "Depth is from the estimator a/depth, masks are from the classes of b/classes."
    assert set(reported["clips"]) == set(KITTI_VIEWS_TEST)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--data", "x"], "--data must not be given with --prepared"),
        (["--stereo"], "--stereo must not be given with --prepared"),
        (["--accumulated-depth"], "--accumulated-depth must not be given with --prepared"),
        (["--depth-model", "x"], "--depth-model and --mask-model are of forecast frames then, and need --perceive"),
    ],
)
def test_what_prepared_clips_exclude(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["street", "--prepared", str(tmp_path), *options]) == 2
    error = capsys.readouterr().err
    assert message in error.replace("`", "") and error.count("\n") == 1


# ---------------------------------------------------------------- KITTI's accumulated depth


def test_accumulated_depth_is_asked_for_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`proj_depth/groundtruth` has the scans of later frames."""
    data = drives(tmp_path / "kitti", KITTI_VIEWS_TEST, 5)
    clip = street_clip(Street.generate(3), 5, *SIZE, samples=1)
    for name in KITTI_VIEWS_TEST:
        for index in (2, 3):
            path = data / name[:10] / name / "proj_depth" / "groundtruth" / "image_02" / f"{index:010}.png"
            write_depth(path, clip[index].read_depth()[0], 256)
    settings = {
        "protocol": "kitti-space",
        "data": data,
        "height": SIZE[0],
        "width": SIZE[1],
        "steps": 1,
        "sheets": False,
    }
    plain = run(**settings, out=tmp_path / "plain")
    assert plain["notes"][0] == "Depth is from motion, masks are from motion."
    reported = run(**settings, accumulated_depth=True, out=tmp_path / "out")
    words = "KITTI's depth maps, accumulated from scans of frames around each, later ones among them"
    assert all(
        f"Depth is from {words}, where there are any, else motion" in table for table in tables(tmp_path / "out")
    )
    (before, after) = (each["summary"]["right at t"][GEOMETRIC]["by_horizon"]["psnr"][0] for each in (plain, reported))
    assert after > before
    assert main(["street", "--accumulated-depth", "--out", str(tmp_path / "street")]) == 2
    assert "--accumulated-depth is of KITTI raw" in capsys.readouterr().err


# ---------------------------------------------------------------- inpainting


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")  # of TorchScript
def test_lama_reaches_every_command(tmp_path: Path, lama: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Evaluation, caches and forecasts: other colours behind what moves, and the method is named."""
    model = model_file(tmp_path / "tiny.safetensors")
    reported, plain = (
        run(**{**ONE, "steps": 2}, model=(model,), out=tmp_path / name, inpaint=inpaint)
        for name, inpaint in (("lama", lama), ("plain", None))
    )
    assert f"Camera motion up to t is from optical flow and depth, inpainting is by {lama}." in reported["notes"]
    one, other = (each["summary"]["source"]["tiny"]["by_horizon"]["psnr"] for each in (reported, plain))
    assert one != other
    caches = [prepare(tmp_path / name, *options) for name, options in (("a", ["--inpaint", lama]), ("b", []))]
    clips = [PreparedClip.open(next(cache.rglob("clip.json")).parent) for cache in caches]
    frames = [clip.frame(2).layers for clip in clips]
    hidden = ~frames[0].mask[0]
    assert hidden.any() and not np.array_equal(*(frame.background_image[:, hidden] for frame in frames))
    assert np.array_equal(frames[0].background_depth, frames[1].background_depth)
    assert clips[0].inputs and clips[1].inputs
    assert (clips[0].inputs.inpainting, clips[1].inputs.inpainting) == (lama, DEFAULT)
    assert clips[0].frames[2].key != clips[1].frames[2].key
    size = ["--height", str(SIZE[0]), "--width", str(SIZE[1]), "--steps", "1", "--frame", "2", "--no-exr"]
    for options in (["--inpaint", lama], ["--inpaint", lama, "--model", str(model)]):
        out = tmp_path / f"forecast {len(options)}"
        assert cli.main(["forecast", "street:3", "--out", str(out), *size, *options]) == 0
        assert json.loads((out / "forecast.json").read_text())["settings"]["inpaint"] == lama
    assert cli.main(["forecast", "street:3", *size, "--out", str(tmp_path / "no"), "--inpaint", "paint"]) == 2
    assert "error: --inpaint must be one of regions" in capsys.readouterr().err
    assert main(["street", "--inpaint", f"lama:{tmp_path / 'none.pt'}", "--out", str(tmp_path / "no")]) == 2
    assert "none.pt: no such file; LaMa's weights are a TorchScript export" in capsys.readouterr().err

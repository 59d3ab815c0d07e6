"""train.forecasts and train.refinement: a cache of geometric forecasts, a run that learns from it, and its files."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from forecaster_scenes import SMALL

from train import forecasts, refinement, refinement_scores
from train.forecasts import Entry, ForecastWindow, pack, unpack
from train.refinement import RefinementConfig, Samples, load_config, train, with_forecast_refinement
from train.run import trainer
from train.run.loop import LOG, STATE
from vestcl.cli.prepare import open_input
from vestcl.data import Street, street_clip
from vestcl.forecasting.geometric import Perception, forecast_frames
from vestcl.forecasting.network.planes import forecast_planes
from vestcl.forecasting.result import View
from vestcl.models.checkpoint import read_trained_on
from vestcl.models.forecaster import Forecaster

STREET = "street:3?drive=road,fps=20"
SIZE = ("--height", "48", "--width", "96")


def make(out: Path, *more: str) -> int:
    return forecasts.main([STREET, "--out", str(out), *SIZE, "--frames", "6", "--horizons", "1", "2", *more])


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("forecasts")
    assert make(folder, "--right") == 0
    return folder


def base() -> Forecaster:
    torch.manual_seed(0)
    return Forecaster(SMALL).eval()


def settings(folder: Path, cache: Path, *overrides: str) -> RefinementConfig:
    whole: dict[str, Any] = {
        "name": "tiny", "out": str(folder / "run"), "data": {"train": [str(cache)], "crop": [32, 64]},
        "stage": {"name": "refine", "steps": 6, "batch": 2, "learning_rate": 3e-3},
        "loss": {"perceptual": {"kind": "none"}, "ssim": 0.2}, "optimiser": {"ema": 0.5},
        "run": {"checkpoint_every": 2, "log_every": 1, "threads": 1},
    }  # fmt: skip
    (folder / "refinement.yaml").write_text(yaml.safe_dump(whole), encoding="utf-8")
    return load_config(folder / "refinement.yaml", overrides)


# ---------------------------------------------------------------- the cache


def test_the_cache_has_what_inference_shows(cache: Path) -> None:
    """Planes of the geometric forecast of both views, and the true frames; up to rounding to 8 bits."""
    (file,) = [path for path in cache.glob("*/*.npz") if path.stem == "000002"]
    window = unpack(file)
    clip = open_input(STREET, forecasts.Forecasts((STREET,), cache, 48, 96, 6).as_prepare())
    camera = clip[2].right
    assert window.clip == clip.name and window.frames == (0, 4) and camera is not None
    assert [entry.ahead for entry in window.entries] == [1, 1, 2, 2]
    views = [View("source", np.eye(4)), View("right", camera.right_from_left, camera.K)]
    frames = forecast_frames(Perception(clip), 2, 2, views).frames
    for number, (ahead, name) in enumerate([(1, "source"), (1, "right"), (2, "source"), (2, "right")]):
        entry, later = window.entries[number], clip[2 + ahead]
        np.testing.assert_allclose(entry.planes, forecast_planes(frames[ahead - 1][name], ahead, 0.05), atol=2.5e-3)
        truth = later.right.image.read() if name == "right" and later.right else later.image.read()
        np.testing.assert_allclose(entry.target, truth, atol=2.1e-3)
        assert entry.planes[6, 0, 0] == np.float32(0.05 * ahead)


def test_the_cache_is_the_same_again_and_keeps_what_is_there(cache: Path, tmp_path: Path, capsys: Any) -> None:
    assert make(tmp_path, "--right", "--shard", "0/1") == 0
    files = sorted(path.relative_to(cache) for path in cache.glob("*/*.npz"))
    assert len(files) == 2 and all((cache / file).read_bytes() == (tmp_path / file).read_bytes() for file in files)
    (tmp_path / files[0]).unlink()
    assert make(tmp_path, "--right") == 0
    assert "1 windows made, 1 kept" in capsys.readouterr().out
    assert (tmp_path / files[0]).read_bytes() == (cache / files[0]).read_bytes()


def test_clips_are_forecast_and_compared_at_the_size_asked_for() -> None:
    clip = street_clip(Street.generate(3), 4, 60, 120).resized(48, 96)
    made = forecasts.entries(Perception(clip), clip, 2, [1], right=True)
    assert [entry.target.shape for entry in made] == [(3, 48, 96)] * 2
    np.testing.assert_array_equal(made[0].target, clip[3].read_image())


def test_a_shard_has_its_clips(tmp_path: Path) -> None:
    assert make(tmp_path, "--shard", "1/2") == 0
    assert not list(tmp_path.glob("*/*.npz"))


@pytest.mark.parametrize(
    ("options", "message"),
    [(("--horizons", "0"), "`horizons`|--horizons"), (("--windows", "0"), "windows"), (("--frames", "4"), "5 or more")],
)
def test_options_that_cannot_be(options: tuple[str, ...], message: str, tmp_path: Path, capsys: Any) -> None:
    made = forecasts.Forecasts((STREET,), tmp_path, frames=6, horizons=(1, 2))
    values = {options[0].removeprefix("--"): (0,) if options[0] == "--horizons" else int(options[1])}
    with pytest.raises(ValueError, match=message):
        forecasts.check_options(dataclasses.replace(made, **values))


def test_a_damaged_window_is_named(cache: Path, tmp_path: Path) -> None:
    content = next(iter(cache.glob("*/*.npz"))).read_bytes()
    (tmp_path / "a.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"a\.npz: is not a window of `train\.forecasts`"):
        unpack(tmp_path / "a.npz")


# ---------------------------------------------------------------- samples


def test_samples_depend_on_their_number_only(tmp_path: Path, cache: Path) -> None:
    config = settings(tmp_path, cache)
    one, two = Samples(config.data, 5), Samples(config.data, 5)
    one.batch(0, 2)
    for first, second in zip(one.batch(3, 2), two.batch(3, 2), strict=True):
        assert torch.equal(first, second)
    planes, target = one.batch(1, 2)
    assert planes.shape == (2, 7, 32, 64) and target.shape == (2, 3, 32, 64)


def test_planes_and_target_are_varied_equally(tmp_path: Path) -> None:
    """Of a perfect forecast the target is the image, however cut, mirrored and coloured; grey is grey."""
    image = np.random.default_rng(0).integers(0, 256, (3, 40, 80)).astype(np.float32) / 255
    planes = np.concatenate([image, np.ones((4, 40, 80), np.float32)])
    (tmp_path / "000000.npz").write_bytes(pack(ForecastWindow("c", 2, [Entry(planes, image, 1)])))
    data = refinement.ForecastData((str(tmp_path),), (32, 64), colour=0.5, grey=1.0)
    got, target = Samples(data, 0).batch(0, 4)
    assert torch.equal(got[:, :3], target) and torch.equal(target[:, 0], target[:, 2])
    with pytest.raises(ValueError, match=r"`data.crop` must be at most 40x80"):
        Samples(dataclasses.replace(data, crop=(48, 64)), 0).batch(0, 1)
    with pytest.raises(ValueError, match="got none in"):
        Samples(dataclasses.replace(data, train=(str(tmp_path / "x*"),)), 0)


# ---------------------------------------------------------------- runs


def test_a_run_learns_and_keeps_all_other_parts(tmp_path: Path, cache: Path) -> None:
    """Forecasts that are 0.1 too dark."""
    image = np.random.default_rng(0).uniform(0.2, 0.6, (3, 32, 64)).astype(np.float32)
    planes = np.concatenate([image, np.ones((4, 32, 64), np.float32)])
    (tmp_path / "dark").mkdir()
    (tmp_path / "dark" / "000002.npz").write_bytes(pack(ForecastWindow("dark", 2, [Entry(planes, image + 0.1, 1)])))
    config = settings(tmp_path, tmp_path / "dark", "stage.steps=20", "stage.learning_rate=0.01")
    file = train(config, base=base())
    rows = [json.loads(line) for line in (config.out / LOG).read_text().splitlines()]
    assert rows[0]["l1"] == pytest.approx(rows[0]["l1_geometric"], rel=1e-6)  # it starts from changing nothing
    assert np.mean([row["l1"] / row["l1_geometric"] for row in rows[-8:]]) < 0.6
    made, before = Forecaster.load(file), base().state_dict()
    assert made.config.name == "tiny" and made.config.refine.refines == "forecast"
    others = {name: value for name, value in made.state_dict().items() if not name.startswith("refine.")}
    assert others.keys() < before.keys() and all(torch.equal(value, before[name]) for name, value in others.items())
    assert (read_trained_on(file) or {})["dark"] == (0, 3)
    assert refinement_scores.main([str(file), str(cache)]) == 0


def test_a_resumed_run_comes_to_the_same_weights(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = settings(tmp_path, cache)
    wanted = Forecaster.load(train(config, base=base())).state_dict()
    broken, original = dataclasses.replace(config, out=tmp_path / "broken"), Samples.batch

    def dies(self: Samples, step: int, size: int) -> Any:
        if step == 3:
            raise KeyboardInterrupt
        return original(self, step, size)

    with monkeypatch.context() as patch:
        patch.setattr(Samples, "batch", dies)
        with pytest.raises(KeyboardInterrupt):
            train(broken, base=base())
    with pytest.raises(ValueError, match="has a run already: --resume resumes it"):
        train(broken, base=base())
    got = Forecaster.load(train(broken, resume=True, base=base())).state_dict()
    assert (broken.out / STATE).is_file() and all(torch.equal(value, got[name]) for name, value in wanted.items())


def test_a_model_that_refines_forecasts_keeps_its_refinement() -> None:
    once = with_forecast_refinement(base(), "one")
    torch.nn.init.normal_(once.refine.out.weight)
    again = with_forecast_refinement(once, "two")
    assert again.config.name == "two" and torch.equal(again.refine.out.weight, once.refine.out.weight)


def test_a_run_starts_from_another_models_refinement(tmp_path: Path, cache: Path) -> None:
    once = with_forecast_refinement(base(), "one")
    torch.nn.init.normal_(once.refine.out.weight)
    once.save(tmp_path / "one.safetensors")
    config = settings(tmp_path, cache, f"init={tmp_path / 'one.safetensors'}")
    started = refinement.RefinementTraining(config, base())
    assert torch.equal(started.whole.refine.out.weight, once.refine.out.weight)
    base().save(tmp_path / "clouds.safetensors")
    with pytest.raises(ValueError, match="its refinement is of splatted clouds"):
        refinement.RefinementTraining(dataclasses.replace(config, init=str(tmp_path / "clouds.safetensors")), base())


def test_other_parts_train_on_from_such_a_model(tmp_path: Path) -> None:
    """`train.fit` takes all parts of it but refinement, which it trains on splatted clouds."""
    with_forecast_refinement(base(), "one").save(tmp_path / "one.safetensors")
    given = Forecaster.load(tmp_path / "one.safetensors")
    state = trainer._fitting(given, base())
    base().load_state_dict(state)
    others = [name for name in state if not name.startswith("refine.")]
    assert others and all(torch.equal(state[name], given.state_dict()[name]) for name in others)


def test_the_shipped_configuration_is_complete() -> None:
    path = Path(__file__).resolve().parents[2] / "train" / "configs" / "refinement" / "street.yaml"
    with pytest.raises(ValueError, match="`weights` must be set"):
        load_config(path)
    assert load_config(path, ["loss.perceptual.weights=squeezenet.npz"]).stage.batch == 4

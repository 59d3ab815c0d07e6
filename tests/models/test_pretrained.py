"""Trained networks by name, file or checkpoint, and what is said where there is none."""

import hashlib
from pathlib import Path

import pytest
import torch
from forecaster_scenes import TINY

from vestcl.models import shipped
from vestcl.models.checkpoint import write_checkpoint
from vestcl.models.forecaster import Forecaster

#: The largest amount that a file in the package may have, bytes.
LARGEST = 20e6


@pytest.fixture
def model() -> Forecaster:
    return Forecaster(TINY)


def same(one: Forecaster, other: Forecaster) -> bool:
    pairs = zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    return all(torch.equal(first, second) for first, second in pairs)


def test_a_file(model: Forecaster, tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    model.save(path)
    for given in (path, str(path)):
        loaded = Forecaster.from_pretrained(given)
        assert same(loaded, model) and loaded.config == TINY and not loaded.training
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    assert shipped.about_model(path) == {"model_file": str(path), "model_sha256": sha256}


def test_of_a_checkpoint_the_running_mean(model: Forecaster, tmp_path: Path) -> None:
    folder, mean = tmp_path / "step-00000012", Forecaster(TINY)
    model.save(folder / "model.safetensors")
    assert same(Forecaster.from_pretrained(folder), model)
    mean.save(folder / "ema.safetensors")
    assert not same(mean, model)
    assert same(Forecaster.from_pretrained(str(folder)), mean)
    assert shipped.find_model(folder) == folder / "ema.safetensors"


def test_half_precision_is_loaded_as_float32(model: Forecaster, tmp_path: Path) -> None:
    path, half = tmp_path / "half.safetensors", {name: t.half() for name, t in model.state_dict().items()}
    write_checkpoint(path, TINY, half)
    loaded = Forecaster.from_pretrained(path).state_dict()
    assert {tensor.dtype for tensor in loaded.values()} == {torch.float32}
    assert all(torch.equal(loaded[name], half[name].float()) for name in half)


def test_by_name(model: Forecaster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shipped, "FOLDER", tmp_path)
    monkeypatch.chdir(tmp_path)
    assert shipped.shipped() == {}
    with pytest.raises(ValueError, match=r"vest-s: its weights are missing \(.*vest-s.safetensors\); install vestcl"):
        Forecaster.from_pretrained("vest-s")
    path = tmp_path / "vest-s.safetensors"
    model.save(path)
    assert shipped.shipped() == {"vest-s": path}
    assert same(Forecaster.from_pretrained("vest-s"), model)
    assert shipped.about_model("vest-s")["model_file"] == "vest-s.safetensors"
    with pytest.raises(ValueError, match="is not a model"):  # a path is not a name
        Forecaster.from_pretrained(Path("vest-s"))


def test_errors(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match="vest-xl: is not a model: no file, no checkpoint's folder, and none of vest-s"
    ):
        Forecaster.from_pretrained("vest-xl")
    with pytest.raises(ValueError, match=r"must have ema.safetensors or model.safetensors, as a training checkpoint"):
        Forecaster.from_pretrained(tmp_path)
    (tmp_path / "torn.safetensors").write_bytes(b"12345678torn")
    with pytest.raises(ValueError, match=r"must be a safetensors file, got .*torn"):
        Forecaster.from_pretrained(tmp_path / "torn.safetensors")


@pytest.mark.parametrize("name", shipped.SHIPPED)
def test_what_ships(name: str) -> None:
    model = Forecaster.from_pretrained(name)
    assert model.config.name.split("+")[0] == name
    assert all(torch.isfinite(parameter).all() for parameter in model.parameters())
    assert shipped.shipped()[name].stat().st_size <= LARGEST

"""A checkpoint as it ships."""

from pathlib import Path

import pytest
import torch
from forecaster_scenes import TINY, stir

from train.export import main
from vestcl.models.forecaster import Forecaster


def test_half_the_size_and_nearly_the_weights(tmp_path: Path) -> None:
    model, folder = stir(Forecaster(TINY)), tmp_path / "step-00000010"
    model.save(folder / "ema.safetensors")
    Forecaster(TINY).save(folder / "model.safetensors")
    out = tmp_path / "out" / "tiny.safetensors"
    assert main([str(folder), str(out)]) == 0
    assert out.stat().st_size < 0.6 * (folder / "ema.safetensors").stat().st_size
    shipped = Forecaster.load(out)
    assert shipped.config == TINY
    for name, tensor in model.state_dict().items():
        assert shipped.state_dict()[name].dtype == torch.float32
        assert torch.allclose(shipped.state_dict()[name], tensor, rtol=1e-3, atol=1e-6), name


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "nothing"), str(tmp_path / "out.safetensors")]) == 2
    model = Forecaster(TINY)
    with torch.no_grad():
        next(model.parameters()).fill_(1e6)
    model.save(tmp_path / "large.safetensors")
    assert main([str(tmp_path / "large.safetensors"), str(tmp_path / "out.safetensors")]) == 2
    assert "below 65,504" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "out.safetensors").exists()

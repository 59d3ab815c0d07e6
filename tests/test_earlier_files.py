"""Files that an earlier version wrote still open: a prepared clip, a checkpoint, a stopped run, a benchmark's results.

`tests/earlier` has them. They hold no absolute path, and names of modules and classes in them would be noticed here.
"""

import shutil
from pathlib import Path

import pytest
import train_scenes
import yaml

from train import fit
from vestcl.cli import main as cli
from vestcl.models import config
from vestcl.models.forecaster import Forecaster
from vestcl.prepare.prepared import find_prepared

EARLIER = Path(__file__).parent / "earlier"
CHECKPOINT = "checkpoints/step-00000002"


@pytest.fixture
def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The files where they may be changed, as the working folder."""
    folder = tmp_path / "earlier"
    shutil.copytree(EARLIER, folder)
    (folder / "prepared").rename(folder / "cache")  # as run.yaml names it
    monkeypatch.chdir(folder)
    monkeypatch.setattr(config, "CONFIGS", train_scenes.MODELS)
    return folder


def test_a_prepared_clip_opens() -> None:
    (clip,) = find_prepared(EARLIER / "prepared")
    assert clip.name == "street 3" and clip.size == (32, 96) and len(clip.frames) == 3
    assert clip.frame(1).layers.image.shape == (3, 32, 96)


def test_a_checkpoint_opens_as_a_model() -> None:
    model = Forecaster.from_pretrained(EARLIER / "run" / CHECKPOINT / "ema.safetensors")
    assert sum(weights.numel() for weights in model.parameters()) == 28336


def test_a_stopped_run_is_resumed(copied: Path) -> None:
    settings = yaml.safe_load((copied / "run.yaml").read_text())
    settings["stages"][0]["steps"] = 3
    (copied / "run.yaml").write_text(yaml.safe_dump(settings))
    assert fit.main(["run.yaml", "--resume"]) == 0
    assert (copied / "run/checkpoints/step-00000003/state.pt").exists()
    assert len((copied / "run/log.jsonl").read_text().splitlines()) > len(
        (EARLIER / "run/log.jsonl").read_text().splitlines()
    )


def test_results_of_a_benchmark_are_compared(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "compare", str(EARLIER / "operators.json"), str(EARLIER / "operators.json")]) == 0
    assert "splat" in capsys.readouterr().out

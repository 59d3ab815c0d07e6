"""train.peer: the loss by hand, a run that learns and can be resumed, and settings that cannot be."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from train_scenes import street

from train import peer
from train.data.windows import Batch
from train.fit import window_set
from train.peer import WEIGHTS, PeerConfig, load_config, loss_of, pyramid_loss, train
from train.run.loop import LOG, STATE
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

SETTINGS: dict[str, Any] = {
    "name": "tiny",
    "data": {"crop": [32, 64], "flip": False, "colour": 0.0},
    "stages": [
        {"name": "all", "steps": 5, "batch": 2, "learning_rate": 3e-3},
        {"name": "more", "steps": 3, "batch": 2, "learning_rate": 1e-3, "data": {"horizons": [0.0, 1.0]}},
    ],
    "loss": {"perceptual": {"kind": "none"}, "ssim": 0.2},
    "optimiser": {"ema": 0.5},
    "run": {"checkpoint_every": 3, "log_every": 1, "threads": 1},
}


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return street(tmp_path_factory)


def settings(folder: Path, cache: Path, *overrides: str, **changes: Any) -> PeerConfig:
    """As read from a file."""
    whole = SETTINGS | {"out": str(folder / "run"), "data": SETTINGS["data"] | {"train": [str(cache)]}} | changes
    (folder / "peer.yaml").write_text(yaml.safe_dump(whole), encoding="utf-8")
    return load_config(folder / "peer.yaml", overrides)


def network() -> VoxelFlowNetwork:
    torch.manual_seed(1)
    return VoxelFlowNetwork(blocks=[(2, 8), (1, 8)])


def a_batch(config: PeerConfig, stage: int) -> Batch:
    windows = window_set(config.data_of(config.stages[stage]))
    return windows.batch(windows.global_batch(0, 0, 2))


# ---------------------------------------------------------------- loss


def test_the_pyramid_of_a_constant_error_is_its_last_level() -> None:
    """0.25 off everywhere: no detail differs. An earlier block's image counts 0.8 times as much."""
    target = torch.rand(2, 3, 32, 48)
    torch.testing.assert_close(pyramid_loss([target + 0.25], target), torch.tensor(0.25))
    torch.testing.assert_close(pyramid_loss([target - 0.5, target + 0.25], target), torch.tensor(0.8 * 0.5 + 0.25))
    assert pyramid_loss([target], target) == 0


def test_the_pyramid_of_a_checkerboard_is_its_first_level() -> None:
    """1 and -1 in turn: the means of 2 x 2 pixels are 0, so that all of it is the finest detail."""
    board = torch.ones(1, 1, 32, 32)
    board[..., ::2, ::2] = board[..., 1::2, 1::2] = -1
    torch.testing.assert_close(pyramid_loss([board], torch.zeros(1, 1, 32, 32)), torch.tensor(1.0))


def test_later_frames_are_forecast_recursively(tmp_path: Path, cache: Path) -> None:
    config, peer_network = settings(tmp_path, cache), network()
    batch = a_batch(config, 1)
    assert batch.horizon == 2
    first, second = batch.frame_prev.image, batch.frame_cur.image
    images = list(peer_network.corrected(second, peer_network(first, second)))
    total, terms = loss_of(peer_network, batch, config.loss, None)
    torch.testing.assert_close(terms["pyramid"], pyramid_loss(images, batch.target).detach())
    assert set(terms) == {"pyramid", "ssim"}
    torch.testing.assert_close(total.detach(), terms["pyramid"] + 0.2 * terms["ssim"])
    total.backward()
    silent = {name.split(".")[0] for name, p in peer_network.named_parameters() if p.grad is None or not p.grad.any()}
    assert silent == {"router"}


# ---------------------------------------------------------------- runs


def test_a_run_learns_and_writes_its_files(tmp_path: Path, cache: Path) -> None:
    one_window = ["data.frames=[0, 2]", "data.crop=null", "stages.all.steps=12", "stages.all.batch=1"]
    config = settings(tmp_path, cache, *one_window)
    config = dataclasses.replace(config, stages=config.stages[:1])
    made = train(config, network=network())
    rows = [json.loads(line) for line in (config.out / LOG).read_text().splitlines()]
    assert [row["step"] for row in rows] == list(range(1, 13))
    losses = [row["loss"] for row in rows]
    assert losses == sorted(losses, reverse=True) and losses[-1] < 0.97 * losses[0]
    loaded = VoxelFlowNetwork.load(config.out / WEIGHTS)
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in made.state_dict().items())


def test_a_resumed_run_comes_to_the_same_weights(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed in step 5, after the state of step 3; and again in the first step of the second stage."""
    whole = settings(tmp_path, cache)
    wanted = train(whole, network=network()).state_dict()
    broken, original, calls = dataclasses.replace(whole, out=tmp_path / "broken"), peer.loss_of, list[int]()

    def dies(*arguments: Any) -> Any:
        calls.append(len(calls))
        if len(calls) in (5, 8):
            raise KeyboardInterrupt
        return original(*arguments)

    monkeypatch.setattr(peer, "loss_of", dies)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            train(broken, resume=True, network=network())
    made = train(broken, resume=True, network=network()).state_dict()
    assert all(torch.equal(value, made[name]) for name, value in wanted.items())
    with pytest.raises(ValueError, match="has a run already: --resume resumes it"):
        train(broken)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("stages.all.step=3", "`stages.0.step` is not a key; did you mean `stages.0.steps`"),
        ("data.right=0.5", r"`data.right` must be 0"),
        ("data.crop=[24, 64]", r"`crop` must be multiples of 16 px, got \[24, 64\]"),
        ("stages.all.crop=[32, 40]", r"`crop` must be multiples of 16 px"),
        ("run.precision=bfloat16", "`run.precision` must be float32"),
        ("stages=[]", "`stages` must be one or more"),
        ("model=vest-s", "`model` is not a key"),
    ],
)
def test_settings_that_cannot_be(override: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        settings(tmp_path, tmp_path, override)


def test_the_command_reports_mistakes_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings(tmp_path, tmp_path / "nowhere")
    assert peer.main([str(tmp_path / "peer.yaml")]) == 1
    err = capsys.readouterr().err
    assert err.startswith("error: ") and err.count("\n") == 1
    assert not (tmp_path / "run" / STATE).exists()


def test_the_shipped_configuration_is_complete() -> None:
    path = Path(__file__).resolve().parents[2] / "train" / "configs" / "peer" / "dmvfn_street.yaml"
    with pytest.raises(ValueError, match="`weights` must be set"):
        load_config(path)
    config = load_config(path, ["loss.perceptual.weights=squeezenet.npz"])
    assert [stage.name for stage in config.stages] == ["all", "large"]

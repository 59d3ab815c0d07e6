"""Checkpoints: the same bits back, nothing lost to a kill, a full disk or a torn file."""

import dataclasses
import errno
import json
import os
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from checkpoint_states import configured, state_of, steps
from forecaster_scenes import TINY, camera, pair_of

from train.run import checkpoint, hashes
from train.run.checkpoint import (
    CheckpointError,
    TrainingState,
    list_checkpoints,
    load_latest,
    restore_rng,
    rng_state,
    save,
)
from train.settings.config import from_dict
from vestcl.models.forecaster import Forecaster


def test_the_same_state_comes_back(tmp_path: Path) -> None:
    state = state_of(7, extra={"best": [1, 2.5, "x", None, (3, torch.ones(2))]})
    path = save(tmp_path, state)
    assert path == tmp_path / "checkpoints" / "step-00000007"
    loaded = load_latest(tmp_path)
    assert loaded is not None and loaded.ema is not None
    for name in ("step", "config", "model_config", "scheduler", "versions"):
        assert getattr(loaded, name) == getattr(state, name)
    for name, tensor in state.model.items():
        assert loaded.model[name].equal(tensor) and loaded.ema[name].equal(tensor / 2)
    assert loaded.optimiser["state"][0]["exp_avg"].equal(state.optimiser["state"][0]["exp_avg"])
    assert loaded.extra["best"][:4] == [1, 2.5, "x", None] and loaded.extra["best"][4][1].equal(torch.ones(2))
    assert loaded.versions["torch"] == torch.__version__
    assert from_dict(loaded.config) == configured()


def test_none_yet(tmp_path: Path) -> None:
    assert load_latest(tmp_path / "nowhere") is None and list_checkpoints(tmp_path) == []


def test_without_a_running_mean(tmp_path: Path) -> None:
    path = save(tmp_path, dataclasses.replace(state_of(1), ema=None))
    loaded = load_latest(tmp_path)
    assert loaded is not None and loaded.ema is None and not (path / "ema.safetensors").exists()


def test_the_models_files_are_models(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = Forecaster(TINY).eval()
    weights = model.state_dict()
    halved = {name: tensor / 2 for name, tensor in weights.items()}
    path = save(tmp_path, dataclasses.replace(state_of(1), model=weights, ema=halved))
    loaded = Forecaster.load(path / "ema.safetensors")
    assert all(loaded.state_dict()[name].equal(tensor) for name, tensor in halved.items())
    frames = (*pair_of(1, 24, 32), camera(1, 24, 32))
    with torch.no_grad():
        again = Forecaster.load(path / "model.safetensors")(*frames).views[0].image
        assert again.equal(model(*frames).views[0].image)


def test_adam_continues_to_the_same_bits(tmp_path: Path) -> None:
    """Two steps, a checkpoint, two steps: as four without one, dropout's generator included."""

    def build() -> tuple[Any, Any, Any]:
        torch.manual_seed(0)
        net = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Dropout(0.5), torch.nn.Linear(8, 1))
        adam = torch.optim.Adam(net.parameters(), 0.1)
        return net, adam, torch.optim.lr_scheduler.CosineAnnealingLR(adam, 4)

    def train(net: Any, adam: Any, cosine: Any, count: int) -> None:
        for _ in range(count):
            adam.zero_grad()
            noise = random.random() + np.random.rand()  # noqa: NPY002 - the global generator is what is tested
            (net(torch.rand(3, 4) + noise).square().mean()).backward()
            adam.step()
            cosine.step()

    straight = build()
    train(*straight, 2)
    rest = {"optimiser": straight[1].state_dict(), "scheduler": straight[2].state_dict()}
    save(tmp_path, TrainingState(2, {}, TINY, straight[0].state_dict(), None, **rest))
    train(*straight, 2)
    loaded, resumed = load_latest(tmp_path), build()
    assert loaded is not None
    for part, state in zip(resumed, (loaded.model, loaded.optimiser, loaded.scheduler), strict=True):
        part.load_state_dict(state)
    restore_rng(loaded.rng)
    train(*resumed, 2)
    pairs = zip(straight[0].state_dict().values(), resumed[0].state_dict().values(), strict=True)
    assert all(first.equal(second) for first, second in pairs)


def test_generators_come_back() -> None:
    np.random.standard_normal()  # noqa: NPY002 - leaves a second number waiting in the generator
    state = rng_state()

    def draw() -> tuple[Any, ...]:
        return torch.rand(1).item(), np.random.standard_normal(), np.random.rand(), random.random()  # noqa: NPY002

    first = draw()
    assert first != draw()
    restore_rng(state)
    assert draw() == first


def test_old_ones_are_removed(tmp_path: Path) -> None:
    for step in (1, 2, 3, 4):
        save(tmp_path, state_of(step), keep=2)
    assert steps(tmp_path) == [4, 3]
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == ["step-00000003", "step-00000004"]
    with pytest.raises(ValueError, match="`keep` must be 2 or more, got 1"):
        save(tmp_path, state_of(5), keep=1)


def test_damaged_ones_do_not_count_as_kept(tmp_path: Path) -> None:
    for step in (1, 2):
        save(tmp_path, state_of(step), keep=2)
    tear(tmp_path, 2)
    save(tmp_path, state_of(3), keep=2)
    assert steps(tmp_path) == [3, 2, 1]
    save(tmp_path, state_of(4), keep=2)
    assert steps(tmp_path) == [4, 3]


def test_a_save_reads_only_what_is_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kept checkpoints are hashed when they are written, and never again by this process unless they have changed."""
    read: list[str] = []

    def counting(path: Path) -> str:
        read.append(path.name)
        return hashes_sha256(path)

    hashes_sha256 = hashes.sha256
    monkeypatch.setattr(hashes, "sha256", counting)
    for step in range(1, 6):
        save(tmp_path, state_of(step), keep=3)
        assert sorted(read) == ["ema.safetensors", "model.safetensors", "state.pt"]
        read.clear()
    assert steps(tmp_path) == [5, 4, 3]


def test_a_changed_one_does_not_count_as_kept(tmp_path: Path) -> None:
    """Of the same size, with another byte."""
    for step in (1, 2):
        path = save(tmp_path, state_of(step), keep=2)
    content = bytearray((path / "state.pt").read_bytes())
    content[100] ^= 1
    (path / "state.pt").write_bytes(content)
    save(tmp_path, state_of(3), keep=2)
    assert steps(tmp_path) == [3, 2, 1]


@pytest.mark.parametrize("failing", ["rmtree", "rename", "iterdir"])
def test_an_old_one_that_cannot_be_removed_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    for step in (1, 2):
        save(tmp_path, state_of(step), keep=2)
    rename, iterdir, calls = Path.rename, Path.iterdir, [0]

    def refuse(path: Path, *arguments: Any, **_: Any) -> Any:
        old = str(path).endswith("step-00000001") or ".step-00000001" in str(path)
        calls[0] += failing == "iterdir" and path.name == "checkpoints"
        if (failing in ("rmtree", "rename") and old) or (failing == "iterdir" and calls[0] == 1):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return rename(path, *arguments) if failing == "rename" else iterdir(path)

    with monkeypatch.context() as patch:
        patch.setattr(shutil if failing == "rmtree" else Path, failing, refuse)
        with pytest.warns(UserWarning, match="old checkpoints? .*can't be removed: Permission denied"):
            save(tmp_path, state_of(3), keep=2)
    assert steps(tmp_path)[:2] == [3, 2]
    save(tmp_path, state_of(4), keep=2)
    assert [path.name for path in sorted((tmp_path / "checkpoints").iterdir())] == ["step-00000003", "step-00000004"]


def test_a_step_is_written_once(tmp_path: Path) -> None:
    path = save(tmp_path, state_of(1))
    before = (path / "state.pt").stat().st_mtime_ns
    save(tmp_path, state_of(1))
    assert (path / "state.pt").stat().st_mtime_ns == before
    with pytest.raises(CheckpointError, match="other weights"):
        save(tmp_path, state_of(1, seed=1))
    tear(tmp_path, 1)
    save(tmp_path, state_of(1, seed=1))
    loaded = load_latest(tmp_path)
    assert loaded is not None and loaded.model["a.weight"].equal(state_of(1, seed=1).model["a.weight"])


def tear(out: Path, step: int, name: str = "state.pt") -> Path:
    """Cut the file's second half off."""
    file = out / "checkpoints" / f"step-{step:08d}" / name
    os.truncate(file, file.stat().st_size // 2)
    return file


@pytest.mark.parametrize("name", ["state.pt", "model.safetensors", "ema.safetensors", "manifest.json"])
@pytest.mark.parametrize("damage", ["torn", "empty", "absent", "flipped", "other"])
def test_a_damaged_one_is_reported_and_the_one_before_it_used(tmp_path: Path, name: str, damage: str) -> None:
    for step in (1, 2):
        save(tmp_path, state_of(step))
    file = tmp_path / "checkpoints" / "step-00000002" / name
    if damage == "torn":
        tear(tmp_path, 2, name)
    elif damage == "absent":
        file.unlink()
    elif damage == "empty":
        file.write_bytes(b"")
    elif damage == "other":
        file.write_text('{"format": 1, "files": []}')
    else:
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 0x10
        file.write_bytes(content)
    with pytest.warns(UserWarning, match=r"damaged checkpoint, the one before it is used: .*step-00000002: ."):
        loaded = load_latest(tmp_path)
    assert loaded is not None and loaded.step == 1


def test_a_later_format_is_not_guessed_at(tmp_path: Path) -> None:
    for step in (1, 2):
        path = save(tmp_path, state_of(step))
    manifest = json.loads((path / "manifest.json").read_text())
    (path / "manifest.json").write_text(json.dumps({**manifest, "format": 99}))
    with pytest.warns(UserWarning, match="must be of format 1"):
        assert load_latest(tmp_path) is not None


def test_all_damaged_is_an_error_and_no_new_beginning(tmp_path: Path) -> None:
    for step in (1, 2):
        save(tmp_path, state_of(step))
        tear(tmp_path, step)
    both = r"(?s)step-00000002.*bytes.*step-00000001"
    with pytest.warns(UserWarning, match="damaged checkpoint"), pytest.raises(CheckpointError, match=both):
        load_latest(tmp_path)


def test_objects_are_refused_when_saving_and_not_when_loading(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"`state` must hold plain containers.*PosixPath"):
        save(tmp_path, state_of(1, extra={"path": Path("x")}))
    assert list_checkpoints(tmp_path) == []


@pytest.mark.parametrize("failing", ["write_checkpoint", "_flush", "_publish"])
def test_a_full_disk_is_reported_and_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    save(tmp_path, state_of(1), keep=2)

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, failing, fail)
        with pytest.raises(
            CheckpointError, match=r"step-00000002 could not be .*No space left .*it takes \d"
        ) as caught:
            save(tmp_path, state_of(2), keep=2)
    assert isinstance(caught.value.__cause__, OSError)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["step-00000001"]
    save(tmp_path, state_of(2), keep=2)
    loaded = load_latest(tmp_path)
    assert loaded is not None and loaded.step == 2


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(CheckpointError, match="could not be written"):
        save(tmp_path / "file", state_of(1))

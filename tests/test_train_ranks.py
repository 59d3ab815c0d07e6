"""train.ranks: processes that share a batch come to one process's weights, and go on after one of them is lost."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from train_scenes import MODELS, MOMENT, ROOT, configured, steps, street, weights, write_yaml

from train import fit
from train.ranks import Ranks
from train.report import LOG, read_log
from train.trainer import build_model
from vestcl import runtime
from vestcl.models import config

#: Two processes' weights beside one's, relative to how far training has moved them: Adam divides a gradient by its own
#: size, so that rounding counts most where there is next to no gradient.
TOLERANCE = 0.02


@dataclass(frozen=True)
class Info:
    index: str
    kind: str


def test_alone_nothing_is_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "TORCHELASTIC_RESTART_COUNT"):
        monkeypatch.delenv(name, raising=False)
    ranks = Ranks.join()
    assert ranks == Ranks() and ranks.first and not ranks.restarted
    assert ranks.any(True) and not ranks.any(False)
    assert ranks.mean({"loss": 2.0}) == {"loss": 2.0}
    ranks.leave()


def test_a_restart_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    for count, restarted in (("0", False), ("2", True)):
        monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", count)
        assert Ranks().restarted == restarted


@pytest.mark.parametrize(
    ("devices", "wanted"),
    [
        ([("0:0", "CPU")], [None, None, None]),
        ([("0:0", "CPU"), ("1:0", "CPU")], [None, None, None]),
        ([("0:0", "GPU"), ("1:0", "CPU"), ("0:1", "GPU")], ["0:0", "0:1", "0:0"]),
    ],
)
def test_devices_are_dealt_in_turn(
    devices: list[tuple[str, str]], wanted: list[str | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the processes of one machine, wherever they rank among all; CPUs are shared."""
    infos = [Info(*each) for each in devices]
    monkeypatch.setattr(runtime, "devices", lambda: infos)
    monkeypatch.setattr(runtime, "select", lambda: infos[0])
    assert [Ranks(rank=4 + local, world=8, local=local).device() for local in range(3)] == wanted


def test_two_processes_reach_the_weights_of_one(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although the second one is lost after step 5: both are started again, and go on from step 4."""
    monkeypatch.setattr(config, "CONFIGS", MODELS)
    cache, one, two = street(tmp_path_factory), tmp_path / "one", tmp_path / "two"
    settings = configured(cache, one, run={"threads": None})
    assert fit.fit(settings)
    file = write_yaml(tmp_path / "run.yaml", cache, two)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2",
               "--max-restarts", "1", str(ROOT / "tests" / "train_scenes.py"), str(file)]  # fmt: skip
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    environment = {**os.environ, "PYTHONPATH": paths, MOMENT: "SIGKILL update 5 1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "from step 4 to step 8, 2 processes" in done.stdout + done.stderr

    start = torch.cat([parameter.detach().flatten() for parameter in build_model(settings).parameters()])
    for name in ("model", "ema"):
        alone, shared = (torch.cat([value.flatten() for value in weights(out, name).values()]) for out in (one, two))
        assert (shared - alone).norm() < TOLERANCE * (alone - start).norm(), name
    assert steps(two) == steps(one) == [8, 6, 4, 2]
    rows = read_log(one / LOG), read_log(two / LOG)
    assert [row["step"] for row in rows[1]] == list(range(1, 9))  # the first process alone writes
    assert len(list((two / "tensorboard").iterdir())) == 2  # once a start
    for name in ("loss", "l1", "translation", "gradient"):
        assert rows[1][0][name] == pytest.approx(rows[0][0][name], rel=1e-4), name

"""train.run.ranks: processes that share a batch reach one process's weights, and resume after a lost process."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
import two_hosts
from processes import Process, torchrun
from torch import distributed
from train_scenes import MODELS, MOMENT, configured, steps, street, weights, write_yaml

from train import fit
from train.fit import TrainingError
from train.run.ranks import LostProcessError, Ranks, lost_processes_named
from train.run.report import LOG, read_log
from train.run.trainer import build_model
from vestcl import opencl
from vestcl.models import config

#: Two processes' weights against one's, relative to how far training has moved them. 6e-8 were measured, for the halves
#: of a batch of two add up identically; elsewhere rounding may count for more, as Adam divides gradients by their own
#: size.
TOLERANCE = 1e-3


@dataclass(frozen=True)
class Info:
    index: str
    kind: str


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of a single process."""
    folder = tmp_path_factory.mktemp("one")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "CONFIGS", MODELS)
        assert fit.fit(configured(street(tmp_path_factory), folder, run={"threads": None}))
    return folder


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of two processes' run."""
    out = tmp_path_factory.mktemp("two") / "out"
    reported = run_both(street(tmp_path_factory), out)
    assert "to step 8, 2 processes" in reported and "from step" not in reported
    return out


def run_both(cache: Path, out: Path, moment: str = "") -> str:
    """Two processes under torchrun, which starts them once more after a signal at ``moment``; what they print."""
    file, log = write_yaml(out.parent / "run.yaml", cache, out), out.parent / "output.txt"
    options = [
        "--nproc-per-node",
        "2",
        "--max-restarts",
        "1",
        "--rdzv-backend",
        "c10d",
        "--rdzv-endpoint",
        "localhost:0",
    ]
    process = Process(log, torchrun, options, two_hosts.training(file), environment={MOMENT: moment})
    assert process.wait() == 0, process.output
    return process.output


def test_a_single_process_shares_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "TORCHELASTIC_RESTART_COUNT"):
        monkeypatch.delenv(name, raising=False)
    ranks = Ranks.join()
    assert ranks == Ranks() and ranks.first and not ranks.restarted
    assert ranks.any(True) and not ranks.any(False)
    assert ranks.mean({"loss": 2.0}) == {"loss": 2.0}
    ranks.leave()


@pytest.mark.parametrize(
    "raised",
    [
        RuntimeError("[../third_party/gloo/gloo/transport/tcp/pair.cc:547] Connection closed by peer [::1]:9\nframes"),
        distributed.DistNetworkError("The client socket has failed to connect\nException raised from ..."),
    ],
)
def test_a_lost_process_is_a_line(raised: RuntimeError) -> None:
    line = r"^another process of this run can't be reached or has ended \([^\n]*\)$"
    with pytest.raises(LostProcessError, match=line), lost_processes_named():
        raise raised


def test_other_errors_stay_what_they_are() -> None:
    for raised in (RuntimeError("shapes differ"), TrainingError("timed out"), ValueError("gloo")):
        with pytest.raises(type(raised)) as caught, lost_processes_named():
            raise raised
        assert caught.value is raised


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
    monkeypatch.setattr(opencl, "devices", lambda: infos)
    monkeypatch.setattr(opencl, "select", lambda: infos[0])
    assert [Ranks(rank=4 + local, world=8, local=local).device() for local in range(3)] == wanted


def flat(weights: Mapping[str, torch.Tensor]) -> torch.Tensor:
    return torch.cat([value.flatten() for value in weights.values()])


def test_two_processes_reach_the_weights_of_one(one: Path, two: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "CONFIGS", MODELS)
    start = flat(build_model(configured(one, one)).state_dict())
    for name in ("model", "ema"):
        single, shared = (flat(weights(out, name)) for out in (one, two))
        assert (shared - single).norm() < TOLERANCE * (single - start).norm(), name
    assert steps(two) == steps(one) == [8, 6, 4, 2]
    rows = read_log(one / LOG), read_log(two / LOG)
    assert [row["step"] for row in rows[1]] == list(range(1, 9))  # only the first process writes
    for name in ("loss", "l1", "translation", "gradient"):
        assert rows[1][0][name] == pytest.approx(rows[0][0][name], rel=1e-4), name


def test_started_again_they_reach_the_same_weights(
    two: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The second one is lost after step 5: both resume from step 4, and to the same bits as if nothing had happened."""
    out = tmp_path / "out"
    reported = run_both(street(tmp_path_factory), out, "SIGKILL update 5 1")
    assert "from step 4 to step 8, 2 processes" in reported
    for name in ("model", "ema"):
        assert torch.equal(flat(weights(out, name)), flat(weights(two, name))), name
    assert [row["step"] for row in read_log(out / LOG)] == list(range(1, 9))
    assert len(list((out / "tensorboard").iterdir())) == 2  # once a start


def test_two_hosts_of_which_one_is_lost_reach_the_same_weights(
    two: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Both processes of a host that is started again count its starts from 0, and resume all the same."""
    try:
        with two_hosts.Hosts() as hosts:
            reported = two_hosts.train_on_both(hosts, street(tmp_path_factory), tmp_path, lost=True)
    except two_hosts.NotAllowedError as error:
        pytest.skip(f"two hosts can't be made here: {error}")
    assert "error: another process of this run can't be reached or has ended (" in reported
    assert "from step 4 to step 8, 2 processes" in reported
    assert two_hosts.distance(tmp_path / "out", two) <= two_hosts.SAME
    assert [row["step"] for row in read_log(tmp_path / "out" / LOG)] == list(range(1, 9))

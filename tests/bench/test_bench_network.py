"""`vestcl bench network`: that it runs, counts and writes what it should. No time is judged."""

from pathlib import Path
from typing import Any

import pytest

from vestcl.bench.common import results as _results
from vestcl.bench.common.timing import Spread, busy_cores
from vestcl.bench.network import bench as network
from vestcl.bench.network.bench import NetworkBench

TINY: dict[str, Any] = {"height": 32, "width": 64, "runs": 2}

STAGES = {"encode", "camera motion (EMF)", "object motion (OMF)", "lift", "displace and splat", "refine"}


def test_a_run_writes_and_prints_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setitem(
        network.TARGETS, ("vest-s+joint", 32, 64), {"forward": 1e9, "training step": 1e-9, "memory": 1e9}
    )
    path = tmp_path / "new folder" / "network.json"
    network.main(NetworkBench("vest-s+joint", **TINY, json=path, plots=tmp_path / "plots"))
    assert len(list((tmp_path / "plots").glob("*.png"))) == 2
    (result,), printed = _results.load(path), capsys.readouterr().out
    assert result.bench == "network" and result.config["model"] == "vest-s+joint" and result.config["height"] == 32
    medians = result.figures.set_index("name")["median"]
    of_training = {"all of forward", "backward", "Adam", "all OpenCL, both ways", "training step"}
    for title, names, whole in (
        ("forecast", STAGES | {"inpaint", "forward"}, "forward"),
        ("training, batch 1", STAGES | of_training, "training step"),
    ):
        own = {name.removeprefix(f"{title}: "): of for name, of in medians.items() if name.startswith(title)}
        assert set(own) == names | {"peak memory"} and 0.1 < own.pop("peak memory") < 1000
        assert all(0 < seconds <= own[whole] for name, seconds in own.items() if name != "inpaint")
    runs = result.figures[result.figures["unit"] == "s"]["runs"]
    assert (runs == 2).all()
    assert "32x64" in printed and "refine" in printed and "reached" in printed
    assert "missed" in printed or "can't tell" in printed


def test_without_training(tmp_path: Path) -> None:
    path = tmp_path / "network.json"
    network.main(NetworkBench(**TINY, training=False, json=path))
    (result,) = _results.load(path)
    assert result.frame["table"].unique() == ["vest-s, forecast, 32x64, 2 threads"]


@pytest.mark.parametrize(
    ("cores", "seconds", "verdict"),
    [(0.0, 1.0, "reached"), (0.0, 3.0, "missed"), (1e3, 3.0, "can't tell"), (1e3, 1.0, "reached")],
)
def test_a_busy_machine_proves_no_target_missed(cores: float, seconds: float, verdict: str) -> None:
    spread = Spread(seconds, seconds, seconds, 1)
    token = busy_cores.set(cores)
    found = network.section(NetworkBench(), "forecast", {"forward": spread})
    busy_cores.reset(token)
    assert found.grid().rows[0][2] == f"<= 2000 {verdict}"


@pytest.mark.parametrize("change", [{"height": 0}, {"runs": -1}, {"threads": 0}])
def test_refuses(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"`{next(iter(change))}` must be positive"):
        network.main(NetworkBench(**change))
    with pytest.raises(ValueError, match="`name` must begin with"):
        network.main(NetworkBench(model="vest-xl"))

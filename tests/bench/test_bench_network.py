"""`vestcl bench network`: that it runs, counts and writes what it should. No time is judged."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from vestcl.bench.common.timing import Spread
from vestcl.bench.network import bench as network
from vestcl.bench.network.bench import NetworkBench
from vestcl.constants import SKY_DEPTH
from vestcl.data.street.raycast import STREET_SKY_DEPTH as STREET_SKY

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
    network.main(NetworkBench("vest-s+joint", **TINY, json=path))
    results, printed = json.loads(path.read_text(encoding="utf-8")), capsys.readouterr().out
    assert {"vestcl", "torch", "device", "processor", "cores", "date"} <= set(results["machine"])
    assert results["config"]["model"] == "vest-s+joint" and results["config"]["height"] == 32
    forecast, training = results["parts"]
    names = [{timing["name"] for timing in part["timings"]} for part in (forecast, training)]
    of_training = {"all of forward", "backward", "Adam", network.OPENCL, "training step"}
    assert names == [STAGES | {"inpaint", "forward"}, STAGES | of_training]
    for part, whole in ((forecast, "forward"), (training, "training step")):
        assert part["timings"][-1]["name"] == whole
        wall = {timing["name"]: timing["wall"]["median"] for timing in part["timings"]}
        assert all(0 < seconds <= wall[whole] for name, seconds in wall.items() if name != "inpaint")
        assert all(timing["wall"]["runs"] == 2 and timing["cpu"]["median"] >= 0 for timing in part["timings"])
        assert 0.1 < part["peak_gigabytes"] < 1000
    assert "32x64" in printed and "refine" in printed and "reached" in printed
    assert "missed" in printed or "can't tell" in printed


def test_without_training(tmp_path: Path) -> None:
    path = tmp_path / "network.json"
    network.main(NetworkBench(**TINY, training=False, json=path))
    assert [part["title"] for part in json.loads(path.read_text(encoding="utf-8"))["parts"]] == ["vest-s, forecast"]


def test_layers_of_the_street() -> None:
    frames, _ = network.street_frames(32, 64, 3)
    frame = frames[0]
    layers = network.street_layers(frame)
    sky = torch.from_numpy(frame.depth >= STREET_SKY)
    assert sky.any() and (layers.depth[sky] == SKY_DEPTH).all()
    assert torch.equal(layers.depth[~sky], torch.from_numpy(frame.depth)[~sky])
    assert torch.equal(layers.image, torch.from_numpy(frame.colour))
    foreground = torch.from_numpy(np.isin(frame.labels, (5, 11, 13)))
    assert foreground.any() and torch.equal(layers.mask == 0, foreground)


@pytest.mark.parametrize(
    ("cores", "seconds", "verdict"),
    [(0.0, 1.0, "reached"), (0.0, 3.0, "missed"), (1e3, 3.0, "can't tell"), (1e3, 1.0, "reached")],
)
def test_a_busy_machine_proves_no_target_missed(
    capsys: pytest.CaptureFixture[str], cores: float, seconds: float, verdict: str
) -> None:
    spread = Spread(seconds, seconds, seconds, 1)
    timings = [{"name": "forward", "wall": spread, "cpu": spread}]
    part = {"title": "title", "timings": timings, "peak_gigabytes": 1.0, "others_cores": cores}
    network.show(NetworkBench(), Console(width=140), part)
    printed = " ".join(capsys.readouterr().out.split())
    assert f"<= 2000 {verdict}" in printed and ("measure again" in printed) == (cores > 1)


@pytest.mark.parametrize("change", [{"height": 0}, {"runs": -1}, {"threads": 0}])
def test_refuses(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"`{next(iter(change))}` must be positive"):
        network.main(NetworkBench(**change))
    with pytest.raises(ValueError, match="`name` must begin with"):
        network.main(NetworkBench(model="vest-xl"))

"""`vestcl bench train-step`: that it runs, splits a step into stages and tells what is frozen. No time is judged."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, stir
from PIL import Image

from vestcl.bench.common import results as _results
from vestcl.bench.network import train_step
from vestcl.bench.network.train_step import (
    ADAM,
    BACKWARD,
    EVERYTHING_LEARNS,
    FORWARD,
    FROZEN,
    OPENCL,
    Batch,
    Trainer,
    TrainStepBench,
    main,
    stacked,
)
from vestcl.bench.pipeline.traffic import LEAST_FRAMES, TRAFFIC, drive
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.stage_times import REST, STAGES

HEIGHT, WIDTH = 32, 64


def model() -> Forecaster:
    torch.manual_seed(0)
    return stir(Forecaster(SMALL)).train()


def batch() -> Batch:
    return stacked(drive(TRAFFIC, HEIGHT, WIDTH, LEAST_FRAMES, 1100).windows)


def test_windows_become_one_batch() -> None:
    windows = drive(TRAFFIC, HEIGHT, WIDTH, LEAST_FRAMES, 1100).windows
    both, truth = stacked(windows)
    assert truth.shape == (2, 3, HEIGHT, WIDTH) and both.K.shape == (2, 3, 3)
    for index, window in enumerate(windows):
        for one, other in zip(window.given.frame_cur, both.frame_cur, strict=True):
            assert torch.equal(one[0], other[index])
        for part in (0, 1):
            assert torch.equal(window.given.prior.cur_from_prev[part][0], both.prior.cur_from_prev[part][index])
        assert torch.equal(window.given.prior.velocity_cur[0], both.prior.velocity_cur[index])


@pytest.mark.parametrize("variant", FROZEN)
def test_a_step_moves_what_learns_alone(variant: str) -> None:
    network = model()
    trainer = Trainer(network, FROZEN[variant], batch())
    trainer.step()
    moved = {
        name.partition(".")[0]
        for (name, one), other in zip(trainer.model.named_parameters(), network.parameters(), strict=True)
        if not torch.equal(one, other)
    }
    assert moved == {"encoder", "ego_motion", "object_motion", "refine"} - {*FROZEN[variant]}
    assert trainer.parameters == sum(
        parameter.numel() for name, parameter in network.named_parameters() if name.partition(".")[0] in moved
    )
    (run,) = trainer.runs
    assert list(run["stages"]) == [*STAGES.values(), REST]
    assert sum(run["stages"].values()) == pytest.approx(run["parts"][FORWARD], rel=1e-6)
    assert all(run["stages"][stage] > 0 for stage in STAGES.values())
    assert 0 < run[OPENCL][OPENCL] < sum(run["parts"].values())


def test_a_run_writes_and_prints_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(train_step, "configuration", lambda name: SMALL)
    path = tmp_path / "new folder" / "train.json"
    main(
        TrainStepBench(
            height=HEIGHT,
            width=WIDTH,
            batch=2,
            seconds=0.01,
            threads=1,
            json=path,
            markdown=tmp_path / "train.md",
            plots=tmp_path / "plots",
            trace=tmp_path / "trace.json",
        )
    )
    (result,), printed = _results.load(path), capsys.readouterr().out
    figures, medians = result.figures.set_index("name"), result.figures.set_index("name")["median"]
    for variant in FROZEN:
        assert 0 < medians[f"{variant}: OpenCL"] < medians[variant]
        assert all(0 < medians[f"{variant}: {part}"] < medians[variant] for part in (FORWARD, BACKWARD, ADAM))
        assert medians[f"{variant}: {FORWARD}: refine"] > 0
    assert f"{EVERYTHING_LEARNS}: saved" not in medians and figures["unit"]["encoder frozen: saved"] == "1"
    texts = result.frame[result.frame["column"] == "parameters"]["text"]
    learning = [int(text.replace(",", "")) for text in texts]
    assert learning == sorted(learning, reverse=True) and len(set(learning)) == len(FROZEN)
    (plot,) = (tmp_path / "plots").iterdir()
    with Image.open(plot) as picture:
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 20
    events = json.loads((tmp_path / "trace.json").read_text(encoding="utf-8"))["traceEvents"]
    assert {FORWARD, BACKWARD, ADAM, "refine"} <= {event["name"] for event in events}
    for word in ("training step, vest-s, 32x64, batch 2", "encoder frozen", "stages of forward"):
        assert word in printed and word in (tmp_path / "train.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("change", [{"height": 0}, {"batch": -1}, {"threads": 0}, {"seconds": 0.0}])
def test_refuses(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"`{next(iter(change))}` must be positive"):
        main(TrainStepBench(**change))
    with pytest.raises(ValueError, match="`name` must begin with"):
        main(TrainStepBench(model="vest-xl"))

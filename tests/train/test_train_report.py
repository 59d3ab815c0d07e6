"""train.run.report: the log, TensorBoard's files and images, and what a resumed run makes of them."""

import errno
import json
import os
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from forecaster_scenes import camera, measured, pair_of
from rich.console import Console
from tensorboard.backend.event_processing import event_accumulator  # type: ignore[import-untyped]
from train_scenes import MODELS, configured

from train.data.windows import Batch
from train.run.report import LOG, Reporter, read_log, training_sheet
from train.run.trainer import Update
from train.settings.config import Config
from vestcl.models import config
from vestcl.models.forecaster import RenderedView

HEIGHT, WIDTH = 24, 64


@pytest.fixture(autouse=True)
def _models(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "CONFIGS", MODELS)


def settings(out: Path, **run: Any) -> Config:
    return configured(Path("cache"), out, run={"log_every": 2, "image_every": 3, **run})


def batch_of() -> Batch:
    prev, cur = pair_of(2, HEIGHT, WIDTH)
    K, eye = camera(2, HEIGHT, WIDTH), torch.eye(4).repeat(2, 1, 1)
    known = torch.tensor([True, True])
    prior = measured(2, HEIGHT, WIDTH)
    target, path = torch.rand(2, 3, HEIGHT, WIDTH), torch.eye(4).repeat(2, 3, 1, 1)
    return Batch(prev, cur, K, prior, 3, target, eye, K, eye, path, known, ("a/001", "b/002"))


def batch_of_nothing() -> Batch:
    """For updates without an image."""
    return cast(Batch, SimpleNamespace(horizon=1, clips=()))


def view_of(image: torch.Tensor) -> RenderedView:
    one, three = torch.ones(2, 1, HEIGHT, WIDTH), torch.ones(2, 3, HEIGHT, WIDTH)
    return RenderedView(image, three, one, one, one, three)


def update_of(loss: float, *, render: bool = True, skipped: bool = False) -> Update:
    terms = {"loss": loss, **({"l1": loss / 2} if render else {}), "gradient": 1.0}
    view = view_of(torch.rand(2, 3, HEIGHT, WIDTH)) if render else None
    return Update(terms, {"networks": 0.5, "splatting": 0.25}, view, skipped)


def report(out: Path, losses: list[float], begin: int = 0, **run: Any) -> str:
    """Updates with these losses after ``begin``; what was printed."""
    with (out.parent / "printed.txt").open("w+") as file:
        reporter = Reporter(settings(out, **run), begin, Console(file=file), True)
        with reporter.bar(begin):
            for step, loss in enumerate(losses, start=begin + 1):
                reporter.updated(step, "ego", 1e-3, update_of(loss), 0.125, batch_of())
        file.seek(0)
        return file.read()


def test_rows_are_means_since_the_last_row(tmp_path: Path) -> None:
    printed = report(tmp_path / "out", [1.0, 2.0, 3.0, 5.0])
    rows = read_log(tmp_path / "out" / LOG)
    assert [(row["step"], row["loss"], row["l1"]) for row in rows] == [(2, 1.5, 0.75), (4, 4.0, 2.0)]
    about = {"stage": "ego", "learning_rate": 1e-3, "horizon": 3, "gradient": 1.0}
    seconds = {"s_data": 0.125, "s_networks": 0.5, "s_splatting": 0.25}
    assert all(row.items() >= (about | seconds).items() for row in rows)
    assert "step 4/8  ego  loss 2.7500  l1 1.3750  0.12+0.50+0.25 s data+networks+splatting" in printed


def test_a_stage_that_renders_after_one_that_does_not(tmp_path: Path) -> None:
    """Its rows have more terms than those before it, and are means of its own updates."""
    reporter = Reporter(settings(tmp_path), 0, Console(quiet=True), True)
    with reporter.bar(0):
        for step, render in enumerate((False, False, False, True), start=1):
            reporter.updated(step, "ego", 1e-3, update_of(float(step), render=render), 0.1, batch_of())
    first, second = read_log(tmp_path / LOG)
    assert "l1" not in first and (second["loss"], second["l1"]) == (4.0, 2.0)
    assert [path.name for path in tmp_path.glob("images/*")] == []  # of step 3 there is none


def test_a_resumed_log_is_cut(tmp_path: Path) -> None:
    """Rows of updates that are made again, and a line that was half written, go."""
    out = tmp_path / "out"
    report(out, [1.0] * 6)
    with (out / LOG).open("a") as file:
        file.write('{"step": 7, "lo')
    assert [row["step"] for row in read_log(out / LOG)] == [2, 4, 6]
    report(out, [2.0] * 4, begin=4)
    assert [(row["step"], row["loss"]) for row in read_log(out / LOG)] == [(2, 1.0), (4, 1.0), (6, 2.0), (8, 2.0)]
    for line in (out / LOG).read_text().splitlines():
        json.loads(line)


def test_a_resumed_row_is_a_mean_over_all_its_updates(tmp_path: Path) -> None:
    """Also over those before the checkpoint, however many updates a row has."""
    first = Reporter(settings(tmp_path, log_every=60, image_every=0), 0, Console(quiet=True), True)
    with first.bar(0):
        for step in range(1, 58):
            first.updated(step, "ego", 1e-3, update_of(float(step)), 0.1, batch_of_nothing())
    second = Reporter(settings(tmp_path, log_every=60, image_every=0), 57, Console(quiet=True), True, first.recent)
    with second.bar(57):
        for step in range(58, 61):
            second.updated(step, "ego", 1e-3, update_of(float(step)), 0.1, batch_of_nothing())
    row = read_log(tmp_path / LOG)[-1]
    assert (row["step"], row["loss"]) == (60, pytest.approx(30.5))


@pytest.mark.parametrize(
    "line",
    [
        b"", b"\x00\x00", b"\xff\xfe", b"nothing", b"[1]", b"3", b'{"stage": "ego"}', b'{"step": "1", "stage": "ego"}',
        b'{"step": -1, "stage": "ego"}', b'{"step": 1}', b'{"step": 1, "stage": "ego", "loss": "low"}',
        b'{"step": true, "stage": "ego"}', b"[" * 100_000, b'{"step": 1, "stage": "ego", "loss": ' + b"9" * 5000 + b"}",
    ],
)  # fmt: skip
def test_a_line_that_is_no_row_is_named(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / LOG
    path.write_bytes(b'{"step": 1, "stage": "ego", "loss": null}\n' + line + b"\n")
    with pytest.raises(ValueError, match=r"log.jsonl: line 2 must be a row of train.fit, got b?'[^\n]{0,200}; remove"):
        read_log(path)


def test_no_number_is_null(tmp_path: Path) -> None:
    report(tmp_path, [1.0, float("nan"), 1.0, 3.0])
    assert [row["loss"] for row in read_log(tmp_path / LOG)] == [None, 2.0]


def test_scalars_and_images_appear(tmp_path: Path) -> None:
    """TensorBoard reads what was written; a resumed run's steps replace those that are made again."""
    report(tmp_path, [1.0] * 6)
    time.sleep(1.1)  # TensorBoard orders files by the second that they were begun in
    report(tmp_path, [2.0] * 4, begin=4)
    events = event_accumulator.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    scalars = [(event.step, event.value) for event in events.Scalars("training/loss")]
    assert scalars == [(2, 1.0), (4, 1.0), (6, 2.0), (8, 2.0)]
    assert set(events.Tags()["scalars"]) >= {"training/l1", "training/learning_rate", "seconds/data"}
    assert [image.step for image in events.Images("forecast")] == [3, 6]
    assert sorted(path.name for path in (tmp_path / "images").iterdir()) == ["step-00000003.png", "step-00000006.png"]


def test_only_the_first_process_writes(tmp_path: Path) -> None:
    reporter = Reporter(settings(tmp_path / "out"), 0, Console(), False)
    with reporter.bar(0):
        reporter.updated(2, "ego", 1e-3, update_of(1.0), 0.1, batch_of())
        reporter.say("nothing")
    assert not (tmp_path / "out").exists()


def test_a_full_disk_costs_curves_and_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("train.run.report.write_pixels", full)
    printed = report(tmp_path / "out", [1.0] * 8)
    assert printed.count("can't be written") == 1 and "No space left" in printed
    assert [row["step"] for row in read_log(tmp_path / "out" / LOG)] == [2, 4, 6, 8]


def test_a_training_sheet_shows_all_four(tmp_path: Path) -> None:
    """t and truth above, forecast and error below: flat colours are found again in each quarter."""
    batch, colours = batch_of(), {"t": 0.2, "truth": 0.8, "forecast": 0.5}
    batch.frame_cur.image.fill_(colours["t"])
    batch.target.fill_(colours["truth"])
    contact_sheet = training_sheet(batch, view_of(torch.full((2, 3, HEIGHT, WIDTH), colours["forecast"])), "step 1")
    assert contact_sheet.dtype == np.uint8 and contact_sheet.ndim == 3 and contact_sheet.shape[2] == 3
    middle = contact_sheet.shape[1] // 2
    halves = contact_sheet[:, :middle], contact_sheet[:, middle:]
    for half, names in ((halves[0], ("t", "forecast")), (halves[1], ("truth",))):
        for name in names:
            level = round(255 * colours[name])
            share = (np.abs(half.astype(int) - level).max(axis=2) <= 1).mean()
            assert share > 0.15, name

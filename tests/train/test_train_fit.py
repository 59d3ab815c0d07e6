"""train.fit: nothing is lost when a run is killed or asked to stop, and what breaks is reported."""

import dataclasses
import errno
import os
import shlex
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from train_scenes import MODELS, Processes, configured, steps, street, write_yaml

from train import export, fit
from train.evaluation.options import Evaluation, models_of
from train.fit import STOPPED, TrainingError
from train.run import checkpoint, losses, trainer
from train.run.checkpoint import CheckpointError
from train.run.report import LOG, Reporter, read_log
from train.settings.config import DataConfig
from vestcl.data import Street, street_clip
from vestcl.data.readers.splits import KITTI_VIEWS_TEST, KITTI_VIEWS_TRAIN
from vestcl.models import ObjectMotion, config
from vestcl.models.checkpoint import read_trained_on, write_checkpoint
from vestcl.models.forecaster import Forecaster
from vestcl.prepare.clip import prepare_clip

KILLED = -9

#: Moments at which one run is killed, one after the other, and its checkpoints then: before there is one, while the
#: last one of a stage is written, when that is written but nameless, between the stages, and in the middle of one.
KILLS: tuple[tuple[str, list[int]], ...] = (
    ("SIGKILL update 1", []),
    ("SIGKILL write 4", [2]),
    ("SIGKILL publish 4", [2]),
    ("SIGKILL prune 4", [4, 2]),
    ("SIGKILL update 7", [6, 4, 2]),
)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return street(tmp_path_factory)


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Processes:
    return Processes(tmp_path_factory.mktemp("processes"))


@pytest.fixture(scope="module")
def whole(cache: Path, processes: Processes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    status = processes.train(str(write_yaml(folder / "run.yaml", cache, folder / "out")))
    assert status == 0, processes.output
    return folder / "out"


@pytest.fixture
def models(monkeypatch: pytest.MonkeyPatch) -> None:
    """The small networks have names in this process."""
    monkeypatch.setattr(config, "CONFIGS", MODELS)


def run(cache: Path, out: Path, *, go_on: bool = False, **changes: Any) -> bool:
    """In this process, whose threads are left as they are."""
    asked = {"threads": None, **changes.pop("run", {})}
    return fit.fit(configured(cache, out, run=asked, **changes), go_on=go_on)


# ---------------------------------------------------------------- killed, stopped, resumed


def test_killed_at_any_moment_it_comes_to_the_same_weights(
    cache: Path, processes: Processes, whole: Path, tmp_path: Path
) -> None:
    file, out = str(write_yaml(tmp_path / "run.yaml", cache, tmp_path / "out")), tmp_path / "out"
    for moment, left in KILLS:
        assert processes.train(file, "--resume", moment=moment) == KILLED, (moment, processes.output)
        assert steps(out) == left, moment
    assert processes.train(file, "--resume") == 0, processes.output
    assert_same_run(out, whole)


def test_asked_to_stop_it_saves_and_leaves(cache: Path, processes: Processes, whole: Path, tmp_path: Path) -> None:
    """Between checkpoints."""
    file, out = str(write_yaml(tmp_path / "run.yaml", cache, tmp_path / "out")), tmp_path / "out"
    assert processes.train(file, moment="SIGTERM update 5") == STOPPED == 143
    assert steps(out) == [5, 4, 2] and "stopped after step 5; --resume continues" in processes.output
    assert processes.train(file, "--resume") == 0
    assert "from step 5 to step 8" in processes.output
    assert_same_run(out, whole)


def test_ctrl_c_saves_and_leaves(cache: Path, processes: Processes, whole: Path, tmp_path: Path) -> None:
    file, out = str(write_yaml(tmp_path / "run.yaml", cache, tmp_path / "out")), tmp_path / "out"
    assert processes.train(file, moment="SIGINT update 5") == 130
    last = out / "checkpoints" / "step-00000005"
    assert f"stopped after step 5; the last checkpoint is {last}; --resume resumes\n" in processes.output
    assert processes.output.count("stopped") == 1 and "Traceback" not in processes.output
    assert processes.train(file, "--resume") == 0
    assert_same_run(out, whole)


def assert_same_run(out: Path, wanted: Path) -> None:
    """Weights, running mean, optimiser and schedule are the same bits, and so is every scalar but the seconds."""
    got, straight = checkpoint.load_latest(out), checkpoint.load_latest(wanted)
    assert got is not None and straight is not None and got.step == straight.step == 8
    for name in ("model", "ema", "optimiser", "scheduler", "extra"):
        assert_same(getattr(got, name), getattr(straight, name), name)
    rows, others = (
        [{key: value for key, value in row.items() if not key.startswith("s_")} for row in read_log(folder / LOG)]
        for folder in (out, wanted)
    )
    assert [row["step"] for row in rows] == list(range(1, 9))
    assert rows == others


def assert_same(got: Any, wanted: Any, where: str) -> None:
    if isinstance(wanted, Mapping):
        assert got.keys() == wanted.keys(), where
        for key in wanted:
            assert_same(got[key], wanted[key], f"{where}.{key}")
    elif isinstance(wanted, torch.Tensor):
        assert torch.equal(got, wanted), where
    elif isinstance(wanted, list):
        for one, other in zip(got, wanted, strict=True):
            assert_same(one, other, where)
    else:
        assert got == wanted, where


def test_a_run_learns_in_each_stage_what_that_may(models: None, whole: Path) -> None:
    """Until step 4 object motion is as it was made; afterwards it moves, too."""
    states = {int(path.name[5:]): Forecaster.load(path / "model.safetensors") for path in
              checkpoint.list_checkpoints(whole)}  # fmt: skip
    before = dict(states[2].named_parameters())
    moved = {name.split(".")[0] for name, value in states[4].named_parameters() if not torch.equal(value, before[name])}
    assert moved == {"encoder", "ego_motion", "refine"}
    assert states[4].config.interval_s == 0.1  # the street's
    for step, still in ((4, True), (8, False)):
        objects = states[step].object_motion
        assert isinstance(objects, ObjectMotion)
        with torch.no_grad():
            assert objects.changes_nothing == still


def test_a_finished_run_is_finished(models: None, cache: Path, whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It ends with the loss, the checkpoint, and commands that take it."""
    before = checkpoint.load_latest(whole)
    assert run(cache, whole, go_on=True)
    loss = np.mean([row["loss"] for row in read_log(whole / LOG)])
    finished, saved, evaluated, forecast = capsys.readouterr().out.splitlines()[-4:]
    assert finished.startswith(f"finished: {whole}, step 8, loss ")
    assert float(finished.split()[-1]) == pytest.approx(loss, rel=1e-3)
    last = checkpoint.list_checkpoints(whole)[0]
    assert saved == f"checkpoint: {last}"
    command = shlex.split(evaluated.removeprefix("next: "))
    assert command[:4] == ["python", "-m", "train.evaluate", "street"]
    (path,) = models_of(Evaluation("street", model=(Path(command[-1]),))).values()
    assert path == last / "ema.safetensors"
    assert forecast.split()[:2] == ["vestcl", "forecast"] and str(last) in forecast
    after = checkpoint.load_latest(whole)
    assert before is not None and after is not None
    assert_same(after.model, before.model, "model")
    assert [row["step"] for row in read_log(whole / LOG)] == list(range(1, 9))


def test_a_run_is_not_begun_twice(models: None, cache: Path, whole: Path) -> None:
    with pytest.raises(ValueError, match=r"has a run already: --resume continues it, or take another folder"):
        run(cache, whole)
    with pytest.raises(ValueError, match="`seed` was 0, is 1"):
        run(cache, whole, go_on=True, seed=1)


def test_the_command_reports_what_is_wrong(
    models: None, cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_yaml(tmp_path / "run.yaml", tmp_path / "nothing", tmp_path / "out")
    for arguments, words in (
        ([str(file)], "nothing: has no prepared clip"),
        ([str(file), "stages.ego.stps=3"], "stps"),
        ([str(file), "seed=[[["], "'seed=[[[' must be YAML: line 1, column 4: "),
        ([str(tmp_path / "absent.yaml")], "absent.yaml"),
    ):
        assert fit.main(arguments) == 2
        printed = capsys.readouterr()
        assert printed.err.startswith("error: ") and words in printed.err and "error" not in printed.out
    assert not (tmp_path / "out" / "checkpoints").exists()


@pytest.mark.parametrize(
    ("environment", "words"),
    [
        ({"RANK": "abc"}, "RANK must be a whole number, 0 or more, as torchrun sets it, got 'abc'"),
        ({"RANK": "abc", "WORLD_SIZE": "2"}, "RANK must be a whole number"),
        ({"RANK": "-1", "WORLD_SIZE": "2"}, "RANK must be a whole number"),
        ({"RANK": "0", "WORLD_SIZE": "0"}, "WORLD_SIZE must be a whole number, 1 or more"),
        ({"RANK": "2", "WORLD_SIZE": "2"}, "RANK must be below WORLD_SIZE, 2, got 2"),
        ({"RANK": "0", "WORLD_SIZE": "1", "LOCAL_RANK": "first"}, "LOCAL_RANK must be a whole number"),
        ({"RANK": "0", "WORLD_SIZE": "1"}, "MASTER_ADDR must be set"),
        ({"RANK": "0", "WORLD_SIZE": "1", "MASTER_ADDR": "localhost"}, "MASTER_PORT must be set"),
        ({"RANK": "0", "WORLD_SIZE": "1", "MASTER_ADDR": "localhost", "MASTER_PORT": "99999"}, "MASTER_PORT must be"),
        ({"TORCHELASTIC_RESTART_COUNT": "x"}, "TORCHELASTIC_RESTART_COUNT must be a whole number"),
    ],
)
def test_a_wrong_environment_is_a_line(
    environment: dict[str, str], words: str, models: None, cache: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT", "TORCHELASTIC_RESTART_COUNT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert fit.main([str(write_yaml(tmp_path / "run.yaml", cache, tmp_path / "out"))]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {words}") and error.count("\n") == 1


@pytest.mark.parametrize(
    ("raised", "words"),
    [
        ("DataLoader worker (pid 17) is killed by signal: Killed. ", "a process that reads data was killed"),
        ("DataLoader worker (pid(s) 17) exited unexpectedly", "a process that reads data was killed"),
    ],
)
def test_a_lost_worker_is_a_line(
    raised: str, words: str, models: None, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def lost(*_: Any, **__: Any) -> None:
        raise RuntimeError(raised)

    monkeypatch.setattr(fit, "fit", lost)
    assert fit.main([str(write_yaml(tmp_path / "run.yaml", cache, tmp_path / "out"))]) == 2
    assert capsys.readouterr().err.startswith(f"error: {words}")


# ---------------------------------------------------------------- what it was trained on


def test_a_models_file_has_its_training_clips(models: None, whole: Path, tmp_path: Path) -> None:
    """The first and the last frame that windows showed, in every file and in what is exported."""
    newest = checkpoint.list_checkpoints(whole)[0]
    for name in ("model", "ema"):
        assert read_trained_on(newest / f"{name}.safetensors") == {"street 3": (0, 4)}
    assert export.main([str(newest), str(tmp_path / "half.safetensors")]) == 0
    assert read_trained_on(tmp_path / "half.safetensors") == {"street 3": (0, 4)}
    Forecaster(MODELS["small"]).save(tmp_path / "fresh.safetensors")
    assert read_trained_on(tmp_path / "fresh.safetensors") is None


def test_what_init_was_trained_on_counts(models: None, cache: Path, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model, init = Forecaster(MODELS["small"]), tmp_path / "init.safetensors"
    write_checkpoint(init, model.config, model.state_dict(), {"elsewhere": (3, 9), "street 3": (2, 8)})
    assert run(cache, tmp_path / "out", init=str(init), data={"frames": [1, 4]})
    newest = checkpoint.list_checkpoints(tmp_path / "out")[0]
    assert read_trained_on(newest / "model.safetensors") == {"elsewhere": (3, 9), "street 3": (1, 8)}


def test_files_with_both_records_are_the_same_bytes(tmp_path: Path) -> None:
    model, contents = Forecaster(MODELS["small"]), set()
    for _ in range(8):
        write_checkpoint(tmp_path / "a.safetensors", model.config, model.state_dict(), {"b": (0, 1), "a": (2, 3)})
        contents.add((tmp_path / "a.safetensors").read_bytes())
    assert len(contents) == 1
    assert Forecaster.load(tmp_path / "a.safetensors").config == model.config


def test_only_the_drives_of_a_split_are_shown(tmp_path: Path) -> None:
    """Of a folder that has a training drive and a test drive."""
    street = street_clip(Street.generate(3), 4, 48, 160, samples=1)
    for name in (KITTI_VIEWS_TRAIN[0], KITTI_VIEWS_TEST[0]):
        prepare_clip(dataclasses.replace(street, name=name), tmp_path / name)
    roots = (str(tmp_path),)
    for split, drives in (("kitti-views", KITTI_VIEWS_TRAIN[:1]), (None, (KITTI_VIEWS_TRAIN[0], KITTI_VIEWS_TEST[0]))):
        shown = fit.window_set(DataConfig(train=roots, split=split)).shown
        assert shown == dict.fromkeys(drives, (0, 3))
    with pytest.raises(ValueError, match="must have drives that kitti-views trains on, got none in"):
        fit.window_set(DataConfig(train=(str(tmp_path / KITTI_VIEWS_TEST[0]),), split="kitti-views"))


# ---------------------------------------------------------------- the log


def test_a_resumed_run_logs_the_rows_of_a_straight_one(
    models: None, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row is a mean over three updates, some of them before the checkpoint that the run is resumed from."""

    def rows(out: Path) -> list[dict[str, Any]]:
        return [{k: v for k, v in row.items() if not k.startswith("s_")} for row in read_log(out / LOG)]

    settings = {"log_every": 3, "checkpoint_every": 4}
    assert run(cache, tmp_path / "straight", run=settings)
    updated = Reporter.updated

    def dying(self: Reporter, step: int, *arguments: Any) -> None:
        updated(self, step, *arguments)
        if step == 5:
            raise InterruptedError

    monkeypatch.setattr(Reporter, "updated", dying)
    with pytest.raises(InterruptedError):
        run(cache, tmp_path / "resumed", run=settings)
    assert steps(tmp_path / "resumed") == [4]
    monkeypatch.setattr(Reporter, "updated", updated)
    assert run(cache, tmp_path / "resumed", run=settings, go_on=True)
    assert [row["step"] for row in rows(tmp_path / "straight")] == [3, 6, 8]
    assert rows(tmp_path / "resumed") == rows(tmp_path / "straight")


def test_a_damaged_log_is_a_line(models: None, cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_yaml(tmp_path / "run.yaml", cache, tmp_path / "out", run={"threads": None})
    assert fit.main([str(file)]) == 0
    log = tmp_path / "out" / LOG
    log.write_bytes(log.read_bytes().replace(b'{"step": 2,', b'\x00\xff{"step": 2,'))
    capsys.readouterr()
    assert fit.main([str(file), "--resume"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {log}: line 2 must be a row of train.fit, got ") and error.count("\n") == 1


def test_an_old_checkpoint_that_stays_ends_no_run(
    models: None, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def busy(path: Path, ignore_errors: bool = False) -> None:
        if not ignore_errors:
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))

    monkeypatch.setattr(checkpoint.shutil, "rmtree", busy)
    file = write_yaml(tmp_path / "run.yaml", cache, tmp_path / "out", run={"threads": None, "keep": 2})
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        assert fit.main([str(file)]) == 0
    assert steps(tmp_path / "out") == [8, 6]
    lines = [line for line in capsys.readouterr().err.splitlines() if line]
    assert lines and all(line.startswith("warning: old checkpoint ") for line in lines)
    assert "step-00000002 can't be removed: Device or resource busy" in lines[0]


# ---------------------------------------------------------------- no number


@pytest.fixture(params=["loss", "gradient"])
def broken(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, models: None) -> None:
    """The fourth update's loss, or a gradient of it, is not a number."""
    calls = [0]

    def total_loss(view: Any, *others: Any) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        calls[0] += 1
        total, terms = losses.total_loss(view, *others)
        if calls[0] == 4 and request.param == "loss":
            total = total * torch.nan
        if calls[0] == 4 and request.param == "gradient":
            view.image.register_hook(lambda grad: grad * torch.nan)
        return total, terms

    monkeypatch.setattr(trainer, "total_loss", total_loss)


def test_no_number_stops(broken: None, cache: Path, tmp_path: Path) -> None:
    """The step, what was shown, and where to resume."""
    settings = configured(cache, tmp_path)
    windows = fit.window_set(settings.data)
    shown = ", ".join(windows.label(draw) for draw in windows.global_batch(0, 3, 2))
    with pytest.raises(TrainingError) as error:
        run(cache, tmp_path)
    reported = str(error.value)
    assert reported.startswith("step 4: a loss or gradient is not a number (loss ") and "nan" in reported
    assert f"with {shown}; the last good checkpoint is {tmp_path / 'checkpoints' / 'step-00000002'}" in reported
    assert "`run.on_nan=skip`" in reported
    assert steps(tmp_path) == [2]


def test_no_number_is_left_out(broken: None, cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The weights and their mean stay for that step, and the run continues."""
    assert run(cache, tmp_path, run={"on_nan": "skip", "checkpoint_every": 1})
    assert "step 4: non-finite, skipped (" in capsys.readouterr().out
    for name in ("model", "ema"):
        kept = {int(path.name[5:]): Forecaster.load(path / f"{name}.safetensors").state_dict() for path in
                checkpoint.list_checkpoints(tmp_path)}  # fmt: skip
        assert_same(kept[4], kept[3], name)
        assert any(not torch.equal(kept[5][key], kept[4][key]) for key in kept[4])
        assert all(value.isfinite().all() for value in kept[8].values())
    rows = read_log(tmp_path / LOG)
    assert rows[3]["gradient"] is None and all(rows[i]["gradient"] is not None for i in (0, 2, 4, 7))


# ---------------------------------------------------------------- a full disk


def fill_disk(monkeypatch: pytest.MonkeyPatch, full: tuple[int, ...]) -> None:
    """Checkpoints of these steps find no disk space."""
    save, write, step = checkpoint.save, write_checkpoint, [0]

    def saving(out: Path | str, state: checkpoint.TrainingState, keep: int = 3) -> Path:
        step[0] = state.step
        return save(out, state, keep)

    def writing(*arguments: Any) -> None:
        if step[0] in full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(*arguments)

    monkeypatch.setattr(checkpoint, "save", saving)
    monkeypatch.setattr(checkpoint, "write_checkpoint", writing)


def test_a_full_disk_is_reported_and_training_continues(
    models: None, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fill_disk(monkeypatch, (2, 6))
    assert run(cache, tmp_path)
    assert steps(tmp_path) == [8, 4]
    printed = capsys.readouterr().out
    assert "step 2: checkpoint" in printed and "No space left" in printed and "step 6: checkpoint" in printed


def test_a_full_disk_at_the_end_is_an_error(
    models: None, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill_disk(monkeypatch, (8,))
    with pytest.raises(CheckpointError, match=r"step-00000008 could not be written: No space left"):
        run(cache, tmp_path)
    assert steps(tmp_path) == [6, 4, 2]
    monkeypatch.undo()
    monkeypatch.setattr(config, "CONFIGS", MODELS)
    assert run(cache, tmp_path, go_on=True) and steps(tmp_path)[0] == 8

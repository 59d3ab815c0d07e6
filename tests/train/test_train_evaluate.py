"""train.evaluate: whole runs on tiny streets and on a tiny tree of KITTI raw, what they keep, and what they report."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, TINY, stir
from kitti_trees import SIZE, drives
from st_lpips_weights import public_state

from train import evaluate
from train.evaluate import Evaluation, main
from train.evaluation import windows as evaluate_windows
from train.evaluation.inputs import PAIR
from train.evaluation.leaks import training_overlap
from train.evaluation.protocols import NOW, Source
from train.evaluation.windows import AS_SEEN, CAMERA, CONSTANT_VELOCITY, PART_WINDOWS
from vestcl.data import Street
from vestcl.data.readers.splits import (
    KITTI_PREDICTION_TEST,
    KITTI_PREDICTION_TRAIN,
    KITTI_VIEWS_TEST,
    KITTI_VIEWS_TRAIN,
)
from vestcl.evaluation.compare import FLOW, REPEAT
from vestcl.evaluation.scores import GEOMETRIC, ORACLE, OTHER_CAMERA
from vestcl.forecasting import peer
from vestcl.io import read_pixels
from vestcl.models.checkpoint import write_checkpoint
from vestcl.models.forecaster import Forecaster
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

STREETS: dict[str, Any] = {
    "protocol": "street", "height": SIZE[0], "width": SIZE[1], "steps": 2, "horizons": (1, 2), "samples": 1,
    "seeds": (3, 5),
}  # fmt: skip


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return model_file(tmp_path_factory.mktemp("model") / "tiny.safetensors", 0)


@pytest.fixture(scope="module")
def whole(model: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """An unbroken run, and its folder."""
    out = tmp_path_factory.mktemp("whole") / "new"
    return run(**STREETS, model=(model,), out=out), out


def model_file(path: Path, seed: int) -> Path:
    torch.manual_seed(seed)
    stir(Forecaster(TINY)).save(path)
    return path


def run(**settings: Any) -> dict[str, Any]:
    """results.json."""
    config = Evaluation(**settings)
    evaluate.evaluate(config)
    assert config.out is not None
    reported: dict[str, Any] = json.loads((config.out / "results.json").read_text(encoding="utf-8"))
    return reported


def scores(reported: dict[str, Any]) -> list[tuple[Any, ...]]:
    """All but the time it took."""
    rows = [(w["clip"], w["index"], w["view"], w["method"], w["scores"]) for w in reported["windows"]]
    return sorted(rows, key=lambda row: row[:4])


def test_a_run_measures_every_method(whole: tuple[dict[str, Any], Path]) -> None:
    reported, _ = whole
    methods = {REPEAT, FLOW, GEOMETRIC, "tiny"}
    assert set(reported["summary"]) == {"source", "right", CAMERA}
    assert set(reported["summary"]["source"]) == methods
    left = {REPEAT + OTHER_CAMERA, FLOW + OTHER_CAMERA}
    assert set(reported["summary"]["right"]) == {GEOMETRIC, "tiny", ORACLE} | left
    assert set(reported["summary"][CAMERA]) == {CONSTANT_VELOCITY, "tiny"}
    assert set(reported["clips"]) == {"street 3", "street 4", "street 5"}
    own = [w["scores"]["psnr"] for w in reported["windows"] if (w["view"], w["method"]) == ("source", GEOMETRIC)]
    found = reported["summary"]["source"][GEOMETRIC]
    np.testing.assert_allclose(found["by_horizon"]["psnr"], np.mean(own, axis=0))
    np.testing.assert_allclose(found["running_mean"]["psnr"], [np.mean(own, axis=0)[0], np.mean(own)])
    assert found["by_horizon"]["psnr"][0] > reported["summary"]["source"][REPEAT]["by_horizon"]["psnr"][0]
    interval = reported["intervals"]["source"][GEOMETRIC]["psnr"][0]
    assert interval["low"] < interval["mean"] < interval["high"]
    assert interval["mean"] == pytest.approx(found["by_horizon"]["psnr"][0])
    difference = reported["differences"]["source"]["tiny"]["psnr"][0]
    tiny = reported["summary"]["source"]["tiny"]["by_horizon"]["psnr"][0]
    assert difference["mean"] == pytest.approx(tiny - interval["mean"]) and difference["better"] == 0
    assert reported["models"]["tiny"]["sha256"] and {"device", "torch", "vestcl"} <= set(reported["machine"])
    assert "Depth is from the street itself, true, masks are from labels." in reported["notes"]
    assert reported["models"]["tiny"]["mode"] == "feedback"  # it starts from rest


def test_the_files_contain_the_same(whole: tuple[dict[str, Any], Path]) -> None:
    reported, out = whole
    with (out / "results.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(next(iter(w["scores"].values()))) for w in reported["windows"])
    for row in rows:
        (window,) = [w for w in reported["windows"] if all(w[k] == row[k] for k in ("clip", "view", "method"))]
        for name, values in window["scores"].items():
            value = values[int(row["horizon"]) - 1]
            assert float(row[name]) == value if value is not None else row[name] in ("nan", "inf")
    text = (out / "results.md").read_text(encoding="utf-8")
    best = reported["summary"]["source"]["tiny"]["by_horizon"]["psnr"]
    assert f"| tiny | {best[0]:.2f} | {best[1]:.2f} |" in text
    assert ", mode feedback" in text and text.count("Mode of later frames: tiny feedback.") >= 6
    assert "view source, model less geometric" in text and "view camera, model less constant velocity" in text
    assert "by clip" in text and "| street 4 | 1 |" in text and "LPIPS (--lpips), ST-LPIPS (--st-lpips)" in text
    sheets = [read_pixels(out / f"sheet_{word}.png") for word in ("best", "median", "worst")]
    assert {sheet.shape for sheet in sheets} == {sheets[0].shape}
    assert sheets[0].shape[0] > 2 * SIZE[0] and sheets[0].shape[1] > 5 * SIZE[1]  # two steps, five images each
    assert not np.array_equal(sheets[0], sheets[2])


def test_what_is_done_is_not_done_again(
    whole: tuple[dict[str, Any], Path], model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that dies in its second clip, and continues: the same scores, and the first clip is not looked at again."""
    original, seen = evaluate_windows.window, list[str]()

    def window(perception: Any, truth: Any, *arguments: Any) -> Any:
        seen.append(truth.clip.name)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return original(perception, truth, *arguments)

    monkeypatch.setattr(evaluate_windows, "window", window)
    settings = {**STREETS, "model": (model,), "out": tmp_path / "broken", "sheets": False}
    with pytest.raises(KeyboardInterrupt):
        run(**settings)
    assert not (tmp_path / "broken" / "results.json").exists()
    assert scores(run(**settings)) == scores(whole[0])
    assert seen == ["street 3", "street 4", "street 4", "street 5"]


def test_shares_come_together(
    whole: tuple[dict[str, Any], Path], model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {**STREETS, "model": (model,), "sheets": False}
    evaluate.evaluate(Evaluation(**settings, out=tmp_path / "shared", shard="1/2"))
    assert not (tmp_path / "shared" / "results.json").exists()
    with pytest.raises(ValueError, match="`merge` needs all of them: 1 of 3 parts"):
        run(**settings, out=tmp_path / "shared", merge=True)
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert scores(run(**settings, out=tmp_path / "shared")) == scores(whole[0])
    assert scores(run(**settings, out=tmp_path / "shared", merge=True)) == scores(whole[0])


def test_another_model_is_another_evaluation(tmp_path: Path) -> None:
    model = model_file(tmp_path / "tiny.safetensors", 1)
    settings = {**STREETS, "seeds": (3, 3), "out": tmp_path / "out", "sheets": False}
    before = run(**settings, model=(model,))
    model_file(model, 2)  # other weights by the same name
    after = run(**settings, model=(model,))
    assert before["models"]["tiny"]["sha256"] != after["models"]["tiny"]["sha256"]
    assert before["summary"]["source"]["tiny"] != after["summary"]["source"]["tiny"]
    assert len(list((tmp_path / "out" / "clips").iterdir())) == 2


def test_a_part_that_holds_something_else_is_reported(tmp_path: Path) -> None:
    settings = {**STREETS, "seeds": (3, 3), "out": tmp_path, "sheets": False}
    run(**settings)
    (kept,) = (tmp_path / "clips").iterdir()
    kept.write_text('{"records": [{}]}', encoding="utf-8")
    with pytest.raises(ValueError, match=r"holds no scores .* delete it"):
        run(**settings)


# ---------------------------------------------------------------- KITTI raw


def test_the_papers_protocol_on_kitti(tmp_path: Path, model: Path) -> None:
    data = drives(tmp_path / "kitti", KITTI_PREDICTION_TEST)
    settings = {"data": data, "height": SIZE[0], "width": SIZE[1], "steps": 3, "model": (model,), "sheets": False}
    reported = run(protocol="kitti-space-time", out=tmp_path / "out", **settings)
    assert set(reported["clips"]) == set(KITTI_PREDICTION_TEST) and set(reported["summary"]) == {"right"}
    assert reported["summary"]["right"]["tiny"]["windows"] == 4
    assert len(reported["summary"]["right"]["tiny"]["by_horizon"]["ssim"]) == 3
    of_right = {name: of["by_horizon"]["ssim"][0] for name, of in reported["summary"]["right"].items()}
    assert of_right[GEOMETRIC + PAIR] > max(of_right[GEOMETRIC], of_right[REPEAT + OTHER_CAMERA])
    assert of_right["tiny"] != of_right["tiny" + PAIR]
    assert set(reported["differences"]["right"]) == {"tiny", "tiny" + PAIR}
    text = (tmp_path / "out" / "results.md").read_text(encoding="utf-8")
    assert f"model less {GEOMETRIC}**" in text and f"model less {GEOMETRIC}{PAIR}**" in text
    paper = [row for row in reported["paper"] if (row["method"], row["metric"]) == ("the paper", "ms_ssim")]
    assert len(paper) == 1 and f"| {paper[0]['values']['1']:.3f} |" in text.replace(" | ", " | ")
    assert 'Depth is from motion and from the stereo pair at t-1 and t (rows ending in "stereo pair")' in text
    assert "MS-SSIM needs 176 pixels per side, got 48 x 160." in text
    assert "Not the published protocol: size (48, 160), steps 3." in text


def test_the_present_from_the_right(tmp_path: Path, model: Path) -> None:
    data = drives(tmp_path / "kitti", KITTI_VIEWS_TEST)
    settings = {"data": data, "height": SIZE[0], "width": SIZE[1], "steps": 3, "model": (model,), "sheets": False}
    reported = run(protocol="kitti-space", out=tmp_path / "out", **settings)
    present = reported["summary"][NOW]
    assert set(present) == {AS_SEEN, GEOMETRIC, "tiny"} and len(present[GEOMETRIC]["by_horizon"]["ssim"]) == 1
    assert present[GEOMETRIC]["by_horizon"]["psnr"][0] > present[AS_SEEN]["by_horizon"]["psnr"][0]
    assert "tiny" in reported["summary"]["source"]
    assert not any("Mode compose" in note for note in reported["notes"])
    text = (tmp_path / "out" / "results.md").read_text(encoding="utf-8")
    assert "view right at t" in text and "Depth is from motion, masks are from motion." in text
    assert "compute_scores.py): the outer 5 % of each side are black" in text
    assert "The file of tiny has no record of what it was trained on." in text


def test_the_answer_is_refused_as_an_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = drives(tmp_path / "kitti", KITTI_VIEWS_TEST, 2)
    assert main(["kitti-space", "--data", str(data), "--stereo", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: `--stereo` must not be used here") and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_training_on_what_is_evaluated_is_named(tmp_path: Path) -> None:
    """The list of video prediction trains on three of the four drives that novel views are tested on."""
    data, frames = drives(tmp_path / "kitti", KITTI_VIEWS_TEST), (0, 6)
    torch.manual_seed(0)
    model = stir(Forecaster(TINY))
    for name, shown in (
        ("prediction", dict.fromkeys(KITTI_PREDICTION_TRAIN, frames)),
        ("views", dict.fromkeys(KITTI_VIEWS_TRAIN, frames)),
    ):
        write_checkpoint(tmp_path / f"{name}.safetensors", model.config, model.state_dict(), shown)
    models = tuple(tmp_path / f"{name}.safetensors" for name in ("prediction", "views"))
    settings = {"data": data, "height": SIZE[0], "width": SIZE[1], "steps": 1, "model": models, "sheets": False}
    reported = run(protocol="kitti-space", out=tmp_path / "out", **settings)
    drive = "2011_09_26_drive_{}_sync".format
    line = f"prediction was trained on frames of 3 of these 4 clips: {', '.join(map(drive, ('0001', '0057', '0106')))}."
    assert line in reported["notes"] and not any("views was trained" in note for note in reported["notes"])
    text = (tmp_path / "out" / "results.md").read_text(encoding="utf-8")
    tables = [
        part
        for part in text.split("\n**")
        if part.startswith("KITTI") and not part.startswith(f"{reported['title']}, the paper")
    ]
    assert tables and all(line in table for table in tables)


def test_other_frames_of_a_clip_are_no_overlap(tmp_path: Path) -> None:
    model = stir(Forecaster(TINY))
    write_checkpoint(tmp_path / "a.safetensors", model.config, model.state_dict(), {"street 3": (0, 3), "x": (0, 9)})
    for index, overlaps in ((4, True), (5, False)):
        part = evaluate_windows.ShardPart(Source("street 3", Street.generate), (index,), tmp_path / "part")
        leaks, unknown = training_overlap([tmp_path / "a.safetensors"], [part], 2)
        assert bool(leaks) == overlaps and unknown == ()


def test_each_model_makes_later_frames_as_it_is_meant_to(tmp_path: Path) -> None:
    """A setting overrides that, and where it is not the paper's way, a caveat says so."""
    for name, kind in (("rest", TINY), ("prior", SMALL)):
        Forecaster(kind).save(tmp_path / f"{name}.safetensors")
    models = tuple(tmp_path / f"{name}.safetensors" for name in ("rest", "prior"))
    wanted = {None: ("feedback", "compose"), "compose": ("compose",) * 2, "feedback": ("feedback",) * 2}
    for mode, modes in wanted.items():
        config = Evaluation("kitti-prediction", model=models, mode=mode)  # type: ignore[arg-type]
        setup = evaluate.setup_of(config, evaluate.protocol_of(config))
        assert tuple(setup.modes.values()) == modes
        composed = [name for name, own in setup.modes.items() if own == "compose"]
        caveats = [note for note in evaluate._caveats(config, setup) if note.startswith("Mode compose")]
        assert len(caveats) == bool(composed) and all(", ".join(composed) in note for note in caveats)


# ---------------------------------------------------------------- the command line


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": 0}, "`steps` must be 1 or more"),
        ({"horizons": (3,)}, "`horizons` must be steps, 1 ... 2"),
        ({"seeds": (5, 4)}, "`seeds` must be from a lower to a higher"),
        ({"shard": "2/2"}, "`shard`"),
        ({"model": (Path("a/x.safetensors"), Path("b/x.safetensors"))}, "`model` must have files with different stems"),
        ({"protocol": "kitti-prediction"}, "`data` must be a folder"),
        ({"first": 9, "last": 3}, "must have 12 frames and a window"),
    ],
)
def test_what_cannot_be_is_reported(settings: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate.evaluate(Evaluation(**({**STREETS, "out": tmp_path} | settings)))


def test_the_command_line_reports_errors_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["street", "--model", str(tmp_path / "none.safetensors")]) == 2
    assert "error: no model at" in capsys.readouterr().err


def test_windows_of_long_clips_are_kept_in_parts(tmp_path: Path) -> None:
    steps = 1
    frames = PART_WINDOWS + 5 + steps
    config = Evaluation("street", seeds=(3, 3), steps=steps, first=1, last=frames - 1 - steps, out=tmp_path)
    protocol = evaluate.protocol_of(config)
    sources = protocol.sources(evaluate._where(config, protocol))
    parts = evaluate_windows.plan(sources, protocol, steps, 1, tmp_path, "key")
    assert [len(part.indices) for part in parts] == [PART_WINDOWS, frames - 1 - steps - PART_WINDOWS]
    assert [index for part in parts for index in part.indices] == list(range(1, frames - steps))


def test_st_lpips_and_the_peer_come_by_file(tmp_path: Path) -> None:
    torch.save(public_state(), tmp_path / "st.pth")
    VoxelFlowNetwork(blocks=[(4, 8), (1, 4)]).save(tmp_path / "flow.safetensors")
    settings = {**STREETS, "seeds": (3, 3), "steps": 1, "horizons": (1,), "sheets": False, "out": tmp_path / "out"}
    reported = run(**settings, st_lpips=tmp_path / "st.pth", peer=tmp_path / "flow.safetensors")
    assert set(reported["weights"]) == {"peer", "st_lpips"} and "peer" not in reported["settings"]
    assert set(reported["summary"]["source"]) == {REPEAT, FLOW, GEOMETRIC, peer.METHOD}
    assert peer.METHOD in reported["summary"]["right"] and peer.METHOD not in reported["summary"][CAMERA]
    assert all(method["by_horizon"]["st_lpips"][0] > 0 for method in reported["summary"]["source"].values())
    (note,) = [line for line in reported["notes"] if line.startswith(f"{peer.METHOD} (flow.safetensors): ")]
    assert note.endswith("with the geometric forecast's depth.")
    files = list((tmp_path / "out" / "clips").iterdir())
    run(**settings, peer=tmp_path / "flow.safetensors")
    assert len(list((tmp_path / "out" / "clips").iterdir())) == len(files) + 1, "other weights, another key"

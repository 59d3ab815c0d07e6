"""train.card.__main__: a card of a run that was made up, number by number."""

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from forecaster_scenes import TINY

from train.card import __main__ as card
from train.card import images as card_images
from train.card import tables as card_tables
from train.card.__main__ import Card, main, portable, thinned, write_card
from train.card.images import draw_curves, smoothed, stages_of, write_sheet
from train.evaluation.protocols import PROTOCOLS
from train.evaluation.report import EvaluationResults, as_json
from train.evaluation.windows import CAMERA, CONSTANT_VELOCITY
from train.run import checkpoint
from train.run.report import LOG
from train.settings.config import from_dict, load_config, to_dict
from vestcl.data import Street
from vestcl.evaluation.scores import GEOMETRIC, Record
from vestcl.io.images import read_pixels, write_pixels
from vestcl.models.forecaster import Forecaster
from vestcl.prepare.files import JSON, RECIPE

FRAMES, STEP = 6, 0.8
SETTINGS: dict[str, Any] = {
    "name": "small",
    "model": "vest-s",
    "data": {"crop": [24, 64], "horizons": [3, 1], "right": 0.5},
    "stages": [
        {"name": "pose", "steps": 40, "batch": 2, "train": ["encoder", "ego_motion"], "render": False},
        {"name": "all", "steps": 60, "batch": 4, "learning_rate": 2e-4},
    ],
    "loss": {"perceptual": {"kind": "none"}, "ssim": 0.2, "pose": {"rotation": 10.0}},
}


def prepare(folder: Path, seed: int, begin: float) -> None:
    """clip.json of a street whose camera drives straight on, STEP metres per frame."""
    frames, K = [], np.eye(3).tolist()
    for index in range(FRAMES):
        pose = Street.generate(seed).camera_pose(0.0)
        pose[2, 3] += begin + STEP * index
        frames.append({"name": f"{index:06}", "key": "", "K": K, "world_from_cam": pose.tolist(), "right": None})
    about = {"recipe": RECIPE, "name": f"street {seed}", "kind": "procedural street", "fps": 10.0, "size": [48, 160]}
    (folder / f"street_{seed}").mkdir(parents=True)
    (folder / f"street_{seed}" / JSON).write_text(json.dumps({**about, "frames": frames}))


def log() -> list[dict[str, Any]]:
    """A row every tenth step: 0.5 s of networks, and in the second stage 0.1 s of splatting and an image's losses."""
    rows = []
    for step in range(10, 101, 10):
        row = {"step": step, "stage": "pose" if step <= 40 else "all", "learning_rate": 1e-4, "horizon": 1}
        row |= {"loss": 1 / step, "rotation": 0.1 / step, "translation": 0.2, "s_data": 0.0, "s_networks": 0.5}
        row |= {"s_splatting": 0.0} if step <= 40 else {"s_splatting": 0.1, "l1": 0.1, "ssim": 0.2}
        rows.append(row)
    return rows


def results(folder: Path, sha256: str) -> Path:
    """A model that has 1 dB more than the geometric forecast in one clip and 2 dB more in the other."""
    values = {GEOMETRIC: (20.0, 22.0), "tiny": (21.0, 24.0), "rival": (0.0, 0.0)}
    records = [
        Record(f"street {clip}", "2", 2, "source", method, 0.5, {"psnr": [value[clip], value[clip] - 4]})
        for method, value in values.items()
        for clip in (0, 1)
    ]
    for method, error in ((CONSTANT_VELOCITY, 0.3), ("tiny", 0.2)):
        records += [Record(f"street {c}", "2", 2, CAMERA, method, 0.5, {"rotation_deg": [error] * 2}) for c in (0, 1)]
    settings = {"protocol": "street", "data": None, "size": [48, 160], "seeds": [0, 1], "steps": 2, "samples": 1}
    about = {
        "settings": {**settings, "height": None, "width": None, "every": 1, "first": 2, "mode": "compose"},
        "models": {"tiny": {"sha256": sha256}, "rival": {"sha256": "0"}},
        "weights": {"squeeze": "1"},
        "machine": {"cores": "3", "processor": "Some CPU", "device": "0:0 Some OpenCL", "date": "2030-01-02T03:04"},
    }
    folder.mkdir()
    reported = as_json(
        EvaluationResults(PROTOCOLS["street"], records, (1, 2), ("tiny", "rival"), ("It was reported.",)), about
    )
    (folder / "results.json").write_text(json.dumps(reported))
    noise = np.random.default_rng(0).integers(0, 256, (500, 1200, 3), np.uint8)
    for word in ("best", "worst"):
        write_pixels(folder / f"sheet_{word}.png", noise)
    return folder


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> Card:
    """A run that is finished, evaluated."""
    folder = tmp_path_factory.mktemp("card")
    for seed, begin in ((7, 30.0), (8, 30.0), (10, 30.0)):
        prepare(folder / "streets", seed, begin)
    settings = {**SETTINGS, "out": str(folder / "run")}
    config = from_dict({**settings, "data": {**SETTINGS["data"], "train": [str(folder / "streets")]}})
    weights = Forecaster(TINY).state_dict()
    state = checkpoint.TrainingState(100, to_dict(config), TINY, weights, weights, {}, {}, versions={"torch": "9.9"})
    path = checkpoint.save(folder / "run", state)
    (folder / "run" / LOG).write_text("".join(json.dumps(row) + "\n" for row in log()))
    sha256 = hashlib.sha256((path / "ema.safetensors").read_bytes()).hexdigest()
    return Card(folder / "run", (results(folder / "unseen", sha256),), folder / "vest-x", horizons=(1, 2, 3))


@pytest.fixture(scope="module")
def text(options: Card) -> str:
    write_card(options)
    return (options.out / "README.md").read_text()


def test_every_file_is_there(options: Card, text: str) -> None:
    names = {path.name for path in options.out.iterdir()}
    assert names == {"README.md", "curves.png", LOG, "config.yaml", "unseen_best.jpg", "unseen_worst.jpg"}
    head, _, body = text.removeprefix("---\n").partition("\n---\n")
    assert yaml.safe_load(head)["license"] == "apache-2.0" and yaml.safe_load(head)["library_name"] == "vestcl"
    assert body.startswith("\n# vest-x\n") and "{{" not in text and "}}" not in text
    assert "![best window](unseen_best.jpg)" in text and "median window" not in text
    assert all((options.out / name).stat().st_size <= card_images.SHEET_BYTES for name in names if "jpg" in name)


def test_the_model_is_identified_by_its_file(options: Card, text: str) -> None:
    file = checkpoint.list_checkpoints(options.run)[0] / "ema.safetensors"
    model = Forecaster.load(file)
    count = sum(parameter.numel() for parameter in model.parameters())
    assert f"`{hashlib.sha256(file.read_bytes()).hexdigest()}`" in text
    assert f"{file.stat().st_size / 1e6:.1f} MB" in text and f"| all | {count:,} |" in text
    assert f"| refine | {sum(p.numel() for p in model.refine.parameters()):,} |" in text


def test_data_by_hand(text: str) -> None:
    """Three clips of 6 frames; with targets up to t+2 each has t = 1, 2, 3. 0.8 m at 10 frames per second is 8 m/s."""
    assert "| pose, all | `streets` | 3 | 18 | 9 | 48 x 160 | 7-8, 10 | 8.0 to 8.0 | 0.0 to 0.0 |" in text
    assert "Targets: t+1 75%, t+2 25%, 50% of them from the right camera" in text


def test_training_by_hand(text: str) -> None:
    """40 steps of 0.5 s, 60 of 0.6 s, a sixth of it splatting."""
    assert "| pose | encoder, ego_motion | no | 40 | 2 | 0.0001 | 24 x 64 | 0.3 | 0.0% |" in text
    assert (
        "| all | encoder, ego_motion, object_motion, refine | yes | 60 | 4 | 0.0002 | 24 x 64 | 0.6 | 16.7% |" in text
    )
    assert "Loss: L1 x 1, 1 - SSIM x 0.2, rotation (1/rad) x 10." in text
    assert "Packages: torch 9.9." in text and "Machine: 3 cores, Some CPU, Some OpenCL (of the evaluation)." in text


def test_results_by_hand(text: str) -> None:
    assert "|  | geometric | vest-x | vest-x less geometric, better in |" in text
    assert "| PSNR t+1 | 21.00 [20.00, 22.00] | 22.50 [21.00, 24.00] | +1.50 [+1.00, +2.00], 100% |" in text
    assert "| PSNR t+2 | 17.00 [16.00, 18.00] | 18.50 [17.00, 20.00] | +1.50 [+1.00, +2.00], 100% |" in text
    assert "| rotation t+2 | 0.300 [0.300, 0.300] | 0.200 [0.200, 0.200] | -0.100 [-0.100, -0.100], 100% |" in text
    assert "t+3 |" not in text and "rival" not in text and "It was reported." in text
    assert "2 windows of 2 clips, seeds 0 to 1, 48 x 160 px" in text


def test_commands_are_of_what_was_done(text: str) -> None:
    sizes = "--out streets --height 48 --width 160 --frames 6 --drive random"
    assert f"vestcl prepare street:7-8 street:10 {sizes}\n" in text
    assert "python -m train.fit vest-x/config.yaml out=runs/vest-x data.train='[\"streets\"]'\n" in text
    settings = "--seeds 0 1 --steps 2 --samples 1 --height 48 --width 160 --mode compose"  # its own is feedback
    assert f"python -m train.evaluate street --model ema.safetensors {settings} --squeeze WEIGHTS\n" in text


def test_what_the_author_writes_is_taken(options: Card, tmp_path: Path) -> None:
    reported = dataclasses.replace(
        options, results=(), out=tmp_path, prepare=("vestcl prepare mine",), machine="a machine"
    )
    write_card(reported)
    text = (tmp_path / "README.md").read_text()
    assert "vestcl prepare mine\n" in text and "street:7-8" not in text and "Machine: a machine.\n" in text
    assert "None yet." in text and "train.evaluate" not in text


def test_steps_after_the_checkpoint_are_left_out(options: Card, tmp_path: Path) -> None:
    log_file = options.run / LOG
    before = log_file.read_text()
    log_file.write_text(before + json.dumps({**log()[-1], "step": 110}) + "\n")
    write_card(dataclasses.replace(options, results=(), out=tmp_path))
    assert (tmp_path / LOG).read_text() == before
    log_file.write_text(before)


def test_config_and_log_can_be_read_again(options: Card, text: str, tmp_path: Path) -> None:
    reported = yaml.safe_load((options.out / "config.yaml").read_text())
    assert reported["data"]["train"] == ["streets"] and reported["out"] == "run"
    again = load_config(options.out / "config.yaml", [f"out={tmp_path}"])
    assert [stage.steps for stage in again.stages] == [40, 60]
    assert (options.out / LOG).read_text() == (options.run / LOG).read_text()


def test_a_long_log_is_thinned_to_its_end() -> None:
    rows = [{"step": step} for step in range(1000)]
    for most in (2, 300, 999, 1000, 5000):
        kept = thinned(rows, most)
        assert len(kept) <= most and (kept[0], kept[-1]) == (rows[0], rows[-1])
    assert thinned(rows, 1000) == rows and len(thinned(rows, 300)) > 200


def test_no_folder_of_this_machine_is_reported() -> None:
    given = {"a": ["/x/y/cache", "rel/ative", 3, None], "b": {"c": Path("/x").joinpath("w.npz").as_posix()}}
    assert portable(given) == {"a": ["cache", "rel/ative", 3, None], "b": {"c": "w.npz"}}


def test_figures_of_another_file_are_refused(options: Card, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = results(tmp_path / "other", "ff" * 32)
    with pytest.raises(ValueError, match=r"`results` must be of the file .* got .*other of 0, ffff"):
        write_card(dataclasses.replace(options, results=(other,), out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
    assert main([str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "`run` must be a folder of train.fit" in capsys.readouterr().err


@pytest.mark.parametrize("content", [b"", b"\xff", b"[]", b"{}", b"[" * 100_000, b'{"models": {"x": 1}}'])
def test_damaged_results_are_a_line(
    options: Card, tmp_path: Path, content: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "results.json").write_bytes(content)
    assert main([str(options.run), "--results", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        f"error: {tmp_path / 'results.json'}: must be what train.evaluate writes, with title, models"
    )
    assert error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_damaged_log_is_a_line(options: Card, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = shutil.copytree(options.run, tmp_path / "run")
    with (run / LOG).open("ab") as file:
        file.write(b"\x00\xff\n")
    assert main([str(run), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {run / LOG}: line ") and "must be a row of train.fit" in error
    assert error.count("\n") == 1


def test_names_of_results_part_their_sheets(options: Card, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="`results` must be folders of different names, got unseen, unseen"):
        write_card(dataclasses.replace(options, results=options.results * 2, out=tmp_path))


def test_an_unfinished_run_says_so(options: Card, text: str) -> None:
    state = checkpoint.load_latest(options.run)
    assert state is not None
    weights = card_tables.Weights("x", 1, "y", TINY, {})
    config = from_dict(state.config)
    assert "not finished" in card._about(config, weights, 50) and "not finished" not in card._about(
        config, weights, 100
    )
    table = card_tables.training_table(config, log()[:3], 30, None, "")
    assert "| 30 |" in table and "| all |" not in table and "Machine" not in table


def test_smoothing_by_hand() -> None:
    values = np.zeros(40)
    values[[0, 20]] = 6.0
    mean = smoothed(values)  # over a row to either side
    assert mean[:3].tolist() == [3.0, 2.0, 0.0] and mean[19:22].tolist() == [2.0, 2.0, 2.0] and mean[39] == 0
    assert smoothed(np.arange(3.0)).tolist() == [0, 1, 2]


def test_stages_follow_each_other() -> None:
    assert stages_of(log()) == [("pose", 0, 40), ("all", 40, 100)]


def test_curves_are_drawn_of_what_there_is(tmp_path: Path) -> None:
    """A value that was not finite (null) and a single row are not an error; curves change the image."""
    rows = log()
    draw_curves(tmp_path / "a.png", rows)
    rows[5] = {**rows[5], "l1": None, "loss": 5.0}
    draw_curves(tmp_path / "b.png", rows)
    draw_curves(tmp_path / "c.png", rows[:1])
    drawn = [read_pixels(tmp_path / f"{name}.png") for name in "abc"]
    assert len({image.shape for image in drawn}) == 1 and (drawn[0] != drawn[1]).any()


def test_a_sheet_gets_smaller_until_it_fits(tmp_path: Path) -> None:
    plain = np.full((400, 600, 3), 127, np.uint8)
    write_pixels(tmp_path / "plain.png", plain)
    write_sheet(tmp_path / "plain.jpg", tmp_path / "plain.png")
    assert (read_pixels(tmp_path / "plain.jpg") == plain).all()
    write_pixels(tmp_path / "noise.png", np.random.default_rng(0).integers(0, 256, plain.shape, np.uint8))
    write_sheet(tmp_path / "noise.jpg", tmp_path / "noise.png", 20_000)
    height, width = read_pixels(tmp_path / "noise.jpg").shape[:2]
    assert (tmp_path / "noise.jpg").stat().st_size <= 20_000 and height < 400 and abs(width / height - 1.5) < 0.05
    with pytest.raises(ValueError, match="`limit` must be 10000 or more, got 5"):
        write_sheet(tmp_path / "x.jpg", tmp_path / "plain.png", 5)

"""`vestcl forecast --every N` from the command line: clips, folders of clips, what is kept, what is refused."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from forecast_clips import write_clip
from video_files import flat, write_video

from vestcl.cli import drive
from vestcl.cli import main as cli
from vestcl.forecasting.files import read_forecast
from vestcl.forecasting.result import Forecast, Rendered, View
from vestcl.io.images import write_pixels
from vestcl.io.video.reading import Video
from vestcl.scene.perception import Perception


class Repeater:
    """Frame t again in place of a forecast; the frames that it was asked for."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int, int]] = []
        self.fails_at: int | None = None

    def __call__(
        self, perception: Perception, index: int, steps: int, views: Sequence[View], memory: int = 0
    ) -> Forecast:
        if len(self.calls) == self.fails_at:
            raise ValueError("the disk fell down")
        self.calls.append((perception.clip.name, index, steps))
        image = perception.clip[index].read_image()
        rendered = Rendered(image, 9 + 0 * image[:1], 1 + 0 * image[:1], 0 * image)
        return Forecast("repeater", [np.eye(4)] * steps, [{view.name: rendered for view in views}] * steps)


@pytest.fixture
def repeater(monkeypatch: pytest.MonkeyPatch) -> Repeater:
    made = Repeater()
    monkeypatch.setattr(drive, "forecast_geometric", made)
    monkeypatch.setenv("COLUMNS", "80")
    return made


def scores(out: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((out / "scores.csv").read_text(encoding="utf-8").splitlines()))


def test_one_video_and_the_scores_by_frame(
    tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = write_clip(tmp_path / "clip"), tmp_path / "out"
    arguments = ["forecast", str(folder), "--every", "2", "--frame", "1", "--steps", "1", "--out", str(out)]
    assert cli.main([*arguments, "--view", "source", "--view", "right", "--view", "0.5,0,0"]) == 0
    assert repeater.calls == [("clip", 1, 1), ("clip", 3, 1)]
    assert [(row["frame"], row["view"]) for row in scores(out)] == [(f, v) for f in "13" for v in ("source", "right")]
    assert float(scores(out)[0]["psnr"]) > 3
    assert len(list(out.rglob("*.mp4"))) == 1
    assert len(Video(out / "drive.mp4")) == 2
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines()[:6])) <= 80
    for words in ("PSNR, dB", "source, forecast", "2 frames forecast", str(out / "drive.mp4")):
        assert words in said


def test_an_interrupted_run_continues(tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]) -> None:
    folder, whole, out = write_clip(tmp_path / "clip"), tmp_path / "whole", tmp_path / "out"
    arguments = ["forecast", str(folder), "--every", "1", "--frame", "1", "--steps", "1", "--out"]
    assert cli.main([*arguments, str(whole)]) == 0
    repeater.calls.clear()
    repeater.fails_at = 2
    assert cli.main([*arguments, str(out)]) == 2
    assert not (out / "drive.mp4").exists()
    assert [index for _, index, _ in repeater.calls] == [1, 2]
    repeater.fails_at = None
    assert cli.main([*arguments, str(out)]) == 0
    assert [index for _, index, _ in repeater.calls] == [1, 2, 3, 4]
    assert "2 kept from an earlier run" in capsys.readouterr().out
    for name in ("drive.mp4", "scores.csv"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    assert cli.main([*arguments, str(out)]) == 0
    assert len(repeater.calls) == 4


def test_a_changed_request_is_refused(tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = write_clip(tmp_path / "clip"), tmp_path / "out"
    arguments = ["forecast", str(folder), "--every", "1", "--out", str(out), "--steps"]
    assert cli.main([*arguments, "1"]) == 0
    assert cli.main([*arguments, "2"]) == 2
    assert "holds a drive with steps 1 (now 2): continue it with the same options, or choose another --out" in " ".join(
        capsys.readouterr().err.split()
    )
    (folder / "image" / "0005.png").unlink()
    assert cli.main([*arguments, "1"]) == 2
    assert "clips" in capsys.readouterr().err


def test_the_same_request_in_other_words_continues(
    tmp_path: Path, repeater: Repeater, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also from another folder; there a clip of the same name is another one."""
    folder, out = write_clip(tmp_path / "clip"), str(tmp_path / "out")
    options = ["--every", "1", "--frame", "1", "--steps", "1", "--out", out]
    assert cli.main(["forecast", str(folder), *options]) == 0
    monkeypatch.chdir(tmp_path)
    assert cli.main(["forecast", "clip", *options, "--view", "source"]) == 0
    assert len(repeater.calls) == 4
    write_clip(tmp_path / "other" / "clip")
    monkeypatch.chdir(tmp_path / "other")
    assert cli.main(["forecast", "clip", *options]) == 2
    assert "holds a drive with clips" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("content", [b"a,b\n", b"\xff", b"clip,1,0001,0.0,source,forecast,x,12", b"\0"])
def test_a_frame_with_damaged_lines_is_forecast_again(content: bytes, tmp_path: Path, repeater: Repeater) -> None:
    folder, out = write_clip(tmp_path / "clip"), tmp_path / "out"
    arguments = ["forecast", str(folder), "--every", "1", "--frame", "1", "--steps", "1", "--out", str(out)]
    assert cli.main(arguments) == 0
    kept, whole = out / "frames" / "001_clip" / "000002.csv", (out / "scores.csv").read_bytes()
    kept.write_bytes(content)
    assert cli.main(arguments) == 0
    assert [index for _, index, _ in repeater.calls] == [1, 2, 3, 4, 2]
    assert (out / "scores.csv").read_bytes() == whole


@pytest.mark.parametrize("picture", [b"", np.zeros((9, 9, 3), np.uint8)])
def test_a_damaged_image_is_named(
    picture: bytes | np.ndarray, tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = write_clip(tmp_path / "clip"), tmp_path / "out"
    arguments = ["forecast", str(folder), "--every", "1", "--frame", "1", "--steps", "1", "--out", str(out)]
    assert cli.main(arguments) == 0
    kept = out / "frames" / "001_clip" / "000002.jpg"
    if isinstance(picture, bytes):
        kept.write_bytes(picture)
    else:
        write_pixels(kept, picture)
    assert cli.main(arguments) == 2
    message = capsys.readouterr().err
    assert str(kept) in message and "delete it, and the same command makes it again" in " ".join(message.split())
    kept.unlink()
    assert cli.main(arguments) == 0


def test_a_file_in_place_of_drive_json(tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "drive.json").write_text("no json")
    arguments = ["forecast", str(write_clip(tmp_path / "clip")), "--every", "1", "--out", str(tmp_path / "out")]
    assert cli.main([*arguments, "--steps", "1"]) == 2
    assert "delete the file, or give --out another folder" in " ".join(capsys.readouterr().err.split())
    assert repeater.calls == []


def test_a_folder_of_clips_and_several_inputs(
    tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    drives = tmp_path / "Fahrten"
    write_clip(drives / "clip10")
    write_clip(drives / "clip9")
    write_video(drives / "überland.mp4", flat(5))
    (drives / "notes.txt").write_text("no clip")
    write_video(tmp_path / "short.mp4", flat(2))
    arguments = ["forecast", str(drives), str(tmp_path / "short.mp4"), "--every", "10", "--steps", "1"]
    assert cli.main([*arguments, "--out", str(tmp_path / "out")]) == 0
    assert [(name, index) for name, index, _ in repeater.calls] == [("clip9", 3), ("clip10", 3), ("überland", 3)]
    assert {row["clip"] for row in scores(tmp_path / "out")} == {"clip9", "clip10", "überland"}
    said = " ".join(capsys.readouterr().out.split())
    assert "left out: " in said
    assert "1 after it, got 2 frames" in said


def test_streets_by_seed_and_seconds(tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]) -> None:
    """A horizon of 0.17 s is two frames at 10 Hz and four at 25."""
    inputs = ["street:1-2", "street:1?fps=25"]
    size = ["--height", "24", "--width", "40", "--frames", "9"]
    arguments = ["forecast", *inputs, *size, "--every", "3", "--seconds", "0.17", "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 0
    assert [steps for _, _, steps in repeater.calls] == [2, 2, 2, 2, 4]
    said = capsys.readouterr().out
    assert "--seconds 0.17: 2 steps of 0.1 s, 0.2 s in all (street 1)" in said
    assert "--seconds 0.17: 4 steps of 0.04 s, 0.16 s in all" in said


def test_baselines_with_compare(tmp_path: Path, repeater: Repeater) -> None:
    arguments = ["forecast", str(write_clip(tmp_path / "clip")), "--every", "9", "--steps", "1", "--compare"]
    assert cli.main([*arguments, "--out", str(tmp_path / "out")]) == 0
    assert [row["method"] for row in scores(tmp_path / "out")] == ["forecast", "repeat last", "optical flow"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--every 0", "--every must be 1 or more, got 0"),
        ("--every -3", "--every must be 1 or more, got -3"),
        ("--every 1 --gif", "--gif is of a single forecast"),
        ("--every 1 --steps 3 --seconds 1", "give one, got 3 and 1"),
        ("--every 1 --seconds 0", "--seconds must be between 0 and"),
        ("--every 1 --seconds nan", "--seconds must be finite"),
        ("--every 1 --seconds 0.01", "a frame every 0.04 s; --seconds must be half of it or more, got 0.01"),
        ("--every 1 --seconds 900", "the steps of --seconds 900 must be 1,000 or less, got 22,500"),
        ("--every 1 --frame 0", "--frame must be 1 or more, to have a frame before it, got 0"),
        ("--every 1 --frame 5", "has no frame from frame 5 on with one before it and 5 after it, got 6 frames"),
        ("--every 1 --frames 9", "--frames is of streets, got 9"),
        ("--frames 9", "it needs --every"),
        ("street:3", "INPUT must be one clip, or several with --every"),
        ("--every 1 --view right --view right", "different names"),
    ],
)
def test_refused(
    arguments: str, words: str, tmp_path: Path, repeater: Repeater, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_clip(tmp_path / "clip")
    assert cli.main(["forecast", str(folder), *arguments.split(), "--out", str(tmp_path / "out")]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
    assert repeater.calls == []


def test_no_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["forecast", "--every", "3"]) == 2
    assert "INPUT must be one clip or more, got none" in capsys.readouterr().err


def test_seconds_of_a_single_forecast(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["forecast", "street:3?fps=25", "--height", "48", "--width", "96", "--no-exr", "--out", str(tmp_path)]
    assert cli.main([*arguments, "--seconds", "0.09", "--compare"]) == 0
    settings = read_forecast(tmp_path).about["settings"]
    assert (settings["steps"], settings["seconds"], settings["input"]) == (2, 0.09, "street:3?fps=25")
    assert "--seconds 0.09: 2 steps of 0.04 s, 0.08 s in all" in capsys.readouterr().out

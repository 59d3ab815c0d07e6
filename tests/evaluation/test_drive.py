"""Forecasts of a whole drive: which frames, how long the video shows each, what is kept and continued."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip, Sample
from vestcl.evaluation.compare import FORECAST
from vestcl.evaluation.drive.files import DriveFolder
from vestcl.evaluation.drive.frame import DriveFrames, score_rows
from vestcl.evaluation.drive.plan import Drive, drive, repeats, video_rate
from vestcl.evaluation.scores import REPEAT
from vestcl.forecasting.geometric.forecast import forecast_clip, forecast_frames
from vestcl.forecasting.result import Forecast, Rendered, View
from vestcl.forecasting.views import parse_views
from vestcl.io.video.reading import Video
from vestcl.scene.perception import Perception

K = np.array([[40.0, 0, 20], [0, 40, 12], [0, 0, 1]])
SOURCE = (View("source", np.eye(4)),)


def clip_of(seconds: Sequence[float | None], height: int = 24, width: int = 40, name: str = "noise") -> Clip:
    images = np.random.default_rng(0).random((len(seconds), 3, height, width), np.float32)
    samples = (
        Sample.from_arrays(f"{i:04}", images[i], K, timestamp=seconds[i], depth=np.full((1, height, width), 9.0))
        for i in range(len(seconds))
    )
    return Clip(name, "arrays", tuple(samples))


def evenly(frames: int, fps: float = 10.0) -> Clip:
    return clip_of([i / fps for i in range(frames)])


def repeat_frame(perception: Perception, index: int, steps: int, views: Sequence[View]) -> Forecast:
    """Frame t again, as every step of every view."""
    image = perception.clip[index].read_image()
    rendered = Rendered(image, 9 + 0 * image[:1], 1 + 0 * image[:1], 0 * image)
    return Forecast("repeat", [np.eye(4)] * steps, [{view.name: rendered for view in views}] * steps)


@pytest.mark.parametrize(
    ("frames", "steps", "every", "first", "indices"),
    [
        (12, 2, 1, None, range(3, 10)),
        (12, 2, 3, None, (3, 6, 9)),
        (12, 2, 3, 1, (1, 4, 7)),
        (12, 2, 100, None, (3,)),
        (4, 2, 1, None, (1,)),  # too short for four frames in sight
        (3, 2, 1, None, ()),
        (12, 2, 1, 10, ()),
    ],
)
def test_frames(frames: int, steps: int, every: int, first: int | None, indices: Sequence[int]) -> None:
    assert drive(evenly(frames), "clip", 1, steps, every, first).indices == tuple(indices)


def test_a_first_frame_needs_one_before_it() -> None:
    with pytest.raises(ValueError, match="`frame` must be 1 or more, to have a frame before it, got 0"):
        drive(evenly(9), "clip", 1, 1, 1, 0)


def test_frames_without_a_true_frame_at_every_step_are_left_out() -> None:
    """Between frames 5 and 6 there are four intervals."""
    seconds = [i / 10 for i in range(6)] + [0.9 + i / 10 for i in range(6)]
    assert drive(clip_of(seconds), "clip", 1, 2, 1).indices == (3, 6, 7, 8, 9)


@pytest.mark.parametrize(
    ("name", "folder"),
    [("a/b c", "002_a_b_c"), ("Straße 7", "002_Straße_7"), ("..", "002_clip"), ("x" * 99, "002_" + "x" * 60)],
)
def test_folder_names(name: str, folder: str) -> None:
    assert drive(clip_of([0, 1, 2, 3, 4], name=name), "clip", 2, 1, 1).folder == folder


def test_the_video_plays_at_natural_speed() -> None:
    """Every fifth frame of 10 Hz is two frames a second, shown three times each: players want five and more."""
    one = drive(evenly(30), "clip", 1, 1, 5)
    assert video_rate([one]) == pytest.approx(6)
    assert list(repeats(one, 6.0)) == [3] * len(one.indices)
    assert video_rate([drive(evenly(30, 25), "clip", 1, 1, 1)]) == pytest.approx(25)


def test_clips_of_two_rates_both_play_at_natural_speed() -> None:
    slow, fast = drive(evenly(30, 10), "a", 1, 1, 1), drive(evenly(30, 25), "b", 2, 1, 1)
    rate = video_rate([slow, fast])
    assert rate == pytest.approx(25)
    assert sum(repeats(slow, rate)) == pytest.approx(len(slow.indices) * 2.5, abs=1)
    assert set(repeats(fast, rate)) == {1}


def test_a_gap_is_shown_for_two_seconds() -> None:
    seconds = [i / 10 for i in range(8)] + [100 + i / 10 for i in range(8)]
    one = drive(clip_of(seconds), "clip", 1, 1, 1)
    counts = dict(zip(one.indices, repeats(one, 10.0), strict=True))
    assert counts[6] == 20
    assert {count for index, count in counts.items() if index != 6} == {1}


def test_a_clip_without_times_has_ten_frames_a_second() -> None:
    one = drive(clip_of([None] * 8), "clip", 1, 1, 2)
    assert video_rate([one]) == pytest.approx(5)
    assert set(repeats(one, 5.0)) == {1}


def test_scores_and_picture() -> None:
    clip = evenly(8)
    frames = DriveFrames(clip, Perception(clip), {FORECAST: repeat_frame})
    views = parse_views(("source", "0.5,0,0"), clip)
    (record,), picture = frames.forecast(3, 2, views)
    wanted = np.square(clip[3].read_image() - clip[5].read_image()).mean()
    assert record.scores["psnr"][1] == pytest.approx(-10 * np.log10(wanted), abs=0.05)  # of 8 bit
    rows = score_rows([record], 0.3)
    assert [row[:7] for row in rows] == [["noise", "3", "0003", "0.300", "source", "forecast", str(k)] for k in (1, 2)]
    assert picture.shape[1] > 4 * 40
    again, _ = frames.forecast(4, 1, views)
    assert again[0].index == 4


def test_baselines() -> None:
    clip = evenly(8)
    frames = DriveFrames(clip, Perception(clip), {FORECAST: repeat_frame}, baselines=True)
    records, _ = frames.forecast(3, 1, SOURCE)
    by_method = {record.method: record.scores["psnr"] for record in records}
    assert by_method[FORECAST] == by_method[REPEAT]
    assert len(by_method) == 3


def test_a_drive_is_what_single_forecasts_are_and_its_memory_is_bounded() -> None:
    clip = street_clip(Street.generate(3), 16, 48, 96, fps=10.0)
    perception, kept, seen = Perception(clip), [], {}

    def keep(perception: Perception, index: int, steps: int, views: Sequence[View]) -> Forecast:
        seen[index] = forecast_frames(perception, index, steps, views)
        return seen[index]

    frames = DriveFrames(clip, perception, {FORECAST: keep})
    for index in range(3, 15):
        frames.forecast(index, 1, SOURCE)
        kept.append(len(perception._kept) + len(frames._truth._full) + len(frames._truth._looks))
    assert max(kept[6:]) <= max(kept[:6])
    single = forecast_clip(clip, 9, 1, SOURCE)
    assert np.array_equal(seen[9].frames[0]["source"].image, single.frames[0]["source"].image)


def filled(folder: DriveFolder, drives: Sequence[Drive], values: Sequence[int] = (40, 120)) -> None:
    for number, one in enumerate(drives):
        for index in one.indices:
            rows = [[one.clip.name, str(index), "a,b", "", "source", "forecast", "1", "20", "0.5", "", "", ""]]
            folder.add(one, index, rows, np.full((32, 64 + 16 * number, 3), values[number], np.uint8))


def test_files(tmp_path: Path) -> None:
    """Clips of two sizes in one video; a name with a comma in the CSV."""
    drives = [drive(evenly(8), "a", 1, 1, 1), drive(evenly(6), "b", 2, 1, 1)]
    folder = DriveFolder(tmp_path / "Ölspur", {"steps": 1})
    assert not folder.has(drives[0], 3)
    filled(folder, drives)
    assert folder.has(drives[0], 3)
    folder.finish(drives, {"more": 1})
    video = Video(tmp_path / "Ölspur" / "drive.mp4")
    assert (len(video), video.fps, video.height, video.width) == (4 + 2, 10, 32, 80)
    assert abs(int(video[0][5, 5, 0]) - 40) < 6
    assert abs(int(video[5][5, 5, 0]) - 120) < 6
    lines = list(csv.DictReader((tmp_path / "Ölspur" / "scores.csv").read_text(encoding="utf-8").splitlines()))
    assert [line["frame"] for line in lines] == ["3", "4", "5", "6", "3", "4"]
    assert lines[0]["name"] == "a,b"
    assert json.loads((tmp_path / "Ölspur" / "drive.json").read_text())["more"] == 1


def test_another_request_is_refused(tmp_path: Path) -> None:
    DriveFolder(tmp_path, {"steps": 1, "model": None})
    DriveFolder(tmp_path, {"steps": 1, "model": None})
    with pytest.raises(ValueError, match=r"holds a drive with steps 1 \(now 2\); model none \(now vest-s\): continue"):
        DriveFolder(tmp_path, {"steps": 2, "model": "vest-s"})


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"format": "vestcl drive 0", "request": {}}', '{"format": "vestcl drive 1"}']
)
def test_a_damaged_drive_json_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "drive.json").write_text(text)
    with pytest.raises(ValueError, match=r"drive\.json: (is not JSON|must have the format)"):
        DriveFolder(tmp_path, {"steps": 1})


def test_frames_of_an_unknown_drive_are_refused(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    with pytest.raises(ValueError, match="frames of an unknown drive"):
        DriveFolder(tmp_path, {"steps": 1})

"""Forecasts of clips whose frames are not evenly spaced: everything moves by time."""

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
import torch
from geometric_scenes import HEIGHT, WIDTH, decibels, turned
from test_network_input import MOTIONS, displaced, prepared
from video_files import write_video

from train.data.windows import WindowSet
from vestcl.bench.forecast import bench
from vestcl.bench.forecast.windows import chosen_windows
from vestcl.cli import main as cli
from vestcl.data import Street, street_clip
from vestcl.data.calibration import power
from vestcl.data.sample import Clip
from vestcl.evaluation import compare
from vestcl.forecasting import baselines
from vestcl.forecasting.files import read_forecast
from vestcl.forecasting.geometric import Perception, forecast_frames
from vestcl.forecasting.network import forecast as network
from vestcl.forecasting.network.input import last_motions, network_input
from vestcl.forecasting.result import View
from vestcl.io.images import to_pixels
from vestcl.models.config import configuration
from vestcl.models.forecaster import Forecaster
from vestcl.prepare.clip import EightBitPerception, frame_keys, prepare_clip
from vestcl.prepare.prepared import PreparedClip
from vestcl.scene.motion.ego_motion import constant_velocity

SOURCE = View("source", np.eye(4))

#: Twentieths of a second at which frames were taken: 10 Hz, but for one that comes 50 ms late, and a gap of 0.25 s.
TAKEN = (0, 2, 4, 7, 8, 10, 12, 17, 19, 21, 23)
LATE, AFTER_GAP = 3, 7


@functools.cache
def fine() -> Clip:
    return street_clip(Street.generate(4), 24, HEIGHT, WIDTH, fps=20.0)


def uneven() -> Clip:
    return dataclasses.replace(fine(), samples=tuple(fine()[i] for i in TAKEN))


@functools.cache
def seen() -> Perception:
    return Perception(uneven())


def as_if_even() -> Clip:
    """The same frames, with times that hide the gaps."""
    samples = enumerate(uneven())
    return dataclasses.replace(uneven(), samples=tuple(dataclasses.replace(s, timestamp=i / 10) for i, s in samples))


def truth(index: int, step: int) -> np.ndarray:
    """The street as it is ``step`` tenths of a second after a frame of the uneven clip."""
    return fine()[TAKEN[index] + 2 * step].read_image()


@pytest.mark.parametrize("index", [LATE, LATE + 1, AFTER_GAP])
def test_the_camera_moves_by_time(index: int) -> None:
    """Step k is k tenths of a second, whatever time went by before."""
    made = forecast_frames(seen(), index, 1, [SOURCE])
    now, after = fine()[TAKEN[index]].world_from_cam, fine()[TAKEN[index] + 2].world_from_cam
    assert now is not None and after is not None
    expected = np.linalg.inv(after) @ now
    assert made.future_from_cur[0][2, 3] == pytest.approx(expected[2, 3], rel=0.08)


@pytest.mark.parametrize("index", [LATE, AFTER_GAP])
def test_better_than_the_last_frame_and_than_without_times(index: int) -> None:
    by_time = forecast_frames(seen(), index, 2, [SOURCE])
    without = forecast_frames(Perception(as_if_even()), index, 2, [SOURCE])
    for step in (1, 2):
        wanted = truth(index, step)
        scores = [decibels(made.frames[step - 1]["source"].image, wanted) for made in (by_time, without)]
        assert scores[0] > decibels(uneven()[index].read_image(), wanted) + 2
        assert scores[0] > scores[1] + 0.3


def test_without_gaps_nothing_changes() -> None:
    even = dataclasses.replace(fine(), samples=fine().samples[::2])
    bare = dataclasses.replace(even, samples=tuple(dataclasses.replace(s, timestamp=None) for s in even))
    made, wanted = (forecast_frames(Perception(clip), 3, 1, [SOURCE]) for clip in (even, bare))
    assert np.array_equal(made.frames[0]["source"].image, wanted.frames[0]["source"].image)


def test_objects_move_by_time() -> None:
    """What was measured over 1.5 intervals is 1 / 1.5 of it in each."""
    per_interval, over_all = (Perception(clip).seen(LATE).velocity for clip in (uneven(), as_if_even()))
    assert over_all.any()
    np.testing.assert_allclose(per_interval, over_all / 1.5, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("gap", [3.0, 7.0])
def test_a_gap_that_is_too_long_to_match(gap: float) -> None:
    """The camera continues as before the gap, where flow across it is lost; a line reports it."""
    street = Street.generate(4)
    seconds = [0.0, 0.1, 0.2, 0.2 + gap / 10, 0.3 + gap / 10]
    clips = [street_clip(street, 1, HEIGHT, WIDTH, start=second)[0] for second in seconds]
    perception = Perception(Clip("street", "street", tuple(clips)))
    assert [perception.is_lost(i) for i in range(5)] == [False, False, False, True, False]
    poses = [clip.world_from_cam for clip in clips]
    assert poses[2] is not None and poses[3] is not None
    wanted = np.linalg.inv(poses[2]) @ poses[3]
    off = np.linalg.norm(perception.prev_from_cur(3)[:3, 3] - wanted[:3, 3]) / np.linalg.norm(wanted[:3, 3])
    assert off < 0.03
    (note,) = forecast_frames(perception, 3, 1, [SOURCE]).notes
    assert note.startswith(f"frames 0000000000 and 0000000000 are {gap / 10:g} s apart, too far to be matched")
    assert forecast_frames(perception, 4, 1, [SOURCE]).notes == ()


def test_constant_velocity_by_hand() -> None:
    bend = turned(0.02, 0, 0, (0.1, 0, -1.0))
    got = constant_velocity([power(bend, 3.0), power(bend, 0.5)], [3.0, 0.5])
    np.testing.assert_allclose(got, bend, atol=1e-9)
    with pytest.raises(ValueError, match=r"`elapsed` must be 1 numbers above 0, as `motions`, got \[0\.0\]"):
        constant_velocity([bend], [0.0])


def test_flow_is_extrapolated_by_time() -> None:
    frames = [torch.from_numpy(uneven()[i].read_image())[None] for i in (AFTER_GAP - 1, AFTER_GAP)]
    by_time, without = (baselines.flow_extrapolation(*frames, 1, elapsed=elapsed)[0, 0] for elapsed in (2.5, 1.0))
    wanted = truth(AFTER_GAP, 1)
    assert decibels(by_time.numpy(), wanted) > decibels(without.numpy(), wanted) + 0.5
    with pytest.raises(ValueError, match="`elapsed` must be above 0, got 0"):
        baselines.flow_extrapolation(*frames, 1, elapsed=0)


# ---------------------------------------------------------------- networks


def test_the_prior_is_per_interval() -> None:
    prev, cur = prepared(0, MOTIONS[0]), dataclasses.replace(prepared(1, power(MOTIONS[1], 3.0), own=True), elapsed=3.0)
    even = network_input(prepared(0, MOTIONS[0]), prepared(1, MOTIONS[1], own=True), MOTIONS)
    got = network_input(prev, cur, last_motions(prev, cur))
    assert got.prior.intervals == 4 and even.prior.intervals == 2
    for part, wanted in zip(got.prior.next_from_cur, even.prior.next_from_cur, strict=True):
        torch.testing.assert_close(part, wanted, atol=1e-6, rtol=0)
    # What rides along with the recording car stays in the image.
    still = displaced(cur, got.prior.next_from_cur, got.prior.velocity_cur, 1)
    assert still[torch.from_numpy(cur.own.reshape(-1))].norm(dim=1).max() < 1e-4


def test_another_interval_than_the_networks() -> None:
    """vest-s learned at 10 Hz: its corrections of motion are left out, and a line reports it."""
    model = Forecaster.from_pretrained("vest-s")
    clip = dataclasses.replace(fine(), samples=fine().samples[:4]).resized(48, 160)
    made = network.forecast_frames(Perception(clip), model, 3, 2, [SOURCE], learned="all")
    measured = [np.linalg.inv(Perception(clip).prev_from_cur(index)) for index in (2, 3)]
    plain = [np.linalg.matrix_power(constant_velocity(measured), step) for step in (1, 2)]
    (note,) = made.notes
    assert note == (
        "frames are 0.05 s apart, vest-s learned at 0.1 s: "
        "its corrections of the camera's and the objects' motion are left out"
    )
    for got, wanted in zip(made.future_from_cur, plain, strict=True):
        np.testing.assert_allclose(got, wanted, atol=1e-5)
    known = dataclasses.replace(
        clip, samples=tuple(dataclasses.replace(s, timestamp=i / 10) for i, s in enumerate(clip))
    )
    assert network.forecast_frames(Perception(known), model, 3, 1, [SOURCE]).notes == ()


@pytest.mark.parametrize(
    ("name", "index", "message"),
    [
        ("vest-s", 2, None),
        ("vest-s", LATE, "frames t-1 and t are 0.15 s apart, vest-s learned at 0.1 s: its corrections"),
        ("vest-paper", LATE, "frames t-1 and t are 0.15 s apart, vest-paper learned at 0.1 s: its motion may be wrong"),
    ],
)
def test_which_frames_a_network_knows(name: str, index: int, message: str | None) -> None:
    note = network.interval_note(uneven(), index, configuration(name))
    assert note is None if message is None else (note or "").startswith(message)


def test_an_interval_of_a_configuration() -> None:
    assert configuration("vest-s").interval_s == 0.1
    with pytest.raises(ValueError, match="`interval_s` must be positive seconds, got 0"):
        dataclasses.replace(configuration("vest-s"), interval_s=0)


# ---------------------------------------------------------------- truth, caches, windows


def test_truth_is_the_frame_at_that_time() -> None:
    """After the frame that came late the next is half an interval away, and no truth of a step."""
    clip = uneven()
    made = forecast_frames(seen(), 4, 3, [SOURCE])
    (comparison,) = compare.compare(made, clip, 4, [SOURCE])
    assert len(comparison.truth) == 2 and np.array_equal(comparison.truth[1], clip[6].read_image())
    with pytest.raises(
        ValueError, match=r"`index` must have a frame one interval after it; after 6 there is none for 2\.5"
    ):
        compare.compare(made, clip, 6, [SOURCE])


def test_windows_with_a_gap_are_left_out(tmp_path: Path) -> None:
    clip = uneven()
    assert chosen_windows(clip, bench.ForecastBench(("x",), steps=2)) == [4, 7, 8]
    small = clip.resized(24, 80)
    prepare_clip(small, tmp_path)
    cache = PreparedClip.open(tmp_path)
    assert cache.interval == pytest.approx(0.1) and cache.positions == pytest.approx(small.positions)
    windows = WindowSet([cache], horizons=(0.5, 0.5))
    assert windows.windows == [(0, 8)] and windows.interval == 0.1
    assert cache.frame(AFTER_GAP).elapsed == 2.5
    wanted = EightBitPerception(small).seen(AFTER_GAP)
    np.testing.assert_allclose(cache.frame(AFTER_GAP).velocity, wanted.velocity, rtol=1e-3, atol=1e-6)


def test_times_that_change_velocities_are_in_the_key() -> None:
    even = as_if_even()
    later = dataclasses.replace(
        even, samples=tuple(dataclasses.replace(s, timestamp=9 + i / 10) for i, s in enumerate(even))
    )
    assert frame_keys(even) == frame_keys(later)
    changed = [i for i, (a, b) in enumerate(zip(frame_keys(even), frame_keys(uneven()), strict=True)) if a != b]
    assert changed == [3, 4, 5, 6, 7, 8, 9, 10]


# ---------------------------------------------------------------- a video


@functools.cache
def street() -> list[np.ndarray]:
    clip = street_clip(Street.generate(2), 20, 96, 256)
    return [to_pixels(sample.read_image()).astype(np.uint8) for sample in clip]


def test_a_video_of_variable_frame_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Frames 8 to 13 are missing: 0.7 s are no interval. The forecast is better than the last frame again."""
    kept = [i for i in range(20) if not 8 <= i <= 13]
    pixels = [street()[i] for i in kept]
    video = write_video(tmp_path / "a.mkv", pixels, [i / 10 for i in kept], options={"crf": "10"})
    out = tmp_path / "out"
    arguments = [
        "forecast",
        str(video),
        "--fov",
        "80",
        "--frame",
        "8",
        "--steps",
        "2",
        "--compare",
        "--no-exr",
        "--out",
        str(out),
    ]
    assert cli.main(arguments) == 0
    about = read_forecast(out).about
    scores = about["scores"]["source"]
    for mine, repeated in zip(scores["forecast"], scores["repeat last"], strict=True):
        assert mine["psnr"] > repeated["psnr"]
    assert (about["interval_s"], about["fps"]) == (pytest.approx(0.1), 10)
    (note,) = about["notes"]
    assert note.startswith("frames 000007 and 000008 are 0.7 s apart")
    assert f"note: {note}" in capsys.readouterr().out
    assert cli.main([*arguments, "--frame", "7"]) == 2
    assert "after 7 there is none for 7" in capsys.readouterr().err

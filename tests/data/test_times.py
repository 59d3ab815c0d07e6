"""vestcl.times, and how clips and readers take it."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import test_data_folder
import test_data_kitti_odometry
import test_data_kitti_raw

from vestcl import times
from vestcl.data.open import open_sequence
from vestcl.data.sample import Clip, Sample

#: A recorder's: frames 4 and 5 are missing, and one comes late.
GAPS = [0.0, 0.1, 0.2, 0.3, 0.6, 0.7, 0.85, 0.9, 1.0]


def clip(seconds: list[float] | list[None]) -> Clip:
    image, K = np.zeros((3, 2, 2)), np.eye(3)
    named = enumerate(seconds)
    return Clip("made", "arrays", tuple(Sample.from_arrays(f"{i}", image, K, timestamp=t) for i, t in named))


@pytest.mark.parametrize("start", [0.0, 1.7e9])
@pytest.mark.parametrize("interval", [0.1, 1 / 17, 1 / 30, 0.5])
def test_even_frames_are_whole_intervals_apart(start: float, interval: float) -> None:
    """Exactly, although times are rounded to 1 ms, as Matroska's are."""
    seconds = start + np.round(np.arange(50) * interval, 3)
    found = times.median_interval(seconds)
    assert found == pytest.approx(interval, abs=3e-5)
    assert np.array_equal(times.positions(seconds, found), np.arange(50))


def test_clocks_that_jitter_count_as_even() -> None:
    """KITTI's, by 0.5 %."""
    seconds = np.cumsum(np.random.default_rng(0).uniform(0.1031, 0.1043, 40))
    assert np.array_equal(clip(seconds.tolist()).positions, np.arange(40))


def test_gaps_by_hand() -> None:
    made = clip(GAPS)
    assert made.interval == pytest.approx(0.1) and made.fps == 10
    assert made.positions == pytest.approx([0, 1, 2, 3, 6, 7, 8.5, 9, 10])
    assert [made.elapsed(i) for i in (0, 1, 4, 6, 7)] == pytest.approx([1, 1, 3, 1.5, 0.5])
    assert made.after(1, 4) == [2, 3]
    assert made.after(3, 2) == []
    assert made.after(4, 5) == [5]
    assert made.after(5, 5) == []
    assert made.after(7, 3) == [8]
    assert [made.is_whole(1, steps) for steps in (1, 2, 3)] == [True, True, False]


def test_a_clip_without_timestamps_is_evenly_spaced() -> None:
    made = clip([None] * 4)
    assert made.interval is None and made.fps is None
    assert made.positions.tolist() == [0, 1, 2, 3] and made.elapsed(2) == 1 and made.after(1, 5) == [2, 3]


@pytest.mark.parametrize(
    ("seconds", "message"),
    [
        (
            [0.0, 0.2, 0.1],
            "made: the time of frame 2, 0.1 s, steps back from that of frame 1, 0.2 s; times must increase",
        ),
        ([0.0, 0.1, 0.1], "made: the time of frame 2, 0.1 s, repeats that of frame 1, 0.1 s; times must increase"),
        ([0.0, float("nan"), 0.2], "made: the time of frame 1 must be finite, got nan"),
        ([0.0, None, 0.2], "made: frame 1 must have a timestamp, as others do; got none"),
    ],
)
def test_times_that_cannot_be(seconds: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        _ = clip(seconds).positions


def test_networks_of_another_interval() -> None:
    assert [times.is_same(1 / hertz, 0.1) for hertz in (10, 9, 12, 17, 25, 5)] == [
        True,
        True,
        True,
        False,
        False,
        False,
    ]


# ---------------------------------------------------------------- files


def folder(tmp_path: Path) -> Path:
    return test_data_folder.folder(tmp_path) / "times.txt"


def odometry(tmp_path: Path) -> Path:
    return test_data_kitti_odometry.tree(tmp_path) / "times.txt"


def raw(tmp_path: Path) -> Path:
    return test_data_kitti_raw.drive(tmp_path) / "image_02" / "timestamps.txt"


def written(path: Path, seconds: list[float | None]) -> None:
    """A line per time; None is a blank one."""
    stamp = "{:.6f}" if path.name == "times.txt" else "2011-09-26 13:02:{:09.6f}000"
    path.write_text("".join("\n" if second is None else stamp.format(second) + "\n" for second in seconds))


def opened(path: Path) -> Clip:
    return open_sequence(path.parent if path.name == "times.txt" else path.parents[1])


READERS = pytest.mark.parametrize("reader", [folder, odometry, raw])


@READERS
def test_gaps_in_files(reader: Callable[[Path], Path], tmp_path: Path) -> None:
    path = reader(tmp_path)
    count = len(opened(path))
    written(path, [5.0, 5.1, *(5.4 + i / 10 for i in range(count - 2)), None, None])  # blank lines at the end are none
    assert opened(path)[2].timestamp - opened(path)[0].timestamp == pytest.approx(0.4)
    assert opened(path).elapsed(2) > 1.4


@READERS
@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, None, 0.1, 0.2, 0.3, 0.4], r"line 2.*blank|none in line 2"),
        ([None, 0.0, 0.1, 0.2, 0.3, 0.4], r"line 1.*blank|none in line 1"),
        ([0.0, 0.2, 0.1, 0.3], r"the time of line 3, 0\.1 s, steps back from that of line 2, 0\.2 s"),
        ([0.0, 0.1, 0.1, 0.3], r"the time of line 3, 0\.1 s, repeats that of line 2, 0\.1 s"),
    ],
)
def test_lines_that_shift_or_do_not_increase(
    reader: Callable[[Path], Path], times: list[float | None], message: str, tmp_path: Path
) -> None:
    path = reader(tmp_path)
    extra = len([time for time in times if time is None])
    written(path, times[: len(opened(path)) + extra])
    with pytest.raises(ValueError, match=rf"{path.name}: .*({message})"):
        opened(path)


def test_a_blank_line_does_not_shift_poses(tmp_path: Path) -> None:
    path = odometry(tmp_path)
    poses = path.parents[2] / "poses" / "03.txt"
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join([lines[0], "", *lines[1:]]) + "\n")
    with pytest.raises(ValueError, match=r"03\.txt: line 2 is blank; it must have what belongs to frame 1"):
        opened(path)


@pytest.mark.parametrize(
    ("seconds", "interval", "steps"),
    [(0.5, 0.1, 5), (0.5, 1 / 30, 15), (0.5, 1 / 17, 9), (0.25, 0.1, 3), (0.35, 0.1, 4), (0.05, 0.1, 1), (2.0, 1.0, 2)],
)
def test_steps_of_a_time_ahead(seconds: float, interval: float, steps: int) -> None:
    """To the nearest; a half upwards."""
    assert times.steps_ahead(seconds, interval, "clip") == steps


@pytest.mark.parametrize(
    ("seconds", "interval", "message"),
    [
        (0.04, 0.1, r"clip: has a frame every 0\.1 s; `seconds` must be half of it or more, got 0\.04"),
        (0.0, 0.1, "`seconds` must be positive, got 0"),
        (-1.0, 0.1, "`seconds` must be positive"),
        (float("nan"), 0.1, "`seconds` must be positive"),
        (0.5, None, "clip: has no times, so that `seconds` can't be counted in frames; give `steps`"),
    ],
)
def test_a_time_ahead_that_is_no_steps(seconds: float, interval: float | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        times.steps_ahead(seconds, interval, "clip")

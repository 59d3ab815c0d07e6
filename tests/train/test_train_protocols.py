"""train.evaluation.protocols: windows by hand, and window counts on trees in the data sets' own layouts."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest
from data_files import noise_image
from kitti_trees import calibration

from train.evaluation.protocols import HELD_OUT, NOW, PROTOCOLS, Name, Where, currents
from train.evaluation.windows import PART_WINDOWS, ShardPart, plan
from vestcl.bench.forecast.bench import HELD_OUT as BENCH_HELD_OUT
from vestcl.data.readers.splits import KITTI_PREDICTION_TEST, KITTI_VIEWS_TEST, KITTI_VIEWS_VAL, windows
from vestcl.evaluation.tables import METRICS
from vestcl.io import write_pixels

#: Frames of the synced test drives, as KITTI raw's release has them.
TEST_FRAMES = {"0060": 78, "0084": 383, "0093": 433, "0096": 475}

#: Snippets of Cityscapes' val. It has three cities; opening a snippet lists its city, so more of them test faster.
SNIPPETS, CITIES = 500, [f"city-{letter}" for letter in "abcdefghijklmnopqrstuvwxy"]


def empty_drives(root: Path, frames: Mapping[str, int]) -> Path:
    """Drives whose first images are tiny and whose others are empty: who opens them reads no more."""
    calibration(root)
    for number, count in frames.items():
        for camera in ("02", "03"):
            folder = root / "2011_09_26" / f"2011_09_26_drive_{number}_sync" / f"image_{camera}" / "data"
            write_pixels(folder / f"{0:010}.png", noise_image(10, 33))
            for index in range(1, count):
                (folder / f"{index:010}.png").touch()
    return root


def parts_of(name: Name, data: Path | None, every: int = 1, seeds: range = HELD_OUT) -> list[ShardPart]:
    protocol = PROTOCOLS[name]
    where = Where(data, seeds, protocol.size, 1 + (protocol.last or 1) + protocol.steps, 1)
    return plan(protocol.sources(where), protocol, protocol.steps, every, Path("kept"), "key")


def count(parts: list[ShardPart]) -> int:
    return sum(len(part.indices) for part in parts)


def test_windows_by_hand() -> None:
    assert list(currents(9, 5, 3)) == [3]
    assert list(currents(11, 5, 3)) == [3, 4, 5]
    assert list(currents(8, 5, 3)) == []
    assert list(currents(30, 10, None)) == [19]
    assert list(currents(12, 5, 2, 4)) == [2, 3, 4]
    assert list(currents(6, 5, None)) == [] and list(currents(7, 5, None)) == [1]


@pytest.mark.parametrize(("steps", "first"), [(0, 3), (5, 0)])
def test_windows_need_a_frame_before_and_after(steps: int, first: int) -> None:
    with pytest.raises(ValueError, match="`steps` and `first` must be 1 or more"):
        currents(20, steps, first)


def test_they_are_the_windows_of_the_split() -> None:
    assert [window.context[-1] for window in windows(20)] == list(currents(20, 5, PROTOCOLS["kitti-prediction"].first))


@pytest.mark.parametrize("name", ["kitti-prediction", "kitti-space-time"])
def test_windows_of_the_kitti_test_drives(tmp_path: Path, name: Name) -> None:
    parts = parts_of(name, empty_drives(tmp_path, TEST_FRAMES))
    assert count(parts) == sum(frames - 8 for frames in TEST_FRAMES.values()) == 1337
    assert {part.source.name for part in parts} == set(KITTI_PREDICTION_TEST)
    assert parts[0].indices[0] == 3 and parts[-1].indices[-1] == TEST_FRAMES["0096"] - 6
    assert max(len(part.indices) for part in parts) == PART_WINDOWS
    assert len({part.file for part in parts}) == len(parts)


def test_every_counts_through_all_clips(tmp_path: Path) -> None:
    data = empty_drives(tmp_path, {"0060": 12, "0084": 12, "0093": 12, "0096": 12})
    parts = parts_of("kitti-prediction", data, every=3)
    assert [part.indices for part in parts] == [(3, 6), (5,), (4,), (3, 6)]


def test_drives_of_the_pair_in_space_and_in_time(tmp_path: Path) -> None:
    frames = {"0001": 108, "0057": 9, "0084": 10, "0106": 12}
    parts = parts_of("kitti-space", empty_drives(tmp_path, frames))
    assert {part.source.name for part in parts} == set(KITTI_VIEWS_TEST)
    assert count(parts) == sum(n - 8 for n in frames.values())


def test_missing_drives_are_reported(tmp_path: Path) -> None:
    empty_drives(tmp_path, {"0060": 9, "0093": 9})
    with pytest.raises(ValueError, match="without 2011_09_26_drive_0084_sync, 2011_09_26_drive_0096_sync"):
        parts_of("kitti-prediction", tmp_path)
    with pytest.raises(ValueError, match="`data` must be a folder"):
        parts_of("kitti-prediction", None)


def test_clips_without_a_window_are_reported(tmp_path: Path) -> None:
    data = empty_drives(tmp_path, {"0060": 9, "0084": 9, "0093": 8, "0096": 9})
    with pytest.raises(ValueError, match=r"0093_sync: must have 9 frames and a window .* without a gap, got 8"):
        parts_of("kitti-prediction", data)


def test_snippets_of_cityscapes_val(tmp_path: Path) -> None:
    camera = {"intrinsic": {"fx": 2262.5, "fy": 2265.3, "u0": 1096.9, "v0": 513.1}, "extrinsic": {"baseline": 0.2093}}
    write_pixels(tmp_path / "tiny.png", noise_image(4, 8))
    tiny, reported = (tmp_path / "tiny.png").read_bytes(), json.dumps(camera)
    for city in CITIES:
        folders = [tmp_path / kind / "val" / city for kind in ("leftImg8bit_sequence", "camera")]
        for folder in folders:
            folder.mkdir(parents=True)
        for sequence in range(SNIPPETS // len(CITIES)):
            stem = f"{city}_{sequence:06}"
            (folders[1] / f"{stem}_000019_camera.json").write_text(reported, encoding="utf-8")
            (folders[0] / f"{stem}_000000_leftImg8bit.png").write_bytes(tiny)
            for frame in range(1, 30):
                (folders[0] / f"{stem}_{frame:06}_leftImg8bit.png").touch()
    parts = parts_of("cityscapes-prediction", tmp_path)
    assert count(parts) == len(parts) == SNIPPETS
    assert {part.indices for part in parts} == {(19,)}  # the annotated frame, with ten after it
    assert len({part.source.name for part in parts}) == SNIPPETS


def test_no_snippets_are_reported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="leftImg8bit_sequence/val/CITY"):
        parts_of("cityscapes-prediction", tmp_path)


def test_streets_are_held_out() -> None:
    parts = parts_of("street", None)
    assert [part.source.name for part in parts] == [f"street {seed}" for seed in HELD_OUT]
    assert {part.indices for part in parts} == {(2,)} and count(parts) == len(HELD_OUT)
    assert not set(HELD_OUT) & set(BENCH_HELD_OUT)


def test_the_papers_ssim_has_several_scales() -> None:
    """But for the right camera's image at t, where it follows VEST-MPI."""
    for protocol in PROTOCOLS.values():
        for row in protocol.paper:
            assert row.metric in ("lpips", "ssim" if row.view == NOW else "ms_ssim")
    rows = {row.method[:12]: row.values for row in PROTOCOLS["kitti-space-time"].paper if row.metric == "ms_ssim"}
    assert [rows[name][1] for name in ("the paper", "the paper, B", "the paper, C", "the paper, A")] == [
        0.862, 0.856, 0.846, 0.832,
    ]  # fmt: skip


def test_validation_drives_of_novel_views(tmp_path: Path) -> None:
    frames = {"0009": 9, "0017": 9, "0048": 9, "0117": 9}
    parts = parts_of("kitti-space-val", empty_drives(tmp_path, frames))
    assert {part.source.name for part in parts} == set(KITTI_VIEWS_VAL) and not PROTOCOLS["kitti-space-val"].paper


def test_the_papers_rows_are_of_what_is_measured() -> None:
    for protocol in PROTOCOLS.values():
        views = {*protocol.views, *([NOW] if protocol.now else [])}
        for row in protocol.paper:
            assert row.view in views and row.metric in METRICS
            assert set(row.values) == ({0} if row.view == NOW else set(protocol.shown))
            assert all(0 < value < 1 for value in row.values.values())


def test_the_papers_sizes_horizons_and_figures() -> None:
    """All of its tables, x 10^-2, by protocol, row and metric."""
    kitti, cityscapes = ((256, 832), 5, (1, 3, 5), 3), ((512, 1024), 10, (1, 5, 10), None)
    settings = {name: (p.size, p.steps, p.shown, p.first) for name, p in PROTOCOLS.items() if p.paper}
    assert settings == {
        "kitti-prediction": kitti, "kitti-space-time": kitti, "kitti-space": kitti, "cityscapes-prediction": cityscapes,
    }  # fmt: skip
    views = {name: p.views for name, p in PROTOCOLS.items() if p.paper}
    assert views.pop("kitti-space-time") == ("right",) and set(views.values()) == {("source",)}
    figures = {
        "kitti-prediction": [("the paper", "87.7 77.6 71.3", "10.1 15.4 19.8")],
        "kitti-space-time": [
            ("the paper", "86.2 76.1 69.3", "12.3 17.1 21.4"),
            ("the paper, A: fixed depth", "83.2 73.1 66.4", "15.1 20.2 25.8"),
            ("the paper, B: without EMF", "85.6 75.5 68.4", "12.9 18.1 22.4"),
            ("the paper, C: without OMF", "84.6 74.8 67.9", "13.5 19.1 24.3"),
        ],
        "kitti-space": [("the paper, space", "94.6", "5.2"), ("the paper, time", "", "8.1 18.6 20.4")],
        "cityscapes-prediction": [("the paper", "96.4 86.2 78.0", "4.6 9.8 14.9")],
    }
    for name, rows in figures.items():
        wanted = {
            (method, metric): numbers
            for method, *both in rows
            for metric, numbers in zip(("ssim", "lpips"), both, strict=True)
            if numbers
        }
        found = {
            (row.method, row.metric.removeprefix("ms_")): " ".join(
                f"{100 * value:.1f}" for value in row.values.values()
            )
            for row in PROTOCOLS[name].paper  # type: ignore[index]
        }
        assert found == wanted

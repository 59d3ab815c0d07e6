"""A clip's cache: what is computed again and what is not, whatever has changed and whenever it was killed."""

import dataclasses
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prepare_scenes import (
    FRAMES,
    HEIGHT,
    WIDTH,
    contents,
    options,
    prepare,
    run,
    settings_for,
    until,
    write_drive,
)

from vestcl.cli import prepare as prepare_command
from vestcl.data import calibration
from vestcl.data.open import open_sequence
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import ImageArray
from vestcl.io.images import read_pixels, to_pixels, write_pixels
from vestcl.io.video.writing import write_mp4
from vestcl.prepare import clip as prepare_clip
from vestcl.prepare.clip import frame_keys
from vestcl.prepare.files import frame_path
from vestcl.prepare.prepared import PreparedClip, find_prepared
from vestcl.scene.estimators import with_estimates
from vestcl.scene.perception import Perception


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_drive(tmp_path / "drive")


# ---------------------------------------------------------------- keys


def clip_of(images: np.ndarray, **changes: Any) -> Clip:
    """Frames of 3 x 4 pixels, with depth and classes."""
    depth, train_ids = np.full((1, 3, 4), 5.0), np.zeros((1, 3, 4), np.uint8)
    K = calibration.intrinsics(4, 4, 2, 1)
    facts = {"K": K, "depth": depth, "train_ids": train_ids, **changes}
    return Clip("any", "arrays", tuple(Sample.from_arrays(str(i), image, **facts) for i, image in enumerate(images)))


def differ(before: list[str], after: list[str]) -> list[int]:
    return [index for index, (old, new) in enumerate(zip(before, after, strict=True)) if old != new]


def test_a_pixel_changes_the_keys_of_the_frames_that_see_it() -> None:
    images = np.random.default_rng(0).random((8, 3, 3, 4), np.float32)
    before = frame_keys(clip_of(images))
    assert len(set(before)) == 8
    assert differ(before, frame_keys(clip_of(images.copy()))) == []
    for frame, seen_by in ((7, [7]), (3, [3, 4, 5, 6]), (1, [0, 1, 2, 3, 4]), (0, [0, 1, 2, 3])):
        after = images.copy()
        after[frame, 2, 1, 3] = np.nextafter(after[frame, 2, 1, 3], np.float32(2))
        assert differ(before, frame_keys(clip_of(after))) == seen_by


@pytest.mark.parametrize(
    "changes",
    [
        {"K": calibration.intrinsics(4, 4, 2, 1.5)},
        {"depth": np.full((1, 3, 4), 5.5)},
        {"depth": None},
        {"train_ids": np.full((1, 3, 4), 10, np.uint8)},
        {"train_ids": None},
    ],
)
def test_all_that_perception_reads_is_in_the_key(changes: dict[str, Any]) -> None:
    images = np.zeros((2, 3, 3, 4), np.float32)
    assert differ(frame_keys(clip_of(images)), frame_keys(clip_of(images, **changes))) == [0, 1]


def test_what_it_does_not_read_is_not() -> None:
    images = np.zeros((2, 3, 3, 4), np.float32)
    elsewhere = clip_of(images, world_from_cam=calibration.translation((1, 2, 3)))
    assert differ(frame_keys(clip_of(images)), frame_keys(elsewhere)) == []


def test_recipe_size_and_estimators_are_in_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    clip = clip_of(np.zeros((2, 3, 3, 4), np.float32))
    before = frame_keys(clip)
    assert differ(before, frame_keys(clip.resized(6, 8))) == [0, 1]
    assert differ(before, frame_keys(clip, "a network")) == [0, 1]
    monkeypatch.setattr(prepare_clip, "RECIPE", "another")
    assert differ(before, frame_keys(clip)) == [0, 1]


def test_the_right_camera_is_in_the_key() -> None:
    clip = clip_of(np.zeros((2, 3, 3, 4), np.float32))
    pictures = (np.zeros((3, 3, 4), np.float32), np.ones((3, 3, 4), np.float32))

    def keys(picture: np.ndarray, baseline: float) -> list[str]:
        right = RightCamera(ImageArray(picture), clip[0].K, calibration.translation((-baseline, 0, 0)))
        return frame_keys(dataclasses.replace(clip, samples=tuple(dataclasses.replace(s, right=right) for s in clip)))

    assert len({tuple(frame_keys(clip)), *(tuple(keys(p, b)) for p in pictures for b in (0.5, 0.6))}) == 5


def test_what_an_estimator_keeps_is_not_in_the_key() -> None:
    clip = with_estimates(clip_of(np.zeros((2, 3, 3, 4), np.float32)), depth=lambda image: image[:1] + 3)
    before = frame_keys(clip)
    assert clip[0].read_depth()[0, 0, 0] == 3
    assert frame_keys(clip) == before


def test_a_video_counts_by_its_content(tmp_path: Path) -> None:
    pictures = np.random.default_rng(0).integers(0, 256, (4, 32, 48, 3), np.uint8)
    keys = []
    for name, frames in (("a", pictures), ("b", pictures), ("c", pictures[::-1])):
        write_mp4(tmp_path / f"{name}.mp4", list(frames), 10.0)
        keys.append(frame_keys(open_sequence(tmp_path / f"{name}.mp4", fov=60)))
    assert keys[0] == keys[1] and not set(keys[0]) & set(keys[2]) and len(set(keys[0])) == 4


def test_files_count_by_their_content(folder: Path, tmp_path: Path) -> None:
    before = frame_keys(prepare_command.open_input(str(folder), settings_for(folder)))
    moved = folder.rename(tmp_path / "elsewhere")
    assert frame_keys(prepare_command.open_input(str(moved), settings_for(moved))) == before
    for what in ("image", "metres", "classes"):
        path = max((moved / what).iterdir())
        pixels = read_pixels(path)
        pixels[3, 5] ^= 1
        write_pixels(path, pixels)
        after = frame_keys(prepare_command.open_input(str(moved), settings_for(moved)))
        assert differ(before, after) == [FRAMES - 1]
        before = after


def test_no_frame_is_computed_from_more_than_its_key_covers(folder: Path) -> None:
    """A monocular clip is where perception looks furthest."""
    clip = prepare_command.open_input(str(folder), options())
    for index in range(FRAMES + 2):
        seen: set[int] = set()

        class Watched(Clip):
            def __getitem__(self, key: Any, seen: set[int] = seen) -> Any:
                seen.add(key)
                return self.samples[key]

        repeated = enumerate((clip.samples[0], *clip.samples, clip.samples[-1]))
        samples = tuple(dataclasses.replace(sample, timestamp=i / 10) for i, sample in repeated)
        Perception(Watched(clip.name, clip.kind, samples)).seen(index)
        assert seen == ({0, 1} if index == 0 else set(range(max(index - prepare_clip.LOOKS_BACK, 0), index + 1)))


# ---------------------------------------------------------------- what is computed, and what is kept


def test_a_second_run_computes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = options("street:5", out=tmp_path)
    assert run(settings, capsys) == (FRAMES, 0)
    before = contents(tmp_path)
    assert run(settings, capsys) == (0, FRAMES)
    assert contents(tmp_path) == before
    assert run(dataclasses.replace(settings, frames=FRAMES + 1), capsys) == (1, FRAMES)
    assert len(find_prepared(tmp_path)[0]) == FRAMES + 1
    assert run(settings, capsys) == (0, FRAMES)
    assert contents(tmp_path) == before


def test_deleted_truncated_and_damaged_frames_are_computed_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings, folder = options("street:5", out=tmp_path), tmp_path / f"street_5-{HEIGHT}x{WIDTH}"
    run(settings, capsys)
    before = contents(tmp_path)
    frame_path(folder, 0).unlink()
    frame_path(folder, 1).write_bytes(frame_path(folder, 1).read_bytes()[:-1])
    content = bytearray(frame_path(folder, 3).read_bytes())
    content[-1] ^= 1
    frame_path(folder, 3).write_bytes(content)
    (folder / ".000002.1-abcd.safetensors").write_bytes(b"half")
    assert run(settings, capsys) == (3, 1)
    assert contents(tmp_path) == before
    (folder / "clip.json").unlink()
    assert run(settings, capsys) == (0, FRAMES)
    assert contents(tmp_path) == before


def test_changed_files_are_computed_again_next_to_the_data_set(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(settings_for(folder), capsys) == (FRAMES, 0)
    (clip,) = find_prepared(folder)
    assert clip.folder == folder / ".vestcl" / f"drive-{HEIGHT}x{WIDTH}" and clip.kind == "folder"
    path = max((folder / "image").iterdir())
    write_pixels(path, read_pixels(path)[::-1])
    assert run(settings_for(folder), capsys) == (1, FRAMES - 1)
    np.testing.assert_array_equal(to_pixels(PreparedClip.open(clip.folder).image(FRAMES - 1)), read_pixels(path))
    with pytest.raises(ValueError, match=r"was computed from other frames than clip.json lists"):
        clip.image(FRAMES - 1)  # as it was opened before


def test_killed_at_any_moment_it_continues(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = options("street:5", out=tmp_path / "cache")
    folder = tmp_path / "cache" / f"street_5-{HEIGHT}x{WIDTH}"
    for wanted in (1, 3):  # frames that are there when it is killed
        process = prepare(tmp_path / "log", "street:5", "--out", str(settings.out))
        until(frame_path(folder, wanted - 1).exists)
        process.kill()
        assert process.wait() == -signal.SIGKILL
        assert not (folder / "clip.json").exists()
        with pytest.raises(ValueError, match="has no prepared clip"):
            find_prepared(tmp_path)
    computed, kept = run(settings, capsys)
    assert kept >= 3 and computed + kept == FRAMES
    run(dataclasses.replace(settings, out=tmp_path / "whole"), capsys)
    assert contents(tmp_path / "cache") == contents(tmp_path / "whole")

"""vestcl.scene.perception: what is seen on a street, where it comes from, and what is kept how long."""

import itertools
import logging
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometric_scenes import HEIGHT, WIDTH, drive

from vestcl.constants import SKY_DEPTH
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import DepthArray, DepthFile, ImageArray
from vestcl.forecasting.geometric.forecast import forecast_frames, input_notes
from vestcl.forecasting.result import View
from vestcl.scene.perception import Perception

#: A frame with another on either side.
FRAME = 2


@dataclass(frozen=True)
class Counted:
    """A source that says when it is read."""

    source: Any
    read_one: Any

    @property
    def height(self) -> int:
        return self.source.height

    @property
    def width(self) -> int:
        return self.source.width

    def read(self) -> Any:
        self.read_one()
        return self.source.read()


def counted(clip: Clip, counts: Counter[str], *names: str) -> Clip:
    """Every read of these parts counts as "image 3"."""

    def wrapped(sample: Sample, index: int) -> dict[str, Any]:
        return {n: Counted(getattr(sample, n), lambda n=n: counts.update([f"{n} {index}"])) for n in names}

    return replace(clip, samples=tuple(replace(s, **wrapped(s, i)) for i, s in enumerate(clip)))


def without(clip: Clip, *names: str) -> Clip:
    """The same clip without depth, labels or a right camera."""
    nothing: dict[str, Any] = dict.fromkeys(names)
    return replace(clip, samples=tuple(replace(sample, **nothing) for sample in clip))


def relative_error(depth: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Up to 40 m."""
    near = (depth > 0) & (truth < 40)
    return np.abs(depth[near] / truth[near] - 1)


# ---------------------------------------------------------------- what is seen


def test_a_frame_of_the_street() -> None:
    clip = drive(4).clip
    perception, sample = Perception(clip), clip[FRAME]
    seen, instances = perception.seen(FRAME), perception.moving(FRAME).instances
    layers, labels = seen.layers, sample.read_labels()
    assert np.array_equal(layers.image, sample.read_image())
    assert np.array_equal(layers.mask, sample.read_mask()) and not seen.own.any()
    assert (layers.depth > 0).all() and (layers.background_depth >= layers.depth).all()
    assert (layers.depth[labels == 10] == SKY_DEPTH).all() and (labels == 10).any()
    assert np.median(relative_error(layers.depth, sample.read_depth())) < 0.01
    assert instances.shape == (HEIGHT, WIDTH) and instances.max() > 3
    assert not instances[layers.mask[0]].any()


def test_the_first_frame_has_no_motion() -> None:
    seen = Perception(drive(4).clip).seen(0)
    assert not seen.velocity.any() and seen.velocity.shape == (3, HEIGHT, WIDTH)
    assert np.array_equal(Perception(without(drive(4).clip, "labels")).mask(0), np.ones((1, HEIGHT, WIDTH), bool))


def test_own_motion_is_as_the_street_drives() -> None:
    clip = drive(4).clip
    cur, prev = clip[FRAME].world_from_cam, clip[FRAME - 1].world_from_cam
    assert cur is not None and prev is not None
    found, truth = Perception(clip).prev_from_cur(FRAME), np.linalg.inv(prev) @ cur
    assert truth[2, 3] > 0.5
    np.testing.assert_allclose(found, truth, atol=0.02)


def test_depth_is_the_clips_own() -> None:
    clip = drive(4).clip
    assert np.array_equal(Perception(clip).raw_depth(FRAME), clip[FRAME].read_depth())


def test_a_scan_is_densified() -> None:
    """One pixel in 20, as of a laser."""
    clip = drive(4).clip
    truth = clip[FRAME].read_depth()
    scan = np.where(np.random.default_rng(0).random(truth.shape) < 0.05, truth, np.float32(0))
    sparse = replace(clip, samples=(*clip[:FRAME], replace(clip[FRAME], depth=DepthArray(scan)), *clip[FRAME + 1 :]))
    depth = Perception(sparse).raw_depth(FRAME)
    assert (depth > 0).all() and np.median(relative_error(depth, truth)) < 0.05


def test_a_pair_gives_depth_where_the_clip_has_none() -> None:
    clip = drive(4, samples=2).clip
    depth = Perception(without(clip, "depth")).raw_depth(FRAME)
    assert (depth > 0).mean() > 0.6 and (depth == 0).any()
    assert np.median(relative_error(depth, clip[FRAME].read_depth())) < 0.05


def test_of_a_pair_depth_is_as_good_as_its_disparity() -> None:
    """0.35 px over f b."""
    clip = drive(4).clip
    expected = 0.35 / (clip[0].K[0, 0] * 0.54)
    assert Perception(without(clip, "depth")).inverse_std(0) == pytest.approx(expected)
    assert Perception(clip).inverse_std(0) == Perception(without(clip, "depth", "right")).inverse_std(0)


def test_without_labels_motion_makes_the_mask() -> None:
    """Much of an oncoming car at 10 m is foreground, and little of what is static."""
    passing = drive(0, start=1.3, samples=2)
    mask, moving = Perception(without(passing.clip, "labels")).mask(3), passing.moving(3)
    assert mask.dtype == np.bool_ and moving.mean() > 0.05
    assert (~mask[0][moving]).mean() > 0.4 > 0.03 > (~mask[0][~moving]).mean()


def test_masks_of_a_clip_are_from_one_source() -> None:
    """Cityscapes labels one frame of 30: M(t) from its labels and M(t-1) from motion would be of different objects."""
    clip = drive(4).clip
    some = tuple(replace(s, labels=s.labels if i == FRAME else None) for i, s in enumerate(clip))
    partly, blind = Perception(replace(clip, samples=some)), Perception(without(clip, "labels"))
    for index in (FRAME - 1, FRAME):
        assert np.array_equal(partly.mask(index), blind.mask(index))
    assert np.array_equal(partly.prev_from_cur(FRAME), blind.prev_from_cur(FRAME))
    assert np.array_equal(partly.seen(FRAME).layers.depth, blind.seen(FRAME).layers.depth)  # the sky, too
    assert not np.array_equal(partly.mask(FRAME), Perception(clip).mask(FRAME))
    assert input_notes(partly, FRAME) == ("1 of 8 frames have labels: masks of all are from motion",)
    assert input_notes(blind, FRAME) == input_notes(Perception(clip), FRAME) == ()


def test_the_background_is_inpainted_as_asked() -> None:
    clip = drive(4).clip

    def white(colour: np.ndarray, hole: np.ndarray, road: np.ndarray) -> np.ndarray:
        return np.ones_like(colour)

    layers = Perception(clip, inpaint=white).seen(FRAME).layers
    assert (layers.background_image[:, ~layers.mask[0]] == 1).all()
    assert np.array_equal(Perception(clip, inpaint="telea").mask(FRAME), layers.mask)
    with pytest.raises(ValueError, match="`method` must be one of"):
        Perception(clip, inpaint="paint")


def test_what_rides_along_is_background() -> None:
    bonnet = np.zeros((1, HEIGHT, WIDTH), bool)
    bonnet[:, 80:, 100:220] = True
    clip = drive(4).clip
    riding = SimpleNamespace(read=lambda: bonnet)
    seen = Perception(replace(clip, samples=tuple(replace(s, ego_vehicle=riding) for s in clip))).seen(FRAME)
    assert np.array_equal(seen.own, bonnet)
    blind = without(replace(clip, samples=tuple(replace(s, ego_vehicle=riding) for s in clip)), "labels")
    assert Perception(blind).mask(FRAME)[bonnet].all()


# ---------------------------------------------------------------- what is kept


def test_everything_is_computed_once() -> None:
    counts: Counter[str] = Counter()
    stages: list[str] = []
    perception = Perception(counted(drive(4).clip, counts, "image", "depth"), stages.append)
    first = perception.seen(FRAME)
    again = perception.seen(FRAME)
    assert again is first
    assert counts == {f"{name} {index}": 1 for name in ("image", "depth") for index in (FRAME - 1, FRAME)}
    assert Counter(stages) == {"layers": 1, "mask": 1, "depth": 2, "flow": 1, "read": 2, "ego-motion": 1}
    perception.seen(FRAME + 1)
    assert counts[f"image {FRAME}"] == counts[f"depth {FRAME}"] == 1


def test_a_forecast_inpaints_only_the_current_frame() -> None:
    """Earlier frames are shown as they were seen; their `surface` and `moving` are parts of what `seen` finds."""
    filled: list[np.ndarray] = []

    def fill(colour: np.ndarray, hole: np.ndarray, road: np.ndarray) -> np.ndarray:
        filled.append(colour)
        return colour

    clip = drive(4, frames=8).clip
    perception = Perception(clip, inpaint=fill)
    forecast_frames(perception, 6, 1, [View("source", np.eye(4))])
    assert len(filled) == 1 and np.array_equal(filled[0], perception.image(6))
    whole, parts = Perception(clip).seen(5), Perception(clip)
    surface, moving = parts.surface(5), parts.moving(5)
    for name in ("image", "depth", "mask"):
        assert np.array_equal(getattr(surface, name), getattr(whole.layers, name))
    assert np.array_equal(moving.velocity, whole.velocity)


@dataclass(frozen=True)
class OneBuffer:
    """A source that reads into the same array as all others, as a camera's driver may."""

    source: Any
    buffer: np.ndarray

    @property
    def height(self) -> int:
        return self.source.height

    @property
    def width(self) -> int:
        return self.source.width

    def read(self) -> Any:
        np.copyto(self.buffer, self.source.read())
        return self.buffer


def test_sources_may_read_into_one_buffer() -> None:
    clip = drive(4).clip
    image, depth = np.zeros((3, HEIGHT, WIDTH), np.float32), np.zeros((1, HEIGHT, WIDTH), np.float32)
    samples = (replace(s, image=OneBuffer(s.image, image), depth=OneBuffer(s.depth, depth)) for s in clip)
    shared, own = Perception(replace(clip, samples=tuple(samples))), Perception(clip)
    for index in (FRAME - 1, FRAME):
        got, wanted = shared.seen(index).layers, own.seen(index).layers
        for name in ("image", "depth", "mask", "background_image", "background_depth"):
            assert np.array_equal(getattr(got, name), getattr(wanted, name))
        assert np.array_equal(shared.prev_from_cur(index), own.prev_from_cur(index))


def test_threads_share_what_is_computed_once() -> None:
    counts: Counter[str] = Counter()
    perception = Perception(counted(drive(4).clip, counts, "image", "depth"))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(perception.seen, [FRAME, FRAME + 1] * 4))
    assert all(one is found[index % 2] for index, one in enumerate(found))
    assert set(counts.values()) == {1}


def test_old_frames_are_forgotten_and_recent_ones_are_not() -> None:
    counts: Counter[str] = Counter()
    perception = Perception(counted(drive(4, frames=10).clip, counts, "image"))
    for index in (*range(10), 7, 0):
        perception.image(index)
    assert counts["image 7"] == 1 and counts["image 0"] == 2


def test_a_long_drive_keeps_a_bounded_number_of_frames() -> None:
    clip = drive(4).clip
    endless = replace(clip, samples=tuple(itertools.islice(itertools.cycle(clip), 40)))
    kept = []
    perception = Perception(endless)
    for index in range(40):
        perception.image(index)
        kept.append(sum(isinstance(value, np.ndarray) for value in perception._kept.values()))
    assert max(kept) == kept[-1] <= 8


def test_seconds_are_exclusive(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that only reading moves: an image takes 1 s, a depth 10 s, and nothing is counted twice."""
    clock = [0.0]

    def slow(sample: Sample, name: str, seconds: float) -> Counted:
        return Counted(getattr(sample, name), lambda: clock.__setitem__(0, clock[0] + seconds))

    clip = drive(4).clip
    samples = (replace(s, image=slow(s, "image", 1), depth=slow(s, "depth", 10)) for s in clip)
    fake_time = SimpleNamespace(perf_counter=lambda: clock[0], perf_counter_ns=lambda: 0, process_time=lambda: 0.0)
    monkeypatch.setattr("vestcl.clock.time", fake_time)
    perception = Perception(replace(clip, samples=tuple(samples)))
    perception.seen(FRAME)
    taken = {stage: seconds for stage, seconds in perception.seconds.items() if seconds}
    assert taken == {"read": 2, "depth": 20}
    assert set(perception.seconds) == {"read", "depth", "flow", "ego-motion", "mask", "layers"}


def test_seconds_add_up_to_what_it_took() -> None:
    perception = Perception(drive(4).clip)
    start = time.perf_counter()
    perception.seen(FRAME)
    taken = time.perf_counter() - start
    assert 0.9 * taken < sum(perception.seconds.values()) <= taken


# ---------------------------------------------------------------- what can't be seen


def test_no_depth_and_no_second_camera_takes_motion() -> None:
    clip = without(drive(4).clip, "depth", "right")
    depth, truth = Perception(clip).raw_depth(FRAME), drive(4).clip[FRAME].read_depth()
    near = truth < 40  # its shape; test_scene_motion_depth.py holds the metres, on larger images
    assert (depth > 0).all() and np.corrcoef(np.log(depth[near]), np.log(truth[near]))[0, 1] > 0.6
    assert Perception(clip).prev_from_cur(FRAME)[2, 3] > 0.3  # the frame before was behind
    assert Perception(clip).raw_depth(0).shape == depth.shape


@pytest.mark.parametrize("pair", [True, False])
def test_a_map_without_a_valid_pixel_is_as_a_missing_one(pair: bool, caplog: pytest.LogCaptureFixture) -> None:
    clip = drive(4).clip if pair else without(drive(4).clip, "right")
    empty = DepthArray(np.zeros((1, HEIGHT, WIDTH), np.float32))
    blind = [replace(s, depth=empty) if i == FRAME else s for i, s in enumerate(clip)]
    missing = [replace(s, depth=None) if i == FRAME else s for i, s in enumerate(clip)]
    given, wanted = (Perception(replace(clip, samples=tuple(samples))) for samples in (blind, missing))
    with caplog.at_level(logging.WARNING):
        assert np.array_equal(given.seen(FRAME).layers.depth, wanted.seen(FRAME).layers.depth)
        assert np.array_equal(given.raw_depth(FRAME - 1), wanted.raw_depth(FRAME - 1))
    instead = "the stereo pair" if pair else "motion"
    said = f"{clip.name}: frame {clip[FRAME].name}: its depth has no valid depth; it comes from {instead}"
    assert caplog.messages == [said] and given.inverse_std(FRAME) == wanted.inverse_std(FRAME)


def test_a_map_without_a_valid_pixel_is_named_by_its_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "scan.npy"
    np.save(path, np.zeros((HEIGHT, WIDTH), np.float32))
    clip = drive(4).clip
    samples = tuple(replace(sample, depth=DepthFile(path)) for sample in clip)
    with caplog.at_level(logging.WARNING):
        Perception(replace(clip, samples=samples)).raw_depth(1)
    assert f"frame {clip[1].name}: {path} has no valid depth; it comes from the stereo pair" in caplog.text


def test_a_right_camera_with_other_intrinsics() -> None:
    """A right image without its first columns and rows, at another scale: the same depth from the pair."""
    clip = without(drive(4).clip, "depth", "labels")
    right = clip[FRAME].right
    assert right is not None
    image = right.read_image()[:, 4:, 10:]
    cut = RightCamera(ImageArray(image), right.K - [[0, 0, 10], [0, 0, 4], [0, 0, 0]], right.right_from_left)
    other = replace(clip, samples=tuple(replace(s, right=cut) if i == FRAME else s for i, s in enumerate(clip)))
    expected, found = (Perception(c).raw_depth(FRAME)[0, 8:, 24:] for c in (clip, other))
    both = (expected > 0) & (found > 0)
    assert both.mean() > 0.5 * (expected > 0).mean()
    assert np.median(np.abs(found[both] / expected[both] - 1)) < 0.02


def test_a_single_frame_has_no_depth() -> None:
    clip = without(drive(4).clip, "depth", "right")[:1]
    with pytest.raises(ValueError, match="needs two frames, a right camera or depth, got only one frame"):
        Perception(clip).raw_depth(0)


def test_the_first_frame_has_none_before_it() -> None:
    """It is not the last one, as Python counts."""
    perception = Perception(drive(4).clip)
    for result in (perception.correspondence, perception.prev_from_cur):
        with pytest.raises(ValueError, match="`index` must be 1"):
            result(0)

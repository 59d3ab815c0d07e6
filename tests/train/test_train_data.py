"""train.data.windows: batches that follow from (seed, step, position) only."""

import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from forecaster_scenes import change
from processes import Process
from test_network_input import MOTIONS, prepared
from torch.nn import functional

from train.data.windows import Batch, Draw, WindowSet, loader
from vestcl import geometry
from vestcl.data import Street, street_clip
from vestcl.forecasting.network.input import last_motions, network_input
from vestcl.models.forecaster import Forecaster
from vestcl.ops.unproject import unproject
from vestcl.prepare.clip import prepare_clip
from vestcl.prepare.prepared import PreparedClip, find_prepared
from vestcl.scene.perceived import PerceivedFrame

HEIGHT, WIDTH, FRAMES = 48, 160, 6

#: Everything that is drawn at random.
VARIED: dict[str, Any] = {
    "horizons": (0.5, 0.3, 0.2), "crop": (24, 80), "scale": (0.6, 1.0), "flip": True, "colour": 0.5, "right": 0.5,
}  # fmt: skip


class FakeClip:
    """Random frames, made when asked for; which were asked for is kept."""

    def __init__(self, frames: int, size: tuple[int, int] = (8, 12), name: str = "fake") -> None:
        self.frames, self.size, self.name, self.touched = frames, size, name, set[int]()

    def __len__(self) -> int:
        return self.frames

    def is_whole(self, index: int, steps: int) -> bool:
        return index + steps < self.frames

    def frame(self, index: int) -> PerceivedFrame:
        self.touched.add(index)
        return prepared(index, MOTIONS[index % 2] if index else None)

    def image(self, index: int) -> np.ndarray:
        return self.frame(index).layers.image

    def right(self, index: int) -> None:
        return None

    def K(self, index: int) -> np.ndarray:  # noqa: N802 - as PreparedClip has it
        return prepared(index, None).K

    def world_from_cam(self, index: int) -> None:
        return None

    def frame_name(self, index: int) -> str:
        return f"{index:03}"


def fakes(*lengths: int, **settings: Any) -> WindowSet:
    return WindowSet(cast(list[PreparedClip], [FakeClip(frames) for frames in lengths]), **settings)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two streets, prepared."""
    folder = tmp_path_factory.mktemp("cache")
    for seed in (3, 5):
        prepare_clip(street_clip(Street.generate(seed), FRAMES, HEIGHT, WIDTH, samples=2), folder / f"street {seed}")
    return folder


@pytest.fixture
def clips(cache: Path) -> list[PreparedClip]:
    return find_prepared(cache)


def leaves(batch: Any) -> Iterator[Any]:
    """Everything that a batch holds, flat."""
    if isinstance(batch, tuple):
        for part in batch:
            yield from leaves(part)
    else:
        yield batch


def assert_same(first: Batch, second: Batch) -> None:
    """The same bits."""
    for one, other in zip(leaves(first), leaves(second), strict=True):
        if isinstance(one, torch.Tensor):
            assert one.dtype == other.dtype and torch.equal(one, other)
        else:
            assert one == other


def rows(batch: Batch, which: slice) -> Iterator[Any]:
    for leaf in leaves(batch._replace(clips=())):
        yield leaf[which] if isinstance(leaf, torch.Tensor) else leaf


# ---------------------------------------------------------------- which windows


@pytest.mark.parametrize("frames", [None, (0, 4), (2, 7), (3, 99)])
def test_windows_are_all_that_have_their_frames(frames: tuple[int, int] | None) -> None:
    lengths, first, last = (3, 6, 10, 2), *(frames or (0, 99))
    wanted = [
        (clip, t)
        for clip, length in enumerate(lengths)
        for t in range(length)
        if all(max(first, 0) <= touched <= min(last, length - 1) for touched in (t - 1, t, t + 3))
    ]
    assert fakes(*lengths, horizons=(0.2, 0, 0.8), frames=frames).windows == wanted


def test_no_frame_outside_the_range_is_read() -> None:
    windows = fakes(12, horizons=(1, 1), frames=(4, 9))
    for step in range(12):
        windows.batch(windows.global_batch(0, step, 2))
    assert cast(FakeClip, windows.clips[0]).touched == set(range(4, 10))


def test_every_epoch_has_every_window_once_in_an_order_of_its_own() -> None:
    windows = fakes(6, 5)
    count = len(windows.windows)
    assert count == 7
    draws = [draw for step in range(7) for draw in windows.global_batch(1, step, 3)]
    epochs = [[(draw.clip, draw.frame) for draw in draws[i : i + count]] for i in range(0, 3 * count, count)]
    assert all(sorted(epoch) == windows.windows for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 3
    other = [(draw.clip, draw.frame) for step in range(7) for draw in windows.global_batch(2, step, 3)]
    assert other[:count] != epochs[0]


def test_horizons_follow_their_weights_one_a_batch() -> None:
    windows, steps = fakes(9, horizons=(2.0, 0.0, 1.0, 1.0)), 1000
    drawn = []
    for step in range(steps):
        (horizon,) = {draw.horizon for draw in windows.global_batch(3, step, 2)}
        drawn.append(horizon)
    counts = np.bincount(drawn, minlength=5)
    assert counts[0] == counts[2] == 0
    assert np.abs(counts[[1, 3, 4]] - steps * np.array([0.5, 0.25, 0.25])).max() < 4 * np.sqrt(steps * 0.25)


def test_right_cameras_and_augmentation_seeds_are_drawn_for_each_position() -> None:
    windows = fakes(9, right=0.3)
    draws = [draw for step in range(300) for draw in windows.global_batch(3, step, 4)]
    assert abs(sum(draw.right for draw in draws) - 0.3 * 1200) < 4 * np.sqrt(1200 * 0.21)
    assert len({draw.seed for draw in draws}) == 1200
    assert not any(draw.right for step in range(20) for draw in fakes(9).global_batch(3, step, 4))


def test_each_seed_draws_differently(clips: list[PreparedClip]) -> None:
    windows = WindowSet(clips, **VARIED)
    first, second = (windows.batch(windows.global_batch(seed, 0, 2)) for seed in (0, 1))
    assert not torch.equal(first.target, second.target)


# ---------------------------------------------------------------- the same for everyone


def test_batches_from_the_middle_are_those_of_the_whole_run(clips: list[PreparedClip], cache: Path) -> None:
    whole = list(loader(WindowSet(clips, **VARIED), 7, 3, range(6)))
    resumed = list(loader(WindowSet(find_prepared(cache), **VARIED), 7, 3, range(4, 6)))
    assert len(whole) == 6 and len(resumed) == 2
    for one, other in zip(whole[4:], resumed, strict=True):
        assert_same(one, other)
    assert len({batch.horizon for batch in whole}) > 1
    assert not torch.equal(whole[4].target, whole[5].target)


def test_ranks_share_the_batch_of_one_process(clips: list[PreparedClip]) -> None:
    windows = WindowSet(clips, **VARIED)
    whole = loader(windows, 7, 4, range(3))
    parts = [loader(windows, 7, 4, range(3), rank=rank, world=2) for rank in range(2)]
    for together, *shared in zip(whole, *parts, strict=True):
        for rank, part in enumerate(shared):
            assert part.clips == together.clips[rank::2] and part.horizon == together.horizon
            for one, other in zip(rows(part, slice(None)), rows(together, slice(rank, None, 2)), strict=True):
                assert torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other


def test_a_worker_reads_what_the_process_itself_reads(clips: list[PreparedClip]) -> None:
    windows = WindowSet(clips, **VARIED)
    single, helped = (list(loader(windows, 7, 2, range(2, 4), workers=workers)) for workers in (0, 1))
    for one, other in zip(single, helped, strict=True):
        assert_same(one, other)
    assert isinstance(helped[0], Batch) and isinstance(helped[0].clips, tuple)


def test_reading_leaves_the_global_generators_unchanged(clips: list[PreparedClip]) -> None:
    torch_before, numpy_before = torch.get_rng_state(), pickle.dumps(np.random.get_state())  # noqa: NPY002
    list(loader(WindowSet(clips, **VARIED), 7, 2, range(2)))
    assert torch.equal(torch.get_rng_state(), torch_before)
    assert pickle.dumps(np.random.get_state()) == numpy_before  # noqa: NPY002 - it is what must not change


def test_reading_opens_no_device(cache: Path, tmp_path: Path) -> None:
    process = Process(tmp_path / "log", read_two_batches, cache)
    assert process.wait() == 0, process.output


def read_two_batches(cache: Path) -> None:
    windows = WindowSet(find_prepared(cache), crop=(24, 80), flip=True, colour=0.5, right=0.5)
    assert len(list(loader(windows, 0, 2, range(2)))) == 2
    assert "libpocl" not in Path("/proc/self/maps").read_text()


# ---------------------------------------------------------------- what a batch holds


def test_batch_without_augmentation_is_what_the_clip_has(clips: list[PreparedClip]) -> None:
    windows = WindowSet(clips, horizons=(0, 1))
    batch = windows.batch([Draw(0, 2, 2, False, (0,)), Draw(1, 3, 2, True, (0,))])
    assert batch.horizon == 2 and batch.pose_known.tolist() == [True, True]
    assert batch.clips == (f"street 3/{clips[0].frame_name(2)}", f"street 5/{clips[1].frame_name(3)}")
    for b, (clip, t) in enumerate(((clips[0], 2), (clips[1], 3))):
        given = network_input(clip.frame(t - 1), clip.frame(t), last_motions(clip.frame(t - 1), clip.frame(t)))
        for got, wanted in zip(leaves((*batch[:4], batch.own)), leaves(given), strict=True):
            assert torch.equal(got[b : b + 1], wanted)
        here, there = clip.world_from_cam(t), clip.world_from_cam(t + 2)
        assert here is not None and there is not None
        np.testing.assert_allclose(there @ batch.future_from_cur[b].double().numpy(), here, rtol=0, atol=1e-5)
    right = clips[1].right(5)
    assert right is not None
    assert np.array_equal(batch.target[0], clips[0].image(4)) and np.array_equal(batch.target[1], right[0])
    np.testing.assert_allclose(batch.tgt_from_next, np.stack([np.eye(4), right[2]]), rtol=0, atol=1e-7)
    np.testing.assert_allclose(batch.target_K, np.stack([clips[0].K(4), right[1]]), rtol=1e-7)


def test_what_a_clip_does_not_know_is_said() -> None:
    windows = fakes(6, right=1.0)
    batch = windows.batch(windows.global_batch(0, 0, 3))
    assert not batch.pose_known.any() and torch.equal(batch.future_from_cur, torch.eye(4).expand(3, 4, 4))
    assert torch.equal(batch.tgt_from_next, torch.eye(4).expand(3, 4, 4))
    draw = windows.global_batch(0, 0, 3)[0]
    assert np.array_equal(batch.target[0], windows.clips[0].image(draw.frame + 1))


def warped(batch: Batch, future_from_cur: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The target where it shows the current frame's pixels, and where that is inside it and not foreground."""
    points_xyz = unproject(batch.frame_cur.depth, batch.K)
    there = geometry.transform_points(batch.tgt_from_next @ future_from_cur, points_xyz)
    u, v, z = (there @ batch.target_K.mT).unbind(-1)
    height, width = batch.target.shape[2:]
    grid = torch.stack([u / z / width, v / z / height], dim=-1) * 2 - 1
    seen = functional.grid_sample(batch.target, grid.unflatten(1, (height, width)), align_corners=False)
    inside = ((grid.abs() < 1).all(dim=-1) & (z > 0.1)).unflatten(1, (height, width))[:, None]
    return seen, inside & (batch.frame_cur.mask > 0.5)


def test_augmented_targets_show_the_scene_where_cameras_and_depth_say(clips: list[PreparedClip]) -> None:
    windows = WindowSet(clips, **VARIED | {"colour": 0.0, "horizons": (0, 1)})
    batch = windows.batch(windows.global_batch(1, 0, 8))
    sides = {round(float(tgt_from_next[0, 3]), 2) for tgt_from_next in batch.tgt_from_next}
    assert len(sides) == 3 and min(sides) == -max(sides)  # the source camera, a right one, and one that was mirrored
    errors = []
    for motion in (batch.future_from_cur, torch.eye(4).expand(8, 4, 4)):
        seen, where = warped(batch, motion)
        difference = (seen - batch.frame_cur.image).abs().mean(dim=1, keepdim=True)
        errors.append(torch.stack([each[inside].mean() for each, inside in zip(difference, where, strict=True)]))
    assert (errors[0] < 0.65 * errors[1]).all()


def test_the_network_takes_a_batch(clips: list[PreparedClip]) -> None:
    windows = WindowSet(clips, crop=(24, 80), flip=True, colour=0.5, right=1.0)
    batch = windows.batch(windows.global_batch(0, 0, 2))
    views = [(batch.tgt_from_next, batch.target_K)]
    with torch.no_grad():
        step = Forecaster(change(start="prior")).forecast(*batch[:3], views=views, prior=batch.prior)[0]
    assert step.views[0].image.shape == batch.target.shape == (2, 3, 24, 80)
    assert step.views[0].image.isfinite().all() and float(step.views[0].coverage.mean()) > 0.5


def test_whole_frames_can_be_shrunk(clips: list[PreparedClip]) -> None:
    windows = WindowSet(clips, scale=(0.5, 0.5))
    batch = windows.batch(windows.global_batch(0, 0, 2))
    assert batch.target.shape == (2, 3, HEIGHT // 2, WIDTH // 2)
    scale = torch.tensor([0.5, 0.5, 1.0])[:, None]
    torch.testing.assert_close(batch.K, scale * torch.from_numpy(clips[0].K(0)).float().expand(2, 3, 3))


def test_crops_reach_every_edge() -> None:
    windows, seen = fakes(6, crop=(4, 6)), set[tuple[float, float]]()
    whole = prepared(0, None).K
    for step in range(100):
        batch = windows.batch(windows.global_batch(0, step, 1))
        left, top = whole[:2, 2] - batch.K[0, :2, 2].double().numpy()
        seen.add((round(top), round(left)))
    tops, lefts = zip(*seen, strict=True)
    assert set(tops) == set(range(5)) and set(lefts) == set(range(7))


class RidingClip(FakeClip):
    """Its second half has the recording car in the two lowest rows."""

    def frame(self, index: int) -> PerceivedFrame:
        return prepared(index, MOTIONS[index % 2] if index else None, own=index >= self.frames // 2)


def test_batches_know_where_the_recording_car_is() -> None:
    """Each window has it where its frames do, whatever the others have."""
    windows = WindowSet([RidingClip(12)])
    batch = windows.batch([Draw(0, t, 1, False, (0, t)) for t in (2, 6, 9)])
    assert batch.own is not None and batch.own.shape == (3, 1, 8, 12)
    assert batch.own[:, :, -2:].flatten(1).mean(dim=1).tolist() == [0, 1, 1]
    assert not batch.own[:, :, :-2].any()

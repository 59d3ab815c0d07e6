"""Degraded windows: what is drawn, what each kind does to frames and target, and the mixing of prepared folders."""

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from train.data import degrade
from train.data.degrade import Degradation
from train.data.windows import WindowSet
from train.fit import window_set
from train.settings.config import DataConfig, DegradeConfig
from vestcl.data.street import input as street_input
from vestcl.prepare.clip import prepare_clip
from vestcl.prepare.prepared import PreparedClip, find_prepared

HEIGHT, WIDTH, FRAMES = 48, 160, 5
PLAIN = Degradation(False, (1.0, 1.0, 1.0), 0.0, 0.0, 0.0, None)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for each of two drives."""
    folder = tmp_path_factory.mktemp("degraded")
    for drive, seed in (("usual", 3), ("road", 9)):
        clip = street_input.clip(seed, street_input.Driven(drive), FRAMES, (HEIGHT, WIDTH), samples=2)
        prepare_clip(clip, folder / drive / f"street {seed}")
    return folder


@pytest.fixture
def clips(cache: Path) -> list[PreparedClip]:
    return find_prepared(cache)


def window_of(clips: list[PreparedClip], horizon: int = 1) -> degrade.TrainingWindow:
    windows = WindowSet(clips, horizons=(0, 1) if horizon == 2 else (1,))
    return windows.window(next(d for d in windows.global_batch(0, 0, 9) if d.frame == 2))


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_nothing_done_changes_nothing(clips: list[PreparedClip]) -> None:
    window = window_of(clips)
    done = degrade.degrade(window, PLAIN, rng())
    for frame, other in ((window.prev, done.prev), (window.cur, done.cur)):
        np.testing.assert_array_equal(frame.layers.image, other.layers.image)
        np.testing.assert_array_equal(frame.layers.background_image, other.layers.background_image)
        np.testing.assert_array_equal(frame.layers.depth, other.layers.depth)
    np.testing.assert_array_equal(window.target, done.target)


def test_exposure_is_of_the_frame_before_only(clips: list[PreparedClip]) -> None:
    window = window_of(clips)
    done = degrade.degrade(window, dataclasses.replace(PLAIN, prev_gain=(0.25, 1.0, 1.0)), rng())
    np.testing.assert_array_equal(done.cur.layers.image, window.cur.layers.image)
    np.testing.assert_array_equal(done.target, window.target)
    red, before = done.prev.layers.image[0], window.prev.layers.image[0]
    np.testing.assert_allclose(red, before * 0.25 ** (1 / 2.2), rtol=1e-5)
    np.testing.assert_array_equal(done.prev.layers.image[1:], window.prev.layers.image[1:])
    np.testing.assert_allclose(
        done.prev.layers.background_image[0], window.prev.layers.background_image[0] * 0.5325, rtol=1e-3
    )


def test_noise_is_stronger_in_the_light_and_not_in_the_target(clips: list[PreparedClip]) -> None:
    window = window_of(clips)
    done = degrade.degrade(window, dataclasses.replace(PLAIN, shot=0.05, read=0.01), rng())
    image = window.cur.layers.image
    off = done.cur.layers.image - image
    for low, high in ((0.1, 0.2), (0.5, 0.6)):
        chosen = (image > low) & (image < high)
        assert off[:, :][chosen].std() == pytest.approx(np.sqrt(0.05**2 * (low + high) / 2 + 0.01**2), rel=0.1)
    np.testing.assert_array_equal(done.target, window.target)
    layers = done.cur.layers
    shown = np.broadcast_to(layers.mask, image.shape)
    np.testing.assert_array_equal(layers.background_image[shown], layers.image[shown])
    assert not np.array_equal(done.prev.layers.image - window.prev.layers.image, off)


def test_grey_and_jpeg(clips: list[PreparedClip]) -> None:
    window = window_of(clips)
    grey = degrade.degrade(window, dataclasses.replace(PLAIN, grey=True, shot=0.02), rng())
    for image in (grey.prev.layers.image, grey.cur.layers.image, grey.cur.layers.background_image, grey.target):
        np.testing.assert_array_equal(image[0], image[2])
    rough, fine = (
        np.abs(
            degrade.degrade(window, dataclasses.replace(PLAIN, quality=q), rng()).cur.layers.image
            - window.cur.layers.image
        ).mean()
        for q in (20, 95)
    )
    assert 0 < fine < rough / 2 < 0.05


def test_flow_is_where_the_points_were(clips: list[PreparedClip]) -> None:
    """Against the poses that the clip has: of static pixels the flow to the frame before is the rigid one."""
    clip = clips[0]
    frame = clip.frame(2)
    assert frame.prev_from_cur is not None
    flow = degrade.flow_to_prev(frame, frame.prev_from_cur, frame.layers.depth, None)
    v, u = HEIGHT // 2 + 10, WIDTH // 2 + 30
    point = np.linalg.inv(frame.K) @ [u + 0.5, v + 0.5, 1] * frame.layers.depth[0, v, u]
    there = frame.K @ (frame.prev_from_cur[:3, :3] @ point + frame.prev_from_cur[:3, 3])
    np.testing.assert_allclose(flow[:, v, u], there[:2] / there[2] - [u + 0.5, v + 0.5], atol=1e-4)


def test_blur_follows_motion(clips: list[PreparedClip]) -> None:
    clip = clips[0]
    window, later = window_of([clip]), clip.frame(3)
    same = degrade.blur(window, later, 0.0)
    np.testing.assert_allclose(same.cur.layers.image, window.cur.layers.image, atol=1e-3)
    blurred = degrade.blur(window, later, 0.8)
    flow = degrade.flow_to_prev(window.cur, window.cur.prev_from_cur, window.cur.layers.depth, window.cur.velocity)  # type: ignore[arg-type]
    length = np.hypot(*flow)

    def edges(image: np.ndarray) -> np.ndarray:
        return np.abs(np.diff(image.mean(axis=0), axis=1))[:, :-1]

    fast, slow = length[:, 1:-1] > 4, length[:, 1:-1] < 0.3
    before, after = edges(window.cur.layers.image), edges(blurred.cur.layers.image)
    assert after[fast].mean() < 0.7 * before[fast].mean()
    assert after[slow].mean() > 0.9 * before[slow].mean()
    assert edges(blurred.target).mean() < 0.95 * edges(window.target).mean()
    assert edges(blurred.prev.layers.image).mean() < 0.95 * edges(window.prev.layers.image).mean()


def test_draws_follow_the_settings_and_the_seed() -> None:
    settings = DegradeConfig(share=0.5, grey=0.5, blur=0.4, noise=0.03, jpeg=30)
    drawn = [degrade.draw(np.random.default_rng(i), settings) for i in range(400)]
    done = [one for one in drawn if one is not None]
    assert 150 < len(done) < 250
    assert 0.35 < np.mean([one.grey for one in done]) < 0.65
    assert all(one.shutter <= 0.4 and one.shot <= 0.03 and one.read <= one.shot for one in done)
    assert {one.quality is None for one in done} == {True, False}
    assert all(30 <= one.quality <= 95 for one in done if one.quality is not None)
    assert degrade.draw(np.random.default_rng(3), settings) == drawn[3]
    assert degrade.draw(rng(), DegradeConfig(share=0.0)) is None


def test_batches_are_degraded_equally_again_and_only_if_asked_for(clips: list[PreparedClip]) -> None:
    always = DegradeConfig(share=1.0)
    plain, one, other = (WindowSet(clips, degrade=settings) for settings in (None, always, always))
    draws = plain.global_batch(4, 0, 4)
    first, again, untouched = one.batch(draws), other.batch(draws), plain.batch(draws)
    assert torch.equal(first.frame_cur.image, again.frame_cur.image) and torch.equal(first.target, again.target)
    assert not torch.equal(first.frame_cur.image, untouched.frame_cur.image)
    assert torch.equal(first.frame_cur.depth, untouched.frame_cur.depth)
    assert torch.equal(first.future_from_cur, untouched.future_from_cur)
    never = WindowSet(clips, degrade=DegradeConfig(share=0.0)).batch(draws)
    assert torch.equal(never.frame_prev.image, untouched.frame_prev.image)


# ---------------------------------------------------------------- several folders


def test_folders_are_mixed_by_weight(cache: Path) -> None:
    straight, road = str(cache / "usual"), str(cache / "road")
    data = DataConfig(train=(straight, road), weights=((straight, 0.25), (road, 0.75)))
    windows = window_set(data)
    draws = [draw for step in range(50) for draw in windows.global_batch(1, step, 8)]
    counts = Counter(windows.clips[draw.clip].folder.parent.name for draw in draws)
    assert 0.67 < counts["road"] / len(draws) < 0.83
    assert {draw.frame for draw in draws} == {1, 2, 3}
    assert draws[:8] == windows.global_batch(1, 0, 8)
    only = window_set(dataclasses.replace(data, weights=((road, 1.0),)))
    assert {only.clips[draw.clip].folder.parent.name for draw in only.global_batch(1, 0, 20)} == {"road"}


def test_weights_that_fit_no_folders_are_refused() -> None:
    for weight in (0.0, -1.0):
        with pytest.raises(ValueError, match="weights"):
            DataConfig(train=("a", "b"), weights=(("a", weight),))
    with pytest.raises(ValueError, match=r"`data\.weights` must name folders of `data\.train`, a, b, got c"):
        window_set(DataConfig(train=("a", "b"), weights=(("c", 1.0),)))

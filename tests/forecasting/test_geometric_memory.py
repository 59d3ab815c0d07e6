"""vestcl.forecasting.geometric.memory: what earlier frames saw is bounded, and shown only where t and t-1 see
nothing."""

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from geometric_scenes import HEIGHT, WIDTH, Floats, K, Matrix, decibels, drive, noise, turned

from vestcl.forecasting.geometric import memory
from vestcl.forecasting.geometric.clouds import _static
from vestcl.forecasting.geometric.forecast import forecast_frames
from vestcl.forecasting.geometric.memory import SceneMemory, remember
from vestcl.forecasting.geometric.render import HOLE, Shown, holes, show
from vestcl.forecasting.result import Forecast, View
from vestcl.scene.perceived import Surface
from vestcl.scene.perception import Perception

NOW, DISTANCE = 6, 20.0

#: The camera turns right by that much from frame to frame, radians.
TURN = 0.08

#: Of the wall, in front of the middle of which the camera stands; pixels of a metre.
TEXTURE, SCALE = noise(400, 1600, blur=3.0), 10.0


class Turning:
    """Stands in for a `Perception` of a camera that turns in front of a wall, with a red box before it."""

    def __init__(self, box: Callable[[int], int] | None = None) -> None:
        self.clip = [SimpleNamespace(K=K)] * 20
        self.box, self.computed, self.lost = box, list[int](), set[int]()

    def seen(self, index: int) -> Any:
        if index > NOW:
            raise AssertionError("a frame after t was looked at")
        image, depth = wall(TURN * (index - NOW))
        mask = np.ones((1, HEIGHT, WIDTH), bool)
        if self.box is not None:
            where = np.s_[:, 30:60, self.box(index) : self.box(index) + 40]
            mask[where], depth[where] = False, 8.0
            image[where] = np.array([1, 0, 0], np.float32)[:, None, None]
        return SimpleNamespace(layers=SimpleNamespace(image=image, depth=depth, mask=mask), own=np.zeros_like(mask))

    def surface(self, index: int) -> Surface:
        seen = self.seen(index)
        return Surface(seen.layers.image, seen.layers.depth, seen.layers.mask, seen.own)

    def prev_from_cur(self, index: int) -> Matrix:
        return turned(TURN, 0, 0, (0, 0, 0))

    def is_lost(self, index: int) -> bool:
        return index in self.lost

    def once(self, stage: str, index: int, compute: Callable[[], Any], *, lifetime: int = 0) -> Any:
        self.computed.append(index)
        return compute()


def wall(yaw: float) -> tuple[Floats, Floats]:
    """Image and depth [m] of the wall from a camera that is turned right by ``yaw`` radians."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)])
    ahead = np.tensordot(turned(yaw, 0, 0, (0, 0, 0))[:3, :3], rays, 1)
    depth = DISTANCE / ahead[2]
    across, down = ahead[0] * depth * SCALE + 800, ahead[1] * depth * SCALE + 200
    planes = [cv2.remap(plane, *map(np.float32, (across, down)), cv2.INTER_LINEAR) for plane in TEXTURE]  # type: ignore[arg-type]
    return np.stack(planes), depth[None].astype(np.float32)


def recalled(frames: int, perception: Any = None) -> SceneMemory:
    found = remember(perception or Turning(), NOW, frames)
    assert found is not None
    return found


def shown_left(found: SceneMemory, yaw: float) -> Shown:
    """From a camera at t that is turned left by ``yaw`` radians."""
    return show([_static(found, K)(0, lambda step: np.eye(4))], K, turned(yaw, 0, 0, (0, 0, 0)), HEIGHT, WIDTH)


# ---------------------------------------------------------------- what is kept


def test_a_wall_seen_only_at_t_4_is_shown_to_a_turned_camera() -> None:
    """Left of what t-3 saw: open with two frames of memory, the wall with three, and open beyond."""
    shown, truth = shown_left(recalled(3), 4 * TURN), wall(-4 * TURN)[0]
    only_then = np.s_[:, 10:-10, 3:13]  # a step of the turn is 13 to 15 px here
    assert holes(shown_left(recalled(2), 4 * TURN))[only_then].all()
    assert not holes(shown)[only_then].any()
    assert decibels(shown.planes[:3][only_then], truth[only_then]) > 30
    beyond = shown_left(recalled(3), 6 * TURN)
    assert not beyond.coverage[:, :, :35].any() and not holes(beyond)[:, 20:-20, 50:58].any()


def test_what_t_and_t_1_cover_is_left_out() -> None:
    """Of a wall that both see, only the strip at the left that t-1 no longer shows, and a margin; nothing at rest."""
    found = recalled(1)
    assert found.columns[(found.rows > 20) & (found.rows < HEIGHT - 20)].max() < 30
    still = Turning()
    still.prev_from_cur = lambda index: np.eye(4)  # type: ignore[method-assign]
    still.seen = lambda index: Turning.seen(still, NOW)  # type: ignore[method-assign]
    columns = recalled(5, still).columns
    assert ((columns < 4) | (columns >= WIDTH - 4)).all()


@pytest.mark.parametrize("box", [lambda index: 0, lambda index: 40 * (index % 3), lambda index: 20 + 15 * index])
def test_no_moving_object_is_kept(box: Callable[[int], int]) -> None:
    found = recalled(5, Turning(box))
    red, green, _ = found.image[:, found.rows, found.columns]
    assert len(red) and not ((red > 0.95) & (green < 0.05)).any()
    assert (found.z_src > 9).all()


def test_it_is_no_larger_than_an_image(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_covered", lambda depth, which, *_: np.zeros_like(which))
    found = recalled(5)
    assert 0.5 * HEIGHT * WIDTH < len(found.points_xyz) <= HEIGHT * WIDTH
    assert found.rows.max() < found.image.shape[1] <= 5 * (HEIGHT + 1)


def test_a_frame_that_disagrees_is_left_out() -> None:
    wrong = Turning()
    depth_of = wrong.seen

    def seen(index: int) -> Any:
        found = depth_of(index)
        if index == NOW - 2:
            found.layers.image = 1 - found.layers.image
        return found

    wrong.seen = seen  # type: ignore[method-assign]
    assert remember(wrong, NOW, 1) is None  # type: ignore[arg-type]
    assert remember(wrong, NOW, 2) is not None  # type: ignore[arg-type]


def test_scale_and_exposure_are_corrected() -> None:
    """Depths of t-2 that are 8 % too large, half as bright as t."""
    other = Turning()
    right = other.seen

    def seen(index: int) -> Any:
        found = right(index)
        if index == NOW - 2:
            found.layers.depth, found.layers.image = found.layers.depth * np.float32(1.08), found.layers.image / 2
        return found

    other.seen = seen  # type: ignore[method-assign]
    found, wanted = recalled(1, other), recalled(1)
    np.testing.assert_allclose(np.median(found.z_src), np.median(wanted.z_src), rtol=0.01)
    np.testing.assert_allclose(np.median(found.image), np.median(wanted.image), rtol=0.1)


def test_nothing_before_a_gap_is_remembered() -> None:
    gap = Turning()
    gap.lost = {NOW - 2}
    recalled(5, gap)
    assert gap.computed == [NOW - 2]


def test_no_frames_no_memory() -> None:
    assert remember(Turning(), NOW, 0) is None and remember(Turning(), 1, 5) is None  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`memory` must be 0 frames or more, got -1"):
        remember(Turning(), NOW, -1)  # type: ignore[arg-type]


# ---------------------------------------------------------------- in a forecast


ASIDE = [View("source", np.eye(4)), View("turned", turned(0.2, 0, 0, (-0.5, 0, 0)))]


@functools.cache
def forecast(frames: int, last: int | None = None) -> Forecast:
    clip = drive(4, frames=8).clip
    perception = Perception(clip if last is None else clip[:last])
    return forecast_frames(perception, 5, 2, ASIDE, memory=frames)


def test_what_t_and_t_1_cover_does_not_change() -> None:
    filled = 0
    for without, given in zip(forecast(0).frames, forecast(3).frames, strict=True):
        for name in without:
            known = without[name].coverage[0] > HOLE
            for part in ("image", "depth", "coverage", "motion_xyz"):
                assert np.array_equal(getattr(without[name], part)[:, known], getattr(given[name], part)[:, known])
            filled += int((given[name].coverage[0] > HOLE)[~known].sum())
            assert not given[name].depth[given[name].coverage <= HOLE].any()
    assert filled > 0


def test_later_frames_change_nothing() -> None:
    for whole, cut in zip(forecast(3).frames, forecast(3, 6).frames, strict=True):
        assert all(np.array_equal(whole[name].image, cut[name].image) for name in whole)


def test_each_frame_is_kept_once() -> None:
    perception = Perception(drive(4, frames=8).clip)
    remember(perception, 5, 4)
    before = {key: value for key, value in perception._kept.items() if key[0] == "memory"}
    assert sorted(index for _, index in before) == [0, 1, 2, 3]
    remember(perception, 6, 4)
    after = {key: value for key, value in perception._kept.items() if key[0] == "memory"}
    assert all(after[key] is before[key] for key in before if key[1] >= 1)

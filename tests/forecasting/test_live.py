"""Forecasts as frames come in are those of the whole clip, and cost what the new frame costs."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import vestcl
from vestcl.data.sample import RightCamera, Sample
from vestcl.forecasting.future import Future
from vestcl.scene import measurements

SIZE = {"height": 48, "width": 160}
K = np.array([[120.0, 0, 80], [0, 120, 24], [0, 0, 1]])
RIG = np.eye(4)
RIG[0, 3] = -0.5


@functools.cache
def clip() -> vestcl.Clip:
    return vestcl.open("street:7?depth=stereo", frames=7, **SIZE)


def camera(sample: Sample) -> RightCamera:
    assert sample.right is not None
    return sample.right


def same(one: Future, other: Future) -> None:
    assert list(one) == list(other)
    for view in one:
        for made, wanted in zip(one[view], other[view], strict=True):
            np.testing.assert_array_equal(made.image, wanted.image)
            np.testing.assert_array_equal(made.depth, wanted.depth)


def by_arrays(**options: Any) -> tuple[list[Future | None], vestcl.Live]:
    first = camera(clip()[0])
    views = {"views": ["source", "right"], "steps": 2}
    made = vestcl.Live(clip()[0].K, fps=10, right_from_left=first.right_from_left, right_K=first.K, **views | options)
    return [made.push(each.read_image(), right=camera(each).read_image()) for each in clip()], made


def test_every_frame_of_a_clip() -> None:
    futures = list(vestcl.live(clip(), steps=2, views=["source", "right"]))
    assert [future.index for future in futures] == [1, 2, 3, 4, 5, 6]
    for index in (1, 4, 6):
        same(futures[index - 1], vestcl.forecast(clip(), index, steps=2, views=["source", "right"]))


def test_every_third_frame() -> None:
    assert [future.index for future in vestcl.live("street:7", steps=1, every=3, frames=6, **SIZE)] == [1, 4]


def test_frames_that_are_pushed() -> None:
    futures, live = by_arrays()
    assert futures[0] is None
    bare = vestcl.Clip("live", "live", live._perception.recorded.samples)  # type: ignore[union-attr]
    for index in (1, 3, 6):
        future = futures[index]
        assert future is not None and future.index == index
        same(future, vestcl.forecast(bare, index, steps=2, views=["source", "right"]))


def test_a_frame_costs_its_own_flow_and_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = {"correspond": 0, "stereo_depth": 0}

    def counted(name: str, plain: Callable[..., Any], *given: Any, **how: Any) -> Any:
        calls[name] += 1
        return plain(*given, **how)

    for name in calls:
        monkeypatch.setattr(measurements, name, functools.partial(counted, name, getattr(measurements, name)))
    by_arrays()
    assert calls == {"correspond": len(clip()) - 1, "stereo_depth": len(clip())}


def test_images_of_old_frames_are_dropped() -> None:
    live = vestcl.Live(K, steps=1, work_width=None)
    rng = np.random.default_rng(0)
    scene = rng.random((3, 48, 400)).astype(np.float32)
    for number in range(15):
        live.push(scene[..., 2 * number : 2 * number + 160])
    perception = live._perception
    assert perception is not None and len(perception.recorded) == 15
    perception.recorded[-12].read_image()
    with pytest.raises(ValueError, match="the frame was dropped"):
        perception.recorded[1].read_image()
    assert len({index for _, index in perception._kept}) <= 12


def test_a_network() -> None:
    (future,) = vestcl.live(clip()[:2], steps=1, model="vest-s")
    assert future.method == "vest-s"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"fps": 0}, "`fps` must be above 0"),
        ({"fps": np.inf}, "`fps` must be above 0"),
        ({"steps": 0}, "`steps` must be 1 or more"),
        ({"right_K": K}, "`right_K` is of a stereo rig"),
        ({"K": np.eye(4)}, "K"),
        ({"right_from_left": np.zeros((4, 4))}, "right_from_left"),
    ],
)
def test_what_can_not_be(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        vestcl.Live(**{"K": K} | given)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ({"image": np.zeros((3, 48, 100))}, "`image` must be 48 x 160 px as the frames before, got 48 x 100"),
        ({"image": np.zeros((1, 48, 160))}, "`image` must be"),
        ({"image": np.full((3, 48, 160), np.nan)}, "`image` must not have NaN"),
        ({"timestamp": 0.0}, "`timestamp` must be after 0 s"),
        ({"right": np.zeros((3, 48, 160))}, "`right` needs a rig"),
        ({"depth": np.ones((1, 48, 160))}, "`depth` must be given with every frame"),
    ],
)
def test_a_frame_that_does_not_follow(frame: dict[str, Any], message: str) -> None:
    live = vestcl.Live(K, steps=1)
    good = np.random.default_rng(1).random((3, 48, 160))
    live.push(good)
    with pytest.raises(ValueError, match=message):
        live.push(**{"image": good} | frame)
    assert live.push(good) is not None  # as if the bad one had not come


def test_a_rig_without_its_right_image() -> None:
    with pytest.raises(ValueError, match="`right` must be given"):
        vestcl.Live(K, right_from_left=RIG).push(np.zeros((3, 48, 160)))


def test_clips_that_can_not_be() -> None:
    with pytest.raises(ValueError, match="`every` must be 1"):
        vestcl.live(clip(), every=0)
    with pytest.raises(ValueError, match="`clip` is open: it takes no fov"):
        vestcl.live(clip(), fov=60)
    with pytest.raises(ValueError, match="2 frames or more"):
        vestcl.live(clip()[:1])

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
        ({"right_from_left": np.eye(4)}, "`right_from_left` must have t_x < 0"),
        ({"right_from_left": "rig"}, "`right_from_left` must be a matrix of numbers"),
        ({"K": "camera"}, "`K` must be a matrix of numbers"),
        ({"K": 1j * K}, "`K` must be a matrix of numbers: an array of complex128"),
        ({"fps": "10"}, "`fps` must be above 0 Hz, got '10'"),
        ({"fps": None}, "`fps` must be above 0 Hz, got None"),
        ({"steps": 1.5}, "`steps` must be 1 or more, a whole number, got 1.5"),
        ({"steps": "5"}, "`steps` must be 1 or more, a whole number, got '5'"),
        ({"quality": "best"}, "`quality` must be one of exact, balanced, fast, realtime, got 'best'"),
        ({"model": 5}, "`model` must be None, a name, a file or a Forecaster, got 5"),
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
        ({"image": np.ones((3, 48, 160), np.uint8)}, "`image` must be RGB in .* divide 8-bit values by 255"),
        ({"timestamp": 0.0}, "`timestamp` must be after 0 s"),
        ({"timestamp": np.nan}, "`timestamp` must be a finite number of seconds, got nan"),
        ({"timestamp": "1"}, "`timestamp` must be a finite number of seconds, got '1'"),
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


def test_a_first_frame_that_is_refused_leaves_no_trace() -> None:
    live, good = vestcl.Live(K, steps=1), np.random.default_rng(1).random((3, 48, 160))
    for bad in ({"image": good[:, :8]}, {"image": good, "depth": np.ones((1, 24, 160))}, {"image": 255 * good}):
        with pytest.raises(ValueError, match="must"):
            live.push(**bad)
    assert live.push(good[:, :, :100]) is None


def test_a_frame_whose_forecast_fails_leaves_no_trace() -> None:
    images = [each.read_image() for each in clip()[:3]]
    whole, broken = (vestcl.Live(clip()[0].K, steps=1) for _ in range(2))
    make = broken._make

    def fails(*given: Any) -> Any:
        make(*given)
        raise KeyboardInterrupt

    for number, image in enumerate(images):
        if number:
            broken._make = fails
            with pytest.raises(KeyboardInterrupt):
                broken.push(image[..., ::-1], timestamp=number / 10 - 0.01)
            broken._make = make
        one, other = (each.push(image, timestamp=number / 10) for each in (whole, broken))
        if one is not None and other is not None:
            same(one, other)


def test_a_camera_that_slows_down_for_good() -> None:
    """Twice the interval from some frame on: no frame is looked at that was dropped."""
    scene = np.random.default_rng(0).random((3, 24, 100)).astype(np.float32)
    times = [number / 10 if number < 17 else 1.7 + (number - 17) / 5 for number in range(33)]
    samples = [Sample.from_arrays(f"{t}", scene[..., i : i + 40], K, timestamp=t) for i, t in enumerate(times)]
    measured = measurements.Measurements(vestcl.Clip("slower", "arrays", (samples[0],)))
    for sample in samples[1:]:
        measured.append(sample, keep=12)
    assert measured.clip.elapsed(32) == pytest.approx(2)
    assert not measured.is_lost(32)


@pytest.mark.filterwarnings("error")
def test_after_a_gap_of_half_a_minute_the_camera_moves_on() -> None:
    live = vestcl.Live(clip()[0].K, steps=1)
    for sample, time in zip(clip(), (0, 0.1, 0.2, 30.0), strict=False):
        future = live.push(sample.read_image(), timestamp=time)
        if future is not None:
            assert all(np.isfinite(motion).all() for motion in future.forecast.future_from_cur)


def test_clips_that_can_not_be() -> None:
    with pytest.raises(ValueError, match="`every` must be 1"):
        vestcl.live(clip(), every=0)
    with pytest.raises(ValueError, match="`steps` must be 1 or more"):
        vestcl.live(clip(), steps=0)
    for views in ([None], 5, ["source", 3.0]):
        with pytest.raises(ValueError, match="`views` must be cameras, each in words or a View, got"):
            vestcl.live(clip(), views=views)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`clip` is open: it takes no fov"):
        vestcl.live(clip(), fov=60)
    with pytest.raises(ValueError, match="2 frames or more"):
        vestcl.live(clip()[:1])

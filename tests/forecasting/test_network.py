"""vestcl.forecasting.network.forecast: forecasts by a network, asked for and answered as the geometric ones are."""

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, TINY, stir

from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip
from vestcl.forecasting.geometric import Perception
from vestcl.forecasting.network.forecast import forecast_clip, forecast_frames, show_frame, what_was_skipped
from vestcl.forecasting.network.input import last_motions, network_input
from vestcl.forecasting.result import Forecast, SkippedWork, View
from vestcl.models.forecaster import Forecaster, perceive_estimated
from vestcl.models.inference.skipping import Count, Tally
from vestcl.models.inference.stage_times import REST, STAGES

HEIGHT, WIDTH = 48, 160
RIGHT = np.eye(4)
RIGHT[0, 3] = -0.54
VIEWS = [View("source", np.eye(4)), View("right", RIGHT)]


@functools.cache
def perception() -> Perception:
    return Perception(clip())


@functools.cache
def clip() -> Clip:
    return street_clip(Street.generate(3), 4, HEIGHT, WIDTH)


def model(start: str = "prior") -> Forecaster:
    torch.manual_seed(0)
    return stir(Forecaster(SMALL if start == "prior" else TINY)).eval()


def assert_same(got: Forecast, wanted: Forecast) -> None:
    for one, other in zip(got.frames, wanted.frames, strict=True):
        assert one.keys() == other.keys()
        for name in one:
            for part in ("image", "depth", "coverage", "motion_xyz"):
                assert np.array_equal(getattr(one[name], part), getattr(other[name], part))


def test_the_recording_car_is_left_out_of_ego_motion() -> None:
    """In forecasts and in the present, as the clip's samples know it."""
    bonnet = np.zeros((1, HEIGHT, WIDTH), bool)
    bonnet[:, -20:] = True
    riding = SimpleNamespace(read=lambda: bonnet)
    samples = tuple(dataclasses.replace(sample, ego_vehicle=riding) for sample in clip())
    given, network, seen = Perception(dataclasses.replace(clip(), samples=samples)), model("rest"), []
    original = network.move_camera

    def move_camera(*arguments: Any) -> Any:
        seen.append(arguments[3])
        return original(*arguments)

    network.move_camera = move_camera  # type: ignore[method-assign]
    forecast_frames(given, network, 2, 2, VIEWS)
    show_frame(given, network, 2, VIEWS)
    assert len(seen) == 3  # two steps of recursion, and the present
    assert all(np.array_equal(own[0].numpy(), bonnet) for own in seen)


def test_the_default_mode_is_the_models() -> None:
    for start, mode in (("prior", "compose"), ("rest", "feedback")):
        assert_same(
            forecast_frames(perception(), model(start), 2, 3, VIEWS),
            forecast_frames(perception(), model(start), 2, 3, VIEWS, mode=mode),  # type: ignore[arg-type]
        )
        assert forecast_frames(perception(), model(start), 2, 1, VIEWS).mode == mode
        assert forecast_frames(perception(), model(start), 2, 1, VIEWS, mode="compose").mode == "compose"


def test_recursion_sees_what_it_is_given() -> None:
    """An estimator of depth runs on the forecast frame, once per step that follows."""
    seen = []

    def depth(image: np.ndarray) -> np.ndarray:
        seen.append(image)
        return np.full_like(image[:1], 12.0)

    made = forecast_frames(perception(), model("rest"), 2, 3, VIEWS[:1], perceive=perceive_estimated(depth))
    assert [image.shape for image in seen] == [(3, HEIGHT, WIDTH)] * 2
    for image, frame in zip(seen, made.frames, strict=False):
        assert np.array_equal(image, frame["source"].image)


@pytest.mark.parametrize("mode", ["compose", "feedback"])
@pytest.mark.parametrize("start", ["prior", "rest"])
def test_it_is_the_models_own_forecast(start: str, mode: Any) -> None:
    """On what was measured of frames t - 1 and t; a model that starts from rest is given no prior."""
    network = model(start)
    result = forecast_frames(perception(), network, 2, 2, VIEWS, mode=mode, learned="all")
    prev, cur = (perception().seen(index) for index in (1, 2))
    given = network_input(prev, cur, last_motions(prev, cur))
    cameras = [(torch.from_numpy(view.tgt_from_next).float()[None], given.K) for view in VIEWS]
    with torch.inference_mode():
        steps = network.forecast(
            given.frame_prev,
            given.frame_cur,
            given.K,
            2,
            cameras,
            mode,
            prior=given.prior if start == "prior" else None,
        )
    assert len(result.frames) == len(steps) == 2
    for shown, future, step in zip(result.frames, result.future_from_cur, steps, strict=True):
        assert list(shown) == ["source", "right"]
        for name, view in zip(shown, step.views, strict=True):
            rendered = shown[name]
            assert rendered.image.shape == rendered.motion_xyz.shape == (3, HEIGHT, WIDTH)
            assert rendered.depth.shape == rendered.coverage.shape == (1, HEIGHT, WIDTH)
            assert rendered.image.dtype == np.float32 and rendered.image.min() >= 0 and rendered.image.max() <= 1
            for part in ("depth", "coverage", "motion_xyz"):
                assert np.array_equal(getattr(rendered, part), getattr(view, part)[0].numpy())
            assert np.array_equal(rendered.image, view.image[0].clamp(0, 1).numpy())
        assert np.allclose(future, step.future_from_cur[0].numpy()) and future.dtype == np.float64
    assert result.method == network.config.name and result.seconds["network"] > 0


def test_a_forecast_reports_its_stages_and_what_it_skipped() -> None:
    """Of this forecast only; the model is as it was."""
    network = model()
    views = [*VIEWS, View("again", np.eye(4))]
    first = forecast_frames(perception(), network, 2, 1, views, learned="all")
    again = forecast_frames(perception(), network, 2, 1, views, learned="all")
    assert not {*STAGES} & {*vars(network)}
    for result, known in ((first, 0), (again, 2)):
        assert list(result.profile) == [*STAGES.values(), REST]
        assert sum(result.profile.values()) == pytest.approx(result.seconds["network"], rel=1e-6)
        assert result.profile["refine"] > 0
        assert result.skipped["seen"][:3] == (known, 2, "frames")
        assert result.skipped["views"][:3] == (1, 3, "views")
        assert result.skipped["views"].share == pytest.approx(1 / 3)
    shown = first.profile["splat"] + first.profile["refine"]
    assert first.skipped["views"].saved_seconds == pytest.approx(shown / 2)
    assert first.skipped["seen"].saved_seconds == 0 and again.skipped["seen"].saved_seconds is None
    for name in ("image", "depth"):
        assert np.array_equal(getattr(first.frames[0]["again"], name), getattr(first.frames[0]["source"], name))


def test_what_skipping_saved_by_hand() -> None:
    """As long as what was computed of the same took: 30 px of a frame, 10 of its background in 4 s; 3 s two views."""
    profile = {"encode": 4.0, "EMF": 9.0, "OMF": 6.0, "lift": 9.0, "splat": 1.0, "refine": 2.0}
    counts = {
        "seen": Count(1, 2, "frames"),
        "background": Count(20, 30, "px"),
        "objects": Count(10, 30, "px"),
        "covered": Count(7, 9, "points"),
        "views": Count(0, 2, "views"),
    }
    found = what_was_skipped(Tally(counts), profile)
    assert found == {
        "seen": SkippedWork(1, 2, "frames", 4.0),
        "background": SkippedWork(20, 30, "px", 2.0),
        "objects": SkippedWork(10, 30, "px", 3.0),
        "covered": SkippedWork(7, 9, "points", None),
        "views": SkippedWork(0, 2, "views", 0.0),
    }
    empty = what_was_skipped(Tally({name: Count(count.of, *count[1:]) for name, count in counts.items()}), profile)
    assert empty["background"].saved_seconds == 4.0
    assert empty["objects"].saved_seconds is None and empty["views"].saved_seconds is None


def test_a_view_may_have_a_camera_of_its_own() -> None:
    closer = clip()[2].K.copy()
    closer[:2, :2] *= 1.5
    views = [View("plain", np.eye(4)), View("closer", np.eye(4), closer)]
    shown = forecast_frames(perception(), model(), 2, 1, views).frames[0]
    assert not np.array_equal(shown["plain"].image, shown["closer"].image)


@pytest.mark.parametrize("learned", ["tested", "all"])
def test_a_clip_is_perceived_and_reported(learned: Any) -> None:
    """Stages are reported with shares that grow to nearly 1; no later frame is looked at."""
    reported: list[tuple[str, float]] = []
    how: dict[str, Any] = {"learned": learned, "progress": lambda stage, share: reported.append((stage, share))}
    result = forecast_clip(clip(), 2, 1, VIEWS, model(), **how)
    assert_same(result, forecast_frames(perception(), model(), 2, 1, VIEWS, learned=learned))
    shares = [share for _, share in reported]
    assert shares == sorted(shares) and shares[0] == 0 and 0.8 < shares[-1] <= 1
    assert (
        reported[-1][0] == ("network" if learned == "all" else "render") and len({stage for stage, _ in reported}) > 3
    )
    short = forecast_clip(clip()[:3], 2, 1, VIEWS, model(), learned=learned)
    assert_same(short, result)


@pytest.mark.parametrize(
    ("index", "steps", "views", "message"),
    [
        (0, 1, VIEWS, r"`index` must be 1 ... 3, a frame of .* with one before, got 0"),
        (4, 1, VIEWS, r"`index` must be 1 ... 3, a frame of .*, got 4"),
        (2, 0, VIEWS, "`steps` and `views` must be 1 or more, got 0 and 2"),
        (2, 1, [], "`steps` and `views` must be 1 or more, got 1 and 0"),
    ],
)
def test_refuses(index: int, steps: int, views: list[View], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        forecast_clip(clip(), index, steps, views, model())

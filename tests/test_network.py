"""vestcl.network: forecasts by a network, asked for and answered as the geometric ones are."""

import functools
from typing import Any

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, TINY, stir

from vestcl.data import Street
from vestcl.data.sample import Clip
from vestcl.forecast import Forecast, View
from vestcl.geometric import Perception
from vestcl.models.forecaster import Forecaster
from vestcl.network import forecast_clip, forecast_frames
from vestcl.network_input import last_motions, network_input
from vestcl.prepared import prepare_frame

HEIGHT, WIDTH = 48, 160
RIGHT = np.eye(4)
RIGHT[0, 3] = -0.54
VIEWS = [View("source", np.eye(4)), View("right", RIGHT)]


@functools.cache
def perception() -> Perception:
    return Perception(clip())


@functools.cache
def clip() -> Clip:
    return Street.generate(3).clip(4, HEIGHT, WIDTH)


def model(start: str = "prior") -> Forecaster:
    torch.manual_seed(0)
    return stir(Forecaster(SMALL if start == "prior" else TINY)).eval()


def assert_same(got: Forecast, wanted: Forecast) -> None:
    for one, other in zip(got.frames, wanted.frames, strict=True):
        assert one.keys() == other.keys()
        for name in one:
            for part in ("image", "depth", "coverage", "motion_xyz"):
                assert np.array_equal(getattr(one[name], part), getattr(other[name], part))


@pytest.mark.parametrize("mode", ["compose", "feedback"])
@pytest.mark.parametrize("start", ["prior", "rest"])
def test_it_is_the_models_own_forecast(start: str, mode: Any) -> None:
    """On what was measured of frames t - 1 and t; a model that starts from rest is told no prior."""
    network = model(start)
    result = forecast_frames(perception(), network, 2, 2, VIEWS, mode=mode)
    prev, cur = (prepare_frame(perception(), index) for index in (1, 2))
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


def test_a_view_may_have_a_camera_of_its_own() -> None:
    closer = clip()[2].K.copy()
    closer[:2, :2] *= 1.5
    views = [View("plain", np.eye(4)), View("closer", np.eye(4), closer)]
    shown = forecast_frames(perception(), model(), 2, 1, views).frames[0]
    assert not np.array_equal(shown["plain"].image, shown["closer"].image)


def test_a_clip_is_perceived_and_told_of() -> None:
    """Stages are told with shares that grow to nearly 1; no later frame is looked at."""
    told: list[tuple[str, float]] = []
    result = forecast_clip(clip(), 2, 1, VIEWS, model(), progress=lambda stage, share: told.append((stage, share)))
    assert_same(result, forecast_frames(perception(), model(), 2, 1, VIEWS))
    shares = [share for _, share in told]
    assert shares == sorted(shares) and shares[0] == 0 and 0.8 < shares[-1] <= 1
    assert told[-1][0] == "network" and len({stage for stage, _ in told}) > 3
    short = forecast_clip(clip()[:3], 2, 1, VIEWS, model())
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

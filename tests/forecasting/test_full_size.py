"""Views at the clip's own size, of scenes perceived at a smaller one."""

import functools
from typing import Any, Literal

import numpy as np
import pytest
import torch

import vestcl
from vestcl.data.resize import resize_image
from vestcl.data.sample import Clip
from vestcl.data.street import input as street_input
from vestcl.evaluation import metrics
from vestcl.forecasting.full_size import enlarged, lookup, without
from vestcl.forecasting.geometric import Perception, forecast_clip, forecast_frames, show_frame
from vestcl.forecasting.geometric.forecast import working_frames
from vestcl.forecasting.network.forecast import forecast_frames as forecast_network
from vestcl.forecasting.network.learned import REFINEMENT
from vestcl.forecasting.result import Forecast, LearnedPart, Rendered, View
from vestcl.forecasting.views import parse_view
from vestcl.models.forecaster import Forecaster

SIZE = 128, 416
SOURCE, STEPS, NOW = View("source", np.eye(4)), 2, 2
RNG = np.random.default_rng(3)
RECORDED = RNG.random((3, 24, 36)).astype(np.float32)
SMALL = resize_image(RECORDED, 12, 18)


def seen(shift: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(18), np.arange(12))
    return np.stack([x + shift, y, np.ones_like(x)]).astype(np.float32)


def test_what_is_shown_as_it_was_recorded_is_the_recorded_image() -> None:
    each = lookup(RECORDED, seen(), SMALL, np.ones((12, 18), np.float32))
    np.testing.assert_allclose(enlarged(SMALL, [each], 24, 36), RECORDED, atol=1e-6)


def test_an_offset_of_the_working_size_is_twice_as_long_at_twice_the_size() -> None:
    each = lookup(RECORDED, seen(3), SMALL, np.ones((12, 18), np.float32))
    np.testing.assert_allclose(enlarged(SMALL, [each], 24, 36)[..., :30], RECORDED[..., 6:], atol=1e-6)


@pytest.mark.parametrize("part", ["no single surface", "an edge of depth", "another cloud in front"])
def test_elsewhere_the_smaller_image_is_shown(part: str) -> None:
    at, share = seen(), np.ones((12, 18), np.float32)
    if part == "no single surface":
        at[2] = 0
    if part == "an edge of depth":
        at[0] += np.where(np.arange(18) % 2, 0, 40)
    each = lookup(RECORDED, at, SMALL, share)
    kept = without([each], np.ones((12, 18), bool)) if part == "another cloud in front" else [each]
    np.testing.assert_allclose(enlarged(SMALL, kept, 24, 36), resize_image(SMALL, 24, 36), atol=1e-6)


def test_shares_of_two_images_add_up() -> None:
    half = np.full((12, 18), 0.5, np.float32)
    dark = RECORDED / 2
    both = [lookup(RECORDED, seen(), SMALL, half), lookup(dark, seen(), SMALL / 2, half)]
    np.testing.assert_allclose(enlarged(SMALL * 0.75, both, 24, 36), 0.75 * RECORDED, atol=1e-6)


@functools.cache
def street() -> Clip:
    parsed = street_input.parse("street:5")
    assert parsed is not None
    return street_input.clip(5, parsed.driven, NOW + STEPS + 1, SIZE)


@functools.cache
def forecast(work_width: int | None) -> Forecast:
    return forecast_clip(street(), NOW, STEPS, [SOURCE], work_width=work_width)


def psnr(forecast: Forecast, step: int = 1) -> float:
    image, truth = forecast.frames[step - 1]["source"].image, street()[NOW + step].read_image()
    return float(metrics.psnr(*(torch.from_numpy(each[None]) for each in (image, truth))))


def test_a_forecast_at_half_the_width_has_the_clips_size_and_nearly_its_quality() -> None:
    small = forecast(SIZE[1] // 2)
    shown = small.frames[0]["source"]
    assert [part.shape for part in (shown.image, shown.depth, shown.coverage, shown.motion_xyz)] == [
        (channels, *SIZE) for channels in (3, 1, 1, 3)
    ]
    assert shown.lookups == ()
    assert psnr(small) > psnr(forecast(None)) - 0.7
    low = working_frames(Perception(street(), work_width=SIZE[1] // 2), NOW, STEPS, [SOURCE]).frames[0]["source"]
    upsampled = Rendered(low.image, low.depth, low.coverage, low.motion_xyz).at_size(*SIZE)
    assert psnr(small) > psnr(Forecast("upsampled", [], [{"source": upsampled}])) + 0.3


def test_the_forecast_says_what_width_it_worked_at() -> None:
    assert "perceived and splatted at 208 px, shown at 416 px (--work-width)" in forecast(SIZE[1] // 2).notes
    assert forecast(None).notes == forecast(2 * SIZE[1]).notes == ()


def test_a_clip_that_is_no_wider_is_worked_at_as_it_is() -> None:
    np.testing.assert_array_equal(
        forecast(None).frames[1]["source"].image, forecast(2 * SIZE[1]).frames[1]["source"].image
    )


def test_a_views_own_camera_is_of_the_recorded_size() -> None:
    K = street()[NOW].K
    views = [SOURCE, View("own", np.eye(4), K)]
    shown = forecast_frames(Perception(street(), work_width=208), NOW, 1, views).frames[0]
    np.testing.assert_allclose(shown["own"].image, shown["source"].image, atol=1e-4)


@pytest.mark.parametrize("learned", ["tested", "all"])
def test_a_networks_views_have_cameras_of_the_recorded_size(
    learned: Literal["tested", "all"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where its refinement counts."""
    used = {REFINEMENT: LearnedPart(True, "for the test")}
    monkeypatch.setattr("vestcl.forecasting.network.forecast.choose_parts", lambda *given: used)
    views = [
        SOURCE,
        View("own", np.eye(4), street()[NOW].K),
        View("aside", np.eye(4), street()[NOW].K * [[1.2], [1.2], [1]]),
    ]
    model = Forecaster.from_pretrained("vest-s")
    shown = forecast_network(Perception(street(), work_width=208), model, NOW, 1, views, learned=learned).frames[0]
    np.testing.assert_allclose(shown["own"].image, shown["source"].image, atol=1e-3)
    geometric = forecast_frames(Perception(street(), work_width=208), NOW, 1, views).frames[0]
    most = {"tested": 0.03, "all": 0.08}[learned]  # its own forecast is another one; a wrong camera is off by 0.2
    assert float(np.abs(shown["aside"].image - geometric["aside"].image).mean()) < most


def test_a_frame_itself_is_shown_at_the_recorded_size() -> None:
    image = show_frame(Perception(street(), work_width=208), NOW, [SOURCE])["source"].image
    recorded = street()[NOW].read_image()
    assert image.shape == recorded.shape
    assert np.median(np.abs(image - recorded)) < 1 / 255


@pytest.mark.parametrize("how", [{"learned": "all"}, {"learned": "tested"}, {"mode": "feedback"}])
def test_a_networks_forecast_has_the_clips_size(how: dict[str, Any]) -> None:
    made = vestcl.forecast(street(), NOW, steps=2, views=["source", "0.5,0,0"], model="vest-s", work_width=208, **how)
    for view in made:
        assert [frame.image.shape for frame in made[view]] == [(3, *SIZE)] * 2
        assert [frame.depth.shape for frame in made[view]] == [(1, *SIZE)] * 2


def test_a_view_of_a_narrow_field_is_covered() -> None:
    """Three times as large, the image's middle is a surface still."""
    shown = forecast_clip(street(), NOW, 1, [parse_view("0,0,0,fov=30,name=near", street())], work_width=208).frames[0]
    assert shown["near"].coverage.mean() > 0.95


@pytest.mark.parametrize("width", ["160", 160.0, True, [160], float("inf")])
def test_a_width_that_is_no_whole_number_is_refused(width: Any) -> None:
    with pytest.raises(ValueError, match="`work_width` must be a whole number of px, or None, got"):
        Perception(street(), work_width=width)
    with pytest.raises(ValueError, match="`work_width` must be a whole number of px, or None, got"):
        vestcl.Live(np.array([[99.0, 0, 80], [0, 99, 24], [0, 0, 1]]), work_width=width)


def test_a_width_at_which_nothing_is_left_of_the_height_is_refused() -> None:
    wide = street().resized(40, 640)
    with pytest.raises(ValueError, match="`work_width` must be 192 px or more for images of 40 x 640 px, 12 px high"):
        Perception(wide, work_width=160)
    assert Perception(wide, work_width=192).clip[0].height == 12


@pytest.mark.parametrize("work_width", [None, 208])
def test_frames_of_two_sizes_are_refused(work_width: int | None) -> None:
    mixed = Clip("mixed", "arrays", (*street()[:2].samples, street()[2].resized(64, 208)))
    with pytest.raises(ValueError, match="mixed: frames must have one size, 128 x 416 px as the first, got 64 x 208"):
        Perception(mixed, work_width=work_width).image(2)


@pytest.mark.parametrize("width", [0, 1, 63, -5])
def test_a_width_that_is_too_small_is_refused(width: int) -> None:
    with pytest.raises(ValueError, match=f"`work_width` must be 64 px or more, got {width}"):
        Perception(street(), work_width=width)

"""vestcl.forecasting.network.learned and its backtest: a network corrects the geometric forecast by what would have
improved it before."""

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, change, stir
from learned_networks import BOUNDED, model, stir_all
from torch import nn

from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip
from vestcl.forecasting import geometric
from vestcl.forecasting.geometric import Perception, render
from vestcl.forecasting.geometric.paths import forecast_cameras, point_paths
from vestcl.forecasting.network import backtest as learned_backtest
from vestcl.forecasting.network import forecast as network
from vestcl.forecasting.network.backtest import choose_parts
from vestcl.forecasting.network.learned import CorrectedPaths, corrections, forecast_path, given_input
from vestcl.forecasting.result import LearnedPart, View
from vestcl.models.config import MOST_CHANGE
from vestcl.models.forecaster import Forecaster

HEIGHT, WIDTH = 48, 160
RIGHT = np.eye(4)
RIGHT[0, 3] = -0.54
VIEWS = [View("source", np.eye(4)), View("right", RIGHT), View("again", np.eye(4))]


@functools.cache
def clip() -> Clip:
    return street_clip(Street.generate(3), 7, HEIGHT, WIDTH)


@functools.cache
def perception() -> Perception:
    return Perception(clip())


def parts(made: Forecaster, index: int = 4, **how: Any) -> dict[str, LearnedPart]:
    with torch.inference_mode():
        return choose_parts(how.get("perception", perception()), made, index, how.get("known", True))


def images(forecast: Any) -> list[np.ndarray]:
    return [frame[name].image for frame in forecast.frames for name in frame]


def assert_geometric(made: Any, index: int = 4) -> None:
    wanted = geometric.forecast_frames(perception(), index, len(made.frames), VIEWS)
    for one, other in zip(images(made), images(wanted), strict=True):
        assert np.array_equal(one, other)
    for got, pose in zip(made.future_from_cur, wanted.future_from_cur, strict=True):
        np.testing.assert_array_equal(got, pose)


# ---------------------------------------------------------------- the prior


def test_the_prior_is_the_geometric_forecasts_camera() -> None:
    """All intervals, at any frame; as measured they are the last four motions."""
    for index in (1, 2, 5):
        wanted = forecast_cameras(perception(), index, [1, 2, 3])
        path = forecast_path(perception(), index, 3)
        for got, pose in zip(path.future_from_cur, wanted, strict=True):
            np.testing.assert_array_equal(got, pose)
        assert int(path.measured[:, -1].sum()) == min(index, 4) and path.seconds == pytest.approx(0.1)
        given = given_input(perception(), index, "forecast", 3)
        with torch.inference_mode():
            found = corrections(model(), given, 3)
        for got, pose in zip(found.cameras, wanted, strict=True):
            np.testing.assert_allclose(got, pose, atol=2e-5)


# ---------------------------------------------------------------- the choice


def test_a_network_that_adds_nothing_is_the_geometric_forecast() -> None:
    """To the last bit: closed gates, object motion and refinement as they start."""
    made = network.forecast_frames(perception(), model(), 4, 3, VIEWS)
    assert_geometric(made)
    assert made.method == "small" or made.method == BOUNDED.name
    assert "camera" not in made.learned and not made.learned["refinement"].used


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_camera_that_is_worse_is_left_out(sign: int) -> None:
    """One percent of yaw too much: the test has the numbers, and the forecast is the geometric one."""
    made = network.forecast_frames(perception(), model(camera=0.9 * sign), 4, 2, VIEWS)
    camera = made.learned["camera"]
    assert not camera.used and camera.psnr is not None and camera.psnr_without is not None
    assert camera.psnr < camera.psnr_without - 0.1 and f"{camera.psnr:.2f} dB at frame" in camera.why
    assert_geometric(made)


def test_a_camera_that_is_better_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """The geometric forecast is wrong in yaw by what the network corrects: in both tests, and in the forecast."""
    wrong = np.eye(4)
    angle = 0.9 * 0.25 * 0.1
    wrong[:3, :3] = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    from vestcl.forecasting.network import learned

    original = learned.camera_path

    def off(*arguments: Any) -> Any:
        path = original(*arguments)
        futures, before, true = [], np.eye(4), np.eye(4)
        for pose in path.future_from_cur:
            before = wrong @ pose @ np.linalg.inv(true) @ before
            futures.append(before)
            true = pose
        return path._replace(future_from_cur=tuple(futures))

    monkeypatch.setattr(learned, "camera_path", off)
    made = network.forecast_frames(perception(), model(camera=0.9), 4, 2, VIEWS)
    camera = made.learned["camera"]
    assert camera.used and camera.why.count("dB at frame") == 3 and "from 2 frames before" in camera.why
    right = forecast_cameras(perception(), 4, [1, 2])
    for got, pose in zip(made.future_from_cur, right, strict=True):
        np.testing.assert_allclose(got, pose, atol=2e-3)


def test_all_tests_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """At t, at t - 1, and for motion two frames ahead; what loses one is left out and tested no further."""
    asked = []

    def tested(perception: Any, made: Any, start: int, ahead: int, back: int, wanted: Any) -> dict[str, LearnedPart]:
        asked.append((start, ahead, back, tuple(wanted)))
        used = {"camera": ahead == 1, "objects": back == 1, "refinement": True}
        return {part: LearnedPart(used[part], f"{start} {ahead}") for part in wanted}

    monkeypatch.setattr(learned_backtest, "_tested", tested)
    found = parts(stir_all(model(camera=0.5)))
    every = ("camera", "objects", "refinement")
    assert asked == [(3, 1, 1, every), (2, 1, 2, every), (2, 2, 2, ("camera",))]
    assert {part: one.used for part, one in found.items()} == {"camera": False, "objects": False, "refinement": True}
    assert [found[part].why for part in every] == ["3 1; 2 1; 2 2", "3 1; 2 1", "3 1; 2 1"]


@pytest.mark.parametrize("ahead", [1, 2])
def test_the_test_by_hand(ahead: int) -> None:
    """A wall 8 m away that moves 3 px per interval with the camera, at a pixel each: right at the true motion only."""
    rng = np.random.default_rng(0)
    strip = cv2.GaussianBlur(rng.random((40, 200), np.float32), (0, 0), 2.0)
    image, prev = (np.stack([strip[:, at : at + 80]] * 3) for at in (3 * ahead, 0))
    K = np.array([[40.0, 0, 40], [0, 40, 20], [0, 0, 1]])
    planes = np.full((1, 40, 80), 8, np.float32), np.zeros((3, 40, 80), np.float32), np.ones((40, 80), bool)
    test = learned_backtest._Test("f", image, prev, *planes, K, ahead, 1)
    true, still = np.eye(4), np.eye(4)
    true[0, 3] = -3 * ahead * 8 / 40
    found = test.verdict(test.positions(still), test.positions(true))
    assert found.used and found.psnr is not None and found.psnr > 60 and (found.psnr_without or 99) < 30
    assert not test.verdict(test.positions(true), test.positions(still)).used
    assert not test.verdict(test.positions(true), test.positions(true)).used  # no better is not enough
    velocity = np.zeros((3, 40, 80), np.float32)
    velocity[0] = -3 * 8 / 40
    moved = test.verdict(test.positions(still), test.positions(still, velocity), where=velocity[0] != 0)
    assert moved.used and moved.psnr == pytest.approx(found.psnr, abs=0.1)
    brighter = test.verdict(test.positions(true), test.positions(true), added=np.full_like(image, 0.1))
    assert not brighter.used
    nowhere = test.verdict(test.positions(still), test.positions(true), where=np.zeros((40, 80), bool))
    assert nowhere == LearnedPart(False, "what it changes is too small to be tested")


def test_corrected_velocities_move_points_further() -> None:
    """R n v, on top of what the candidates say; at n = 0 nothing."""
    paths = point_paths(perception(), 4)
    more = np.zeros_like(paths.frame.velocity)
    more[:, 10:20, 30:60] = np.array([0.5, 0.0, -0.25], np.float32)[:, None, None]
    corrected = CorrectedPaths(paths.frame, paths.errors, paths.by_flow, more)
    future = forecast_cameras(perception(), 4, [3])[0]
    wanted = paths.at(3, future) + np.einsum("ij,jhw->ihw", future[:3, :3], 3 * more.astype(np.float64))
    np.testing.assert_allclose(corrected.at(3, future), wanted, atol=1e-6)
    np.testing.assert_array_equal(corrected.at(0, np.eye(4)), paths.at(0, np.eye(4)))


def test_objects_that_are_better_are_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera stays the geometric forecast's; only object motion's answer is added."""
    noisy = stir_all(model())
    monkeypatch.setattr(network, "choose_parts", lambda *_: {"objects": LearnedPart(True, "")})
    made = network.forecast_frames(perception(), noisy, 4, 1, VIEWS)
    plain = geometric.forecast_frames(perception(), 4, 1, VIEWS)
    np.testing.assert_array_equal(made.future_from_cur[0], plain.future_from_cur[0])
    assert not np.array_equal(made.frames[0]["source"].image, plain.frames[0]["source"].image)


def test_noise_is_left_out() -> None:
    made = network.forecast_frames(perception(), stir_all(model()), 4, 2, VIEWS)
    assert not any(one.used for one in made.learned.values())
    assert_geometric(made)


def test_refinement_that_is_better_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the geometric image, in every view and step: what the network's own image has more than its base."""
    noisy = stir_all(model())
    monkeypatch.setattr(network, "choose_parts", lambda *_: {"refinement": LearnedPart(True, "", 30.0, 20.0)})
    made = network.forecast_frames(perception(), noisy, 4, 2, VIEWS)
    plain = geometric.forecast_frames(perception(), 4, 2, VIEWS)
    given = given_input(perception(), 4, "forecast", 2)
    with torch.inference_mode():
        own = noisy.forecast(
            given.frame_prev, given.frame_cur, given.K, 2, prior=given.prior._replace(corrected=torch.tensor([False]))
        )
        still = noisy.refine
        nn.init.zeros_(list(still.parameters())[-1])
        nn.init.zeros_(list(still.parameters())[-2])
        base = noisy.forecast(
            given.frame_prev, given.frame_cur, given.K, 2, prior=given.prior._replace(corrected=torch.tensor([False]))
        )
    for step in (0, 1):
        added = (own[step].views[0].image - base[step].views[0].image)[0].numpy()
        wanted = (plain.frames[step]["source"].image + added).clip(0, 1)
        got = made.frames[step]["source"].image
        inside = (own[step].views[0].image[0].numpy() > 0) & (own[step].views[0].image[0].numpy() < 1)
        assert np.abs(got - wanted)[inside].max() < 1e-4 and np.abs(added).max() > 0.01
        assert np.array_equal(got, made.frames[step]["again"].image)
        assert not np.array_equal(made.frames[step]["right"].image, plain.frames[step]["right"].image)


def test_a_refinement_of_forecasts_is_tested_on_them() -> None:
    """What it adds to the forecast of frames that were seen decides; all views and steps get it."""
    made = forecast_refinement()
    still = network.forecast_frames(perception(), made, 4, 2, VIEWS)
    assert not still.learned["refinement"].used
    assert_geometric(still)
    darker = forecast_refinement(-0.05)
    assert not network.forecast_frames(perception(), darker, 4, 1, VIEWS).learned["refinement"].used


def test_a_refinement_of_forecasts_that_is_better_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every geometric forecast is 0.05 too dark: what brightens it wins both tests."""
    original = render.rendered

    def dark(*arguments: Any) -> Any:
        found = original(*arguments)
        return dataclasses.replace(found, image=(found.image - np.float32(0.05)).clip(0, 1))

    plain = geometric.forecast_frames(perception(), 4, 2, VIEWS)
    monkeypatch.setattr("vestcl.forecasting.geometric.forecast.rendered", dark)
    forecast = network.forecast_frames(perception(), forecast_refinement(0.05), 4, 2, VIEWS)
    assert forecast.learned["refinement"].used and forecast.learned["refinement"].why.count("dB at frame") == 2
    for frame, wanted in zip(forecast.frames, plain.frames, strict=True):
        for name in ("source", "right"):
            inside = (wanted[name].image > 0.06) & (wanted[name].coverage > 0.6)
            np.testing.assert_allclose(frame[name].image[inside], wanted[name].image[inside], atol=1e-4)
    assert forecast.profile["refine"] > 0 and forecast.profile["splat"] == 0


def forecast_refinement(brighter: float = 0.0) -> Forecaster:
    """A refinement of geometric forecasts that brightens covered pixels by so much."""
    refine = dataclasses.replace(BOUNDED.refine, refines="forecast")
    made = Forecaster(dataclasses.replace(BOUNDED, refine=refine)).eval()
    assert made.refine.out.bias is not None
    nn.init.constant_(made.refine.out.bias, float(np.arctanh(brighter / MOST_CHANGE)))
    return made


def test_only_frames_up_to_t_are_read() -> None:
    """A later frame that can't be read changes nothing, nor does a clip that ends at t."""

    def fail() -> Any:
        raise AssertionError("a frame after t was read")

    broken = SimpleNamespace(read=fail)
    later = tuple(
        dataclasses.replace(sample, image=broken, depth=broken, labels=broken) if i > 4 else sample
        for i, sample in enumerate(clip())
    )
    noisy = stir_all(model(camera=0.3))
    whole = network.forecast_frames(perception(), noisy, 4, 2, VIEWS)
    for other in (dataclasses.replace(clip(), samples=later), clip()[:5]):
        made = network.forecast_frames(Perception(other), noisy, 4, 2, VIEWS)
        assert made.learned == whole.learned
        assert all(np.array_equal(one, two) for one, two in zip(images(made), images(whole), strict=True))


def test_what_was_seen_before_changes_nothing() -> None:
    """A sequence that is worked through has the same choice as a single frame."""
    noisy, before = stir_all(model(camera=0.3)), Perception(clip())
    for index in (3, 4):
        network.forecast_frames(before, noisy, index, 1, VIEWS)
    again = network.forecast_frames(before, noisy, 5, 1, VIEWS)
    single = network.forecast_frames(Perception(clip()), stir_all(model(camera=0.3)), 5, 1, VIEWS)
    assert again.learned == single.learned


@pytest.mark.parametrize("index", [1, 2])
def test_without_frames_to_test_on_parts_are_left_out(index: int) -> None:
    made = network.forecast_frames(perception(), model(camera=0.5), index, 1, VIEWS)
    assert {one.why for one in made.learned.values()} == {"there are too few frames before to test it on"}
    assert_geometric(made, index)


@pytest.mark.parametrize(
    ("elapsed", "lost", "words"),
    [
        ({4: 1.0, 3: 1.0}, (), "None"),
        ({4: 1.5, 3: 1.0}, (), "not evenly spaced"),
        ({4: 1.0, 3: 2.0}, (), "not evenly spaced"),
        ({4: 1.0, 3: 1.0}, (3,), "a gap before the last frames"),
    ],
)
def test_uneven_frames_are_no_test(elapsed: dict[int, float], lost: tuple[int, ...], words: str) -> None:
    seen: Any = SimpleNamespace(clip=SimpleNamespace(elapsed=elapsed.__getitem__), is_lost=lost.__contains__)
    assert words in str(learned_backtest._untestable(seen, 4))


def test_a_network_of_another_interval_is_not_tested() -> None:
    made = parts(stir_all(model(camera=0.5)), known=False)
    assert made["camera"].why == made["objects"].why == "it learned at 0.1 s from frame to frame"
    assert made["refinement"].psnr is not None


def test_the_shipped_network_loads_and_says_why() -> None:
    """vest-s learned to correct constant velocity: with all parts it forecasts as it did, tested it is left out."""
    shipped = Forecaster.from_pretrained("vest-s")
    assert shipped.config.prior == "velocity" and shipped.config.ego_motion is not None
    assert shipped.config.ego_motion.correction == "linear"
    found = parts(shipped)
    assert not found["camera"].used and "constant velocity" in found["camera"].why


# ---------------------------------------------------------------- turned off


def test_all_parts_are_the_networks_own_forecast() -> None:
    noisy = stir_all(model(camera=0.5))
    made = network.forecast_frames(perception(), noisy, 4, 2, VIEWS, learned="all")
    given = given_input(perception(), 4, "forecast", 2)
    with torch.inference_mode():
        own = noisy.forecast(given.frame_prev, given.frame_cur, given.K, 2, prior=given.prior, own=given.own)
    for frame, step in zip(made.frames, own, strict=True):
        assert np.array_equal(frame["source"].image, step.views[0].image[0].clamp(0, 1).numpy())
    assert made.learned == {}
    with pytest.raises(ValueError, match='`learned` must be "tested" or "all", got \'some\''):
        network.forecast_frames(perception(), noisy, 4, 1, VIEWS, learned="some")  # type: ignore[arg-type]


def test_models_from_rest_and_feedback_are_as_they_were() -> None:
    torch.manual_seed(0)
    rest = stir(Forecaster(change())).eval()
    for made, mode in ((rest, None), (stir(Forecaster(SMALL)).eval(), "feedback")):
        tested, every = (
            network.forecast_frames(perception(), made, 4, 1, VIEWS, mode=mode, learned=learned)  # type: ignore[arg-type]
            for learned in ("tested", "all")
        )
        assert tested.learned == {}
        assert all(np.array_equal(one, two) for one, two in zip(images(tested), images(every), strict=True))

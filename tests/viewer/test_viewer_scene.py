"""What the viewer renders: still images as `vestcl.forecast` has them, coarse ones like them, any time ahead."""

import time
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

import vestcl
from vestcl import opencl
from vestcl.forecasting.network import backtest
from vestcl.forecasting.network import forecast as network
from vestcl.forecasting.network.learned import PARTS
from vestcl.forecasting.result import LearnedPart, View
from vestcl.forecasting.views import parse_view
from vestcl.opencl import selection
from vestcl.viewer.engine import Engine, Wanted
from vestcl.viewer.motion import MOST_AHEAD
from vestcl.viewer.scene import Scene

SIZE = {"height": 48, "width": 160}
NOW = 3


@pytest.fixture(scope="module")
def clip() -> vestcl.Clip:
    return vestcl.open("street:7", frames=6, **SIZE)


@pytest.fixture(scope="module")
def engine(clip: vestcl.Clip) -> Iterator[Engine]:
    made = Engine(clip, "vest-s")
    yield made
    made.close()


def scene_of(engine: Engine, method: str, frame: int = NOW) -> Scene:
    wanted, until = Wanted(frame, method, "balanced"), time.monotonic() + 60
    while (scene := engine.scene(wanted)) is None:
        assert engine.fault(wanted) is None and time.monotonic() < until
        time.sleep(0.02)
    return scene


@pytest.fixture(scope="module")
def scene(engine: Engine) -> Scene:
    return scene_of(engine, "geometric")


@pytest.fixture(scope="module")
def aside(clip: vestcl.Clip) -> View:
    return parse_view("0.6,-0.3,0.4,yaw=-6,fov=70,name=aside", clip[NOW])


def decibels(image: NDArray[np.float32], wanted: NDArray[np.float32]) -> float:
    return float(-10 * np.log10(np.square(image - wanted).mean()))


@pytest.mark.parametrize("method", ["geometric", "vest-s"])
def test_a_still_image_is_the_forecast(clip: vestcl.Clip, engine: Engine, aside: View, method: str) -> None:
    model = None if method == "geometric" else method
    assert method in engine.methods
    future = vestcl.forecast(clip, NOW, steps=3, views=["source", aside], model=model)
    scene = scene_of(engine, method)
    for view in (View("source", np.eye(4)), aside):
        for step in (3, 1, 2):
            rendered, wanted = scene.render(float(step), view), future[view.name][step]
            assert np.abs(rendered.image - wanted.image).max() <= 1 / 255
            np.testing.assert_allclose(rendered.depth, wanted.depth, rtol=1e-3, atol=1e-3)
            np.testing.assert_allclose(rendered.coverage, wanted.coverage, atol=1e-3)


def test_a_still_image_of_a_clip_wider_than_what_is_worked_at(
    clip: vestcl.Clip, aside: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vestcl.viewer.engine.WORK_WIDTH", 80)
    engine = Engine(clip)
    try:
        scene = scene_of(engine, "geometric")
        future = vestcl.forecast(clip, NOW, steps=2, views=["source", aside], work_width=80)
        for view in (View("source", np.eye(4)), aside):
            rendered, wanted = scene.render(2.0, view), future[view.name][2]
            assert rendered.image.shape == wanted.image.shape == (3, SIZE["height"], SIZE["width"])
            assert np.abs(rendered.image - wanted.image).max() <= 1 / 255
        assert scene.render_coarse(2.0, aside, 2).image.shape == (3, SIZE["height"] // 4, SIZE["width"] // 4)
    finally:
        engine.close()


def test_a_still_image_with_all_learned_parts(clip: vestcl.Clip, aside: View, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if each part had passed its test; here none may."""
    chosen = {part: LearnedPart(True, "the test has it") for part in PARTS}
    for module in (backtest, network):
        monkeypatch.setattr(module, "choose_parts", lambda *given: chosen)
    wanted = vestcl.forecast(clip, NOW, steps=2, views=[aside], model="vest-s")["aside"][2]
    engine = Engine(clip, "vest-s")
    try:
        scene, geometric = (scene_of(engine, method) for method in ("vest-s", "geometric"))
        image = scene.render(2.0, aside).image
        assert np.abs(image - wanted.image).max() <= 1 / 255
        assert np.abs(image - geometric.render(2.0, aside).image).max() > 2 / 255
    finally:
        engine.close()


def test_now_and_before(clip: vestcl.Clip, scene: Scene) -> None:
    """At t the frame itself; at t-1, brought back by the measured motion, the frame before."""
    source = View("source", np.eye(4))
    assert decibels(scene.render(0.0, source).image, clip[NOW].read_image()) > 40
    before = clip[NOW - 1].read_image()
    back = decibels(scene.render(-1.0, source).image, before)
    assert back > decibels(clip[NOW].read_image(), before) + 2


def test_time_is_continuous(scene: Scene) -> None:
    """Half an interval lies between the two whole ones, for cameras and for images."""
    forward = [-scene.motion.camera(ahead)[2, 3] for ahead in (-1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)]
    assert forward == sorted(forward) and len(set(forward)) == len(forward)
    source = View("source", np.eye(4))
    first, half, second = (scene.render(ahead, source).image for ahead in (1.0, 1.5, 2.0))
    assert decibels(half, first) > decibels(second, first)
    np.testing.assert_array_equal(scene.render(1.49999, source).image, half)
    assert np.isfinite(scene.render(float(MOST_AHEAD), source).image).all()


@pytest.mark.parametrize("stride", [2, 4])
def test_coarse_images_are_like_full_ones(scene: Scene, aside: View, stride: int) -> None:
    full, coarse = scene.render(2.0, aside), scene.render_coarse(2.0, aside, stride)
    assert coarse.image.shape == (3, 48 // stride, 160 // stride)
    blocks = full.image.reshape(3, 48 // stride, stride, 160 // stride, stride).mean((2, 4))
    assert decibels(coarse.image, blocks) > 20
    shifted = np.roll(blocks, 2, axis=2)
    assert decibels(coarse.image, blocks) > decibels(coarse.image, shifted) + 2


def test_cameras_points_and_velocities(clip: vestcl.Clip, scene: Scene) -> None:
    paths = scene.cameras
    assert len(paths.past) == 3 and len(paths.forecast) == MOST_AHEAD and len(paths.true) == len(clip) - 1 - NOW
    past, future = [pose[2, 3] for pose in paths.past], [pose[2, 3] for pose in paths.forecast]
    assert past == sorted(past) and past[-1] < 0 < future[0] and future == sorted(future)
    assert paths.true[0][2, 3] == pytest.approx(future[0], rel=0.1)
    points, colours = scene.points(2.0, most=1000)
    assert points.shape == colours.shape and 100 < len(points) <= 1000 and colours.dtype == np.uint8
    arrows = scene.velocities(0.0)
    assert arrows.shape[1:] == (2, 3) and np.isfinite(arrows).all()


def test_arrows_start_where_objects_are_at_that_time(engine: Engine) -> None:
    scene = next(scene for frame in (3, 2, 4) if len((scene := scene_of(engine, "geometric", frame)).velocities(0.0)))
    now, later = scene.velocities(0.0), scene.velocities(5.0)
    camera = scene.motion.camera(5.0)
    np.testing.assert_allclose(later[:, 0], now[:, 1] @ camera[:3, :3].T + camera[:3, 3], atol=1e-3)


def test_true_frames_are_read_when_they_are_asked_for(clip: vestcl.Clip, engine: Engine, scene: Scene) -> None:
    assert engine.truth(NOW, 0.5) is None and engine.truth(NOW, 9.0) is None
    until = time.monotonic() + 30
    scene_of(engine, "geometric")
    while (truth := engine.truth(NOW, 2.0)) is None and time.monotonic() < until:
        time.sleep(0.02)
    assert truth is not None
    np.testing.assert_array_equal(truth, clip[NOW + 2].read_image())


def test_threads_use_the_device_that_was_chosen(clip: vestcl.Clip) -> None:
    seen = []
    with opencl.use(mapping="pixel") as chosen:
        engine = Engine(clip, when_ready=lambda ready: seen.append(selection.current()))
        try:
            scene_of(engine, "geometric")
        finally:
            engine.close()
    assert seen and all(session is chosen for session in seen)


def test_refusals(clip: vestcl.Clip) -> None:
    with pytest.raises(ValueError, match="must have 2 frames or more, got 1"):
        Engine(clip[:1])
    with pytest.raises(ValueError, match="no-such-model"):
        Engine(clip, "no-such-model")


def test_a_frame_that_fails_does_not_end_the_engine(clip: vestcl.Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    engine = Engine(clip)
    try:
        made = Engine._made

        def broken(self: Engine, wanted: Wanted) -> Scene:
            if wanted.frame == 2:
                raise ValueError("frame 2 is damaged")
            return made(self, wanted)

        monkeypatch.setattr(Engine, "_made", broken)
        wanted, until = Wanted(2, "geometric", "balanced"), time.monotonic() + 30
        while engine.fault(wanted) is None and time.monotonic() < until:
            assert engine.scene(wanted) is None
            time.sleep(0.02)
        assert engine.fault(wanted) == "frame 2 is damaged"
        assert scene_of(engine, "geometric", 1).index == 1
    finally:
        engine.close()

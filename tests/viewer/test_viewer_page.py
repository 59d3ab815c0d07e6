"""The viewer in headless Chromium with real mouse input."""

import itertools
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Tab, browser, chromium

import vestcl
from vestcl.forecasting.result import View
from vestcl.io.contact_sheet import rgb
from vestcl.io.exr import read_exr_frame
from vestcl.io.images import read_pixels
from vestcl.io.ply import read_ply
from vestcl.io.video.reading import Video
from vestcl.viewer import camera
from vestcl.viewer.server import Viewer

HEIGHT, WIDTH = 48, 160
NOW = 3

#: Where the mouse drags, px: between the page's notes and its controls.
DRAG = (290, 60), (310, 120)


@pytest.fixture(scope="module")
def clip() -> vestcl.Clip:
    return vestcl.open("street:7", frames=6, height=HEIGHT, width=WIDTH)


@pytest.fixture(scope="module")
def viewer(clip: vestcl.Clip) -> Iterator[Viewer]:
    chromium()
    with Viewer(clip, port=18080) as made:
        yield made


@pytest.fixture(scope="module")
def opened() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def tab(viewer: Viewer, opened: Any) -> Iterator[Tab]:
    made = Tab(opened, viewer.url)
    made.wait_for(WIDTH)
    yield made
    made.close()


def until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


def shown_view(viewer: Viewer, clip: vestcl.Clip) -> View:
    """Of the first visitor's camera."""
    visitor = next(iter(viewer.renderer.visitors.values()))
    return camera.view_of(visitor.pose(), clip[NOW].K, HEIGHT, WIDTH)


def middle(canvas: np.ndarray) -> np.ndarray:
    """The image without its bars."""
    bar = (canvas.shape[0] - HEIGHT) // 2
    return canvas[bar : bar + HEIGHT]


def set_ahead(viewer: Viewer, tab: Tab, ahead: float) -> None:
    shown = len(tab.times())
    viewer.page.ahead.value = ahead
    tab.wait_for(WIDTH, more_than=shown)


def test_only_this_machine_reaches_it(viewer: Viewer) -> None:
    assert viewer.server.get_host() == "127.0.0.1" and viewer.url.startswith("http://127.0.0.1:")
    port = viewer.server.get_port()
    socket.create_connection(("127.0.0.1", port), timeout=5).close()
    with pytest.raises(OSError):  # noqa: PT011  a server on all interfaces answers there
        socket.create_connection(("127.0.0.2", port), timeout=5).close()


def test_it_asks_for_nothing_outside(tab: Tab) -> None:
    assert tab.outside == []


def test_a_drag_changes_the_picture(viewer: Viewer, clip: vestcl.Clip, tab: Tab) -> None:
    before, shown, pose = middle(tab.pixels()), len(tab.times()), shown_view(viewer, clip).tgt_from_next
    np.testing.assert_allclose(pose, np.eye(4), atol=1e-6)
    tab.drag(*DRAG, steps=30)
    tab.wait_for(WIDTH, more_than=shown + 1)
    widths = tab.page.evaluate(f"window.shown.slice({shown}).map((each) => each[1])")
    assert min(widths) <= WIDTH // 2, "coarse images while it moves"
    moved = shown_view(viewer, clip).tgt_from_next
    assert np.abs(moved - pose).max() > 0.05
    images = [tab.pixels()]
    while images[-1].shape[1] != WIDTH:  # a slow drag has full images on its way, and coarse ones after them
        tab.wait_for(WIDTH)
        images.append(tab.pixels())
    assert np.abs(middle(images[-1]).astype(int) - before).mean() > 2


@pytest.mark.parametrize("step", [1, 3])
def test_a_still_picture_is_the_forecast(viewer: Viewer, clip: vestcl.Clip, tab: Tab, step: int) -> None:
    """In the browser's own pixels, at the camera that the mouse left."""
    set_ahead(viewer, tab, float(step))
    view = shown_view(viewer, clip)
    wanted = rgb(vestcl.forecast(clip, NOW, steps=step, views=[view])[view.name][step].image)
    assert np.abs(middle(tab.pixels()).astype(int) - wanted).max() <= 1


def test_the_frame_slider(viewer: Viewer, tab: Tab) -> None:
    """By the keyboard: the next frame is shown, and back again at once."""
    thumb, shown = tab.page.get_by_role("slider").first, len(tab.times())
    thumb.focus()
    thumb.press("ArrowRight")
    until(lambda: int(viewer.page.frame.value) == NOW + 1)
    tab.wait_for(WIDTH, more_than=shown)
    until(lambda: (current := viewer.renderer.current()) is not None and current[0].index == NOW + 1)
    thumb.press("ArrowLeft")
    until(lambda: (current := viewer.renderer.current()) is not None and current[0].index == NOW, 5)
    tab.wait_for(WIDTH, more_than=shown + 1)


def test_panels(viewer: Viewer, clip: vestcl.Clip, tab: Tab) -> None:
    set_ahead(viewer, tab, 2.0)
    until(lambda: viewer.page.panels["truth"].image.shape == (HEIGHT, WIDTH, 3))
    wanted = rgb(clip[NOW + 2].read_image())
    until(lambda: bool((viewer.page.panels["truth"].image == wanted).all()))
    for name in ("error", "depth", "coverage"):
        assert viewer.page.panels[name].image.shape == (HEIGHT, WIDTH, 3) and viewer.page.panels[name].image.any()


def test_colour_modes_and_points(viewer: Viewer, tab: Tab) -> None:
    seen = [tab.pixels()]
    for colour in ("depth", "coverage", "motion", "colour"):
        shown = len(tab.times())
        viewer.page.colour.value = colour
        tab.wait_for(WIDTH, more_than=shown)
        seen.append(tab.pixels())
    assert all((first != second).any() for first, second in itertools.pairwise(seen))
    np.testing.assert_array_equal(seen[0], seen[-1])
    viewer.page.points.value = True
    until(lambda: viewer.page._drawn[3:4] == (True,))
    viewer.page.points.value = False


def press(tab: Tab, name: str) -> None:
    tab.page.get_by_role("button", name=name, exact=True).click()


def downloaded(tab: Tab, name: str, folder: Path) -> Path:
    with tab.page.expect_download(timeout=60_000) as waiting:
        press(tab, name)
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path


def test_files(viewer: Viewer, clip: vestcl.Clip, tab: Tab, tmp_path: Path) -> None:
    set_ahead(viewer, tab, 1.0)
    view = shown_view(viewer, clip)
    wanted = vestcl.forecast(clip, NOW, steps=1, views=[view])[view.name][1]
    image = read_pixels(downloaded(tab, "PNG", tmp_path))
    assert np.abs(image.astype(int) - rgb(wanted.image)).max() <= 1
    frame = read_exr_frame(downloaded(tab, "EXR", tmp_path))
    assert frame.image is not None and frame.depth is not None and frame.motion is not None
    np.testing.assert_allclose(frame.image, wanted.image, atol=1 / 255)
    np.testing.assert_allclose(frame.depth, wanted.depth, rtol=1e-3, atol=1e-3)
    points, _ = read_ply(downloaded(tab, "PLY", tmp_path))
    assert len(points) == (wanted.depth > 0).sum()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"street_7_t3_+1.0.{end}" for end in ("exr", "ply", "png")
    ]


def test_a_camera_path(viewer: Viewer, tab: Tab, tmp_path: Path) -> None:
    viewer.page.seconds.value = 0.5
    press(tab, "add keyframe")
    until(lambda: len(viewer.page.keyframes) == 1)
    press(tab, "save video")
    tab.page.get_by_text("a camera path needs 2 keyframes").wait_for(timeout=20_000)
    shown = len(tab.times())
    tab.drag(*DRAG)
    tab.wait_for(WIDTH, more_than=shown)
    press(tab, "add keyframe")
    until(lambda: len(viewer.page.keyframes) == 2)
    frames = list(Video(downloaded(tab, "save video", tmp_path)))
    assert len(frames) == 10 and frames[0].shape == (HEIGHT, WIDTH, 3)
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 2
    press(tab, "clear keyframes")
    until(lambda: viewer.page.keyframes == [])


def test_the_source_camera_again(viewer: Viewer, clip: vestcl.Clip, tab: Tab) -> None:
    shown = len(tab.times())
    press(tab, "source camera")
    tab.wait_for(WIDTH, more_than=shown)
    until(lambda: np.allclose(shown_view(viewer, clip).tgt_from_next, np.eye(4), atol=1e-5), 10)


def test_second_visitors_and_reloads_do_no_harm(viewer: Viewer, opened: Any, tab: Tab) -> None:
    other = Tab(opened, viewer.url)
    other.wait_for(WIDTH)
    until(lambda: len(viewer.renderer.visitors) == 2)
    before = len(tab.times())
    other.drag(*DRAG)
    other.wait_for(WIDTH, more_than=2)
    assert len(tab.times()) == before, "each visitor has a camera of their own"
    other.close()
    until(lambda: len(viewer.renderer.visitors) == 1)
    tab.page.reload()
    tab.wait_for(WIDTH)
    until(lambda: len(viewer.renderer.visitors) == 1)


def test_closing_ends_the_server(clip: vestcl.Clip, opened: Any) -> None:
    before = {thread.name for thread in threading.enumerate()}
    viewer = Viewer(clip, port=18090)
    waiting = threading.Thread(target=viewer.wait)
    waiting.start()
    tab = Tab(opened, viewer.url)
    tab.wait_for(WIDTH)
    press(tab, "close the viewer")
    waiting.join(10)
    assert not waiting.is_alive()
    viewer.close()
    port = viewer.server.get_port()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=5).close()
    tab.close()
    left = {thread.name for thread in threading.enumerate() if thread.name.startswith("vestcl view")} - before
    assert left == set()

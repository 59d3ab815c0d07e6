"""Headless Chromium as the viewer's tests use it: images that the page shows, counted and read in the browser."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

#: What Debian, others and Google call it.
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")

#: WebGL by the CPU: test machines have no graphics card. Root has no sandbox.
_ARGUMENTS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")

#: Notes when each image was uploaded to WebGL, that is shown, and keeps the last one's pixels where they are asked for.
_HOOK = """
window.shown = []; window.keepPixels = true; window.pixels = null;
const upload = WebGL2RenderingContext.prototype.texSubImage2D;
WebGL2RenderingContext.prototype.texSubImage2D = function (...given) {
  const image = given.find((each) => each instanceof HTMLImageElement);
  if (image) {
    window.shown.push([performance.now(), image.naturalWidth, image.naturalHeight]);
    if (window.keepPixels) {
      const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
      const context = canvas.getContext("2d");
      context.drawImage(image, 0, 0);
      window.pixels = Array.from(context.getImageData(0, 0, canvas.width, canvas.height).data);
    }
  }
  return upload.apply(this, given);
};
"""


def chromium() -> str:
    """Its path; the test is skipped where it is missing."""
    pytest.importorskip("viser", reason="the viewer's tests need viser: pip install 'vestcl[viewer]'")
    pytest.importorskip("playwright", reason="the viewer's tests need playwright: pip install playwright")
    found = next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip("the viewer's tests need chromium: apt-get install chromium")
    return found


@contextmanager
def browser() -> Iterator[Any]:
    """Playwright's browser."""
    path = chromium()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=path, args=list(_ARGUMENTS))
        try:
            yield opened
        finally:
            opened.close()


class Tab:
    """A page of the viewer that can't reach anything but the viewer.

    Args:
        opened: the browser.
        url: of the viewer.
        size: (width, height) px of the window.
    """

    def __init__(self, opened: Any, url: str, size: tuple[int, int] = (640, 260)) -> None:
        self.context = opened.new_context(viewport={"width": size[0], "height": size[1]}, accept_downloads=True)
        self.page = self.context.new_page()
        self.outside: list[str] = []
        self.page.add_init_script(_HOOK)
        self.page.route(lambda address: not address.startswith(url), self._refuse)
        self.page.goto(url)

    def _refuse(self, route: Any) -> None:
        self.outside.append(route.request.url)
        route.abort()

    def times(self) -> NDArray[np.float64]:
        """[N] ms, when images were shown."""
        return np.array(self.page.evaluate("window.shown.map((each) => each[0])"), np.float64)

    def wait_for(self, width: int, more_than: int = 0) -> None:
        """Until an image of that width, px, is the last of more than this many that were shown."""
        shown = f"window.shown.length > {more_than} && window.shown[window.shown.length - 1][1] === {width}"
        self.page.wait_for_function(shown, timeout=60_000)

    def pixels(self) -> NDArray[np.uint8]:
        """[H, W, 3] of the image that was shown last."""
        (_, width, height), values = self.page.evaluate("[window.shown[window.shown.length - 1], window.pixels]")
        flat = np.array(values, np.uint8)
        return flat.reshape(int(height), int(width), 4)[..., :3]

    def drag(self, start: tuple[int, int], end: tuple[int, int], steps: int = 10) -> None:
        """Press the mouse's button, move, release."""
        mouse = self.page.mouse
        mouse.move(*start)
        mouse.down()
        for step in range(1, steps + 1):
            mouse.move(*(first + (last - first) * step / steps for first, last in zip(start, end, strict=True)))
            self.page.wait_for_timeout(15)
        mouse.up()

    def close(self) -> None:
        """Close it."""
        self.context.close()

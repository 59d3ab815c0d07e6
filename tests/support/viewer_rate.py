"""Prints how many images per second the viewer shows in headless Chromium while the mouse drags the camera.

Counted in the browser, where images are uploaded to WebGL. The median is that of the rates of ten seconds, one each.
"""

import argparse
import math
import os
import time

import numpy as np
from browser import Tab, browser

import vestcl
from vestcl.viewer.server import Viewer

#: px: the canvas is as wide as the image, the controls take the rest.
WINDOW = (1152, 400)


def dragged(tab: Tab, seconds: float) -> None:
    """Move the mouse with its button down, in a figure around the canvas's middle."""
    mouse, start = tab.page.mouse, time.monotonic()
    mouse.move(400, 200)
    mouse.down()
    while (since := time.monotonic() - start) < seconds:
        mouse.move(400 + 60 * math.sin(4 * since), 200 + 20 * math.cos(5 * since))
        tab.page.wait_for_timeout(15)
    mouse.up()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--height", type=int, default=256)
    parser.add_argument("--width", type=int, default=832)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--screenshot", help="PNG of the page, afterwards")
    given = parser.parse_args()
    clip = vestcl.open("street:7", frames=12, height=given.height, width=given.width)
    with Viewer(clip, port=18200) as viewer, browser() as opened:
        tab = Tab(opened, viewer.url, WINDOW)
        tab.page.evaluate("window.keepPixels = false")
        tab.wait_for(given.width)
        tab.page.wait_for_timeout(15_000)  # neighbouring frames are prepared
        shown, start = len(tab.times()), tab.page.evaluate("performance.now()")
        dragged(tab, given.seconds)
        times = (tab.times()[shown:] - start) / 1000
        rates = np.bincount(times[times < given.seconds].astype(int), minlength=int(given.seconds))
        load, spread = os.getloadavg()[0], f"{rates.min()} ... {rates.max()}"
        print(f"{np.median(rates):.1f} images/s (median of {len(rates)} s), {spread}, load {load:.1f}")
        if given.screenshot:
            tab.page.wait_for_timeout(3000)
            tab.page.screenshot(path=given.screenshot)


if __name__ == "__main__":
    main()

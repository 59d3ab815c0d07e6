"""Write docs/street.webp: frames seen, forecast and truth of a procedural street, as an animation.

`python docs/street.py` makes it again; `python docs/street.py --rank` lists streets by PSNR at t+3, to choose the
median one, so that the animation is representative, not the best.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import vestcl

#: The street whose PSNR at t+3 is the median of `CANDIDATES`, and its current frame t.
SEED: Final = 3
CURRENT: Final = 3
STEPS: Final = 5
CANDIDATES: Final = range(13)

#: Height and width of a panel, px; milliseconds per frame, ten times slower than the drive's 0.1 s, and of the last.
PANEL: Final = (197, 640)
DURATION: Final = 400
HOLD: Final = 1600


def psnr(image: NDArray[Any], truth: NDArray[Any]) -> float:
    """-10 log10 of the mean squared error of images in [0, 1], dB."""
    return float(-10 * np.log10(np.mean((image - truth) ** 2)))


def forecast(seed: int) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
    """Frames t-3 ... t+5 of a street, and its forecast at t+1 ... t+5, each [3, H, W]."""
    clip = vestcl.open(f"street:{seed}", frames=CURRENT + 1 + STEPS)
    future = vestcl.forecast(clip, CURRENT, steps=STEPS)
    return [clip[i].read_image() for i in range(len(clip))], [frame.image for frame in future["source"]]


def panel(image: NDArray[Any], label: str) -> Image.Image:
    """An image with a label in its corner."""
    pixels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8).transpose(1, 2, 0)
    shown = Image.fromarray(pixels).resize(PANEL[::-1], Image.Resampling.LANCZOS)
    draw, font = ImageDraw.Draw(shown), ImageFont.load_default(16)
    draw.rectangle((0, 0, font.getlength(label) + 12, 24), fill="black")
    draw.text((6, 3), label, fill="white", font=font)
    return shown


def stacked(panels: Sequence[Image.Image]) -> Image.Image:
    """Panels below each other, 4 px apart."""
    height, width = PANEL
    sheet = Image.new("RGB", (width, len(panels) * (height + 4) - 4), "white")
    for row, each in enumerate(panels):
        sheet.paste(each, (0, row * (height + 4)))
    return sheet


def animation(frames: Sequence[NDArray[Any]], forecasts: Sequence[NDArray[Any]]) -> list[Image.Image]:
    """The frames seen, in all three panels, then forecast and truth below the last one seen."""
    seen = [f"seen, t{i - CURRENT}" if i < CURRENT else "seen, t" for i in range(CURRENT + 1)]
    images = [stacked([panel(frames[i], label)] * 3) for i, label in enumerate(seen)]
    for step, image in enumerate(forecasts, 1):
        ahead = f"t+{step}, 0.{step} s ahead"
        truth = panel(frames[CURRENT + step], f"truth, {ahead}")
        images.append(stacked([panel(frames[CURRENT], seen[-1]), panel(image, f"forecast, {ahead}"), truth]))
    return images


def main() -> None:
    """Write the animation, or rank streets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "street.webp")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--rank", action="store_true", help="list streets by PSNR at t+3")
    options = parser.parse_args()
    if options.rank:
        found = []
        for seed in CANDIDATES:
            frames, forecasts = forecast(seed)
            found.append((psnr(forecasts[2], frames[CURRENT + 3]), seed))
        print("\n".join(f"street:{seed} {value:.2f} dB" for value, seed in sorted(found)))
        return
    images = animation(*forecast(options.seed))
    durations = [DURATION] * (len(images) - 1) + [HOLD]
    images[0].save(
        options.out, save_all=True, append_images=images[1:], duration=durations, loop=0, quality=80, method=6
    )


if __name__ == "__main__":
    main()

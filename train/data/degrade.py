"""Images as cameras give them: motion blur, exposure and white balance that change, grey, noise, JPEG.

The target is what the same camera would show at t + k if nothing about it were random: the shutter blurs it by its own
motion, it is grey where the frames are, and its exposure and white balance are those of frame t; there is no noise and
no JPEG in it. What a network can't forecast is not scored.
"""

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from train.data.augment import LUMA, Matrix, TrainingWindow
from train.settings.config import DegradeConfig
from vestcl.scene.perceived import PerceivedFrame

Image = NDArray[np.float32]

#: Display levels are linear light to the power of 1 / that.
GAMMA: Final = 2.2

#: Share of degraded windows that are blurred, and that are compressed; of the others the shutter is fast, or the frames
#: are from a lossless file.
BLURRED, COMPRESSED = 0.5, 0.5

#: Noise in the dark over the noise of full signal, at most.
READ: Final = 0.5

#: Images along the motion that are averaged.
TAPS: Final = 7

#: Highest quality of JPEG.
BEST: Final = 95


@dataclass(frozen=True)
class Degradation:
    """What is done to one window."""

    grey: bool
    prev_gain: tuple[float, float, float]
    """Gain of red, green and blue in linear light at t - 1, relative to t."""
    shutter: float
    """Share of an interval during which it is open; 0 is sharp."""
    shot: float
    """Standard deviation of the noise at full signal: sigma^2 = shot^2 x + read^2 at level x."""
    read: float
    """That at level 0."""
    quality: int | None
    """JPEG quality, 1 to 100; None: not compressed."""


def draw(rng: np.random.Generator, settings: DegradeConfig) -> Degradation | None:
    """Uniform in the settings' ranges, exposure and white balance normal; always as many numbers are drawn.

    Returns:
        None for a window that is left as it is.
    """
    share, grey, blurred, compressed, shutter, shot, read, quality = rng.random(8)
    stops, red, blue = rng.normal(0, 1, 3)
    if share >= settings.share:
        return None
    exposure, balance = 2 ** (settings.exposure * stops), np.exp(settings.white_balance * np.array([red, 0, blue]))
    compress = settings.jpeg is not None and compressed < COMPRESSED
    lowest = settings.jpeg or BEST
    return Degradation(
        grey=bool(grey < settings.grey),
        prev_gain=tuple(exposure * balance),
        shutter=float(settings.blur * shutter) if blurred < BLURRED else 0.0,
        shot=float(settings.noise * shot),
        read=float(settings.noise * shot * READ * read),
        quality=round(lowest + quality * (BEST - lowest)) if compress else None,
    )


def blur(window: TrainingWindow, later: PerceivedFrame, shutter: float) -> TrainingWindow:
    """Frames and target blurred along what they show moves: the mean over tau in shutter [-1/2, 1/2] of I(p + tau u).

    u = project(K (R (x - v) + t)) - p is the flow to the frame before, from depth, camera motion and the velocity v of
    what moves: each image is blurred by its own.

    Args:
        window: whole, not cut out or resized; its target is the source camera's.
        later: the target's frame.
        shutter: share of an interval.

    Returns:
        The window.
    """
    known = window.cur.prev_from_cur
    assert known is not None
    return replace(
        window,
        prev=_blurred(window.prev, known if window.prev.prev_from_cur is None else window.prev.prev_from_cur, shutter),
        cur=_blurred(window.cur, known, shutter),
        target=_blurred(later, known if later.prev_from_cur is None else later.prev_from_cur, shutter).layers.image,
    )


def degrade(window: TrainingWindow, done: Degradation, rng: np.random.Generator) -> TrainingWindow:
    """All but the blur: see the module for what is done to the target.

    Args:
        window: at the size that networks see.
        done: of `draw`.
        rng: for the noise.

    Returns:
        The window, in its own memory.
    """
    even = 1.0, 1.0, 1.0
    return replace(
        window,
        prev=_degraded(window.prev, done.prev_gain, done, rng),
        cur=_degraded(window.cur, even, done, rng),
        target=_exposed(window.target, even, done.grey),
    )


def flow_to_prev(frame: PerceivedFrame, prev_from_cur: Matrix, depth: Image, velocity: Image | None) -> Image:
    """u [2, H, W] px to where each pixel's point was in the frame before, an interval ago.

    Args:
        frame: of K and of the time since the frame before.
        prev_from_cur: [4, 4] m, over that time.
        depth: [1, H, W] m.
        velocity: [3, H, W] m per interval; None is static.
    """
    height, width = depth.shape[1:]
    v, u = np.mgrid[:height, :width] + 0.5
    K = frame.K
    points = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)]) * depth
    if velocity is not None:
        points = points - velocity * frame.elapsed
    moved = np.einsum("ij,jhw->ihw", prev_from_cur[:3, :3], points) + prev_from_cur[:3, 3, None, None]
    z = np.maximum(moved[2], 1e-3)
    there = np.stack([moved[0] / z * K[0, 0] + K[0, 2], moved[1] / z * K[1, 1] + K[1, 2]])
    flow = np.where(moved[2] > 1e-3, there - np.stack([u, v]), 0.0) / frame.elapsed
    return flow.astype(np.float32)


def _blurred(frame: PerceivedFrame, prev_from_cur: Matrix, shutter: float) -> PerceivedFrame:
    layers = frame.layers
    velocity = np.where(frame.own, 0, frame.velocity).astype(np.float32)
    flow = np.where(frame.own, np.float32(0), flow_to_prev(frame, prev_from_cur, layers.depth, velocity))
    image = _along(layers.image, flow, shutter)
    behind = flow_to_prev(frame, prev_from_cur, layers.background_depth, None)
    background = np.where(layers.mask, image, _along(layers.background_image, behind, shutter))
    return replace(frame, layers=replace(layers, image=image, background_image=background))


def _along(image: Image, flow: Image, shutter: float) -> Image:
    """The mean of the image in linear light along the flow."""
    height, width = image.shape[1:]
    pixels = np.ascontiguousarray(image.transpose(1, 2, 0)) ** np.float32(GAMMA)
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    total = np.zeros_like(pixels)
    for tau in np.linspace(-shutter / 2, shutter / 2, TAPS, dtype=np.float32):
        x, y = columns + tau * flow[0], rows + tau * flow[1]
        total += cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.ascontiguousarray(((total / TAPS) ** np.float32(1 / GAMMA)).transpose(2, 0, 1))


def _degraded(
    frame: PerceivedFrame, gain: tuple[float, float, float], done: Degradation, rng: np.random.Generator
) -> PerceivedFrame:
    """The background is exposed as the image is, and is the image where that shows it."""
    layers = frame.layers
    image = _exposed(layers.image, gain, done.grey)
    noise = rng.normal(0, 1, image[:1].shape if done.grey else image.shape).astype(np.float32)
    image = (image + noise * np.sqrt(done.shot**2 * image + done.read**2)).clip(0, 1).astype(np.float32)
    if done.quality is not None:
        image = _compressed(image, done.quality)
    background = np.where(layers.mask, image, _exposed(layers.background_image, gain, done.grey))
    return replace(frame, layers=replace(layers, image=image, background_image=background))


def _exposed(image: Image, gain: tuple[float, float, float], grey: bool) -> Image:
    """Levels of linear light times ``gain``, cut at white; grey is the luma."""
    levels = (np.array(gain) ** (1 / GAMMA)).astype(np.float32)
    result: Image = (image * levels[:, None, None]).clip(0, 1)
    if grey:
        red, green, blue = (weight * plane for weight, plane in zip(LUMA.astype(np.float32), result, strict=True))
        result = np.repeat((red + green + blue)[None], 3, axis=0)
    return result


def _compressed(image: Image, quality: int) -> Image:
    """As JPEG of that quality gives it back."""
    pixels = np.ascontiguousarray((image.transpose(1, 2, 0) * 255).round().astype(np.uint8)[..., ::-1])
    written, content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert written
    read = cv2.imdecode(content, cv2.IMREAD_COLOR)
    assert read is not None
    return np.ascontiguousarray((read[..., ::-1].astype(np.float32) / 255).transpose(2, 0, 1))

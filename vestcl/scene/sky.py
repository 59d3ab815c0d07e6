"""Sky without a network: smooth, bright, joined to the upper border, and never near."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.scene import checked

#: Sky is smoother than that after a blur of 1 px: grey levels (0 to 1) per pixel ...
_SMOOTH: Final = 0.012
#: ... and brighter than that share of the image's 90th percentile.
_BRIGHT: Final = 0.3

#: Sky is not warmer than that, red less blue, unless it is as good as white: on the street that spares half of the
#: walls that were taken for sky, and costs nothing on KITTI. Grey images pass as they are.
_WARMEST, _WHITE = 0.02, 0.97

#: Sky does not reach below that share of the height: a car's camera looks ahead.
_LOWEST: Final = 0.6

#: A region is not a sky if most of its known depths are nearer than that, metres, and as much of it is known as that
#: share of what is known of the whole image: scanners have no return from the sky, and stereo pairs only stray matches,
#: up to 0.19 on KITTI odometry, where white walls have 0.7. Its rim, px, does not count: objects before it widen there.
_NEAR, _KNOWN_SHARE, _RIM = 80.0, 0.35, 7

#: A stereo pair matches the even sky with whatever is around it: from the 10th to the 90th percentile its depths are a
#: factor of 2.5 to 7 apart on KITTI odometry, those of white walls 1.02 to 1.4, and some are far, metres. The first
#: region is above the road: it reaches that part of the width. Others are as bright to that, and as uneven or as far.
_SPREAD, _AS_SPREAD, _FAR, _AS_FAR = 2.2, 1.8, 40.0, 30.0
_MIDDLE, _AS_BRIGHT = (0.4, 0.6), 0.06

#: The sky is of one brightness: regions that differ by more from the first are something else. The first is the one
#: with the most light, area times brightness: shaded walls may be larger than a narrow sky, white ones are brighter.
#: On the street 0.1 takes half the walls for sky that 0.2 takes.
_SIMILAR: Final = 0.1

#: With depth, sky below bridges and between trees, without the border's help: as bright as the sky to that, with less
#: than that share known. It brings KITTI's frames under a bridge from an IoU of 0.5 to 0.77.
_SAME, _ENCLOSED_KNOWN = 0.05, 0.02

#: Regions below that share of the image are left out; enclosed ones may be a fifth of it.
_SMALLEST, _SMALLEST_ENCLOSED = 0.001, 0.0002


def sky_mask(image: ArrayLike, depth: ArrayLike | None = None, *, matched: bool = False) -> NDArray[np.bool_]:
    """True in the sky: regions of a small gradient and enough light that touch the upper border and have no near depth.

    With ``depth`` also regions that don't touch it, if they are as bright as the sky and no depth is known in them.

    Args:
        image: [3, H, W] RGB in [0, 1].
        depth: [1, H, W] m, 0 = invalid; bright walls are distinguished from the sky by it.
        matched: ``depth`` is matched in a stereo pair, which has depths in the sky, too, but not those of one surface.

    Returns:
        [1, H, W].

    Raises:
        ValueError: shapes or numbers that aren't finite.
    """
    image = checked.planes("image", image, 3)
    metres = np.zeros(image.shape[1:], np.float32) if depth is None else checked.planes("depth", depth, 1, image)[0]
    grey = np.asarray(cv2.cvtColor(image.transpose(1, 2, 0), cv2.COLOR_RGB2GRAY), np.float32)
    blurred = cv2.GaussianBlur(grey, (0, 0), 1.0)
    right, down = (np.asarray(cv2.Sobel(blurred, cv2.CV_32F, *order), np.float32) for order in ((1, 0), (0, 1)))
    slope = np.asarray(np.hypot(right, down) / 8, np.float32)
    candidate = (slope < _SMOOTH) & (grey > _BRIGHT * np.quantile(grey, 0.9))
    candidate &= _cold(image)
    candidate[round(_LOWEST * len(candidate)) :] = False
    if matched and metres.any():
        sky = _of_no_surface(candidate, metres, grey)
    else:
        sky = _similar(_regions(candidate, metres), grey)
    if sky.any() and metres.any():
        sky |= _enclosed(candidate, metres, grey, float(np.median(grey[sky])))
    return _closed(sky, grey, slope)[None]


def _cold(image: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[H, W], True where it is blue, grey or white."""
    warmth = cv2.GaussianBlur(image[0] - image[2], (0, 0), 1.0)
    return (warmth <= _WARMEST) | (image.min(axis=0) > _WHITE)


def _enclosed(
    candidate: NDArray[np.bool_], metres: NDArray[np.float32], grey: NDArray[np.float32], brightness: float
) -> NDArray[np.bool_]:
    """[H, W], True in regions as bright as the sky in which next to no depth is known."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(candidate.astype(np.uint8), connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA]
    mean = np.bincount(labels.ravel(), grey.ravel(), count) / np.maximum(area, 1)
    known = np.bincount(labels[metres > 0], minlength=count)
    keep = (area >= _SMALLEST_ENCLOSED * candidate.size) & (known < _ENCLOSED_KNOWN * area)
    keep &= np.abs(mean - brightness) < _SAME
    keep[0] = False
    return np.asarray(keep[labels])


def _regions(candidate: NDArray[np.bool_], metres: NDArray[np.float32]) -> NDArray[np.int32]:
    """[H, W], 0 or the number of a region that may be sky."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(candidate.astype(np.uint8), connectivity=4)
    inner = cv2.erode(candidate.astype(np.uint8), np.ones((2 * _RIM + 1, 2 * _RIM + 1), np.uint8)) > 0
    inner |= np.bincount(labels[inner], minlength=count)[labels] == 0  # a region that is all rim counts whole
    area, known, near = (
        np.bincount(labels[inner & which], minlength=count)
        for which in (True, metres > 0, (metres > 0) & (metres < _NEAR))
    )
    unknown = known <= _KNOWN_SHARE * (metres > 0).mean() * area
    keep = (stats[:, cv2.CC_STAT_AREA] >= _SMALLEST * candidate.size) & (unknown | (2 * near <= known))
    keep &= np.isin(np.arange(count), labels[:2])
    keep[0] = False
    return np.where(keep[labels], labels, 0)


def _of_no_surface(
    candidate: NDArray[np.bool_], metres: NDArray[np.float32], grey: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """[H, W], True in regions at the upper border whose matched depths are not those of one surface."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(candidate.astype(np.uint8), connectivity=4)
    at_border = np.unique(labels[:2])
    large = [n for n in at_border[at_border > 0] if stats[n, cv2.CC_STAT_AREA] >= _SMALLEST * candidate.size]
    middle = slice(*(round(share * candidate.shape[1]) for share in _MIDDLE))
    depths = {n: metres[(labels == n) & (metres > 0)] for n in large}
    spread = {n: np.quantile(z, (0.1, 0.5, 0.9)) if len(z) else np.full(3, np.inf) for n, z in depths.items()}
    first = [
        n
        for n, (low, median, high) in spread.items()
        if (median >= _NEAR or (high >= _SPREAD * low and high >= _FAR)) and (labels[:, middle] == n).any()
    ]
    if not first:
        return np.zeros_like(candidate)
    brightness = {n: float(np.median(grey[labels == n])) for n in large}
    known = brightness[max(first, key=lambda n: int(stats[n, cv2.CC_STAT_AREA]))]
    keep = np.zeros(count, bool)
    for n, (low, median, high) in spread.items():
        uneven = high >= _AS_SPREAD * low or median >= _AS_FAR
        keep[n] = abs(brightness[n] - known) < _AS_BRIGHT and uneven
    return np.asarray(keep[labels])


def _similar(regions: NDArray[np.int32], grey: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[H, W], True in the first region and in those that are as bright."""
    area = np.bincount(regions.ravel())
    brightness = np.bincount(regions.ravel(), grey.ravel()) / np.maximum(area, 1)
    area[0] = 0
    first = (area * brightness).argmax()
    keep = (area > 0) & (np.abs(brightness - brightness[first]) < _SIMILAR)
    return keep[regions]


def _closed(sky: NDArray[np.bool_], grey: NDArray[np.float32], slope: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The soft rim that the gradient cost: what is next to the sky and as bright as it."""
    if not sky.any():
        return sky
    share = cv2.blur(sky.astype(np.float32), (7, 7))
    local = cv2.blur(np.where(sky, grey, np.float32(0)), (7, 7)) / np.maximum(share, np.float32(1e-6))
    rim = cv2.dilate(sky.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    return sky | (rim & (np.abs(grey - local) < 4 * _SMOOTH))

"""The recording car's own bonnet: what at the lower border stays where it is in the image while the road moves."""

import itertools
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

#: Images are compared at that width, px, where noise is averaged out, and in that share of the height from below.
_WIDTH, _LOWER = 416, 0.2

#: Pairs of frames that are compared at least: asphalt may look the same in two.
PAIRS: Final = 2

#: An edge, grey levels (0 to 1) per pixel, is static if it seems to move by less than this many pixels across itself.
_EDGE, _STATIC = 0.015, 0.25

#: What crossing a column costs where no static edge is, where the bonnet is out of the image, and a step of a row.
_NO_EDGE, _OUTSIDE, _STEP, _FARTHEST = 1.0, 0.7, 0.1, 2

#: The upper one of several edges is the rim, others are reflections: a whole height costs that. Notches of the rim up
#: to that share of the width are closed.
_LOW, _NOTCH = 1.0, 0.2

#: The bonnet's rim must be seen in so much of the width, and be a static edge in so much of that.
_WIDE, _EDGES = 0.5, 0.7

#: This share of the edges below the rim is static, and at most this share of those above, up to the horizon.
_BELOW, _ABOVE = 0.2, 0.3

#: Below a border row no bonnet is seen: it has that many rows at least, as a share of the height.
_LEAST: Final = 0.015


def own_car(images: Sequence[NDArray[np.float32]]) -> NDArray[np.bool_]:
    """True below the rim, an edge from left to right that is static while what is above moves.

    The rim is the path of least cost through the lower part of the image (dynamic programming over columns), where
    edges across the vertical are static: those of the road move down. Lane lines move along themselves, but are no
    such edges.

    Args:
        images: [3, H, W] RGB in [0, 1] each, of consecutive frames, the newest first.

    Returns:
        [1, H, W]; nowhere if there are fewer than PAIRS + 1 images, or nothing moves.
    """
    height, width = images[0].shape[1:]
    nothing = np.zeros((1, height, width), bool)
    size = (min(_WIDTH, width), max(round(height * min(_WIDTH, width) / width), 1))
    if len(images) <= PAIRS or size[1] < 16:
        return nothing
    planes = [_grey(image, size) for image in images]
    down = cv2.Sobel(planes[0], cv2.CV_32F, 0, 1, scale=1 / 8)
    right = cv2.Sobel(planes[0], cv2.CV_32F, 1, 0, scale=1 / 8)
    changed = np.max([np.abs(one - other) for one, other in itertools.pairwise(planes)], axis=0)
    edge = (np.abs(down) > _EDGE) & (np.abs(down) > np.abs(right))
    static = edge & (changed < _STATIC * np.abs(down))
    rim = _rim(static, round((1 - _LOWER) * size[1]))
    if not _is_bonnet(rim, edge, static):
        return nothing
    brush = np.ones((1, 2 * round(_NOTCH * size[0] / 2) + 1), np.uint8)
    rim = cv2.morphologyEx(rim.astype(np.float32)[None], cv2.MORPH_OPEN, brush)[0]
    below = (np.arange(size[1])[:, None] >= rim).astype(np.float32)
    return np.asarray(cv2.resize(below, (width, height), interpolation=cv2.INTER_LINEAR) > 0.5)[None]


def _grey(image: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    grey = cv2.cvtColor(np.ascontiguousarray(image.transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.GaussianBlur(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), (0, 0), 1.0), np.float32)


def _rim(static: NDArray[np.bool_], top: int) -> NDArray[np.intp]:
    """[W]: the row of the rim in each column, H where it is out of the image."""
    height, width = static.shape
    near = cv2.dilate(static.astype(np.uint8), np.ones((3, 3), np.uint8))[top:] > 0
    cost = np.full((height - top + 1, width), _OUTSIDE)
    cost[:-1] = np.where(near, 0, _NO_EDGE)
    cost += _LOW * np.arange(len(cost))[:, None] / height
    total, steps = cost[:, 0].copy(), np.arange(-_FARTHEST, _FARTHEST + 1)
    came = np.zeros(cost.shape, np.intp)
    rows = np.arange(len(cost))
    for column in range(1, width):
        padded = np.pad(total, _FARTHEST, constant_values=np.inf)
        ways = np.stack([padded[rows + _FARTHEST + step] + _STEP * abs(step) for step in steps])
        best = ways.argmin(axis=0)
        came[:, column], total = rows + steps[best], ways[best, rows] + cost[:, column]
    path = np.zeros(width, np.intp)
    path[-1] = total.argmin()
    for column in range(width - 1, 0, -1):
        path[column - 1] = came[path[column], column]
    return path + top


def _is_bonnet(rim: NDArray[np.intp], edge: NDArray[np.bool_], static: NDArray[np.bool_]) -> bool:
    """Whether the rim is wide and a static edge, what is below is static, and what is above moves."""
    height, width = edge.shape
    seen = rim < height - max(_LEAST * height, 2)
    near = cv2.dilate(static.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    on_edge = near[np.minimum(rim, height - 1), np.arange(width)] & seen
    rows = np.arange(height)[:, None]
    below, above = edge & (rows > rim), edge & (rows < rim - 2) & (rows > height // 2)
    wide = seen.mean() > _WIDE and on_edge.sum() > _EDGES * seen.sum()
    moves = (static & above).sum() < _ABOVE * above.sum()
    return bool(wide and moves and (static & below).sum() >= _BELOW * below.sum())

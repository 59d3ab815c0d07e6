"""The surface around a frame's points on a view: which points have neighbours, how far apart, and where it was seen."""

import functools
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl import constants
from vestcl.forecasting.geometric.frame_cloud import CloudPixels, FrameCloud

#: A surface is where a pixel has this many of its eight neighbours no farther than `constants.TORN` away, or two on a
#: line: a pole of one pixel has one above and one below, no farther apart than `_LINE`. The rest is spray: pixels at
#: edges whose depth lies between that of the near and the far side.
_NEIGHBOURS, _LINE = 3, 1.1

#: Rows down and columns to the right of the eight neighbours; the first four are opposite to the last, from the end on.
_AROUND: Final = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))

#: A pixel shows one surface if its points were seen within this many pixels of each other (standard deviation).
ONE_SURFACE: Final = 1.5

#: What makes a point at an edge count as of several surfaces, px^2: a tenth of the composite is enough.
_EDGE: Final = 10 * ONE_SURFACE**2

#: The area that a pixel of the source grows to, as a factor of what follows from its depth, lies in this range on a
#: surface.
_GROWTH: Final = (0.2, 5.0)

#: Squared positions are carried in thousands of pixels, so that float32 keeps their differences.
SQUARED: Final = 1000.0


def surface(
    pixels: CloudPixels, uv: NDArray[np.float32], zoom: NDArray[np.float32]
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Which points [N] still have neighbours of their image next to them, and how far apart those are [N], px.

    ``uv`` [2, N] is where they are. A surface that turns towards the camera is stretched by more than what it comes
    nearer by: spacing >= ``zoom``.
    """
    mine, zoomed = pixels.laid_out(uv), pixels.laid_out(zoom)
    at, neighbours = pixels.neighbours(mine), dict[tuple[int, int], NDArray[np.float32]]()
    for down, right in _AROUND:
        across, along = at(down, right) - mine
        across *= across
        along *= along
        across += along
        neighbours[down, right] = across if down * right == 0 else across / np.float32(2)
    limit = np.square(np.maximum(zoomed, np.float32(1)))
    near = np.float32(constants.TORN**2) * limit
    count = functools.reduce(np.add, ((neighbours[step] < near).view(np.uint8) for step in _AROUND))
    line = functools.reduce(np.fmin, (np.maximum(neighbours[y, x], neighbours[-y, -x]) for y, x in _AROUND[:4]))
    whole = (count >= _NEIGHBOURS) | (line < np.float32(_LINE**2) * limit)
    spacing, slanted = np.zeros_like(near), _slanted(zoomed)
    sheared = _between_lines(mine, at, near)
    for (down, right), lines in zip(((1, 0), (0, 1)), sheared, strict=True):
        pair = neighbours[-down, -right], neighbours[down, right]
        gap, plane = np.fmin(*pair), np.maximum(*pair) < slanted
        gap = np.where((gap < near) | plane, gap, np.float32(0))
        spacing = np.maximum(spacing, np.where(lines < np.maximum(near, slanted), lines, gap))
        whole |= plane
    return pixels.of_points(whole), pixels.of_points(np.maximum(zoomed, np.sqrt(spacing)))


def _between_lines(
    mine: NDArray[np.float32], at: Callable[[int, int], NDArray[np.float32]], near: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Squared distances between rows and between columns of one plane, px^2; infinite where there is none.

    A road shears: the neighbour below moves aside as well, and another point of its row comes to lie below. Neighbours
    on a line are of one plane if they are as far away, in opposite directions, and those across are ``near``.
    """
    flat, steps, bent = np.ones(near.shape, bool), [], np.float32(constants.BENT**2)
    for down, right in ((0, 1), (1, 0)):
        after, before = at(down, right), at(-down, -right)
        step, bend = (after - before) / np.float32(2), after + before - 2 * mine
        flat &= np.square(bend).sum(0) < bent * np.square(step).sum(0)
        steps.append(step)
    (a, c), (b, d) = steps
    area, far = np.square(a * d - b * c), np.float32(np.inf)
    rows, columns = (
        np.where(flat & (length < near), area / np.maximum(length, np.float32(1e-9)), far)
        for length in (a * a + c * c, b * b + d * d)
    )
    return rows, columns


def _slanted(zoom: NDArray[np.float32]) -> NDArray[np.float32]:
    """[N] px^2: the square of how far apart a plane that the camera moves along comes to lie."""
    return np.square(np.float32(constants.SLANTED) * np.square(zoom))


def origins(
    cloud: FrameCloud,
    pixels: CloudPixels,
    uv: NDArray[np.float32],
    zoom: NDArray[np.float32],
    solid: NDArray[np.bool_],
    out: NDArray[np.float32],
) -> None:
    """Into ``out`` [9, N]: s - A t, the four numbers of A, s and |s|^2: what `_colour` needs of each point.

    A is the inverse of dt/ds, by central differences over the image that the points come from. Where they tear, or a
    neighbour is not ``solid`` [N], the colours around a point are not all its surface's: |s|^2 is larger by _EDGE.
    """
    neighbours = pixels.neighbours(pixels.laid_out(np.where(solid, uv, np.float32(np.nan))))
    zoomed = pixels.laid_out(zoom)
    (a, c), (b, d) = ((neighbours(*step) - neighbours(-step[0], -step[1])) / np.float32(2) for step in ((0, 1), (1, 0)))
    growth, scale = a * d - b * c, 1 / np.maximum(zoomed, np.float32(1e-3))
    near, area = np.square(np.maximum(zoomed, np.float32(1))) * constants.TORN**2, zoomed**2
    longest = np.maximum(near, _slanted(zoomed))
    whole = (a * a + c * c < longest) & (b * b + d * d < longest)
    whole &= (growth > _GROWTH[0] * area) & (growth < _GROWTH[1] * area)
    safe = np.where(whole, growth, np.float32(1))
    nothing = np.zeros((), np.float32)
    for row, part, flat in ((2, d, scale), (3, -b, nothing), (4, -c, nothing), (5, a, scale)):
        out[row] = pixels.of_points(np.where(whole, part / safe, flat))
    start, slope, seen, squared = out[:2], out[2:6], out[6:8], out[8]
    np.add(cloud.columns, np.float32(0.5), out=seen[0], casting="same_kind")
    np.add(cloud.rows, np.float32(0.5), out=seen[1], casting="same_kind")
    u, v = uv
    np.subtract(seen[0] - slope[0] * u, slope[1] * v, out=start[0])
    np.subtract(seen[1] - slope[2] * u, slope[3] * v, out=start[1])
    edge = np.where(pixels.of_points(whole), np.float32(0), np.float32(_EDGE))
    np.divide(seen[0] ** 2 + seen[1] ** 2 + edge, np.float32(SQUARED), out=squared)

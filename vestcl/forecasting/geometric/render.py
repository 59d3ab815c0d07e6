"""Point clouds on a new view: where each pixel's surface was seen, and the colour there; clouds one behind the other.

A composite of opaque points mixes their colours by their order in depth, and is off by a fraction of a pixel wherever
two of them share one. So points carry where they were seen, s, and how that changes over the view, A = ds/dt around
their position t: each says of the pixel p that its surface was seen at s + A (p - t), and the mean over the composite
is exact to first order whatever the weights are. The colour is taken from there.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl import constants
from vestcl.forecasting.result import Rendered
from vestcl.ops.displace import displace
from vestcl.ops.splat import splat

#: A point's radius in pixels of the source, and its limits in the target: for colour shown directly 0.9 to 1.0 is
#: best (SPEC section 2); 1.2 loses 0.15 dB on KITTI at t+1.
RHO: Final = 0.95
RADIUS_LIMITS: Final = (0.5, 8.0)

#: From this coverage on a pixel is opaque: only cracks between a surface's points let through what lies behind.
_OPAQUE: Final = 0.5

#: A surface is where a pixel has so many of its eight neighbours no farther than `constants.TORN` away, or two on a
#: line: a pole of one pixel has one above and one below, no farther apart than `_LINE`. The rest is spray: pixels at
#: edges whose depth lies between that of the near and the far side.
_NEIGHBOURS, _LINE = 3, 1.1

#: Rows down and columns to the right of the eight neighbours; the first four are opposite to the last, from the end on.
_AROUND: Final = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))

#: Less coverage than that is a hole.
HOLE: Final = 0.05

#: A pixel shows one surface if its points were seen within so many pixels of each other (standard deviation), and the
#: place where its own surface was seen is no farther than that from their mean. Elsewhere colours are mixed.
_ONE_SURFACE, _EXTRAPOLATED = 1.5, 2.0

#: What makes a point at an edge count as of several surfaces, px^2: a tenth of the composite is enough.
_EDGE: Final = 10 * _ONE_SURFACE**2

#: The area that a pixel of the source grows to, as a factor of what its depth says, lies in this range on a surface.
_GROWTH: Final = (0.2, 5.0)

#: OpenCV looks up places in rows of fewer than 32,768.
_ROW: Final = 1024

#: Squared positions are carried in thousands of pixels, so that float32 keeps their differences.
_SQUARED: Final = 1000.0


@dataclass(frozen=True, eq=False)
class FrameCloud:
    """Points of one frame, at the time that is shown."""

    points_xyz: NDArray[np.float32]
    """[N, 3] m, in the source camera's frame at that time."""
    z_src: NDArray[np.float32]
    """[N] m, depth in the picture that the points come from."""
    image: NDArray[np.float32]
    """[3, H, W] RGB, the image that the points come from."""
    step_xyz: NDArray[np.float32]
    """[N, 3] m: how far each came over the last frame interval."""
    rows: NDArray[np.intp]
    """[N], of the pixel that each point comes from ..."""
    columns: NDArray[np.intp]
    """[N] ... and its column."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What clouds leave on a view, divided by coverage."""

    planes: NDArray[np.float32]
    """[7, H, W]: colour 3, inverse depth 1/m, motion 3 m."""
    coverage: NDArray[np.float32]
    """[1, H, W]."""


def show(
    clouds: list[FrameCloud],
    K: NDArray[np.float64],
    tgt_from_next: NDArray[np.float64],
    height: int,
    width: int,
    where: NDArray[np.bool_] | None = None,
) -> Shown:
    """The clouds splatted one by one to a view, each behind those before it: sum_i c_i a_i prod_(j<i) (1 - a_j).

    Args:
        clouds: in order of trust: what the first covers, the others don't show.
        K: [3, 3] px, of the view.
        tgt_from_next: [4, 4] m.
        height: px.
        width: px.
        where: [1, H, W], True in the pixels that are wanted; None wants all.

    Returns:
        The composition; 0 where nothing is, and in pixels that are not wanted.
    """
    wanted = np.arange(height * width) if where is None else np.flatnonzero(where)
    planes, left = np.zeros((7, len(wanted)), np.float32), np.ones(len(wanted), np.float32)
    uncovered = np.ones(len(wanted), np.float32)
    for cloud in clouds:
        through = left > 0
        pixels = _Wanted(height, width, None if where is None else wanted, None if through.all() else wanted[through])
        mean, coverage = _splat(cloud, K, tgt_from_next, pixels)
        opacity = np.minimum(coverage / np.float32(_OPAQUE), 1) * (coverage > HOLE)
        if pixels.coloured is None:
            mean *= left * opacity
            planes += mean
        else:
            planes[:, through] += mean * (left * opacity)[through]
        left *= 1 - opacity
        uncovered *= 1 - coverage
    planes /= np.maximum(1 - left, np.float32(1e-6))
    both = np.concatenate([planes, 1 - uncovered[None]])
    if where is not None:
        some, both = both, np.zeros((8, height * width), np.float32)
        both[:, wanted] = some
    both = both.reshape(8, height, width)
    return Shown(both[:7], both[7:])


@dataclass(frozen=True, eq=False)
class _Wanted:
    """The pixels of a view that are wanted, flat."""

    height: int
    width: int
    covered: NDArray[np.intp] | None
    """[M], whose coverage is; None = of all."""
    coloured: NDArray[np.intp] | None
    """[L], those of them whose colour is, too; None = of the same."""

    def of_view(self) -> NDArray[np.intp] | None:
        """Those whose colour is wanted; None = all."""
        return self.covered if self.coloured is None else self.coloured


def _splat(
    cloud: FrameCloud, K: NDArray[np.float64], tgt_from_next: NDArray[np.float64], wanted: _Wanted
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """image [7, L], divided by coverage, and coverage [M]."""
    still = np.zeros((1, *cloud.points_xyz.shape), np.float32)
    points_uv, z = displace(
        cloud.points_xyz[None], still, K[None].astype(np.float32), tgt_from_next[None].astype(np.float32)
    )
    if wanted.covered is not None:
        kept = _near(cloud, points_uv[0], wanted.covered, wanted)
        cloud, points_uv, z = _some(cloud, kept), points_uv[:, kept], z[:, kept]
    zoom, uv = cloud.z_src / np.maximum(z[0], np.float32(1e-3)), _transposed(points_uv[0])
    whole, stretch = _surface(_Pixels.of(cloud), uv, zoom)
    radii = np.clip(RHO * stretch, *RADIUS_LIMITS)[None]
    opacities = (whole & (RHO * zoom <= RADIUS_LIMITS[1]))[None].astype(np.float32)
    size = wanted.height, wanted.width
    image, coverage = splat(points_uv, z, radii, opacities, _features(cloud, uv, z[0], whole)[None], *size)
    composite, covered, pixels = image[0].transpose(1, 2, 0).reshape(-1, 16), coverage.ravel(), wanted.of_view()
    mean = _transposed(composite if pixels is None else composite[pixels])
    mean /= np.maximum(covered if pixels is None else covered[pixels], np.float32(1e-6))
    mean[:3] = _colour(mean, cloud.image, pixels, *size)
    return mean[:7], covered if wanted.covered is None else covered[wanted.covered]


def _features(
    cloud: FrameCloud, uv: NDArray[np.float32], z: NDArray[np.float32], whole: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """[N, 16]: colour 3, inverse depth, motion 3, and what `_origins` finds of points at ``uv`` [2, N], ``z`` [N]."""
    pixels, distance = _Pixels.of(cloud), np.maximum(z, np.float32(1e-3), dtype=np.float32)
    features = np.empty((16, len(z)), np.float32)
    features[:3] = pixels.colours(cloud.image)
    np.divide(1, distance, out=features[3])
    features[4:7] = _transposed(cloud.step_xyz)
    _origins(cloud, pixels, uv, np.divide(cloud.z_src, distance, dtype=np.float32), whole, features[7:])
    return _transposed(features)


def _near(
    cloud: FrameCloud, points_uv: NDArray[np.float32], pixels: NDArray[np.intp], view: _Wanted
) -> NDArray[np.bool_]:
    """[N], True where a point may be seen in one of the ``pixels`` [M] of a view, flat, or where such a point needs it.

    What a point is, its neighbours say, and theirs: points up to two pixels away in the image that they come from.
    """
    reach = math.ceil(RADIUS_LIMITS[1])
    near = np.zeros((view.height + 2 * reach, view.width + 2 * reach), np.uint8)
    near[pixels // view.width + reach, pixels % view.width + reach] = 1
    near = np.asarray(cv2.dilate(near, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)))
    u, v = np.floor(points_uv.T) + np.float32(reach)
    inside = np.flatnonzero((u >= 0) & (u < near.shape[1]) & (v >= 0) & (v < near.shape[0]))
    seen = inside[near[v[inside].astype(np.intp), u[inside].astype(np.intp)] > 0]
    needed = np.zeros(cloud.image.shape[1:], np.uint8)
    needed[cloud.rows[seen], cloud.columns[seen]] = 1
    return np.asarray(cv2.dilate(needed, np.ones((5, 5), np.uint8)))[cloud.rows, cloud.columns] > 0


def _some(cloud: FrameCloud, kept: NDArray[np.bool_]) -> FrameCloud:
    """The points of ``kept`` [N]."""
    moving = cloud.points_xyz[kept], cloud.z_src[kept], cloud.image, cloud.step_xyz[kept]
    return FrameCloud(*moving, cloud.rows[kept], cloud.columns[kept])


def _transposed(matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    """The transpose in memory of its own, as NumPy copies it, in a third of the time."""
    if not matrix.size:
        return np.zeros(matrix.shape[::-1], np.float32)
    return np.asarray(cv2.transpose(matrix), np.float32).reshape(matrix.shape[::-1])


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Which pixels of an image a cloud's points come from, and what their neighbours have.

    Numbers of points [..., N] are laid out ("..., *") as the image [..., H, W] is where most of its pixels have a
    point, NaN in the others; neighbours are then views. Else they stay [..., N].
    """

    height: int
    width: int
    flat: NDArray[np.intp]
    """[N], of each point's pixel."""
    dense: bool
    """Whether most pixels have a point ..."""
    all: bool
    """... or each one, in order."""

    @classmethod
    def of(cls, cloud: FrameCloud) -> "_Pixels":
        height, width = cloud.image.shape[1:]
        flat = cloud.rows * width + cloud.columns
        count = height * width
        return cls(height, width, flat, 2 * len(flat) > count, len(flat) == count and bool((np.diff(flat) == 1).all()))

    def colours(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Values [C, N] of ``image`` [C, H, W]."""
        planes = image.reshape(len(image), -1)
        return planes if self.all else planes.take(self.flat, axis=1)

    def laid_out(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """``values`` [..., N] as [..., *]."""
        if not self.dense:
            return values
        if self.all:
            return values.reshape(*values.shape[:-1], self.height, self.width)
        grid = np.full((*values.shape[:-1], self.height * self.width), np.nan, np.float32)
        grid[..., self.flat] = values
        return grid.reshape(*values.shape[:-1], self.height, self.width)

    def of_points(self, values: NDArray[Any]) -> NDArray[Any]:
        """[*] as [N], the opposite of `laid_out`."""
        return values.ravel() if not self.dense or self.all else values.ravel()[self.flat]

    def beside(self, planes: NDArray[np.float32]) -> Callable[[int, int], NDArray[np.float32]]:
        """Values of ``planes`` [C, *] so many rows below and columns to the right, up to one: [C, *], NaN if none."""
        grid = np.full((len(planes), self.height + 2, self.width + 2), np.nan, np.float32)
        if self.dense:
            grid[:, 1:-1, 1:-1] = planes
            return lambda down, right: grid[:, 1 + down : 1 + down + self.height, 1 + right : 1 + right + self.width]
        pitch, spread = self.width + 2, grid.reshape(len(planes), -1)
        at = self.flat + 2 * (self.flat // self.width) + pitch + 1
        spread[:, at] = planes
        return lambda down, right: spread.take(at + (down * pitch + right), axis=1)


def _origins(
    cloud: FrameCloud,
    pixels: _Pixels,
    uv: NDArray[np.float32],
    zoom: NDArray[np.float32],
    solid: NDArray[np.bool_],
    out: NDArray[np.float32],
) -> None:
    """Into ``out`` [9, N]: s - A t, the four numbers of A, s and |s|^2: what `_colour` needs of each point.

    A is the inverse of dt/ds, by central differences over the image that the points come from. Where they tear, or a
    neighbour is not ``solid`` [N], the colours around a point are not all its surface's: |s|^2 is larger by _EDGE.
    """
    beside = pixels.beside(pixels.laid_out(np.where(solid, uv, np.float32(np.nan))))
    zoomed = pixels.laid_out(zoom)
    (a, c), (b, d) = ((beside(*step) - beside(-step[0], -step[1])) / np.float32(2) for step in ((0, 1), (1, 0)))
    growth, alike = a * d - b * c, 1 / np.maximum(zoomed, np.float32(1e-3))
    near, area = np.square(np.maximum(zoomed, np.float32(1))) * constants.TORN**2, zoomed**2
    longest = np.maximum(near, _slanted(zoomed))
    whole = (a * a + c * c < longest) & (b * b + d * d < longest)
    whole &= (growth > _GROWTH[0] * area) & (growth < _GROWTH[1] * area)
    safe = np.where(whole, growth, np.float32(1))
    nothing = np.zeros((), np.float32)
    for row, part, flat in ((2, d, alike), (3, -b, nothing), (4, -c, nothing), (5, a, alike)):
        out[row] = pixels.of_points(np.where(whole, part / safe, flat))
    start, slope, seen, squared = out[:2], out[2:6], out[6:8], out[8]
    np.add(cloud.columns, np.float32(0.5), out=seen[0], casting="same_kind")
    np.add(cloud.rows, np.float32(0.5), out=seen[1], casting="same_kind")
    u, v = uv
    np.subtract(seen[0] - slope[0] * u, slope[1] * v, out=start[0])
    np.subtract(seen[1] - slope[2] * u, slope[3] * v, out=start[1])
    edge = np.where(pixels.of_points(whole), np.float32(0), np.float32(_EDGE))
    np.divide(seen[0] ** 2 + seen[1] ** 2 + edge, np.float32(_SQUARED), out=squared)


def _colour(
    mean: NDArray[np.float32], image: NDArray[np.float32], pixels: NDArray[np.intp] | None, height: int, width: int
) -> NDArray[np.float32]:
    """[3, M]: of ``image`` where the surface was seen; where a pixel shows several, the mean of their colours.

    ``mean`` is [16, M], of the ``pixels`` [M] of a view, flat; None = of all.
    """
    row, half = width, np.float32(0.5)
    if pixels is None:
        x = np.tile(np.arange(width, dtype=np.float32) + half, height)
        y = np.repeat(np.arange(height, dtype=np.float32) + half, width)
    else:
        row = _ROW
        y, x = (at.astype(np.float32) + half for at in np.divmod(pixels, width))
    start, slope, seen, squared = mean[7:9], mean[9:13], mean[13:15], mean[15] * np.float32(_SQUARED)
    u, v = start[0] + slope[0] * x + slope[1] * y, start[1] + slope[2] * x + slope[3] * y
    one = (u - seen[0]) ** 2 + (v - seen[1]) ** 2 < _EXTRAPOLATED**2
    one &= squared - seen[0] ** 2 - seen[1] ** 2 < _ONE_SURFACE**2
    if not mean.size:
        return mean[:3]
    u -= half
    v -= half
    across, down = (np.pad(at, (0, -len(at) % row)).reshape(-1, row) for at in (u, v))
    there = [
        cv2.remap(plane, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel() for plane in image
    ]
    return np.where(one, np.stack(there)[:, : len(u)], mean[:3])


def _surface(
    pixels: _Pixels, uv: NDArray[np.float32], zoom: NDArray[np.float32]
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Which points [N] still have neighbours of their picture beside them, and how far apart those are [N], px.

    ``uv`` [2, N] is where they are. A surface that turns towards the camera is stretched by more than what it comes
    nearer by: spacing >= ``zoom``.
    """
    mine, zoomed = pixels.laid_out(uv), pixels.laid_out(zoom)
    at, beside = pixels.beside(mine), dict[tuple[int, int], NDArray[np.float32]]()
    for down, right in _AROUND:
        across, along = at(down, right) - mine
        across *= across
        along *= along
        across += along
        beside[down, right] = across if down * right == 0 else across / np.float32(2)
    limit = np.square(np.maximum(zoomed, np.float32(1)))
    near = np.float32(constants.TORN**2) * limit
    count = functools.reduce(np.add, ((beside[step] < near).view(np.uint8) for step in _AROUND))
    line = functools.reduce(np.fmin, (np.maximum(beside[y, x], beside[-y, -x]) for y, x in _AROUND[:4]))
    whole = (count >= _NEIGHBOURS) | (line < np.float32(_LINE**2) * limit)
    spacing, slanted = np.zeros_like(near), _slanted(zoomed)
    sheared = _between_lines(mine, at, near)
    for (down, right), lines in zip(((1, 0), (0, 1)), sheared, strict=True):
        pair = beside[-down, -right], beside[down, right]
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


def rendered(shown: Shown, image: NDArray[np.float32]) -> Rendered:
    """The view as a forecast holds it, with ``image`` [3, H, W] in place of the splatted colour."""
    inverse, seen = shown.planes[3:4], shown.coverage > HOLE
    depth = np.divide(1, inverse, out=np.zeros_like(inverse), where=seen & (inverse > 0))
    return Rendered(image.clip(0, 1), depth, shown.coverage, np.where(seen, shown.planes[4:], np.float32(0)))


def holes(shown: Shown) -> NDArray[np.bool_]:
    """[1, H, W], True where nothing is seen."""
    return shown.coverage <= HOLE

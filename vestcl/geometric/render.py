"""Point clouds on a new view: where each pixel's surface was seen, and the colour there; clouds one behind the other.

A composite of opaque points mixes their colours by their order in depth, and is off by a fraction of a pixel wherever
two of them share one. So points carry where they were seen, s, and how that changes over the view, A = ds/dt around
their position t: each says of the pixel p that its surface was seen at s + A (p - t), and the mean over the composite
is exact to first order whatever the weights are. The colour is taken from there.
"""

import functools
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

import vestcl
from vestcl import constants
from vestcl.forecast import Rendered

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

#: Less coverage than that is a hole.
HOLE: Final = 0.05

#: A pixel shows one surface if its points were seen within so many pixels of each other (standard deviation), and the
#: place where its own surface was seen is no farther than that from their mean. Elsewhere colours are mixed.
_ONE_SURFACE, _EXTRAPOLATED = 1.5, 2.0

#: What makes a point at an edge count as of several surfaces, px^2: a tenth of the composite is enough.
_EDGE: Final = 10 * _ONE_SURFACE**2

#: The area that a pixel of the source grows to, as a factor of what its depth says, lies in this range on a surface.
_GROWTH: Final = (0.2, 5.0)

#: Squared positions are carried in thousands of pixels, so that float32 keeps their differences.
_SQUARED: Final = 1000.0


@dataclass(frozen=True, eq=False)
class Cloud:
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
    clouds: list[Cloud], K: NDArray[np.float64], tgt_from_next: NDArray[np.float64], height: int, width: int
) -> Shown:
    """The clouds splatted one by one to a view, each behind those before it: sum_i c_i a_i prod_(j<i) (1 - a_j).

    Args:
        clouds: in order of trust: what the first covers, the others don't show.
        K: [3, 3] px, of the view.
        tgt_from_next: [4, 4] m.
        height: px.
        width: px.

    Returns:
        The composition; 0 where nothing is.
    """
    planes, left = np.zeros((7, height, width), np.float32), np.ones((1, height, width), np.float32)
    uncovered = np.ones((1, height, width), np.float32)
    for cloud in clouds:
        image, coverage = _splat(cloud, K, tgt_from_next, height, width)
        opacity = np.minimum(coverage / np.float32(_OPAQUE), 1) * (coverage > HOLE)
        planes += left * opacity * image / np.maximum(coverage, np.float32(1e-6))
        left = left * (1 - opacity)
        uncovered = uncovered * (1 - coverage)
    shown = planes / np.maximum(1 - left, np.float32(1e-6))
    return Shown(shown.astype(np.float32), (1 - uncovered).astype(np.float32))


def _splat(
    cloud: Cloud, K: NDArray[np.float64], tgt_from_next: NDArray[np.float64], height: int, width: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """image [7, H, W], not divided, and coverage [1, H, W]."""
    still = np.zeros_like(cloud.points_xyz)[None]
    points_uv, z = vestcl.displace(
        cloud.points_xyz[None], still, K[None].astype(np.float32), tgt_from_next[None].astype(np.float32)
    )
    zoom = cloud.z_src / np.maximum(z[0], np.float32(1e-3))
    whole, stretch = _surface(cloud, points_uv[0], zoom)
    radii = np.clip(RHO * stretch, *RADIUS_LIMITS)[None]
    opacities = (whole & (RHO * zoom <= RADIUS_LIMITS[1]))[None].astype(np.float32)
    inverse = 1 / np.maximum(z[0], np.float32(1e-3))
    colour = cloud.image[:, cloud.rows, cloud.columns].T
    features = np.concatenate(
        [colour, inverse[:, None], cloud.step_xyz, _origins(cloud, points_uv[0], zoom, whole)], axis=1
    )
    image, coverage = vestcl.splat(points_uv, z, radii, opacities, features[None], height, width)
    mean = np.ascontiguousarray(image[0]) / np.maximum(coverage[0], np.float32(1e-6))
    mean[:3] = _colour(mean, cloud.image)
    return mean[:7] * coverage[0], coverage[0]


def _on_grid(cloud: Cloud, planes: NDArray[np.float32]) -> tuple[NDArray[np.intp], int, NDArray[np.float32]]:
    """Where points are in their image with a border of one pixel, flat [N], its width, and ``planes`` [2, N] there.

    Returns:
        Indices, the width, and [2, (H + 2) (W + 2)], NaN where no point is.
    """
    height, width = cloud.image.shape[1] + 2, cloud.image.shape[2] + 2
    at = (cloud.rows + 1) * width + cloud.columns + 1
    grid = np.full((2, height * width), np.nan, np.float32)
    grid[:, at] = planes
    return at, width, grid


def _origins(
    cloud: Cloud, points_uv: NDArray[np.float32], zoom: NDArray[np.float32], solid: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """[N, 9]: s - A t, the four numbers of A, s and |s|^2: what `_colour` needs of each point.

    A is the inverse of dt/ds, by central differences over the image that the points come from. Where they tear, or a
    neighbour is not ``solid`` [N], the colours around a point are not all its surface's: |s|^2 is larger by _EDGE.
    """
    at, width, places = _on_grid(cloud, np.where(solid, points_uv.T, np.float32(np.nan)))
    (a, c), (b, d) = (
        [(plane.take(at + step) - plane.take(at - step)) / np.float32(2) for plane in places] for step in (1, width)
    )
    growth, alike = a * d - b * c, 1 / np.maximum(zoom, np.float32(1e-3))
    longest = np.square(np.maximum(zoom, np.float32(1))) * constants.TORN**2
    whole = (a * a + c * c < longest) & (b * b + d * d < longest)
    whole &= (growth > _GROWTH[0] * zoom**2) & (growth < _GROWTH[1] * zoom**2)
    safe = np.where(whole, growth, np.float32(1))
    slope = [np.where(whole, part / safe, flat) for part, flat in ((d, alike), (-b, 0), (-c, 0), (a, alike))]
    seen = np.stack([cloud.columns, cloud.rows]).astype(np.float32) + np.float32(0.5)
    u, v = points_uv.T
    start = [seen[0] - slope[0] * u - slope[1] * v, seen[1] - slope[2] * u - slope[3] * v]
    squared = seen[0] ** 2 + seen[1] ** 2 + np.where(whole, 0, np.float32(_EDGE))
    return np.stack([*start, *slope, *seen, squared / np.float32(_SQUARED)], axis=1).astype(np.float32)


def _colour(mean: NDArray[np.float32], image: NDArray[np.float32]) -> NDArray[np.float32]:
    """[3, H, W]: of ``image`` where the surface was seen; where a pixel shows several, the mean of their colours."""
    height, width = mean.shape[1:]
    y, x = np.mgrid[:height, :width].astype(np.float32) + np.float32(0.5)
    start, slope, seen, squared = mean[7:9], mean[9:13], mean[13:15], mean[15] * np.float32(_SQUARED)
    u, v = start[0] + slope[0] * x + slope[1] * y, start[1] + slope[2] * x + slope[3] * y
    one = (u - seen[0]) ** 2 + (v - seen[1]) ** 2 < _EXTRAPOLATED**2
    one &= squared - seen[0] ** 2 - seen[1] ** 2 < _ONE_SURFACE**2
    there = [cv2.remap(plane, u - 0.5, v - 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in image]
    return np.where(one, np.stack(there), mean[:3])


def _surface(
    cloud: Cloud, points_uv: NDArray[np.float32], zoom: NDArray[np.float32]
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Which points [N] still have neighbours of their picture beside them, and how far apart those are [N], px.

    A surface that turns towards the camera is stretched by more than what it comes nearer by: spacing >= ``zoom``.
    """
    mine = np.ascontiguousarray(points_uv.T)
    at, width, places = _on_grid(cloud, mine)
    steps = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
    beside = []
    for down, right in steps:
        across, along = (plane.take(at + (down * width + right)) - own for plane, own in zip(places, mine, strict=True))
        beside.append((across * across + along * along) / np.float32(down * down + right * right))
    limit = np.square(np.maximum(zoom, np.float32(1)))
    near = np.float32(constants.TORN**2) * limit
    count = np.add.reduce([one < near for one in beside], axis=0, dtype=np.uint8)
    line = functools.reduce(np.fmin, map(np.maximum, beside[:4], beside[:3:-1]))
    whole = (count >= _NEIGHBOURS) | (line < np.float32(_LINE**2) * limit)
    above, left, right, below = (beside[steps.index(step)] for step in ((-1, 0), (0, -1), (0, 1), (1, 0)))
    gaps = (np.fmin(above, below), np.fmin(left, right))
    spacing = np.maximum(*(np.where(gap < near, gap, np.float32(0)) for gap in gaps))
    return whole, np.maximum(zoom, np.sqrt(spacing)).astype(np.float32)


def rendered(shown: Shown, image: NDArray[np.float32]) -> Rendered:
    """The view as a forecast holds it, with ``image`` [3, H, W] in place of the splatted colour."""
    inverse, seen = shown.planes[3:4], shown.coverage > HOLE
    depth = np.divide(1, inverse, out=np.zeros_like(inverse), where=seen & (inverse > 0))
    return Rendered(image.clip(0, 1), depth, shown.coverage, np.where(seen, shown.planes[4:], np.float32(0)))


def holes(shown: Shown) -> NDArray[np.bool_]:
    """[1, H, W], True where nothing is seen."""
    return shown.coverage <= HOLE

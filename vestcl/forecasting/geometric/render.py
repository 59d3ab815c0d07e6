"""Point clouds on a new view: where each pixel's surface was seen, and the colour there; clouds one behind the other.

A composite of opaque points mixes their colours by their order in depth, and is off by a fraction of a pixel wherever
two of them share one. So points carry where they were seen, s, and how that changes over the view, A = ds/dt around
their position t: each says of the pixel p that its surface was seen at s + A (p - t), and the mean over the composite
is exact to first order whatever the weights are. The colour is taken from there.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.forecasting.full_size import Lookup, lookup
from vestcl.forecasting.geometric.frame_cloud import CloudPixels, FrameCloud, transposed
from vestcl.forecasting.geometric.surface import ONE_SURFACE, SQUARED, origins, surface
from vestcl.forecasting.result import Rendered
from vestcl.ops.displace import displace
from vestcl.ops.splat import splat

#: A point's radius in pixels of the source, and its limits in the target: for colour shown directly 0.9 to 1.0 is
#: best (SPEC section 2); 1.2 loses 0.15 dB on KITTI at t+1.
RHO: Final = 0.95
RADIUS_LIMITS: Final = (0.5, 8.0)

#: From this coverage on a pixel is opaque: only cracks between a surface's points let through what lies behind.
_OPAQUE: Final = 0.5

#: Less coverage than that is a hole.
HOLE: Final = 0.05

#: In a pixel of one surface, the position where its own surface was seen is no farther than that from their mean, px.
#: Elsewhere colours are mixed.
_EXTRAPOLATED: Final = 2.0

#: OpenCV looks up positions in rows of fewer than 32,768.
_ROW: Final = 1024


@dataclass(frozen=True, eq=False)
class Shown:
    """What clouds leave on a view, divided by coverage."""

    planes: NDArray[np.float32]
    """[7, H, W]: colour 3, inverse depth 1/m, motion 3 m."""
    coverage: NDArray[np.float32]
    """[1, H, W]."""
    lookups: tuple[Lookup, ...] = ()
    """Where the colours were recorded, of clouds that have a larger image; nowhere if ``where`` was given."""


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
        where: [1, H, W], True in requested pixels; None: all.

    Returns:
        The composition; 0 where nothing is, and in pixels that are not requested. Clouds behind an opaque pixel are
        not looked at: they add nothing to its coverage either.
    """
    wanted = np.arange(height * width) if where is None else np.flatnonzero(where)
    planes, left = np.zeros((7, len(wanted)), np.float32), np.ones(len(wanted), np.float32)
    lookups = list[Lookup]()
    for cloud in clouds:
        if not left.any():
            break
        through = np.s_[:] if (left > 0).all() else np.flatnonzero(left > 0)
        everywhere = where is None and isinstance(through, slice)
        pixels = _Requested(height, width, None if everywhere else wanted[through])
        mean, coverage, seen = _splat(cloud, K, tgt_from_next, pixels)
        opacity = np.minimum(coverage / np.float32(_OPAQUE), 1) * (coverage > HOLE)
        share = left[through] * opacity
        if cloud.full is not None and where is None:
            lookups.append(_lookup(cloud.full, seen, mean[:3], share, pixels))
        planes[:, through] += mean * share
        left[through] *= 1 - opacity
    whole = np.maximum(1 - left, np.float32(1e-6))
    planes /= whole
    shares = [np.asarray(each.share / whole.reshape(height, width), np.float32) for each in lookups]
    lookups = [replace(each, share=share) for each, share in zip(lookups, shares, strict=True)]
    both = np.concatenate([planes, 1 - left[None]])
    if where is not None:
        some, both = both, np.zeros((8, height * width), np.float32)
        both[:, wanted] = some
    both = both.reshape(8, height, width)
    return Shown(both[:7], both[7:], tuple(lookups))


@dataclass(frozen=True, eq=False)
class _Requested:
    """The requested pixels of a view, flat."""

    height: int
    width: int
    pixels: NDArray[np.intp] | None
    """[L]; None = all."""


def _lookup(
    full: NDArray[np.float32],
    seen: NDArray[np.float32],
    colour: NDArray[np.float32],
    share: NDArray[np.float32],
    pixels: _Requested,
) -> Lookup:
    """Of ``full`` [3, H', W'], by numbers [..., L] of the requested ``pixels``; 0 in the others."""
    some = np.concatenate([seen, colour, share[None]])
    if pixels.pixels is not None:
        few, some = some, np.zeros((len(some), pixels.height * pixels.width), np.float32)
        some[:, pixels.pixels] = few
    planes = some.reshape(-1, pixels.height, pixels.width)
    return lookup(full, planes[:3], planes[3:6], planes[6])


def _splat(
    cloud: FrameCloud, K: NDArray[np.float64], tgt_from_next: NDArray[np.float64], wanted: _Requested
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """image [7, L], divided by coverage, coverage [L], and of `_seen_at` [3, L]."""
    still = np.zeros((1, *cloud.points_xyz.shape), np.float32)
    points_uv, z = displace(
        cloud.points_xyz[None], still, K[None].astype(np.float32), tgt_from_next[None].astype(np.float32)
    )
    pixels = wanted.pixels
    if pixels is not None:
        kept = _near(cloud, points_uv[0], pixels, wanted)
        cloud, points_uv, z = _some(cloud, kept), points_uv[:, kept], z[:, kept]
    magnified = np.float32(1.0 if cloud.focal is None else K[0, 0] / cloud.focal)
    zoom, uv = magnified * cloud.z_src / np.maximum(z[0], np.float32(1e-3)), transposed(points_uv[0])
    whole, stretch = surface(CloudPixels.of(cloud), uv, zoom)
    radii = np.clip(RHO * stretch, *RADIUS_LIMITS)[None]
    opacities = (whole & (RHO * zoom <= RADIUS_LIMITS[1]))[None].astype(np.float32)
    size = wanted.height, wanted.width
    image, coverage = splat(points_uv, z, radii, opacities, _features(cloud, uv, z[0], zoom, whole)[None], *size)
    composite, covered = image[0].transpose(1, 2, 0).reshape(-1, 16), coverage.ravel()
    if pixels is not None:
        composite, covered = composite[pixels], covered[pixels]
    mean = transposed(composite)
    mean /= np.maximum(covered, np.float32(1e-6))
    seen = _seen_at(mean, pixels, *size)
    mean[:3] = _colour(mean, cloud.image, seen, wanted.width if pixels is None else _ROW)
    return mean[:7], covered, seen


def _features(
    cloud: FrameCloud,
    uv: NDArray[np.float32],
    z: NDArray[np.float32],
    zoom: NDArray[np.float32],
    whole: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """[N, 16]: colour 3, inverse depth, motion 3, and what `origins` finds of points at ``uv`` [2, N], ``z`` [N]."""
    pixels, distance = CloudPixels.of(cloud), np.maximum(z, np.float32(1e-3), dtype=np.float32)
    features = np.empty((16, len(z)), np.float32)
    features[:3] = pixels.colours(cloud.image)
    np.divide(1, distance, out=features[3])
    features[4:7] = transposed(cloud.step_xyz)
    origins(cloud, pixels, uv, zoom, whole, features[7:])
    return transposed(features)


def _near(
    cloud: FrameCloud, points_uv: NDArray[np.float32], pixels: NDArray[np.intp], view: _Requested
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
    return FrameCloud(*moving, cloud.rows[kept], cloud.columns[kept], focal=cloud.focal)


def _seen_at(
    mean: NDArray[np.float32], pixels: NDArray[np.intp] | None, height: int, width: int
) -> NDArray[np.float32]:
    """[3, L]: column and row, 0 = the first pixel's centre, of where the surface was seen; 1 if it is one, else 0.

    ``mean`` is [16, L], of the ``pixels`` [L] of a view, flat; None = of all.
    """
    half = np.float32(0.5)
    if pixels is None:
        x = np.tile(np.arange(width, dtype=np.float32) + half, height)
        y = np.repeat(np.arange(height, dtype=np.float32) + half, width)
    else:
        y, x = (at.astype(np.float32) + half for at in np.divmod(pixels, width))
    start, slope, seen, squared = mean[7:9], mean[9:13], mean[13:15], mean[15] * np.float32(SQUARED)
    u, v = start[0] + slope[0] * x + slope[1] * y, start[1] + slope[2] * x + slope[3] * y
    one = (u - seen[0]) ** 2 + (v - seen[1]) ** 2 < _EXTRAPOLATED**2
    one &= squared - seen[0] ** 2 - seen[1] ** 2 < ONE_SURFACE**2
    return np.stack([u - half, v - half, one.astype(np.float32)])


def _colour(
    mean: NDArray[np.float32], image: NDArray[np.float32], seen: NDArray[np.float32], row: int
) -> NDArray[np.float32]:
    """[3, L]: of ``image`` where the surface was seen; where a pixel shows several, the mean of their colours.

    ``seen`` is [3, L] of `_seen_at`; positions are looked up in rows of ``row``.
    """
    if not mean.size:
        return mean[:3]
    across, down = (np.pad(at, (0, -len(at) % row)).reshape(-1, row) for at in seen[:2])
    there = [
        cv2.remap(plane, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel() for plane in image
    ]
    return np.where(seen[2] > 0, np.stack(there)[:, : seen.shape[1]], mean[:3])


def rendered(shown: Shown, image: NDArray[np.float32]) -> Rendered:
    """The view as a forecast holds it, with ``image`` [3, H, W] in place of the splatted colour."""
    inverse, seen = shown.planes[3:4], shown.coverage > HOLE
    depth = np.divide(1, inverse, out=np.zeros_like(inverse), where=seen & (inverse > 0))
    motion = np.where(seen, shown.planes[4:], np.float32(0))
    return Rendered(image.clip(0, 1), depth, shown.coverage, motion, shown.lookups)


def holes(shown: Shown) -> NDArray[np.bool_]:
    """[1, H, W], True where nothing is seen."""
    return shown.coverage <= HOLE

"""Stereo depth of dynamic objects: windows and smooth sides, on which nothing can be matched.

A car that passes within a few metres grows by half from frame to frame, so that small errors of its depth tear it.
"""

import warnings
from collections.abc import Iterator
from typing import Final, NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.measure import ransac

from vestcl.scene.flow.correspondence import sample
from vestcl.scene.morphology import dilated
from vestcl.scene.motion import objects

#: A window lies farther than its frame by that factor at least, and its frame is that share of what is around it.
_BEHIND, _AROUND = 1.1, 0.35

#: Pixels of the frame: within this many of the window; fewer give no plane, and no more take part.
_FRAME, _FEWEST, _MOST = 7, 40, 1000

#: Pixels that belong to a window's edge, px, if they are as far.
_RIM: Final = 2

#: On the plane: within that share of the frame's inverse depth. A smaller share of the frame on it is no plane.
_INLIER, _ON_PLANE = 0.04, 0.5

#: RANSAC's most rounds, and the certainty that it stops at.
_ROUNDS, _CERTAIN = 200, 0.999

#: The plane explains the right image if it leaves no more than that factor of what the measured depth leaves, and that
#: much more: noise of an image.
_EXPLAINED, _NOISE = 1.15, 0.004

#: Differences of colour beyond that are of something else, and count no more.
_OTHER: Final = 0.15

#: Objects of that share of the image and more are smoothed, up to this many metres away. The window's radius is that
#: share of the square root of an object's area, px, in this range.
_LEAST, _FAR, _RADIUS, _RADII = 0.004, 20.0, 0.12, (3, 40)

#: Pixels whose inverse depth differs by that share from the surface's are of something else.
_SAME: Final = 0.15

#: Residuals of that share of an object's inverse depth count half (Cauchy), in this many fits.
_RESIDUAL, _FITS = 0.03, 3

Plane = NDArray[np.float64]


class StereoPair(NamedTuple):
    """A rectified pair."""

    left: NDArray[np.float32]
    """[3, H, W] RGB in [0, 1]."""
    right: NDArray[np.float32]
    """[3, H, W] likewise."""
    focal: float
    """fx b, px m: the disparity at a depth of 1 m."""


def foreground_depth(
    depth: NDArray[np.float32], foreground: NDArray[np.bool_], pair: StereoPair
) -> NDArray[np.float32]:
    """``depth`` with the windows of objects in their frames' planes, and near objects as locally plane surfaces.

    1/z = a u + b v + c: of a window by RANSAC through the frame around it, if that explains the right image no worse
    than what was measured; of an object by robust least squares over windows around each pixel.

    Args:
        depth: [1, H, W] m of the left image, above 0.
        foreground: [1, H, W], True = dynamic object.
        pair: that the depth was measured on.

    Returns:
        [1, H, W] m; ``depth`` away from the foreground.
    """
    if not foreground.any():
        return depth
    inverse = 1 / depth[0].astype(np.float64)
    for part in _parts(inverse, foreground, _FRAME + 1):
        _close(part, inverse, foreground[0], pair)
    for part in _parts(inverse, foreground, 0):
        measured, region = inverse[part.crop], part.region
        if region.sum() >= _LEAST * inverse.size and np.median(measured[region]) > 1 / _FAR:
            smooth = _locally_plane(measured, region)
            same = region & (np.abs(smooth - measured) < _SAME * measured)
            measured[same] = smooth[same]
    return np.where(foreground, 1 / np.maximum(inverse, 1e-6), depth).astype(np.float32)


class _Part(NamedTuple):
    """One connected piece of the foreground without a jump of depth inside."""

    crop: tuple[slice, slice]
    region: NDArray[np.bool_]
    """Of the crop."""


def _parts(inverse: Plane, foreground: NDArray[np.bool_], margin: int) -> Iterator[_Part]:
    """With a margin around each, px."""
    labels = objects.segment(~foreground, (1 / inverse)[None].astype(np.float32))
    height, width = labels.shape
    for number in range(1, int(labels.max()) + 1):
        x, y, w, h = cv2.boundingRect((labels == number).astype(np.uint8))
        rows = slice(max(y - margin, 0), min(y + h + margin, height))
        crop = rows, slice(max(x - margin, 0), min(x + w + margin, width))
        yield _Part(crop, labels[crop] == number)


def _close(part: _Part, inverse: Plane, foreground: NDArray[np.bool_], pair: StereoPair) -> None:
    """Into ``inverse``: the plane of the nearer surface around a part, if it explains the images as well."""
    measured, region = inverse[part.crop], part.region
    ring = dilated(region, _FRAME) & ~region
    frame = ring & foreground[part.crop] & (measured > _BEHIND * np.median(measured[region]))
    if frame.sum() < max(_FEWEST, _AROUND * ring.sum()):
        return
    plane = _plane_through(measured, frame)
    if plane is None or np.median(plane[region]) < np.median(measured[region]):
        return
    left_by_plane, left = (_unexplained(each, part, pair) for each in (np.where(region, plane, measured), measured))
    if left_by_plane <= _EXPLAINED * left + _NOISE:
        rim = dilated(region, _RIM) & foreground[part.crop] & (_BEHIND * measured < plane)
        measured[region | rim] = np.maximum(plane, measured)[region | rim]


class _PlaneModel:
    """1/z = a u + b v + c, as `skimage.measure.ransac` fits it to rows (u, v, 1/z)."""

    def __init__(self) -> None:
        self.params: Plane = np.zeros(3)

    @classmethod
    def from_estimate(cls, data: Plane) -> Self:
        model = cls()
        model.params = np.asarray(np.linalg.lstsq(_with_one(data), data[:, 2], rcond=None)[0], np.float64)
        return model

    def estimate(self, data: Plane) -> bool:
        """What scikit-image before 0.26 calls."""
        self.params = self.from_estimate(data).params
        return True

    def residuals(self, data: Plane) -> Plane:
        return np.asarray(np.abs(_with_one(data) @ self.params - data[:, 2]))


def _with_one(data: Plane) -> Plane:
    return np.column_stack([data[:, :2], np.ones(len(data))])


def _plane_through(inverse: Plane, which: NDArray[np.bool_]) -> Plane | None:
    """Values [h, w] of the plane that most of the pixels of ``which`` lie on, if enough do."""
    rows, columns = np.nonzero(which)
    some = slice(None, None, -(-len(rows) // _MOST))
    data = np.column_stack([columns, rows, inverse[which]]).astype(np.float64)[some]
    near = _INLIER * float(np.median(data[:, 2]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no plane found
        model, inliers = ransac(data, _PlaneModel, 3, near, max_trials=_ROUNDS, stop_probability=_CERTAIN, rng=0)
    if model is None or inliers is None or inliers.mean() < _ON_PLANE:
        return None
    a, b, c = model.params
    u, v = np.arange(inverse.shape[1]), np.arange(inverse.shape[0])[:, None]
    return np.asarray(a * u + b * v + c)


def _unexplained(inverse: Plane, part: _Part, pair: StereoPair) -> float:
    """Mean difference of a part's colours from those of the right image at disparity fx b / z."""
    (rows, columns), region = part.crop, part.region
    x, y = np.meshgrid(np.arange(columns.start, columns.stop), np.arange(rows.start, rows.stop))
    seen = sample(pair.right, x - pair.focal * inverse, y, outside=np.nan)
    difference = np.abs(seen - pair.left[:, rows, columns]).mean(0)[region]
    return float(np.nan_to_num(difference, nan=_OTHER).clip(max=_OTHER).mean())


def _locally_plane(inverse: Plane, region: NDArray[np.bool_]) -> Plane:
    """The mean of the planes that fit ``inverse`` best in the windows around each pixel, by pixels of ``region``."""
    radius = int(np.clip(_RADIUS * np.sqrt(region.sum()), *_RADII))
    y, x = np.indices(inverse.shape, np.float64)
    level = float(np.median(inverse[region]))
    weight: Plane = region.astype(np.float64)
    smooth = inverse
    for _ in range(_FITS):
        count = _box(weight, radius)
        mean_x, mean_y, mean = (_box(weight * plane, radius) / count for plane in (x, y, inverse))
        xx, yy, xy = (
            _box(weight * a * b, radius) / count - mean_a * mean_b
            for a, b, mean_a, mean_b in ((x, x, mean_x, mean_x), (y, y, mean_y, mean_y), (x, y, mean_x, mean_y))
        )
        xd, yd = (
            _box(weight * a * inverse, radius) / count - mean_a * mean for a, mean_a in ((x, mean_x), (y, mean_y))
        )
        xx, yy = xx + 1, yy + 1  # a pixel's own size: windows of one row have no slope across
        area = xx * yy - xy * xy
        a, b = (xd * yy - yd * xy) / area, (yd * xx - xd * xy) / area
        slopes = (_box(weight * plane, radius) / count for plane in (a, b, mean - a * mean_x - b * mean_y))
        a, b, c = slopes
        smooth = a * x + b * y + c
        weight = np.asarray(region / (1 + np.square((inverse - smooth) / (_RESIDUAL * level))), np.float64)
    return smooth


def _box(plane: Plane, radius: int) -> Plane:
    """Sums over squares; never 0, so that what is far from a region divides by something."""
    side = (2 * radius + 1, 2 * radius + 1)
    total = cv2.boxFilter(plane, cv2.CV_64F, side, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(total + 1e-9, np.float64)

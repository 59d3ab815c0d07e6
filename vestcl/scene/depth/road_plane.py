"""The road as a plane: it gives a moving camera's images their metres, and pixels without parallax their depth."""

import warnings
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.measure import ransac

#: Where the road is looked for: below that share of the height, within that share of the width about the middle.
_TOP, _BREADTH = 0.6, 0.7

#: Every which pixel, both ways, takes part.
_STRIDE: Final = 4

#: The road leans to a side and up or down by less, as tangents: a camera is mounted level to about 10 degrees.
_ROLL, _PITCH = 0.1, 0.25

#: RANSAC's most rounds, with which a third of the points on the road are found with 0.99999; it stops once what it has
#: found could be missed with less than that.
_ROUNDS, _CERTAIN = 400, 0.99999

#: On the plane: within this many standard deviations, which are no smaller than that share of the inverse depth.
_INLIER, _SHARE = 2.0, 0.03

#: Fewer points, or a smaller share of them on the plane, are no road.
_FEWEST, _ON_PLANE = 60, 0.25

Array = NDArray[np.float64]


def rays_of(K: Array, height: int, width: int) -> Array:
    """K^-1 (u, v, 1) at pixel centres, [3, H, W]."""
    return pixels_through(np.asarray(np.linalg.inv(K), np.float64), height, width)


def pixels_through(matrix: Array, height: int, width: int) -> Array:
    """M (u, v, 1) at pixel centres, [3, H, W], of ``matrix`` M [3, 3]."""
    u, v = np.arange(width) + 0.5, np.arange(height) + 0.5
    return np.add(matrix[:, 0, None, None] * u, matrix[:, 1, None, None] * v[:, None] + matrix[:, 2, None, None])


def linear(matrix: ArrayLike, planes: ArrayLike) -> Array:
    """M v [3, ...] of ``matrix`` M [3, 3] and vectors [3, ...], written out: for three rows BLAS takes longer."""
    x, y, z = np.asarray(planes)
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in np.asarray(matrix, np.float64)])


def window_of(height: int, width: int, stride: int = 1) -> tuple[slice, slice]:
    """Rows and columns where the road is looked for."""
    margin = round((1 - _BREADTH) / 2 * width)
    return slice(round(_TOP * height), height, stride), slice(margin, width - margin, stride)


def fit_road(inverse: Array, std: Array, K: Array) -> Array | None:
    """m = n / h of the plane n . x = h, by weighted least squares of 1/z = m . K^-1 p over RANSAC's inliers.

    Args:
        inverse: [H, W] 1/unit.
        std: [H, W] 1/unit; infinite = unknown.
        K: [3, 3] px.

    Returns:
        [3], 1/unit; its length is 1 over the camera's height. None where no level plane is found.
    """
    height, width = inverse.shape
    window = window_of(height, width, _STRIDE)
    rays = rays_of(K, height, width)[(slice(None), *window)].reshape(3, -1).T
    s, spread = inverse[window].ravel(), std[window].ravel()
    use = np.isfinite(spread) & (s > 2 * spread)
    if use.sum() < _FEWEST:
        return None
    rays, s = rays[use], s[use]
    spread = np.maximum(spread[use], _SHARE * s)
    plane = _ransac(rays, s, spread)
    for _ in range(4):
        on = np.abs(rays @ plane - s) < _INLIER * spread
        if on.sum() < max(_FEWEST, _ON_PLANE * len(s)):
            return None
        plane = np.asarray(np.linalg.lstsq(rays[on] / spread[on, None], s[on] / spread[on], rcond=None)[0], np.float64)
    return plane if _is_level(*plane.tolist()) else None


class _Plane:
    """A level plane as `skimage.measure.ransac` fits it, to rays and inverse depths in standard deviations."""

    def __init__(self) -> None:
        self.m: Array = np.zeros(3)

    @classmethod
    def from_estimate(cls, rays: Array, s: Array) -> Self | None:
        """None where no level plane fits; scikit-image from 0.26 on."""
        plane = cls()
        return plane if plane.estimate(rays, s) else None

    def estimate(self, rays: Array, s: Array) -> bool:
        """Whether a level plane fits; scikit-image before 0.26."""
        self.m = np.asarray(np.linalg.lstsq(rays, s, rcond=None)[0], np.float64)
        return _is_level(*self.m.tolist())

    def residuals(self, rays: Array, s: Array) -> Array:
        """|1/z - m . K^-1 p| in standard deviations, [N]."""
        return np.asarray(np.abs(rays @ self.m - s))


def _ransac(rays: Array, s: Array, spread: Array) -> Array:
    """m of the level plane through three points that most points are on; 0 where there is none."""
    data = rays / spread[:, None], s / spread
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # no level plane
        found, _ = ransac(data, _Plane, 3, _INLIER, max_trials=_ROUNDS, stop_probability=_CERTAIN, rng=0)
    return np.zeros(3) if found is None else np.asarray(found.m, np.float64)


def _is_level(right: float, down: float, ahead: float) -> bool:
    """Whether the plane m = (right, down, ahead) lies below the camera and leans no more than a road does."""
    return down > 0 and abs(right) < _ROLL * down and abs(ahead) < _PITCH * down

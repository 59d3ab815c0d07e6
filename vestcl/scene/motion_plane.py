"""The road as a plane: it gives a moving camera's pictures their metres, and pixels without parallax their depth."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

#: Where the road is looked for: below that share of the height, within that share of the width about the middle.
_TOP, _BREADTH = 0.6, 0.7

#: Every which pixel, both ways, takes part.
_STRIDE: Final = 4

#: The road leans to a side and up or down by less, as tangents: a camera is mounted level to about 10 degrees.
_ROLL, _PITCH = 0.1, 0.25

#: RANSAC's rounds; a third of the points on the road are found with 0.99999.
_ROUNDS: Final = 400

#: On the plane: within so many standard deviations, which are no smaller than that share of the inverse depth.
_INLIER, _SHARE = 2.0, 0.03

#: Fewer points, or a smaller share of them on the plane, are no road.
_FEWEST, _ON_PLANE = 60, 0.25

Array = NDArray[np.float64]


def rays_of(K: Array, height: int, width: int) -> Array:
    """K^-1 (u, v, 1) at pixel centres, [3, H, W]."""
    y, x = np.mgrid[:height, :width] + 0.5
    return np.tensordot(np.linalg.inv(K), np.stack([x, y, np.ones_like(x)]), 1)


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
    return plane if is_level(plane[None])[0] else None


def _ransac(rays: Array, s: Array, spread: Array) -> Array:
    """The level plane through three points that most points are on."""
    rng = np.random.default_rng(0)
    triples = rng.integers(0, len(s), (_ROUNDS, 3))
    # By the pseudo-inverse, which three points on a line have, too; what it gives for them is voted down.
    planes: Array = np.asarray((np.linalg.pinv(rays[triples]) @ s[triples][..., None])[..., 0], np.float64)
    counts = (np.abs(planes @ rays.T - s) < _INLIER * spread).sum(1) * is_level(planes)
    return np.asarray(planes[counts.argmax()])


def is_level(planes: Array) -> NDArray[np.bool_]:
    """Which of the planes [N, 3] lie below the camera and lean no more than a road does."""
    down = planes[:, 1]
    return (down > 0) & (np.abs(planes[:, 0]) < _ROLL * down) & (np.abs(planes[:, 2]) < _PITCH * down)

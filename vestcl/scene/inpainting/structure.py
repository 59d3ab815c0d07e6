"""The shape of what is hidden in a street: the road continues as a plane, and walls go down to it."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vestcl.scene.depth.road_plane import fit_road, rays_of

#: The focal length that the search for a level plane takes, as a share of the width: whether the plane is found
#: depends little on it, and its fit not at all.
_FOCAL: Final = 0.6

#: Error of an inverse depth that takes part in the fit, as a share of it.
_STD: Final = 0.02

#: Known pixels are of the road within that share of its inverse depth.
_ON_ROAD: Final = 0.05

#: A wall is continued from above, unless the hole is narrower than that share of the height to it.
_NARROW: Final = 0.5


class Structure(NamedTuple):
    """What is behind a hole."""

    inverse: NDArray[np.float32]
    """[1, H, W], 1/m; unchanged outside the hole."""
    road: NDArray[np.bool_]
    """[1, H, W], True on the road's plane, inside the hole and outside."""


def structure_behind(inverse: NDArray[np.float32], hole: NDArray[np.bool_]) -> Structure:
    """1/z = max(road, wall): road = the level plane that the lower middle of the image lies on, if there is one.

    wall is that of the first known pixel above, as walls are as far at their foot as at their top; where the hole is
    narrow, or nothing known is above, it is interpolated along the row.

    Args:
        inverse: [1, H, W], 1/m, above 0.
        hole: [1, H, W], True = not known.
    """
    height, width = hole.shape[1:]
    focal = _FOCAL * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    std = np.where(hole[0], np.inf, _STD * inverse[0])
    plane = fit_road(np.where(hole[0], 0, inverse[0]).astype(np.float64), std, K)
    road = np.zeros((height, width)) if plane is None else np.tensordot(plane, rays_of(K, height, width), 1)
    wall = _wall(inverse[0], hole[0])
    behind = np.where(hole[0], np.maximum(road, wall), inverse[0]).astype(np.float32)
    on_road = np.where(hole[0], (1 + _ON_ROAD) * road >= wall, np.abs(inverse[0] - road) < _ON_ROAD * road)
    return Structure(behind[None], on_road[None])


def _wall(inverse: NDArray[np.float32], hole: NDArray[np.bool_]) -> NDArray[np.float32]:
    height, width = hole.shape
    rows, columns = np.arange(height)[:, None], np.arange(width)[None]
    above = np.maximum.accumulate(np.where(hole, -1, rows), axis=0)
    left = np.maximum.accumulate(np.where(hole, -1, columns), axis=1)
    right = np.minimum.accumulate(np.where(hole, width, columns)[:, ::-1], axis=1)[:, ::-1]
    inner = (left >= 0) & (right < width)
    gap = np.where(inner, right - left, np.inf)
    from_top = np.take_along_axis(inverse, np.maximum(above, 0), 0)
    left, right = np.where(left < 0, np.minimum(right, width - 1), left), np.where(right < width, right, left)
    right = np.maximum(right, 0)
    share = (columns - left) / np.maximum(right - left, 1)
    ends = (np.take_along_axis(inverse, side.clip(0, width - 1), 1) for side in (left, right))
    first, last = ends
    across = first * (1 - share) + last * share
    return np.where((above >= 0) & (_NARROW * (rows - above) < gap), from_top, across).astype(np.float32)

"""What no frame saw at an image's sides: a street continues along the lines through its vanishing point."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.scene.flow.correspondence import sample

#: Where neighbouring lines enter the hole is smoothed over this many of them, both sides, in an image 832 wide, so
#: that the ragged edge of a hole is not extended.
_SMOOTH, _WIDTH = 9, 832

#: The share of what is extrapolated falls to 1/e at that distance into the hole, over the distance of its edge from the
#: vanishing point.
_DECAY: Final = 0.5

Array = NDArray[np.float32]
Matrix = NDArray[np.float64]


def carry_on(filled: Array, hole: NDArray[np.bool_], at_border: NDArray[np.bool_], vanishing_uv: Matrix) -> Array:
    """The colour in a hole at the border is that on its line through the vanishing point, mirrored where it enters.

    Along such a line the depth of a surface parallel to the road is Z ~ 1/r, r the distance from the vanishing point.
    Mirrored in depth at the hole's edge r_0 this is 1/r' = 2/r_0 - 1/r: kerbs, markings and rows of windows continue,
    and what is nearer is shown larger. The farther into the hole, the more of ``filled`` is left:
    w = exp(-(r/r_0 - 1) / 0.5).

    Args:
        filled: [C, H, W], smoothly filled.
        hole: [H, W], True = unknown.
        at_border: [H, W], True = to be filled: the holes that reach the border.
        vanishing_uv: [2] px, where lines along the road meet.

    Returns:
        [C, H, W]; ``filled`` elsewhere.
    """
    if not at_border.any():
        return filled
    (height, width), (u, v), edges = hole.shape, vanishing_uv, _edges(hole, vanishing_uv)
    y, x = np.nonzero(at_border)
    across, down = x + 0.5 - u, y + 0.5 - v
    r = np.maximum(np.hypot(across, down), 1.0)
    line = (np.arctan2(down, across) / (2 * np.pi) % 1.0) * len(edges) - 0.5
    first, share = np.floor(line).astype(np.intp), line % 1.0
    edge = np.clip(edges[first % len(edges)] * (1 - share) + edges[(first + 1) % len(edges)] * share, 1.0, r)
    shrunk = 1 / (2 * r / edge - 1)  # r' / r
    column, row = np.zeros((2, height, width), np.float32)
    column[y, x] = np.clip(u + shrunk * across - 0.5, 0, width - 1)
    row[y, x] = np.clip(v + shrunk * down - 0.5, 0, height - 1)
    weight = np.exp(-(r / edge - 1) / _DECAY)
    result = np.array(filled, np.float32)
    for plane, mirrored in zip(result, sample(filled, column, row), strict=True):
        plane[y, x] = weight * mirrored[y, x] + (1 - weight) * plane[y, x]
    return result


def _edges(hole: NDArray[np.bool_], vanishing_uv: Matrix) -> Matrix:
    """r_0 [L] px by the line's angle: how far out the last pixel on it is that is known, smoothed over lines."""
    (height, width), (u, v) = hole.shape, vanishing_uv
    lines, reach = 2 * (height + width), max(1, round(_SMOOTH * width / _WIDTH))
    farthest = int(np.hypot(max(abs(u), abs(u - width)), max(abs(v), abs(v - height)))) + 1
    angles, r = (np.arange(lines) + 0.5) * (2 * np.pi / lines), np.arange(1, farthest)
    inside = np.pad(~hole, 1)  # what is outside the image is not known
    column, row = (
        np.floor((start + np.outer(turn(angles), r)).clip(-1, size)) + 1
        for start, turn, size in ((u, np.cos, width), (v, np.sin, height))
    )
    known = inside.take((row * (width + 2) + column).astype(np.intp))
    last = np.where(known.any(axis=1), farthest - 1 - np.argmax(known[:, ::-1], axis=1), 0).astype(np.float32)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(last, 3 * reach, "wrap"), 2 * reach + 1)
    smooth = cv2.GaussianBlur(np.median(around, axis=1)[None], (4 * reach + 1, 1), reach / 2)[0]
    return np.asarray(smooth[2 * reach : 2 * reach + lines], np.float64)

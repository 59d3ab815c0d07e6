"""Points of one frame, and which pixels of its image they come from."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class FrameCloud:
    """Points of one frame, at the time that is shown."""

    points_xyz: NDArray[np.float32]
    """[N, 3] m, in the source camera's frame at that time."""
    z_src: NDArray[np.float32]
    """[N] m, depth in the image that the points come from."""
    image: NDArray[np.float32]
    """[3, H, W] RGB, the image that the points come from."""
    step_xyz: NDArray[np.float32]
    """[N, 3] m: how far each came over the last frame interval."""
    rows: NDArray[np.intp]
    """[N], of the pixel that each point comes from ..."""
    columns: NDArray[np.intp]
    """[N] ... and its column."""
    full: NDArray[np.float32] | None = None
    """[3, H', W'], the image as it was recorded, where it is larger than ``image``."""
    focal: float | None = None
    """Px, fx of ``image``; None is that of the view."""


@dataclass(frozen=True, eq=False)
class CloudPixels:
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
    def of(cls, cloud: FrameCloud) -> "CloudPixels":
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

    def neighbours(self, planes: NDArray[np.float32]) -> Callable[[int, int], NDArray[np.float32]]:
        """Values of ``planes`` [C, *] this many rows below and columns to the right, up to one: [C, *], NaN if none."""
        grid = np.full((len(planes), self.height + 2, self.width + 2), np.nan, np.float32)
        if self.dense:
            grid[:, 1:-1, 1:-1] = planes
            return lambda down, right: grid[:, 1 + down : 1 + down + self.height, 1 + right : 1 + right + self.width]
        pitch, spread = self.width + 2, grid.reshape(len(planes), -1)
        at = self.flat + 2 * (self.flat // self.width) + pitch + 1
        spread[:, at] = planes
        return lambda down, right: spread.take(at + (down * pitch + right), axis=1)


def transposed(matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    """The transpose in its own memory, as NumPy copies it, in a third of the time."""
    if not matrix.size:
        return np.zeros(matrix.shape[::-1], np.float32)
    return np.asarray(cv2.transpose(matrix), np.float32).reshape(matrix.shape[::-1])

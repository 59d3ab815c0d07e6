"""Resizing of images, depth and labels in continuous pixel coordinates: K' = diag(sx, sy, 1) K, no halves.

The target pixel in row i covers the source rows [i H / h, (i + 1) H / h); columns likewise.
"""

from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

Element = TypeVar("Element", bound=np.generic)


def resize_image(image: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Mean over the covered area along axes that shrink, bilinear along axes that grow.

    Args:
        image: [C, H, W].
        height: of the result, px.
        width: of the result, px.

    Returns:
        [C, height, width] float32; ``image`` itself where that is its size.
    """
    check_size(height, width)
    if image.shape[1:] == (height, width):
        return image
    shrunk = min(height, image.shape[1]), min(width, image.shape[2])
    planes = [cv2.resize(plane, shrunk[::-1], interpolation=cv2.INTER_AREA) for plane in image]
    planes = [cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR) for plane in planes]
    return np.stack(planes).clip(image.min(), image.max(), dtype=np.float32)  # a mean rounds beyond its terms


def resize_depth(depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """The source pixel under the target's centre or, where that is invalid, the nearest valid one that it covers.

    Depth is never mixed across edges, and sparse depth stays sparse: a target pixel that covers no valid source pixel
    is invalid. Of equally near ones the smaller depth wins.

    Args:
        depth: [1, H, W] m, valid iff > 0.
        height: of the result, px.
        width: of the result, px.

    Returns:
        [1, height, width] float32 m, valid iff > 0; ``depth`` itself where that is its size.
    """
    check_size(height, width)
    if depth.shape[1:] == (height, width):
        return depth
    resized = resize_labels(depth, height, width).copy()
    target = resized[0]
    rows, columns = np.nonzero(depth[0] > 0)
    row_cells, row_distances = _cells(rows, depth.shape[1], height)
    column_cells, column_distances = _cells(columns, depth.shape[2], width)
    wanted = ~(target[row_cells, column_cells] > 0)
    cells = row_cells[wanted] * width + column_cells[wanted]
    distances = row_distances[wanted] ** 2 + column_distances[wanted] ** 2
    values = depth[0, rows[wanted], columns[wanted]]
    order = np.lexsort((values, distances))
    filled, first = np.unique(cells[order], return_index=True)
    target.flat[filled] = values[order][first]
    return resized


def resize_labels(labels: NDArray[Element], height: int, width: int) -> NDArray[Element]:
    """The source pixel under the target's centre.

    Args:
        labels: [C, H, W] of any dtype.
        height: of the result, px.
        width: of the result, px.

    Returns:
        [C, height, width]; ``labels`` itself where that is its size.
    """
    check_size(height, width)
    if labels.shape[1:] == (height, width):
        return labels
    rows, columns = _under_centres(labels.shape[1], height), _under_centres(labels.shape[2], width)
    return labels.take(columns, axis=2).take(rows, axis=1)


def sample_grid(
    image: NDArray[np.float32], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Bilinear at every row and column of a grid; black outside the image.

    Args:
        image: [C, H, W].
        rows: [h] px, pixel centres at integers.
        columns: [w] px, pixel centres at integers.

    Returns:
        [C, h, w] float32.
    """
    grid = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    return np.stack([cv2.remap(plane, *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) for plane in image])


def check_size(height: int, width: int) -> None:
    """Refuse sizes that are not positive integers.

    Raises:
        ValueError: the message names the size.
    """
    for name, size in (("height", height), ("width", width)):
        if not isinstance(size, int | np.integer) or size < 1:
            raise ValueError(f"`{name}` must be a positive integer, got {size!r}")


def _under_centres(source: int, target: int) -> NDArray[np.intp]:
    """floor((i + 1/2) source / target) for i in 0 ... target - 1, in integers."""
    return (2 * np.arange(target) + 1) * source // (2 * target)


def _cells(indices: NDArray[np.intp], source: int, target: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The target pixel that each source pixel's centre lies in, and how far its centre is, in source pixels."""
    cells = (2 * indices + 1) * target // (2 * source)
    return cells, (indices + 0.5) - (cells + 0.5) * (source / target)

"""A forecast as one image."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vestcl.data.resize import resize_labels
from vestcl.forecasting.result import Rendered
from vestcl.io.contact_sheet import CELL_WIDTH, DEPTH_COLOURS, FAR, NEAR, Cell, Picture, depth_map, grey, sheet


def forecast_sheet(frames: Sequence[Rendered], title: str = "") -> Picture:
    """A row per step: colour, depth and coverage.

    Args:
        frames: of one view, at t+1, ...
        title: a line above all.

    Returns:
        [H, W, 3] uint8.

    Raises:
        ValueError: no frame, or NaN in an image or a coverage.
    """
    rows = [
        [
            Cell(frame.pixels, f"t+{step}  forecast"),
            Cell(depth_map(_small(frame.depth)), "depth (black: unknown)"),
            Cell(
                grey(_small(frame.coverage)),
                f"coverage, mean {frame.coverage.mean():.1%} (black: disoccluded, inpainted)",
            ),
        ]
        for step, frame in enumerate(frames, start=1)
    ]
    scale = (f"depth, by its inverse: {FAR:g} m and more", f"{NEAR:g} m and less", DEPTH_COLOURS)
    return sheet(rows, title=title, bar=scale)


def _small(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """[1, H, W] no wider than a sheet shows it."""
    height, width = plane.shape[1:]
    smaller = min(1.0, CELL_WIDTH / width)
    return resize_labels(plane, max(1, round(height * smaller)), round(width * smaller))

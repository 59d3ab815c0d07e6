"""A forecast as one image."""

from collections.abc import Sequence

from vestcl.forecasting.result import Rendered
from vestcl.io.contact_sheet import DEPTH_COLOURS, FAR, NEAR, Cell, Picture, depth_map, grey, rgb, sheet


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
            Cell(rgb(frame.image), f"t+{step}  forecast"),
            Cell(depth_map(frame.depth), "depth (black: unknown)"),
            Cell(grey(frame.coverage), f"coverage, mean {frame.coverage.mean():.1%} (black: disoccluded, inpainted)"),
        ]
        for step, frame in enumerate(frames, start=1)
    ]
    scale = (f"depth, by its inverse: {FAR:g} m and more", f"{NEAR:g} m and less", DEPTH_COLOURS)
    return sheet(rows, title=title, bar=scale)

"""What a network that refines forecasts is shown of one: planes of a rendered frame."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl.forecasting.result import Rendered
from vestcl.models.config import FORECAST_PLANES

#: Seconds from frame to frame that a clip without timestamps counts as having.
DEFAULT_INTERVAL: Final = 0.1

#: What a pixel's surface moves is counted up to this share of its distance: beyond, it passes by the camera.
_MOST_MOVED: Final = 2.0


def forecast_planes(rendered: Rendered, ahead: int, interval: float | None) -> NDArray[np.float32]:
    """Image 3, coverage 1, inverse depth 1, motion 1 and time 1.

    Inverse depth 1 / z is in 1/m and 0 where unknown. Motion is min(k |m| / z, 2) of the last interval's motion m: how
    far the surface moves in k intervals, as a share of its distance, and with it the error that is to be expected. Time
    is k intervals in seconds, the same in all pixels.

    Args:
        rendered: a frame of a forecast, from any view.
        ahead: k, frame intervals ahead.
        interval: seconds; None counts as `DEFAULT_INTERVAL`.

    Returns:
        [FORECAST_PLANES, H, W].
    """
    inverse = np.divide(1, rendered.depth, out=np.zeros_like(rendered.depth), where=rendered.depth > 0)
    length = np.sqrt(np.square(rendered.motion_xyz).sum(axis=0, keepdims=True))
    moved = np.minimum(ahead * length * inverse, _MOST_MOVED)
    time = np.full_like(inverse, ahead * (DEFAULT_INTERVAL if interval is None else interval))
    planes = np.concatenate([rendered.image, rendered.coverage, inverse, moved, time]).astype(np.float32)
    assert len(planes) == FORECAST_PLANES
    return planes

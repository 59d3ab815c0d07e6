"""Moving objects up to their outline: smooth flow misses the rim of what moves, and its bare doors and windows.

Around a region that moves each pixel is asked which motion explains it: what it shows is looked up in the frame before
at p + f, with f the flow of the nearest reliable pixel of the region, and at p + b, with b the background's.
"""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.scene import checked
from vestcl.scene.depth.completion import smooth
from vestcl.scene.exposure import as_exposed
from vestcl.scene.flow.correspondence import Correspondence, sample
from vestcl.scene.flow.parallax import pixel_centres
from vestcl.scene.morphology import dilated, eroded

#: Asked are pixels up to that share of the image's width from a region. Flow of an object is taken from so far inside.
_BAND, _INSIDE = 0.015, 0.004

#: Forward-backward error beyond which flow is rejected, px.
_FLOW_ERROR: Final = 1.0

#: Differences of colour are averaged over windows of this many pixels, count up to the first number, and decide from
#: the second one on: noise of an image.
_WINDOW, _OTHER, _NOISE = 5, 0.15, 0.006

#: Gaps of a region of up to twice that share of the image's width are closed, holes of up to that share of its area.
_GAP, _HOLE = 0.005, 0.004

#: Pixels with less weight than that around are not added.
_UNSEEN: Final = 0.05


def whole_objects(
    moving: NDArray[np.bool_],
    image: NDArray[np.float32],
    image_prev: NDArray[np.float32],
    correspondence: Correspondence,
    background_uv: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """``moving`` and the pixels around it that look more like the frame before by the motion of what they are next to.

    Pixel p is added if G(w (|I(p) - I_prev(b(p))| - |I(p) - I_prev(p + f)|)) / G(w) > NOISE, with G smoothing up to the
    edges of the image, and w = 0 where the object was in front of the background before, which then gives no
    information. Small holes and narrow gaps are filled: there both motions may look the same.

    Args:
        moving: [H, W].
        image: [3, H, W] RGB in [0, 1] at t.
        image_prev: the same at t - 1.
        correspondence: from t to t - 1.
        background_uv: b [2, H, W] px, where static pixels are seen at t - 1.

    Returns:
        [H, W].
    """
    width = moving.shape[1]
    inner = eroded(moving, _INSIDE * width) & (correspondence.error[0] < _FLOW_ERROR)
    band = dilated(moving, _BAND * width) & ~moving
    if not inner.any() or not band.any():
        return moving
    _, nearest = cv2.distanceTransformWithLabels(
        (~inner).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    flow_of = np.zeros((2, int(nearest.max()) + 1), np.float32)
    flow_of[:, nearest[inner]] = correspondence.flow_uv[:, inner]
    flow_uv = flow_of[:, nearest]
    before = as_exposed(image_prev, image, correspondence.flow_uv)
    by_background, by_object = (
        _difference(image, before, there) for there in (background_uv, pixel_centres(*moving.shape) + flow_uv)
    )
    x, y = background_uv - flow_uv - 0.5
    seen = 1 - sample(dilated(moving, _INSIDE * width)[None].astype(np.float32), x, y, outside=0.0)[0]
    gain, share = (
        smooth(checked.pixels(image), cv2.blur(plane, (_WINDOW, _WINDOW)))
        for plane in (seen * (by_background - by_object), seen)
    )
    return _without_holes(moving | (band & (gain > _NOISE * np.maximum(share, _UNSEEN))))


def _without_holes(region: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """With all that it encloses, but for gaps of up to twice _GAP: windows and wheels go with their car.

    What is enclosed is no larger than _HOLE: a ring of traffic does not take the road inside along.
    """
    radius = _GAP * region.shape[1]
    side = 2 * round(radius) + 2  # so far beyond the border nothing is, and what touches it is not enclosed
    closed = eroded(dilated(np.pad(region, side), radius), radius)
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~closed).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= _HOLE * region.size
    small[0] = False
    return np.asarray(region | (closed | small[labels])[side:-side, side:-side], np.bool_)


def _difference(
    image: NDArray[np.float32], before: NDArray[np.float32], uv: NDArray[np.float64]
) -> NDArray[np.float32]:
    found = sample(before, uv[0] - 0.5, uv[1] - 0.5, outside=np.nan)
    difference = np.nan_to_num(np.abs(found - image).mean(0), nan=_OTHER)
    return np.minimum(difference, np.float32(_OTHER))

"""Views at the clip's own size, of scenes that are perceived and splatted at a smaller, working size.

A splatted pixel knows where its surface was seen (`vestcl.forecasting.geometric`). That offset is smooth on a
surface, so the view's colours are taken from the recorded image at its own size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.data.resize import resize_image

#: Offsets of neighbouring pixels on one surface differ by no more than that, px; elsewhere the smaller image is shown.
_SMOOTH: Final = 1.5

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Lookup:
    """Colours of a view that one recorded image has, all planes at the working size h x w."""

    image: Array
    """[3, H, W], the recorded image at its own size."""
    offset_uv: Array
    """[2, h, w] px of the working size: from a pixel of the view to where its surface was seen."""
    colour: Array
    """[3, h, w], what the view shows of the image at the working size."""
    share: Array
    """[h, w] in [0, 1]: the part of the view's colour that it is; 0 where no single surface is seen."""


def lookup(image: Array, seen: Array, colour: Array, share: Array) -> Lookup:
    """A `Lookup` of one surface wherever offsets are smooth.

    Args:
        image: [3, H, W], the recorded image at its own size.
        seen: [3, h, w]: column and row in px, 0 = the first pixel's centre, where each pixel's surface was seen, and
            1 where that is one surface, else 0.
        colour: [3, h, w].
        share: [h, w].
    """
    height, width = share.shape
    offset = seen[:2] - np.stack(np.meshgrid(np.arange(width), np.arange(height))).astype(np.float32)
    brush = np.ones((3, 3), np.uint8)
    smooth = [cv2.dilate(plane, brush) - cv2.erode(plane, brush) < _SMOOTH for plane in offset]
    one = (seen[2] > 0) & smooth[0] & smooth[1]
    return Lookup(image, offset, colour, np.where(one, share, np.float32(0)))


def without(lookups: Sequence[Lookup], where: NDArray[np.bool_]) -> tuple[Lookup, ...]:
    """``lookups`` that have no part in the colour at ``where`` [h, w]."""
    return tuple(replace(each, share=np.where(where, np.float32(0), each.share)) for each in lookups)


def enlarged(image: Array, lookups: Sequence[Lookup], height: int, width: int) -> Array:
    """A view at the clip's own size: up(I) + sum_i up(s_i) (D_i(p + up(o_i)) - up(c_i)).

    Args:
        image: I [3, h, w] RGB in [0, 1], the view at the working size.
        lookups: share s, offset o and colour c of each recorded image D. Nothing else is looked at.
        height: H, px.
        width: W, px.

    Returns:
        [3, H, W] RGB in [0, 1]; D itself where a view shows just what was recorded.
    """
    result = resize_image(image, height, width)
    result = result.copy() if result is image else result
    factors = width / image.shape[2], height / image.shape[1]
    axes = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    for each in lookups:
        if not each.share.any():
            continue
        share = _up(each.share, height, width)
        at = [_up(plane, height, width) for plane in each.offset_uv]
        for plane, factor, axis in zip(at, factors, axes, strict=True):
            plane *= np.float32(factor)
            plane += axis
        for plane, recorded, colour in zip(result, each.image, each.colour, strict=True):
            mapped = cv2.remap(recorded, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            there = np.asarray(mapped, np.float32)
            there -= _up(colour, height, width)
            there *= share
            plane += there
    return np.clip(result, 0, 1, out=result)


def _up(plane: Array, height: int, width: int) -> Array:
    return np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)

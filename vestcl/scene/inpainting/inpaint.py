"""What is behind the foreground: colour and depth of the static background that it hides (SPEC section 3.3)."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl import constants
from vestcl.scene import checked
from vestcl.scene.inpainting.inpainters import Inpainter, inpainter
from vestcl.scene.inpainting.structure import structure_behind

#: How colour is filled if nothing else is asked for. `vestcl bench inpaint` over 20 streets: regions 15.7 dB in 0.04 s,
#: push-pull 15.5 dB, fsr 15.2 dB in 0.6 s, telea 14.2 dB, ns 13.6 dB, biharmonic 11.9 dB; and only regions keeps the
#: edge between road and houses.
DEFAULT: Final = "regions"

#: `vestcl.constants.BEHIND`, in the depth's own type.
_BEHIND: Final = np.float32(constants.BEHIND)

#: The SPEC's dilation, px, and the width of the images that it is reported.
_DILATE, _WIDTH = 10, 832

#: Nothing hidden is farther, metres.
_FARTHEST: Final = 10_000.0


def inpaint_background(
    image: ArrayLike,
    depth: ArrayLike,
    mask: ArrayLike,
    *,
    dilate: int | None = None,
    method: str | Inpainter | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """I_bg and D_bg: the frame where M = 1; where M = 0 what surrounds the foreground, dilated, continues behind it.

    Depth: D_bg = max(1 / max(road, wall), 1.01 D), see `structure_behind`. Colour: by ``method``.

    Args:
        image: [3, H, W] RGB in [0, 1].
        depth: [1, H, W] m, above 0 everywhere.
        mask: M [1, H, W] bool, True = static background.
        dilate: px by which the hole grows, so that the rim of the foreground is not taken for background; None is 10 px
            at 832 columns, and in proportion.
        method: a name of `inpainters.METHODS`, "lama:PATH", a function as `Inpainter`; None is DEFAULT.

    Returns:
        [3, H, W] and [1, H, W] m; the arguments themselves where nothing is hidden. An image that is all foreground
        has nothing to go by: it keeps its colour, at 1.01 D.

    Raises:
        ValueError: shapes, dtypes, numbers that aren't finite, zero depth, an unknown method.
    """
    depth = checked.depth("depth", depth)
    image = checked.planes("image", image, 3, depth)
    mask = checked.mask("mask", mask, depth)
    if not depth.all():
        raise ValueError(f"`depth` must be above 0 m everywhere, got {int((depth == 0).sum())} pixels of 0")
    fill = inpainter(DEFAULT if method is None else method)
    if mask.all():
        return image, depth
    hole = _dilated(mask, round(_DILATE * depth.shape[2] / _WIDTH) if dilate is None else dilate)
    if hole.all():
        hole = ~mask
    if hole.all():
        return image, _BEHIND * depth
    behind = structure_behind(np.reciprocal(depth), hole)
    colour = np.where(mask, image, fill(image, hole, behind.road)).astype(np.float32)
    hidden = np.maximum(1 / np.maximum(behind.inverse, np.float32(1 / _FARTHEST)), _BEHIND * depth)
    return colour, np.where(mask, depth, hidden)


def _dilated(mask: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
    if radius < 0:
        raise ValueError(f"`dilate` must be 0 px or more, got {radius}")
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.dilate((~mask[0]).astype(np.uint8), brush).astype(bool)[None]

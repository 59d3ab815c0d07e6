"""What is behind the foreground: colour and depth of the static background that it hides (SPEC section 3.3)."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.scene import _check
from vestcl.scene._inpaint_methods import Inpainter, inpainter, push_pull

#: By how much what an object hides is farther than the object, at least (SPEC section 3.3).
_BEHIND: Final = np.float32(1.01)

#: Width of the pictures of which the SPEC's 10 px are told (SPEC section 10).
_WIDTH: Final = 832

#: The SPEC's dilation, px.
_DILATE: Final = 10


def inpaint_background(
    image: ArrayLike,
    depth: ArrayLike,
    mask: ArrayLike,
    *,
    dilate: int | None = None,
    method: str | Inpainter | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """I_bg and D_bg."""
    depth = _check.depth("depth", depth)
    image = _check.planes("image", image, 3, depth)
    mask = _check.mask("mask", mask, depth)
    if mask.all():
        return image, depth
    radius = round(_DILATE * depth.shape[2] / _WIDTH) if dilate is None else dilate
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    hole = cv2.dilate((~mask[0]).view(np.uint8), kernel).view(bool)[None]
    fill = inpainter("push-pull") if method is None else inpainter(method)
    colour = np.where(mask, image, fill(image, hole))
    inverse = push_pull(1 / depth, hole)
    behind = np.maximum(1 / np.maximum(inverse, 1e-6), _BEHIND * depth)
    return colour, np.where(mask, depth, behind)

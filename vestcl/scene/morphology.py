"""Regions grown and shrunk by a radius that depends on the image's size."""

import cv2
import numpy as np
from numpy.typing import NDArray


def dilated(region: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """``region`` [H, W] and all within ``radius`` pixels of it, rounded, one or more; an ellipse."""
    return np.asarray(cv2.dilate(region.astype(np.uint8), _ellipse(radius)) > 0)


def eroded(region: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """``region`` [H, W] without what is within ``radius`` pixels of its outside, as in `dilated`."""
    return np.asarray(cv2.erode(region.astype(np.uint8), _ellipse(radius)) > 0)


def _ellipse(radius: float) -> NDArray[np.uint8]:
    side = 2 * max(round(radius), 1) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)

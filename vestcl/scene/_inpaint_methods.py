"""Ways to fill holes of a picture, by name."""

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray


class Inpainter(Protocol):
    """Fills holes of a picture from what surrounds them."""

    def __call__(self, colour: NDArray[np.float32], hole: NDArray[np.bool_]) -> NDArray[np.float32]:
        """[3, H, W]; equals ``colour`` outside the holes."""


def push_pull(colour: NDArray[np.float32], hole: NDArray[np.bool_]) -> NDArray[np.float32]:
    """A hole takes the mean of the next coarser level, which is filled likewise."""
    planes = np.ascontiguousarray(np.where(hole, np.float32(0), colour).transpose(1, 2, 0))
    return np.where(hole, _pull(planes, (~hole[0]).astype(np.float32)).transpose(2, 0, 1), colour)


def _pull(image: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """[H, W, C] with every pixel of weight 0 filled."""
    height, width = weight.shape
    if min(height, width) < 2 or (weight > 0).all():
        mean = (image * weight[..., None]).sum((0, 1)) / max(float(weight.sum()), 1e-20)
        return np.where(weight[..., None] > 0, image, mean.astype(np.float32))
    size = (-(-width // 2), -(-height // 2))
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(image * weight[..., None], size, interpolation=cv2.INTER_AREA).reshape(*share.shape, -1)
    mean = np.divide(total, share[..., None], out=np.zeros_like(total), where=share[..., None] > 0)
    coarse = cv2.resize(_pull(mean, share), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(weight[..., None] > 0, image, coarse.reshape(height, width, -1))


def inpainter(method: str | Inpainter) -> Inpainter:
    """The inpainter."""
    return push_pull if isinstance(method, str) else method

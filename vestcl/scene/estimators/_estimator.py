"""What depth and classes from one image by transformers' networks have in common."""

from typing import Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from vestcl.scene.estimators._preparation import Preparation, image_array, one_image

Number = TypeVar("Number", np.float32, np.uint8)


class Estimator(Generic[Number]):
    """A plane of numbers for an image; subclasses are dataclasses with `load` and `_estimate`."""

    model: Any
    """transformers' network."""
    preparation: Preparation
    device: str

    def __call__(self, image: ArrayLike) -> NDArray[Number]:
        """The plane of one image.

        Args:
            image: [3, H, W] RGB in [0, 1].

        Returns:
            [1, H, W], as of `batch`.

        Raises:
            ValueError: another shape, or numbers outside [0, 1].
        """
        return self.batch(one_image(image))[0]

    @torch.inference_mode()
    def batch(self, images: ArrayLike) -> NDArray[Number]:
        """The planes of several images of one size, at once.

        Args:
            images: [B, 3, H, W] RGB in [0, 1].

        Returns:
            [B, 1, H, W]; up to rounding what each image gives by itself. Depth is in m, NEAREST or more; classes
            are train ids, 0 to 18: a network knows no void.

        Raises:
            ValueError: another shape, numbers outside [0, 1], or a checkpoint that answers with NaN.
        """
        values = torch.from_numpy(image_array(images))
        seen = self.preparation(values.to(self.device))
        planes: NDArray[Number] = self._estimate(seen, *values.shape[-2:]).cpu().numpy()
        return planes

    def _estimate(self, seen: torch.Tensor, height: int, width: int) -> torch.Tensor:
        """[B, 1, height, width] of what the network sees, [B, 3, h, w]."""
        raise NotImplementedError


def check_finite(values: torch.Tensor, what: str) -> None:
    """Refuse a network's answer that has NaN or infinity.

    Raises:
        ValueError: it has.
    """
    if not torch.isfinite(values).all():
        raise ValueError(f"the checkpoint must give finite {what}, got NaN or infinity: its weights are damaged")

"""From a forecast frame back to layers, so that it can be an input of the next step."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from vestcl.models._frames import FOREGROUND_BELOW
from vestcl.models._render import Camera, RenderedView
from vestcl.scene import layers
from vestcl.scene.layers import SKY_DEPTH, LayerBatch

#: image [B, 3, H, W], depth [B, 1, H, W] m with 0 = unknown, mask [B, 1, H, W] of 0 and 1 -> their layers.
Perceive = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], LayerBatch]

#: From here on a forecast depth, metres, is the sky's: a turn of the camera changes its z-depth by some percent.
_SKY_FROM: Final = SKY_DEPTH / 2


def perceive_forecast(image: torch.Tensor, depth: torch.Tensor, mask: torch.Tensor) -> LayerBatch:
    """The layers of forecast frames: unknown depths from the nearest pixel that has one, then inpainting.

    Args:
        image: [B, 3, H, W] in [0, 1].
        depth: [B, 1, H, W] m; 0 = unknown.
        mask: [B, 1, H, W], 1 on the static background.

    Returns:
        Their layers; no gradient.

    Raises:
        ValueError: a frame without any known depth.
    """
    frames = zip(*(tensor.detach().float().cpu().numpy() for tensor in (image, depth, mask)), strict=True)
    return layers.batch([_layers(*frame) for frame in frames])


def perceive_view(view: RenderedView, perceive: Perceive) -> LayerBatch:
    """``perceive`` on a view from the source camera, in the dtype of the view."""
    mask = (view.background >= FOREGROUND_BELOW).to(view.depth)
    seen = perceive(view.image.detach().clamp(0, 1), view.depth.detach(), mask)
    return LayerBatch(*(tensor.detach().to(view.depth) for tensor in seen))


def known_view(cameras: Sequence[Camera], views: Sequence[RenderedView], wanted: Camera) -> RenderedView | None:
    """The view, where there is one, of the camera ``wanted``."""
    for camera, view in zip(cameras, views, strict=True):
        if all(torch.equal(one, other) for one, other in zip(camera, wanted, strict=True)):
            return view
    return None


def _layers(image: NDArray[Any], depth: NDArray[Any], mask: NDArray[Any]) -> layers.Layers:
    known = depth[0] > 0
    if not known.any():
        raise ValueError("`depth` must be known (above 0 m) somewhere: no point of the forecast is in the picture")
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    at = np.zeros(nearest.max() + 1, np.intp)
    at[nearest[known]] = known.ravel().nonzero()[0]
    filled = depth.ravel()[at[nearest]][None]
    sky = filled >= _SKY_FROM
    return layers.build_layers(image, filled, mask >= FOREGROUND_BELOW, sky=sky)

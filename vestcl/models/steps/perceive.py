"""From a forecast frame back to layers, so that it can be an input of the next step."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from vestcl.constants import SKY_DEPTH
from vestcl.io.labels import SKY, background
from vestcl.models.steps.frames import FOREGROUND_BELOW
from vestcl.models.steps.render import Camera, RenderedView
from vestcl.scene import layers
from vestcl.scene.estimators.sources import CheckedClasses, CheckedDepth
from vestcl.scene.inpainting.inpainters import Inpainter
from vestcl.scene.layers import LayerBatch

#: image [B, 3, H, W], depth [B, 1, H, W] m with 0 = unknown, mask [B, 1, H, W] of 0 and 1 -> their layers.
Perceive = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], LayerBatch]

#: A pixel shows two surfaces if its depth is farther than that factor from both the nearest and the farthest around it.
_MIXED: Final = 1.03

#: From here on a forecast depth, metres, is the sky's: a turn of the camera changes its z-depth by some percent.
_SKY_FROM: Final = SKY_DEPTH / 2


def perceive_forecast(
    image: torch.Tensor, depth: torch.Tensor, mask: torch.Tensor, inpaint: Inpainter | None = None
) -> LayerBatch:
    """The layers of forecast frames: depths between two surfaces go to one of them, unknown ones come from the nearest
    pixel that has one, then inpainting.

    Args:
        image: [B, 3, H, W] in [0, 1].
        depth: [B, 1, H, W] m; 0 = unknown.
        mask: [B, 1, H, W], 1 on the static background.
        inpaint: how the background is filled, see `vestcl.scene.layers.build_layers`.

    Returns:
        Their layers; no gradient.

    Raises:
        ValueError: a frame without any known depth.
    """
    return _of_frames(functools.partial(_layers, inpaint), image, depth, mask)


def perceive_estimated(
    depth: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None = None,
    segmentation: Callable[[NDArray[np.float32]], NDArray[np.uint8]] | None = None,
    inpaint: Inpainter | None = None,
) -> Perceive:
    """Layers of forecast frames by the estimators that see recorded frames: of depth, of classes, or of both.

    Args:
        depth: [3, H, W] RGB in [0, 1] -> [1, H, W] m, 0 = unknown: a `vestcl.scene.estimators.DepthEstimator` or any
            function; None keeps the splatted depth.
        segmentation: [3, H, W] -> [1, H, W] uint8 train ids: a `SegmentationEstimator` or any function; None keeps the
            splatted mask, and takes what is splatted from far away for sky.
        inpaint: how the background is filled, see `vestcl.scene.layers.build_layers`.

    Returns:
        What `vestcl.models.forecaster.Forecaster.forecast` takes for ``perceive``; it raises a ValueError where an
        estimator answers with another shape or with depths or classes that can't be.
    """
    depth_of = None if depth is None else CheckedDepth(depth)
    classes_of = None if segmentation is None else CheckedClasses(segmentation)

    def layers_of(image: NDArray[Any], splatted: NDArray[Any], mask: NDArray[Any]) -> layers.Layers:
        image = np.ascontiguousarray(image)
        metres = _filled(splatted)
        far = metres >= _SKY_FROM
        sky = far
        if classes_of is not None:
            ids = classes_of(image)
            mask, sky = background(ids), (ids == SKY) | (far & (depth_of is None))
        if depth_of is not None:
            metres = depth_of(image)
        return layers.build_layers(image, metres, mask >= FOREGROUND_BELOW, sky=sky, inpaint=inpaint)

    return functools.partial(_of_frames, layers_of)


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


def _of_frames(
    layers_of: Callable[[NDArray[Any], NDArray[Any], NDArray[Any]], layers.Layers],
    image: torch.Tensor,
    depth: torch.Tensor,
    mask: torch.Tensor,
) -> LayerBatch:
    frames = zip(*(tensor.detach().float().cpu().numpy() for tensor in (image, depth, mask)), strict=True)
    return layers.batch([layers_of(*frame) for frame in frames])


def _layers(inpaint: Inpainter | None, image: NDArray[Any], depth: NDArray[Any], mask: NDArray[Any]) -> layers.Layers:
    filled = _filled(depth)
    return layers.build_layers(image, filled, mask >= FOREGROUND_BELOW, sky=filled >= _SKY_FROM, inpaint=inpaint)


def _filled(depth: NDArray[Any]) -> NDArray[Any]:
    """[1, H, W] m of `_unmixed`, unknown depths from the nearest pixel that has one."""
    depth = _unmixed(depth)
    known = depth[0] > 0
    if not known.any():
        raise ValueError("`depth` must be known (above 0 m) somewhere: no point of the forecast is in the image")
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    at = np.zeros(nearest.max() + 1, np.intp)
    at[nearest[known]] = known.ravel().nonzero()[0]
    return np.asarray(depth.ravel()[at[nearest]][None])


def _unmixed(depth: NDArray[Any]) -> NDArray[Any]:
    """[1, H, W] m where pixels that show two surfaces, at edges, have the depth of the one that is nearer in ratio.

    Their splatted depth is a mean, at which nothing is: points there would leave both surfaces, farther in every step.
    """
    known, brush = depth[0] > 0, np.ones((3, 3), np.uint8)
    near = cv2.erode(np.where(known, depth[0], depth[0].max()), brush)
    far = cv2.dilate(depth[0], brush)
    mixed = known & (depth[0] > _MIXED * near) & (_MIXED * depth[0] < far)
    return np.where(mixed, np.where(depth[0] ** 2 < near * far, near, far), depth[0])[None]

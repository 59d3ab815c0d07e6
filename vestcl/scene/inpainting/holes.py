"""Disoccluded regions: holes of a view, filled smoothly from what surrounds them, and at the sides with structure."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.scene.inpainting.sides import carry_on

#: Surroundings count by 1 / (1/z + that)^2, 1/m: what was hidden is more likely to continue behind a hole than what hid
#: it.
_FAR: Final = 0.01

#: OpenCV resizes up to this many channels at once.
_CV_CHANNELS: Final = 4

#: Holes up to that share of the image's width across are cracks.
_CRACK: Final = 0.006


def fill_holes(
    image: NDArray[np.float32],
    inverse_depth: NDArray[np.float32],
    hole: NDArray[np.bool_],
    vanishing_uv: NDArray[np.float64] | None = None,
) -> NDArray[np.float32]:
    """Push and pull: a hole takes the weighted mean of the next coarser level, which is filled likewise.

    Holes inside are filled from the far side first, those that reach the border from all sides equally;
    there what is seen continues along the lines through the vanishing point, if that is known (`carry_on`).

    Args:
        image: [C, H, W]; what is in the holes does not matter.
        inverse_depth: [1, H, W], 1/m.
        hole: [1, H, W], True = to be filled.
        vanishing_uv: [2] px, where lines along the road meet; None = unknown.

    Returns:
        [C, H, W]; ``image`` outside the holes. All 0 if everything is a hole.

    Source: Gortler et al., The Lumigraph, 1996 (push and pull); the preference for what is far is ours.
    """
    if not hole.any():
        return image
    far = (inverse_depth + np.float32(_FAR)) ** -2 * np.float32(_FAR**2)
    planes = np.ascontiguousarray(np.where(hole, np.float32(0), image).transpose(1, 2, 0))
    at_border, filled = _at_border(hole[0]), planes
    for which, weight in ((hole[0] & ~at_border, far[0]), (at_border, np.ones_like(far[0]))):
        if which.any():
            pulled, _ = _pull(planes, np.where(hole[0], np.float32(0), weight).astype(np.float32))
            filled = np.where(which[..., None], pulled, filled)
    filled = filled.transpose(2, 0, 1)
    if vanishing_uv is not None:
        filled = carry_on(np.where(hole, filled, image), hole[0], at_border, vanishing_uv)
    return np.where(hole, filled, image)


def push_pull(image: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """``image`` [C, H, W] with what is not ``known`` [H, W] filled from all sides; all 0 if nothing is known."""
    planes = np.ascontiguousarray(np.where(known, image, np.float32(0)).transpose(1, 2, 0))
    return np.where(known, image, _pull(planes, known.astype(np.float32))[0].transpose(2, 0, 1))


def deep_holes(hole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What remains of ``hole`` [1, H, W] without cracks, and without holes that reach the image's border."""
    side = 2 * round(_CRACK * hole.shape[2] / 2) + 1
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    wide = cv2.morphologyEx(hole[0].astype(np.uint8), cv2.MORPH_OPEN, brush).astype(bool)
    return (wide & ~_at_border(hole[0]))[None]


def _at_border(hole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The holes [H, W] that reach the image's border: they were out of sight, not hidden."""
    count, labels = cv2.connectedComponents(hole.astype(np.uint8))
    at_border = np.zeros(count, bool)
    for side in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        at_border[side] = True
    at_border[0] = False
    return np.asarray(at_border[labels])


def _pull(image: NDArray[np.float32], weight: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """[H, W, C] with every pixel of weight 0 filled, and the weights [H, W] with theirs."""
    height, width = weight.shape
    given = weight[..., None] > 0
    if min(height, width) < 2 or (weight > 0).all():
        mean = (image * weight[..., None]).sum((0, 1)) / max(float(weight.sum()), 1e-20)
        return np.where(given, image, mean.astype(np.float32)), np.where(weight > 0, weight, weight.mean())
    size = (-(-width // 2), -(-height // 2))
    share = np.asarray(cv2.resize(weight, size, interpolation=cv2.INTER_AREA), np.float32)
    total = _resized(image * weight[..., None], size, cv2.INTER_AREA)
    mean = np.divide(total, share[..., None], out=np.zeros_like(total), where=share[..., None] > 0)
    coarse, heavy = _pull(mean, share)
    spread = cv2.resize(heavy, (width, height), interpolation=cv2.INTER_LINEAR)
    drawn = _resized(coarse * heavy[..., None], (width, height), cv2.INTER_LINEAR)
    filled = drawn / np.maximum(spread, np.float32(1e-20))[..., None]
    return np.where(given, image, filled), np.where(weight > 0, weight, spread)


def _resized(planes: NDArray[np.float32], size: tuple[int, int], interpolation: int) -> NDArray[np.float32]:
    """[H, W, C] at ``size`` (width, height), of any number of channels."""
    if 1 < planes.shape[2] <= _CV_CHANNELS:
        return np.asarray(cv2.resize(planes, size, interpolation=interpolation), np.float32)
    return np.stack([cv2.resize(plane, size, interpolation=interpolation) for plane in np.moveaxis(planes, -1, 0)], -1)

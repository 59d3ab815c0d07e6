"""A frame's two layers: what it shows, and the static background behind its foreground (SPEC section 3)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from vestcl.constants import SKY_DEPTH
from vestcl.scene import checked
from vestcl.scene.depth.completion import complete_depth
from vestcl.scene.inpainting.inpaint import inpaint_background
from vestcl.scene.inpainting.inpainters import Inpainter


@dataclass(frozen=True, eq=False)
class Layers:
    """One frame, complete: no depth is missing. Everything is at one size."""

    image: NDArray[np.float32]
    """[3, H, W] RGB in [0, 1]."""
    depth: NDArray[np.float32]
    """[1, H, W] m, above 0 everywhere, SKY_DEPTH in the sky."""
    mask: NDArray[np.bool_]
    """M [1, H, W], True = static background."""
    background_image: NDArray[np.float32]
    """[3, H, W]; equals ``image`` away from the foreground."""
    background_depth: NDArray[np.float32]
    """[1, H, W] m; equals ``depth`` away from the foreground, and is nowhere nearer."""


class LayerBatch(NamedTuple):
    """`Layers` of B frames of one size as float32 tensors: what the networks take."""

    image: torch.Tensor
    """[B, 3, H, W] RGB in [0, 1]."""
    depth: torch.Tensor
    """[B, 1, H, W] m."""
    mask: torch.Tensor
    """[B, 1, H, W], 1 = static background, 0 = foreground."""
    background_image: torch.Tensor
    """[B, 3, H, W]."""
    background_depth: torch.Tensor
    """[B, 1, H, W] m."""


def build_layers(
    image: ArrayLike,
    depth: ArrayLike,
    mask: ArrayLike,
    *,
    sky: ArrayLike | None = None,
    inpaint: str | Inpainter | None = None,
) -> Layers:
    """A frame's layers: invalid depth completed, the sky put far away, the background filled in where M = 0.

    Args:
        image: [3, H, W] RGB in [0, 1].
        depth: [1, H, W] m; 0 = invalid, and at least one pixel outside the sky valid.
        mask: M [1, H, W] bool, True = static background; all True skips inpainting.
        sky: [1, H, W] bool, True = sky; None takes depths of SKY_DEPTH and more for it.
        inpaint: how to fill, as `inpaint_background` takes it; None is its default.

    Returns:
        The layers.

    Raises:
        ValueError: shapes, dtypes, numbers that aren't finite, a negative depth, no valid depth.

    Source: SPEC section 3.
    """
    image = checked.planes("image", image, 3)
    mask = checked.mask("mask", mask, image)
    complete = without_gaps(image, depth, sky)
    background_image, background_depth = inpaint_background(image, complete, mask, method=inpaint)
    return Layers(image, complete, mask, background_image, background_depth)


def without_gaps(image: ArrayLike, depth: ArrayLike, sky: ArrayLike | None = None) -> NDArray[np.float32]:
    """The depth of `build_layers`, without the background: [1, H, W] m, above 0, SKY_DEPTH in the sky.

    Args and raises as there.
    """
    image = checked.planes("image", image, 3)
    depth = checked.depth("depth", depth, image)
    far = depth >= SKY_DEPTH if sky is None else checked.mask("sky", sky, image)
    known = np.where(far, np.float32(0), depth)
    if not (known > 0).any() and not far.all():
        raise ValueError("`depth` must have a valid pixel outside the sky, got none")
    complete = known if far.all() else complete_depth(known, image)
    return np.where(far, np.float32(SKY_DEPTH), complete.clip(max=SKY_DEPTH))


def batch(frames: Sequence[Layers]) -> LayerBatch:
    """The frames side by side: x[b] = frames[b].x, the mask as 0 and 1.

    Args:
        frames: one or more, of one size.

    Returns:
        Tensors with their own memory, on the CPU.

    Raises:
        ValueError: no frame, or frames of several sizes.

    Source: SPEC section 1 (shapes).
    """
    if not frames:
        raise ValueError("`frames` must be one or more, got none")
    sizes = sorted({frame.image.shape[1:] for frame in frames})
    if len(sizes) > 1:
        raise ValueError(f"`frames` must be of one size, got {' and '.join(f'{h}x{w}' for h, w in sizes)}")
    return LayerBatch(*(_stack([getattr(frame, name) for frame in frames]) for name in LayerBatch._fields))


def _stack(arrays: list[NDArray[np.float32]] | list[NDArray[np.bool_]]) -> torch.Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float32, copy=False))

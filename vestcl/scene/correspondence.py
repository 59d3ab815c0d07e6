"""Where every pixel of a frame is in another one: dense optical flow, and how far it can be trusted."""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from vestcl import baselines
from vestcl.scene import _check


class Correspondence(NamedTuple):
    """Flow from a frame to another."""

    flow_uv: NDArray[np.float32]
    """[2, H, W] px: src(p) = dst(p + flow(p))."""
    error: NDArray[np.float32]
    """[1, H, W] px: how far the flow back, taken where the flow leads, misses p; infinite outside the picture."""


def correspond(src: ArrayLike, dst: ArrayLike) -> Correspondence:
    """Flow f from ``src`` to ``dst`` and its forward-backward error |f(p) + b(p + f(p))|, b the flow back.

    Args:
        src: [3, H, W] RGB in [0, 1].
        dst: [3, H, W] alike.

    Raises:
        ValueError: shapes, numbers that aren't finite, or pictures too small for dense inverse search.

    Source: SPEC section 8; Kroeger et al., Fast Optical Flow using Dense Inverse Search, 2016.
    """
    src = _check.planes("src", src, 3)
    dst = _check.planes("dst", dst, 3, src)
    pair = [torch.from_numpy(picture)[None] for picture in (src, dst)]
    there = baselines.optical_flow(pair[0], pair[1])[0].numpy()
    back = baselines.optical_flow(pair[1], pair[0])[0].numpy()
    y, x = np.mgrid[: src.shape[1], : src.shape[2]].astype(np.float32)
    returned = sample(back, x + there[0], y + there[1], outside=np.inf)
    return Correspondence(there, np.hypot(*(there + returned))[None])


def sample(planes: NDArray[np.float32], x: ArrayLike, y: ArrayLike, outside: float = 0.0) -> NDArray[np.float32]:
    """Bilinear values of ``planes`` [C, H, W] at columns x and rows y [h, w] counted from the first pixel's centre.

    Args:
        planes: [C, H, W].
        x: [h, w] px, 0 = centre of the first column.
        y: [h, w] px.
        outside: what a position beyond the outermost centres gets.

    Returns:
        [C, h, w].
    """
    height, width = planes.shape[1:]
    x, y = np.asarray(x, np.float32), np.asarray(y, np.float32)
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    values = [cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in planes]
    return np.where(inside, np.stack(values), np.float32(outside))

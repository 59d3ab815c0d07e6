"""Where every pixel of a frame is in another one: dense optical flow, and how far it can be trusted."""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.scene import checked
from vestcl.scene.exposure import matched_for_flow
from vestcl.scene.flow.optical_flow import FLOW_SIDE, flow_of_grey

#: Error of flow where the image's gradient is 1 a pixel, in pixels: bare asphalt (0.0025 per pixel on a motorway) and
#: sky (0.002) get more than a pixel, grass and rough asphalt (0.02 on KITTI) 0.2.
_NOISE: Final = 0.003

#: Gradients are averaged over about the size of a patch of dense inverse search, px.
_PATCH: Final = 4.0


class Correspondence(NamedTuple):
    """Flow from a frame to another."""

    flow_uv: NDArray[np.float32]
    """[2, H, W] px: src(p) = dst(p + flow(p))."""
    error: NDArray[np.float32]
    """[1, H, W] px: how far off the flow may be; infinite where it leads out of the image."""


def correspond(src: ArrayLike, dst: ArrayLike) -> Correspondence:
    """Flow f from ``src`` to ``dst``, and its error, the root of |f(p) + b(p + f(p))|^2 + (NOISE / least |grad src|)^2.

    b is the flow back: there and back again should end at p. Where the image has no texture, or the same along a
    line, flow may do so and still be wrong, hence the second part. Where the exposure changes by 5 % or more, ``dst``
    is given the histograms of ``src`` first.

    Args:
        src: [3, H, W] RGB in [0, 1].
        dst: [3, H, W] likewise.

    Raises:
        ValueError: shapes, numbers that aren't finite, or images too small for dense inverse search.

    Source: SPEC section 8; Kroeger et al., Fast Optical Flow using Dense Inverse Search, 2016.
    """
    src = checked.planes("src", src, 3)
    dst = checked.planes("dst", dst, 3, src)
    height, width = src.shape[1:]
    if min(height, width) < FLOW_SIDE:
        raise ValueError(f"H and W must be {FLOW_SIDE} or more for optical flow, got {height} x {width}")
    grey_src, grey_dst = _grey(src), _grey(dst)
    there = _flow(grey_src, grey_dst)
    matched = matched_for_flow(dst, src, there)
    if matched is not dst:
        grey_dst = _grey(matched)
        there = _flow(grey_src, grey_dst)
    back = _flow(grey_dst, grey_src)
    x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    returned = sample(back, x + there[0], y + there[1], outside=np.inf)
    missed = (there + returned).astype(np.float64)
    error = np.sqrt((missed**2).sum(0) + np.square(_NOISE / np.maximum(_texture(src), 1e-6)))
    return Correspondence(there, error[None].astype(np.float32))


def _grey(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """8-bit grey [H, W]."""
    return np.asarray(cv2.cvtColor(checked.pixels(image), cv2.COLOR_RGB2GRAY), np.uint8)


def _flow(src: NDArray[np.uint8], dst: NDArray[np.uint8]) -> NDArray[np.float32]:
    """[2, H, W] px."""
    flow = flow_of_grey(src, dst)
    return np.stack([flow[..., 0], flow[..., 1]]).astype(np.float32, copy=False)


def _texture(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Root mean square of the grey gradient around each pixel, in the direction where that is least, 1/px, [H, W]."""
    grey = cv2.cvtColor(image.transpose(1, 2, 0), cv2.COLOR_RGB2GRAY)
    right, down = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8)
    xx, yy, xy = (cv2.GaussianBlur(product, (0, 0), _PATCH) for product in (right**2, down**2, right * down))
    least = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)  # the smaller eigenvalue of the structure tensor
    return np.sqrt(np.maximum(least, 0))


def check_size(name: str, correspondence: Correspondence, like: NDArray[np.float32]) -> None:
    """Refuse a correspondence of another size than ``like`` [C, H, W].

    Raises:
        ValueError: the message calls it ``name``.
    """
    size = like.shape[1:]
    for part, channels, planes in (("flow", 2, correspondence.flow_uv), ("error", 1, correspondence.error)):
        if planes.shape != (channels, *size):
            wanted = f"[{channels}, {size[0]}, {size[1]}]"
            raise ValueError(f"`{name}` must have {part} {wanted}, got {list(planes.shape)}")


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

"""Dense optical flow by OpenCV's DIS, warps along it, and its inverse."""

from typing import Any, Final

import cv2
import numpy as np
import torch
from torch.nn import functional

from vestcl.shapes import check

#: The finest scale of DIS flow: 0 is the full image. OpenCV's own choice, half the image, loses 0.1 to 0.3 dB at t+1.
_FINEST_SCALE: Final = 0

#: DIS flow works on patches of 8 pixels in images of at least 12.
FLOW_SIDE: Final = 12


def optical_flow(src: torch.Tensor, dst: torch.Tensor) -> torch.Tensor:
    """f with src(p) = dst(p + f(p)): dense inverse search on 8-bit grey images.

    Args:
        src: [B, 3, H, W] in [0, 1], RGB; H and W are FLOW_SIDE or more.
        dst: [B, 3, H, W] in [0, 1], RGB.

    Returns:
        flow_uv [B, 2, H, W] px, of src's dtype; no gradient.

    Raises:
        ValueError: shapes don't fit, or an image below FLOW_SIDE.
    """
    sizes = check(src=(src, "B 3 H W"), dst=(dst, "B 3 H W"))
    if min(sizes["H"], sizes["W"]) < FLOW_SIDE:
        raise ValueError(f"H and W must be {FLOW_SIDE} or more for optical flow, got {sizes['H']} x {sizes['W']}")
    flows = [flow_of_grey(*pair) for pair in zip(_grey(src), _grey(dst), strict=True)]
    return torch.from_numpy(np.stack(flows)).permute(0, 3, 1, 2).to(src)


def flow_of_grey(src: np.ndarray, dst: np.ndarray) -> np.ndarray:
    """As `optical_flow`: [H, W, 2] px between 8-bit grey images [H, W], contiguous; H and W are FLOW_SIDE or more."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(_FINEST_SCALE)
    no_guess: Any = None  # OpenCV's stubs know none; zeros would be a guess to start from, and a bad one
    return np.asarray(search.calc(src, dst, no_guess))


def backward_warp(image: torch.Tensor, flow_uv: torch.Tensor) -> torch.Tensor:
    """J(p) = I(p + flow(p)), bilinear; outside the image its border is repeated.

    Args:
        image: [B, C, H, W].
        flow_uv: [B, 2, H, W] px, x then y.

    Returns:
        [B, C, H, W]; differentiable in both.

    Raises:
        ValueError: shapes don't fit.
    """
    sizes = check(image=(image, "B C H W"), flow_uv=(flow_uv, "B 2 H W"))
    height, width = sizes["H"], sizes["W"]
    points_uv = _pixel_centres(flow_uv) + flow_uv
    grid = 2 * points_uv.permute(0, 2, 3, 1) / points_uv.new_tensor([width, height]) - 1
    return functional.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)


def invert_flow(flow_uv: torch.Tensor) -> torch.Tensor:
    """b with b(q) = -f(p) at q = p + f(p): where what is now at q came from.

    Each p claims the four pixel centres around q (one, if q is on it); the fastest claim wins. A pixel that nobody
    claims is a hole: its motion is interpolated from around it, as if a sheet were stretched across.

    Args:
        flow_uv: [B, 2, H, W] px, on the grid of the frame that the motion starts from.

    Returns:
        [B, 2, H, W] px, on the grid of the frame that it leads to; 0 where everything has left. No gradient.

    Raises:
        ValueError: shapes don't fit.
    """
    check(flow_uv=(flow_uv, "B 2 H W"))
    splatted = [_splat_negative(flow) for flow in flow_uv.detach().cpu().numpy()]
    flows, known = (torch.from_numpy(np.stack(arrays)) for arrays in zip(*splatted, strict=True))
    return _fill_holes(flows, known[:, None]).to(flow_uv)


def _grey(image: torch.Tensor) -> list[np.ndarray]:
    """8-bit grey images [H, W], contiguous."""
    pixels = (image.detach().clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()
    return [cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY) for rgb in pixels]


def _pixel_centres(like: torch.Tensor) -> torch.Tensor:
    """[2, H, W] px, x then y."""
    y, x = (torch.arange(size, dtype=like.dtype, device=like.device) + 0.5 for size in like.shape[-2:])
    return torch.stack(torch.meshgrid(x, y, indexing="xy"))


def _splat_negative(flow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-flow [2, H, W] where it leads to, and where that is, bool [H, W]."""
    _, height, width = flow.shape
    y, x = np.mgrid[:height, :width]
    (left, top), (right, bottom) = np.floor([x + flow[0], y + flow[1]]), np.ceil([x + flow[0], y + flow[1]])
    columns, rows = np.stack([left, right, left, right]).ravel(), np.stack([top, top, bottom, bottom]).ravel()
    lands = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    sources = np.tile(np.arange(height * width), 4)[lands]
    targets = (rows[lands] * width + columns[lands]).astype(np.int64)
    slow_to_fast = np.argsort(np.hypot(*flow).ravel()[sources], kind="stable")
    owners = np.full(height * width, -1)
    owners[targets[slow_to_fast]] = sources[slow_to_fast]  # of several claims on a pixel the last one stays
    return -flow.reshape(2, -1)[:, owners].reshape(flow.shape), owners.reshape(height, width) >= 0


def _fill_holes(flow_uv: torch.Tensor, is_known: torch.Tensor) -> torch.Tensor:
    """Push and pull: where nothing is known [B, 1, H, W], what the mean of 2 x 2 pixels knows, filled likewise."""
    if is_known.all():
        return flow_uv
    known = is_known.to(flow_uv)
    if known.shape[-2:] == (1, 1):
        return flow_uv.where(is_known, 0)
    share = functional.avg_pool2d(known, 2, ceil_mode=True)
    mean = functional.avg_pool2d(flow_uv.where(is_known, 0), 2, ceil_mode=True) / share.where(share > 0, 1)
    coarse = _fill_holes(mean, share > 0)
    return flow_uv.where(is_known, functional.interpolate(coarse, flow_uv.shape[-2:], mode="bilinear"))

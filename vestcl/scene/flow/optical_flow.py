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


def _grey(image: torch.Tensor) -> list[np.ndarray]:
    """8-bit grey images [H, W], contiguous."""
    pixels = (image.detach().clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()
    return [cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY) for rgb in pixels]


def _pixel_centres(like: torch.Tensor) -> torch.Tensor:
    """[2, H, W] px, x then y."""
    y, x = (torch.arange(size, dtype=like.dtype, device=like.device) + 0.5 for size in like.shape[-2:])
    return torch.stack(torch.meshgrid(x, y, indexing="xy"))

"""Pixels with depth to 3D points, in plain torch."""

import torch


def unproject(depth: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """p = z K^-1 (u, v, 1) at pixel centres (u, v) = (column + 0.5, row + 0.5).

    Args:
        depth: [B, 1, H, W] m, z-depth.
        K: [B, 3, 3] px, invertible; its last row is (0, 0, 1).

    Returns:
        points_xyz [B, H W, 3] m in the camera's frame, row after row; differentiable in ``depth``.

    Source: SPEC section 2.
    """
    batch, _, height, width = depth.shape
    v, u = torch.meshgrid(
        torch.arange(height, dtype=depth.dtype, device=depth.device) + 0.5,
        torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(1, height * width, 3)
    rays = pixels @ torch.linalg.inv(K).mT
    return depth.reshape(batch, height * width, 1) * rays

"""How far a rigid motion of the camera moves each point, in plain torch."""

import torch

from vestcl import geometry


def rigid_flow(points_xyz: torch.Tensor, quaternion: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """u = R x + t - x with R = R(q / max(|q|, 1e-8)).

    A point that is not finite gets a displacement that is not finite, and takes no part in any gradient.

    Args:
        points_xyz: [B, N, 3] m in the source frame.
        quaternion: [B, 4], (w, x, y, z), rotation of ``dst_from_src``; of any length.
        translation: [B, 3] m, translation of ``dst_from_src``.

    Returns:
        displacement_xyz [B, N, 3] m; differentiable in all three.

    Source: SPEC section 2; the rigid flow of the paper's section on ego-motion forecasting.
    """
    dst_from_src = geometry.compose_rigid(quaternion, translation)
    finite = points_xyz.isfinite().all(dim=-1, keepdim=True)
    safe = torch.where(finite, points_xyz, 0)
    displacement_xyz = geometry.transform_points(dst_from_src, safe) - safe
    return torch.where(finite, displacement_xyz, torch.nan)

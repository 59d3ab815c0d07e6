"""Forward 3D displacement and projection into a camera, in plain torch."""

import torch

from vestcl import geometry


def displace(
    points_xyz: torch.Tensor,
    displacement_xyz: torch.Tensor,
    K: torch.Tensor,
    tgt_from_src: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """(a, b, c) = K q,   uv = (a / c, b / c),   z = q_z   with q = tgt_from_src (x + u).

    Nothing is clipped: a point behind the camera is projected through it. Where uv is not finite (c = 0, or a NaN
    came in), uv has no gradient.

    Args:
        points_xyz: [B, N, 3] m in the source frame.
        displacement_xyz: [B, N, 3] m in the source frame.
        K: [B, 3, 3] px, of the target camera.
        tgt_from_src: [B, 4, 4]; None is the identity.

    Returns:
        points_uv [B, N, 2] px and z [B, N] m in the target camera; both differentiable in ``points_xyz`` and
        ``displacement_xyz``.

    Source: SPEC section 2; the forward 3D displacement of the paper.
    """
    moved_xyz = points_xyz + displacement_xyz
    if tgt_from_src is not None:
        moved_xyz = geometry.transform_points(tgt_from_src, moved_xyz)
    a, b, c = (moved_xyz @ K.mT).unbind(-1)
    with torch.no_grad():
        raw_uv = torch.stack([a / c, b / c], dim=-1)
        finite = raw_uv.isfinite().all(dim=-1)
    safe_uv = torch.stack([a, b], dim=-1) / torch.where(finite, c, 1)[..., None]
    return torch.where(finite[..., None], safe_uv, raw_uv), moved_xyz[..., 2]

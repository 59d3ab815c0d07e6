"""What of a picture is still one surface in another view, and how far it is stretched there, in plain torch."""

import torch
from torch.nn import functional

from vestcl import constants


def stretch(points_uv: torch.Tensor, magnified: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """How much farther apart than magnified a picture's points come to lie, and which are torn from all neighbours.

        h = min(|uv - uv_left|, |uv - uv_right|),   v = min(|uv - uv_above|, |uv - uv_below|)
        each counts where it is below TORN max(m, 1), or where both of its gaps are below SLANTED m^2
        factor = max(1, max(h, v) / m),   opacity = 1 where h or v counts or the picture is one pixel, else 0

    Args:
        points_uv: [B, H, W, 2] px, where the view shows the picture's pixels; a gap to what is not finite does not
            count.
        magnified: m [B, H, W] px, the size that a pixel has in the view.

    Returns:
        factor and opacity [B, H, W]. They have no gradient.

    Source: `constants.TORN`, `constants.SLANTED`.
    """
    points_uv, magnified = points_uv.detach(), magnified.detach()
    slanted = constants.SLANTED * magnified.square()
    limit, spacing = constants.TORN * magnified.clamp(min=1), torch.zeros_like(magnified)
    together = torch.full_like(magnified, magnified.shape[1:] == (1, 1), dtype=torch.bool)
    for axis, (before, after) in ((1, ((0, 0, 1, 0), (0, 0, 0, 1))), (2, ((1, 0), (0, 1)))):
        gap = torch.linalg.vector_norm(points_uv.diff(dim=axis), dim=3).nan_to_num(nan=torch.inf, posinf=torch.inf)
        gaps = [functional.pad(gap, side, value=torch.inf) for side in (before, after)]
        nearer = torch.minimum(*gaps)
        near = (nearer < limit) | (torch.maximum(*gaps) < slanted)
        spacing, together = spacing.maximum(torch.where(near, nearer, 0)), together | near
    factor = (spacing / magnified.clamp(min=1e-6)).clamp(min=1)
    return factor, together.to(magnified)

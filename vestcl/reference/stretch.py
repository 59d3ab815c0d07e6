"""What of an image is still one surface in another view, and how far it is stretched there, in plain torch."""

import torch
from torch.nn import functional

from vestcl import constants


def stretch(points_uv: torch.Tensor, magnified: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """How much farther apart than magnified an image's points come to lie, and which are torn from all neighbours.

        h = min(|uv - uv_left|, |uv - uv_right|),   v = min(|uv - uv_above|, |uv - uv_below|)
        each counts where it is below TORN max(m, 1), or where both of its gaps are below SLANTED m^2
        factor = max(1, max(h, v) / m),   opacity = 1 where h or v counts or the image is one pixel, else 0

    Rows of a plane shear: where the steps to both sides differ by less than BENT of their means r, from left to right,
    and d, downwards, v is |r x d| / |r| as far as |r| counts and v is below the larger limit; h likewise.

    Args:
        points_uv: [B, H, W, 2] px, where the view shows the image's pixels; a gap to what is not finite does not
            count.
        magnified: m [B, H, W] px, the size that a pixel has in the view.

    Returns:
        factor and opacity [B, H, W]. They have no gradient.

    Source: `constants.TORN`, `SLANTED`, `BENT`.
    """
    points_uv, magnified = points_uv.detach(), magnified.detach()
    slanted = constants.SLANTED * magnified.square()
    limit, spacing = constants.TORN * magnified.clamp(min=1), torch.zeros_like(magnified)
    lines = _between_lines(points_uv, limit)
    together = torch.full_like(magnified, magnified.shape[1:] == (1, 1), dtype=torch.bool)
    for axis, (before, after) in ((1, ((0, 0, 1, 0), (0, 0, 0, 1))), (2, ((1, 0), (0, 1)))):
        gap = torch.linalg.vector_norm(points_uv.diff(dim=axis), dim=3).nan_to_num(nan=torch.inf, posinf=torch.inf)
        gaps = [functional.pad(gap, side, value=torch.inf) for side in (before, after)]
        nearer = torch.minimum(*gaps)
        near = (nearer < limit) | (torch.maximum(*gaps) < slanted)
        between = lines[axis - 1]
        counted = torch.where(between < limit.maximum(slanted), between, torch.where(near, nearer, 0))
        spacing, together = spacing.maximum(counted), together | near
    factor = (spacing / magnified.clamp(min=1e-6)).clamp(min=1)
    return factor, together.to(magnified)


def _between_lines(points_uv: torch.Tensor, limit: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances between rows, and between columns [B, H, W] of what is one plane; infinite elsewhere."""
    if min(points_uv.shape[1:3]) < 3:
        return (torch.full_like(limit, torch.inf),) * 2
    inner, steps, flat = points_uv[:, 1:-1, 1:-1], [], []
    for before, after in (
        (points_uv[:, 1:-1, :-2], points_uv[:, 1:-1, 2:]),
        (points_uv[:, :-2, 1:-1], points_uv[:, 2:, 1:-1]),
    ):
        steps.append((after - before) / 2)
        bend = after + before - 2 * inner
        flat.append(bend.square().sum(3) < constants.BENT**2 * steps[-1].square().sum(3))
    right, down = (torch.linalg.vector_norm(step, dim=3) for step in steps)
    area = (steps[0][..., 0] * steps[1][..., 1] - steps[0][..., 1] * steps[1][..., 0]).abs()
    near = limit[:, 1:-1, 1:-1]
    rows, columns = (
        torch.where(flat[0] & flat[1] & (along < near), area / along, torch.inf) for along in (right, down)
    )
    border = (1, 1, 1, 1)
    return functional.pad(rows, border, value=torch.inf), functional.pad(columns, border, value=torch.inf)

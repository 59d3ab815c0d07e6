"""Where the points of `vestcl bench stability` come to lie, and radii that keep clear of pixel centres there."""

import math
from collections.abc import Mapping
from typing import Final

import torch

from vestcl import geometry, reference

#: Radii are chosen from this range about the one wanted.
_SLACK: Final = (0.85, 1.15)

#: Distances that are looked at together: some 100 MB.
_TOGETHER: Final = 1 << 23


def projected(inputs: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Where the points of a "view" come to lie, [N, 2] px: in float64, by matrices."""
    points = reference.unproject(inputs["depth"], inputs["source_K"])
    for motion in geometry.compose_rigid(inputs["quaternion"], inputs["translation"]):
        points = geometry.transform_points(motion, points)
    return reference.displace(points, torch.zeros_like(points), inputs["K"], inputs["tgt_from_src"])[0][0]


def clear_radii(points_uv: torch.Tensor, wanted: float, height: int, width: int) -> torch.Tensor:
    """Radii near the one ``wanted`` whose circles stay clear of pixel centres.

    Args:
        points_uv: [N, 2] px.
        wanted: px.
        height: of the image, px.
        width: of the image, px.

    Returns:
        [N] px: the middle of the widest gap between distances of centres, in [0.85, 1.15] of ``wanted``.
    """
    low, high = (factor * wanted for factor in _SLACK)
    reach = math.ceil(high) + 1
    if 2 * reach + 1 > min(height, width):
        rows, columns, base = torch.arange(height), torch.arange(width), torch.zeros_like(points_uv)
    else:
        rows = columns = torch.arange(-reach, reach + 1)
        base = points_uv.floor()
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    centres = torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5
    chunk = max(1, _TOGETHER // len(centres))
    radii = [
        _middles((start[:, None] + centres - uv[:, None]).norm(dim=-1), low, high)
        for uv, start in zip(points_uv.split(chunk), base.split(chunk), strict=True)
    ]
    return torch.cat(radii)


def _middles(distances: torch.Tensor, low: float, high: float) -> torch.Tensor:
    """[N, M] -> [N], the middle of the widest gap in [low, high]."""
    ends = distances.new_tensor([[low, high]]).expand(len(distances), 2)
    marks = torch.cat([distances.clamp(low, high), ends], dim=1).sort(dim=1).values
    widths, at = marks.diff(dim=1).max(dim=1)
    return marks.gather(1, at[:, None])[:, 0] + widths / 2

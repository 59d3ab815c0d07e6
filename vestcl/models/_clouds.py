"""Packed point clouds: both layers of a frame, lifted and moved to a later time.

Clouds of a batch differ in size, so they are packed: image b owns the points starts[b]:starts[b + 1].
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch

from vestcl import geometry
from vestcl.models._frames import FOREGROUND_BELOW, EncodedFrame
from vestcl.models.ego_motion import RigidMotion
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.unproject import unproject


class Cloud(NamedTuple):
    """Points of one input frame's layers, for all B images; gradients flow through all."""

    points_xyz: torch.Tensor
    """[P, 3] m, in a camera of their own."""
    displacement_xyz: torch.Tensor
    """[P, 3] m: x + u is in the camera of t+k."""
    step_xyz: torch.Tensor
    """[P, 3] m: what moved beside the camera over one frame interval, in the camera of t+k."""
    depth: torch.Tensor
    """[P] m, of the frame that they come from, and so the size of what a point stands for."""
    shown: torch.Tensor
    """[P, C + 3]: features and colour."""
    background: torch.Tensor
    """[P, 1]: 1 on the static background."""
    beside: torch.Tensor
    """int64 [P, 4]: which points are to the left, to the right, above and below in the frame that they come from; where
    there is none, and for inpainted points, the point itself."""
    starts: torch.Tensor
    """int64 [B + 1]."""

    @property
    def sizes(self) -> list[int]:
        return self.starts.diff().tolist()


def hidden_pixels(mask: torch.Tensor) -> list[torch.Tensor]:
    """Per image the indices of the pixels with M = 0: [B, 1, H, W] -> B times int64 [n_b]."""
    return [(image < FOREGROUND_BELOW).nonzero()[:, 0] for image in mask.flatten(1)]


def pack(pixels: torch.Tensor, inpainted: torch.Tensor, hidden: Sequence[torch.Tensor]) -> torch.Tensor:
    """Image after image all of ``pixels`` and then ``inpainted`` where hidden: two [B, N, D] -> [P, D]."""
    pieces = []
    for image, behind, where in zip(pixels, inpainted, hidden, strict=True):
        pieces += [image, behind.index_select(0, where)]
    return torch.cat(pieces)


def as_points(image: torch.Tensor) -> torch.Tensor:
    """[B, C, H, W] -> [B, H W, C], row after row."""
    return image.permute(0, 2, 3, 1).flatten(1, 2)


def as_image(points: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """[B, H W, C] -> [B, C, H, W], what `as_points` undoes."""
    return points.unflatten(1, (height, width)).permute(0, 3, 1, 2)


def lift(
    frame: EncodedFrame, to_next: RigidMotion, flow: torch.Tensor, flow0: torch.Tensor, intervals: int, K: torch.Tensor
) -> Cloud:
    """A frame's cloud: each pixel, and the inpainted background where there is foreground.

    Args:
        frame: B of them.
        to_next: the camera's motion, which inpainted points follow.
        flow: [B, 3, H, W] m, that pixels follow.
        flow0: the same without what objects do.
        intervals: of frames that both span.
        K: [B, 3, 3] px.

    Returns:
        The cloud with H W + |M = 0| points an image; differentiable in all but ``K``.
    """
    layers, hidden = frame.layers, hidden_pixels(frame.layers.mask)
    behind = unproject(layers.background_depth, K)
    still = torch.zeros_like(behind)
    shown = torch.cat([frame.features, layers.image], dim=1)
    shown_behind = torch.cat([frame.background_features, layers.background_image], dim=1)
    sizes = torch.tensor([0] + [behind.shape[1] + len(where) for where in hidden]).cumsum(0)
    return Cloud(
        points_xyz=pack(unproject(layers.depth, K), behind, hidden),
        displacement_xyz=pack(as_points(flow), rigid_flow(behind, *to_next), hidden),
        step_xyz=pack(as_points((flow - flow0) / intervals), still, hidden),
        depth=pack(as_points(layers.depth), as_points(layers.background_depth), hidden)[:, 0],
        shown=pack(as_points(shown), as_points(shown_behind), hidden),
        background=pack(as_points(layers.mask), still[..., :1] + 1, hidden),
        beside=_neighbours(sizes.tolist(), *layers.image.shape[2:]),
        starts=sizes,
    )


def _neighbours(starts: Sequence[int], height: int, width: int) -> torch.Tensor:
    """`Cloud.beside` of images whose H W pixels come first from ``starts`` on, the last of which is their end."""
    place = torch.arange(height * width).view(height, width)
    sides = [
        torch.cat([place[:, :1], place[:, :-1]], dim=1), torch.cat([place[:, 1:], place[:, -1:]], dim=1),
        torch.cat([place[:1], place[:-1]], dim=0), torch.cat([place[1:], place[-1:]], dim=0),
    ]  # fmt: skip
    of_pixels, alone = torch.stack(sides, dim=2).flatten(0, 1), torch.arange(starts[-1])[:, None].expand(-1, 4)
    pieces = []
    for start, end in itertools.pairwise(starts):
        pieces += [of_pixels + start, alone[start + height * width : end]]
    return torch.cat(pieces)


def join(first: Cloud, second: Cloud) -> Cloud:
    """One cloud an image of both, ``first`` before ``second``."""
    sizes = first.sizes, second.sizes

    def alternate(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        pairs = zip(one.split(sizes[0]), other.split(sizes[1]), strict=True)
        return torch.cat([piece for pair in pairs for piece in pair])

    packed = [alternate(one, other) for one, other in zip(first[:-2], second[:-2], strict=True)]
    shifts = (
        second.starts[:-1].repeat_interleave(first.starts.diff()),
        first.starts[1:].repeat_interleave(second.starts.diff()),
    )
    beside = alternate(*(cloud.beside + shift[:, None] for cloud, shift in zip((first, second), shifts, strict=True)))
    return Cloud._make([*packed, beside, first.starts + second.starts])


def advance(cloud: Cloud, next_from_cur: torch.Tensor) -> Cloud:
    """One frame interval on: x_(k+1) = G x_k + R s_k and s_(k+1) = R s_k, with G = (R, t) = ``next_from_cur``.

    The camera repeats its motion G [B, 4, 4], and what has moved beside it moves on at its velocity s in the world.
    What is fixed to the camera, x_1 = x, stays there while R = I. In a bend that is no constant velocity, and it drifts
    by (R - I) (x - G x) in the second step: the recording car's own bonnet at 1 m and 0.01 rad a frame by 1 cm.
    """
    points = cloud.points_xyz + cloud.displacement_xyz
    turned = _per_image(cloud.step_xyz, _rotation(next_from_cur), cloud.sizes)
    moved = _per_image(points, next_from_cur, cloud.sizes) + turned
    return cloud._replace(points_xyz=points, displacement_xyz=moved - points, step_xyz=turned)


def last_motion(cloud: Cloud, next_from_cur: torch.Tensor) -> torch.Tensor:
    """x_k - x_(k-1) with x_(k-1) = G^-1 (x_k - s_k): for the previous frame's points, too, which came two intervals."""
    points = cloud.points_xyz + cloud.displacement_xyz
    return points - _per_image(points - cloud.step_xyz, geometry.invert(next_from_cur), cloud.sizes)


def _per_image(points_xyz: torch.Tensor, dst_from_src: torch.Tensor, sizes: list[int]) -> torch.Tensor:
    """Each image's points [P, 3] through its own [B, 4, 4]."""
    pairs = zip(points_xyz.split(sizes), dst_from_src, strict=True)
    return torch.cat([geometry.transform_points(rigid, points) for points, rigid in pairs])


def _rotation(rigid: torch.Tensor) -> torch.Tensor:
    """[B, 4, 4] without its translation."""
    rotation = rigid.clone()
    rotation[:, :3, 3] = 0
    return rotation

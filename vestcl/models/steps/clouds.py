"""Packed point clouds: the layers of frames, lifted and moved to a later time.

Clouds of a batch differ in size, so they are packed: image b owns the points starts[b]:starts[b + 1].
"""

import bisect
from typing import NamedTuple

import torch
from torch.nn import functional

from vestcl import constants, geometry
from vestcl.models.networks.ego_motion import RigidMotion
from vestcl.models.steps.frames import FOREGROUND_BELOW, EncodedFrame
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.unproject import unproject


class PixelGrid(NamedTuple):
    """The points start ... start + height width - 1 are an image's pixels, row after row."""

    start: int
    height: int
    width: int


class Cloud(NamedTuple):
    """Points of input frames' layers, for all B images; gradients flow through all."""

    points_xyz: torch.Tensor
    """[P, 3] m, each in its own camera."""
    displacement_xyz: torch.Tensor
    """[P, 3] m: x + u is in the camera of t+k."""
    step_xyz: torch.Tensor
    """[P, 3] m: what moved relative to the world over one frame interval, in the camera of t+k."""
    depth: torch.Tensor
    """[P] m, of the frame that they come from, and so the size of what a point represents."""
    features: torch.Tensor
    """[P, C]."""
    colour: torch.Tensor
    """[P, 3]."""
    background: torch.Tensor
    """[P, 1]: 1 on the static background."""
    inpainted: torch.Tensor
    """bool [P]: what no frame has seen."""
    grids: tuple[PixelGrid, ...]
    """Which points are all the pixels of a frame. Others, as inpainted ones, have no neighbours."""
    starts: torch.Tensor
    """int64 [B + 1]."""

    @property
    def sizes(self) -> list[int]:
        return self.starts.diff().tolist()

    def picked(self, points: torch.Tensor, starts: torch.Tensor) -> "Cloud":
        """Only some points, by their rising indices [Q]; ``starts`` [B + 1] among those. They have no neighbours."""
        return Cloud._make([*(tensor.index_select(0, points) for tensor in self[:-2]), (), starts])


def as_points(image: torch.Tensor) -> torch.Tensor:
    """[B, C, H, W] -> [B, H W, C], row after row."""
    return image.permute(0, 2, 3, 1).flatten(1, 2)


def as_image(points: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """[B, H W, C] -> [B, C, H, W], what `as_points` undoes."""
    return points.unflatten(1, (height, width)).permute(0, 3, 1, 2)


def lift(
    frame: EncodedFrame, points_xyz: torch.Tensor, flow: torch.Tensor, flow0: torch.Tensor, span: torch.Tensor | float
) -> Cloud:
    """What a frame shows: each pixel.

    Args:
        frame: B of them.
        points_xyz: [B, H W, 3] m, of its pixels.
        flow: [B, 3, H, W] m, that pixels follow.
        flow0: the same without what objects do.
        span: intervals of the clip that both take; a tensor is [B, 1, 1, 1].

    Returns:
        The cloud with H W points an image; differentiable.
    """
    layers = frame.layers
    batch, _, height, width = layers.image.shape
    starts = torch.arange(batch + 1) * (height * width)

    def points(image: torch.Tensor) -> torch.Tensor:
        return as_points(image).flatten(0, 1)

    return Cloud(
        points_xyz.flatten(0, 1),
        points(flow),
        points((flow - flow0) / span),
        layers.depth.flatten(),
        points(frame.features),
        points(layers.image),
        layers.mask.reshape(-1, 1),
        torch.zeros(batch * height * width, dtype=torch.bool),
        tuple(PixelGrid(start, height, width) for start in starts[:-1].tolist()),
        starts,
    )


def lift_hidden(
    frame: EncodedFrame,
    to_next: RigidMotion,
    K: torch.Tensor,
    flow: torch.Tensor | None = None,
    span: torch.Tensor | float = 1.0,
    flat: bool = False,
) -> Cloud:
    """What a frame's foreground hides: the inpainted background where M = 0, which is static in the world.

    Args:
        frame: B of them.
        to_next: the camera's motion.
        K: [B, 3, 3] px.
        flow: [B, 3, H, W] m, that points follow as their pixels do, where no camera motion is forecast; None is
            the camera's motion.
        span: intervals of the clip that it takes; a tensor is [B, 1, 1, 1].
        flat: motion is a 2D flow, see `in_plane`.

    Returns:
        The cloud with |M = 0| points per image; differentiable in all but ``K``.
    """
    layers = frame.layers
    hidden = (layers.mask < FOREGROUND_BELOW).flatten(1)
    where, sizes = hidden.flatten().nonzero()[:, 0], hidden.sum(dim=1)

    def pick(points: torch.Tensor) -> torch.Tensor:
        return points.flatten(0, 1).index_select(0, where)

    depth = layers.background_depth if len(where) else layers.background_depth[:, :, :0]
    points = pick(unproject(depth, K))
    carried = _flow_of(points, to_next, sizes.tolist())
    if flat:
        carried = in_plane(points, carried)
    moved = carried if flow is None else pick(as_points(flow))
    if isinstance(span, torch.Tensor):
        span = span.flatten().repeat_interleave(sizes)[:, None]
    return Cloud(
        points,
        moved,
        points.new_zeros(len(where), 3) if flow is None else (moved - carried) / span,
        layers.background_depth.flatten()[where],
        pick(as_points(frame.background_features)),
        pick(as_points(layers.background_image)),
        points.new_ones(len(where), 1),
        torch.ones(len(where), dtype=torch.bool),
        (),
        functional.pad(sizes.cumsum(0), (1, 0)),
    )


def join(first: Cloud, second: Cloud) -> Cloud:
    """One cloud an image of both, ``first`` before ``second``; the other one itself where one has no points."""
    if not (len(first.depth) and len(second.depth)):
        return first if len(first.depth) else second
    sizes = first.sizes, second.sizes

    def alternate(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        pairs = zip(one.split(sizes[0]), other.split(sizes[1]), strict=True)
        return torch.cat([piece for pair in pairs for piece in pair])

    packed = [alternate(one, other) for one, other in zip(first[:-2], second[:-2], strict=True)]
    shifts = second.starts[:-1].tolist(), first.starts[1:].tolist()
    grids = [
        grid._replace(start=grid.start + shift[bisect.bisect_right(cloud.starts.tolist(), grid.start) - 1])
        for cloud, shift in zip((first, second), shifts, strict=True)
        for grid in cloud.grids
    ]
    return Cloud._make([*packed, tuple(grids), first.starts + second.starts])


def in_plane(points_xyz: torch.Tensor, displacement_xyz: torch.Tensor) -> torch.Tensor:
    """(x + u) z / (x + u)_z - x: the displacement along the image to the same pixel, at the depth that the point has.

    Args:
        points_xyz: x [..., 3] m, z above 0.
        displacement_xyz: u [..., 3] m.

    Returns:
        [..., 3] m, its z exactly 0; differentiable.
    """
    moved = points_xyz + displacement_xyz
    along = moved[..., :2] * (points_xyz[..., 2:] / moved[..., 2:].clamp(min=constants.NEAR)) - points_xyz[..., :2]
    return functional.pad(along, (0, 1))


def advance(cloud: Cloud, next_from_cur: torch.Tensor, flat: bool = False) -> Cloud:
    """One frame interval on: x_(k+1) = G x_k + R s_k and s_(k+1) = R s_k, with G = (R, t) = ``next_from_cur``.

    The camera repeats its motion G [B, 4, 4], and what moves in the world continues at its velocity s there.
    What is fixed to the camera, x_1 = x, stays there while R = I. In a bend that is not a constant velocity, and it
    drifts by (R - I) (x - G x) in the second step: the recording car's own bonnet at 1 m and 0.01 rad per frame by 1
    cm. With ``flat`` motion is a 2D flow, see `in_plane`.
    """
    points = cloud.points_xyz + cloud.displacement_xyz
    turned = _per_image(cloud.step_xyz, _rotation(next_from_cur), cloud.sizes)
    displacement = _per_image(points, next_from_cur, cloud.sizes) + turned - points
    if flat:
        displacement = in_plane(points, displacement)
    return cloud._replace(points_xyz=points, displacement_xyz=displacement, step_xyz=turned)


def last_motion(cloud: Cloud, next_from_cur: torch.Tensor, flat: bool = False) -> torch.Tensor:
    """x_k - x_(k-1) with x_(k-1) = G^-1 (x_k - s_k): for the previous frame's points, too, which came two intervals.

    With ``flat`` x_(k-1) is at the depth of x_k.
    """
    still = cloud.points_xyz + cloud.displacement_xyz - cloud.step_xyz
    back = geometry.invert(next_from_cur)
    motion = RigidMotion(geometry.matrix_to_quaternion(back[:, :3, :3]), back[:, :3, 3])
    moved = cloud.step_xyz - _flow_of(still, motion, cloud.sizes)
    return -in_plane(cloud.points_xyz + cloud.displacement_xyz, -moved) if flat else moved


def _flow_of(points_xyz: torch.Tensor, rigid: RigidMotion, sizes: list[int]) -> torch.Tensor:
    """Each image's points [P, 3] on their way by its own motion."""
    each = zip(points_xyz.split(sizes), *rigid, strict=True)
    flows = [rigid_flow(own[None], quaternion[None], translation[None])[0] for own, quaternion, translation in each]
    return flows[0] if len(flows) == 1 else torch.cat(flows)


def _per_image(points_xyz: torch.Tensor, dst_from_src: torch.Tensor, sizes: list[int]) -> torch.Tensor:
    """Each image's points [P, 3] through its own [B, 4, 4]."""
    pairs = zip(points_xyz.split(sizes), dst_from_src, strict=True)
    return torch.cat([geometry.transform_points(rigid, points) for points, rigid in pairs])


def _rotation(rigid: torch.Tensor) -> torch.Tensor:
    """[B, 4, 4] without its translation."""
    rotation = rigid.clone()
    rotation[:, :3, 3] = 0
    return rotation

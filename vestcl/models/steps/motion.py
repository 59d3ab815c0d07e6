"""How everything moves to the next frame, and what follows from it: the answer of a forecast's step, the next prior."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch.nn import functional

from vestcl import geometry
from vestcl.models.networks.ego_motion import CameraMotion, RigidMotion
from vestcl.models.networks.object_motion import ObjectMotionForecast
from vestcl.models.steps.clouds import as_image, as_points, in_plane
from vestcl.models.steps.frames import EncodedFrame
from vestcl.models.steps.prior import MotionPrior, repeated
from vestcl.models.steps.render import RenderedView
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.unproject import unproject


class Motion(NamedTuple):
    """How everything moves to the next frame."""

    next_from_prev: RigidMotion
    next_from_cur: RigidMotion
    later: tuple[RigidMotion, ...]
    """The camera's, of the intervals after t + 1, as far as they were forecast in one go."""
    points: tuple[torch.Tensor, torch.Tensor]
    """[B, H W, 3] m, the previous frame's pixels and the current one's, each in its own camera."""
    flow0: torch.Tensor
    """[B, 6, H, W] m: the rigid flow of the previous frame's pixels, then of the current one's."""
    start: torch.Tensor
    """[B, 6, H, W] m: what object motion starts from: ``flow0``, and the prior's object motion in addition to it."""
    objects: ObjectMotionForecast
    """The flow that is used, each block's candidates, which ran, their probabilities; without object motion the flow
    is ``flow0`` and L = 0."""
    spans: tuple[torch.Tensor | float, float] = (2.0, 1.0)
    """Intervals that the previous frame's pixels and the current one's are on their way; a tensor is [B, 1, 1, 1]."""

    @property
    def rigid(self) -> torch.Tensor:
        """``next_from_cur`` as [B, 4, 4]."""
        return geometry.compose_rigid(*self.next_from_cur)

    def following(self) -> "Motion":
        """With the next interval's motion of the camera for ``next_from_cur``: the last one repeats."""
        return self._replace(next_from_cur=self.later[0], later=self.later[1:]) if self.later else self

    def path(self, steps: int) -> torch.Tensor:
        """future_from_cur [B, steps, 4, 4] m, to t + 1 ... t + steps, or further as far as ``later`` goes."""
        motion, path = self, [self.rigid]
        while len(path) < max(steps, 1 + len(self.later)):
            motion = motion.following()
            path.append(motion.rigid @ path[-1])
        return torch.stack(path, dim=1)


class Step(NamedTuple):
    """The forecast of one time, t + k."""

    views: list[RenderedView]
    """One for each camera asked for; none at steps that are not shown."""
    motion: Motion
    """Motion of the interval before t + k; composed motion repeats that of the first interval, except the camera's."""
    future_from_cur: torch.Tensor
    """[B, 4, 4] m: from the camera at t to the camera at t + k."""
    path_from_cur: torch.Tensor
    """[B, n, 4, 4] m: the camera's way as it was forecast at t, to t + 1 ... t + n, n as many as steps or more."""


def next_prior(prior: MotionPrior, motion: Motion, seen: RenderedView, K: torch.Tensor) -> MotionPrior:
    """The prior of the step after ``motion``, from which the source camera has ``seen`` the result.

    It is the networks' own forecast and not corrected again: they learned what a measured motion lacks, and would add
    that in every step.
    """
    moved = (motion.objects.flow - motion.flow0)[:, 3:]
    again, following = repeated(prior, motion.next_from_cur, moved, seen, K), motion.following()
    camera, *rest = [
        RigidMotion(*(part.detach() for part in rigid)) for rigid in (following.next_from_cur, *following.later)
    ]
    later = RigidMotion(*(torch.stack(parts, dim=1) for parts in zip(*rest, strict=True))) if rest else None
    corrected = torch.zeros(len(moved), dtype=torch.bool)
    return again._replace(next_from_cur=camera, later=later, corrected=corrected)


def flattened(points: Sequence[torch.Tensor], flow: torch.Tensor) -> torch.Tensor:
    """`in_plane` of both frames' pixels: ``points`` two of [B, H W, 3] m, ``flow`` [B, 6, H, W] m, as the result."""
    pairs = zip(points, flow.split(3, dim=1), strict=True)
    return torch.cat([as_image(in_plane(xyz, as_points(of_frame)), *flow.shape[2:]) for xyz, of_frame in pairs], dim=1)


def without_z(flow: torch.Tensor) -> torch.Tensor:
    """[B, 6, H, W] m with 0 for the z of both frames' pixels; differentiable."""
    return torch.cat([functional.pad(of[:, :2], (0, 0, 0, 0, 0, 1)) for of in flow.split(3, dim=1)], dim=1)


def arrived(
    prev: EncodedFrame,
    cur: EncodedFrame,
    K: torch.Tensor,
    to_next: MotionPrior | CameraMotion,
    flat: bool = False,
) -> Motion:
    """The motion that brings what t - 1 shows to t, and does not change what t shows.

    Args:
        prev: frame at t - 1.
        cur: frame at t.
        K: [B, 3, 3] px.
        to_next: the camera's motion, or a prior, of which what moves by itself comes along, too.
        flat: motion is a 2D flow, see `in_plane`.
    """
    if isinstance(to_next, MotionPrior):
        cur_from_prev = to_next.cur_from_prev
    else:
        cur_from_prev = to_next.next_from_cur.inverse().after(to_next.next_from_prev)
    height, width = cur.features.shape[2:]
    points = unproject(prev.layers.depth, K), unproject(cur.layers.depth, K)
    of_prev = as_image(rigid_flow(points[0], *cur_from_prev), height, width)
    flow0 = torch.cat([of_prev, torch.zeros_like(of_prev)], dim=1)
    elapsed: torch.Tensor | float = 1.0
    flow = flow0
    if isinstance(to_next, MotionPrior):
        turn = geometry.quaternion_to_matrix(cur_from_prev.quaternion)
        elapsed = to_next.span - 1
        residual = elapsed * torch.einsum("bij,bjhw->bihw", turn, to_next.velocity_prev)
        flow = flow0 + torch.cat([residual, torch.zeros_like(residual)], dim=1)
    if flat:
        flow0, flow = flattened(points, flow0), flattened(points, flow)
    objects = ObjectMotionForecast(flow, [], torch.zeros(len(flow), 0, dtype=torch.bool), None)
    rest, spans = RigidMotion.rest(cur.features), (elapsed, 1.0)
    return Motion(cur_from_prev, rest, (), points, flow0, flow, objects, spans)

"""How everything moves to the next frame, and what follows from it: the answer of a forecast's step, the next prior."""

from typing import Final, NamedTuple

import torch

from vestcl import geometry
from vestcl.models._clouds import as_image
from vestcl.models._frames import EncodedFrame
from vestcl.models._render import RenderedView
from vestcl.models.ego_motion import RigidMotion
from vestcl.models.object_motion import ObjectMotionForecast
from vestcl.models.prior import MotionPrior, repeated
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.unproject import unproject

#: Frame intervals from t - 1 and from t to t + 1.
INTERVALS: Final = (2, 1)


class Motion(NamedTuple):
    """How everything moves to the next frame."""

    next_from_prev: RigidMotion
    next_from_cur: RigidMotion
    flow0: torch.Tensor
    """[B, 6, H, W] m: the rigid flow of the previous frame's pixels, then of the current one's."""
    start: torch.Tensor
    """[B, 6, H, W] m: what object motion starts from: ``flow0``, and what the prior says of things beside it."""
    objects: ObjectMotionForecast
    """The flow that is used, each block's candidates, which ran, their probabilities; without object motion the flow
    is ``flow0`` and L = 0."""

    @property
    def rigid(self) -> torch.Tensor:
        """``next_from_cur`` as [B, 4, 4]."""
        return geometry.compose_rigid(*self.next_from_cur)


class Step(NamedTuple):
    """The forecast of one time, t + k."""

    views: list[RenderedView]
    """One for each camera asked for; none at steps that are not shown."""
    motion: Motion
    """Of the interval before t + k; when motion is composed, that of the first interval."""
    future_from_cur: torch.Tensor
    """[B, 4, 4] m: from the camera at t to the camera at t + k."""


def next_prior(motion: Motion, seen: RenderedView, K: torch.Tensor) -> MotionPrior:
    """Of the step after ``motion``, from which the source camera has ``seen`` the result."""
    moved = (motion.objects.flow - motion.flow0)[:, 3:]
    return repeated(motion.next_from_cur, moved, seen, K)


def arrived(
    prev: EncodedFrame, cur: EncodedFrame, K: torch.Tensor, to_next: MotionPrior | tuple[RigidMotion, RigidMotion]
) -> Motion:
    """The motion that brings what t - 1 shows to t, and leaves alone what t shows.

    Args:
        prev: frame at t - 1.
        cur: frame at t.
        K: [B, 3, 3] px.
        to_next: next_from_prev and next_from_cur; of a prior, what moves beside the camera comes along, too.
    """
    cur_from_prev, still = to_next[1].inverse().after(to_next[0]), rest(cur.features)
    height, width = cur.features.shape[2:]
    of_prev = as_image(rigid_flow(unproject(prev.layers.depth, K), *cur_from_prev), height, width)
    flow0 = torch.cat([of_prev, torch.zeros_like(of_prev)], dim=1)
    flow = flow0
    if isinstance(to_next, MotionPrior):
        turn = geometry.quaternion_to_matrix(cur_from_prev.quaternion)
        beside = torch.einsum("bij,bjhw->bihw", turn, to_next.velocity_prev)
        flow = flow0 + torch.cat([beside, torch.zeros_like(beside)], dim=1)
    none = torch.zeros(len(flow), 0, dtype=torch.bool)
    return Motion(cur_from_prev, still, flow0, flow, ObjectMotionForecast(flow, [], none, None))


def rest(like: torch.Tensor) -> RigidMotion:
    """No motion, for each image of ``like`` [B, ...]."""
    quaternion = like.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(like), 1)
    return RigidMotion(quaternion, like.new_zeros(len(like), 3))

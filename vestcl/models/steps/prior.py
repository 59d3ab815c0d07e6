"""What was measured of a motion before the networks look: where they start from, and what they correct."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from vestcl import geometry
from vestcl.models.networks.camera_correction import MEASURED, RATES, CameraPrior
from vestcl.models.networks.rigid_motion import RigidMotion
from vestcl.models.steps.clouds import as_image, as_points
from vestcl.models.steps.render import RenderedView
from vestcl.ops.unproject import unproject
from vestcl.shapes import check


class MotionPrior(NamedTuple):
    """The motion to the next frame as measurements extrapolate it (SPEC section 8)."""

    next_from_cur: RigidMotion
    """The camera's, B of them, extrapolated."""
    cur_from_prev: RigidMotion
    """As measured, from t - 1 to t ..."""
    prev_from_before: RigidMotion
    """... and from t - 2 to t - 1; where that is not known, ``cur_from_prev`` once more."""
    velocity_prev: torch.Tensor
    """[B, 3, H, W] m per interval, in the camera's axes at t - 1: how what each pixel shows moves in the world; 0 where
    it is static."""
    velocity_cur: torch.Tensor
    """The same at t."""
    intervals: torch.Tensor | None = None
    """[B] from t - 1 to t + 1; None is 2, of evenly spaced frames. From t to t + 1 it is 1."""
    corrected: torch.Tensor | None = None
    """[B] bool, whether the networks correct it; None is True. They know the interval that they learned at: where any
    image has another one, motion is the prior's for all. A forecast motion is not corrected again."""
    later: RigidMotion | None = None
    """[B, n, 4] and [B, n, 3]: the camera's of the n intervals after t + 1, extrapolated; then the last one that is
    known repeats."""
    measured: torch.Tensor | None = None
    """[B, MEASURED, RATES], the last motions as `vestcl.models.networks.camera_correction.rates_of` gives them, oldest
    first; None is the two above."""
    seconds: torch.Tensor | None = None
    """[B] s, one interval of the clip; None is 0.1."""

    @property
    def camera(self) -> CameraPrior:
        """What EMF starts from."""
        known = self.next_from_cur, self.cur_from_prev, self.prev_from_before
        return CameraPrior(*known, self.later, self.measured, self.seconds)

    @property
    def span(self) -> torch.Tensor | float:
        """``intervals`` to be multiplied with [B, C, H, W]."""
        return 2.0 if self.intervals is None else self.intervals[:, None, None, None]

    @property
    def is_corrected(self) -> bool:
        """Whether the networks correct the motion of all images."""
        return self.corrected is None or bool(self.corrected.all())


def nothing_moves(like: torch.Tensor) -> MotionPrior:
    """The prior of frames ``like`` [B, C, H, W] in which neither the camera nor an object was seen to move."""
    rest, still = RigidMotion.rest(like), like.new_zeros(len(like), 3, *like.shape[2:])
    return MotionPrior(rest, rest, rest, still, still)


def check_prior(prior: MotionPrior, like: torch.Tensor) -> None:
    """Refuse a prior of other frames than ``like`` [B, C, H, W].

    Raises:
        ValueError: a tensor of another shape.
    """
    batch, _, height, width = like.shape
    numbers = (("intervals", prior.intervals), ("corrected", prior.corrected), ("seconds", prior.seconds))
    for name, number in numbers:
        if number is not None and number.shape != (batch,):
            raise ValueError(f"`prior.{name}` must be [{batch}], got {list(number.shape)}")
    if prior.measured is not None:
        check(**{"prior.measured": (prior.measured, f"{batch} {MEASURED} {RATES}")})
    if prior.later is not None and (prior.later.quaternion.numel() or prior.later.translation.numel()):
        later = prior.later.quaternion, prior.later.translation
        check(
            **{
                "prior.later.quaternion": (later[0], f"{batch} n 4"),
                "prior.later.translation": (later[1], f"{batch} n 3"),
            }
        )
    check(
        **{
            f"prior.{name}.{part}": (getattr(getattr(prior, name), part), f"{batch} {size}")
            for name in ("next_from_cur", "cur_from_prev", "prev_from_before")
            for part, size in (("quaternion", 4), ("translation", 3))
        },
        **{
            f"prior.{name}": (getattr(prior, name), f"{batch} 3 {height} {width}")
            for name in ("velocity_prev", "velocity_cur")
        },
    )


def residual_flow(prior: MotionPrior, to_next: Sequence[RigidMotion]) -> torch.Tensor:
    """n R v [B, 6, H, W] m: what the velocities v add to the rigid flow over n = `MotionPrior.intervals` and n = 1."""
    moved = []
    velocities, spans = (prior.velocity_prev, prior.velocity_cur), (prior.span, 1)
    for velocity, rigid, intervals in zip(velocities, to_next, spans, strict=True):
        turn = geometry.quaternion_to_matrix(rigid.quaternion)
        moved.append(intervals * torch.einsum("bij,bjhw->bihw", turn, velocity))
    return torch.cat(moved, dim=1)


def repeated(
    prior: MotionPrior,
    next_from_cur: RigidMotion,
    moved: torch.Tensor,
    seen: RenderedView,
    K: torch.Tensor,
) -> MotionPrior:
    """The prior of the step after: the camera's motion G once more, and what moved next to it as it did.

    What is seen at x came m over the interval, so in addition to the camera's motion by s = x - G (x - m), regardless
    of the mask: shadows and errors of depth have velocities, too. The frame before has R^-1 of what its pixels
    moved in addition to the rigid flow.

    Args:
        prior: of the step that is done.
        next_from_cur: G of that step.
        moved: [B, 3, H, W] m, of its current frame's pixels in addition to the rigid flow, in the next camera's axes.
        seen: its view from the source camera.
        K: [B, 3, 3] px.

    Returns:
        The prior; no gradient.
    """
    height, width = seen.depth.shape[2:]
    once = RigidMotion(*(part.detach() for part in next_from_cur))
    rigid = geometry.compose_rigid(*once)
    points = unproject(seen.depth.detach(), K)
    before = geometry.transform_points(rigid, points - as_points(seen.motion_xyz))
    velocity = as_image(points - before, height, width)
    velocity_prev = torch.einsum("bji,bjhw->bihw", rigid[:, :3, :3], moved.detach())
    velocity_cur = torch.where(seen.depth > 0, velocity, 0)
    return MotionPrior(
        once, once, prior.cur_from_prev, velocity_prev, velocity_cur, corrected=prior.corrected, seconds=prior.seconds
    )

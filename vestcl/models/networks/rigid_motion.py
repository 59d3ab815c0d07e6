"""Rigid motions of a batch, as the motion networks have them: quaternion and translation."""

from typing import NamedTuple

import torch

from vestcl import geometry


class RigidMotion(NamedTuple):
    """``dst_from_src``: x_dst = R(q / |q|) x_src + t."""

    quaternion: torch.Tensor
    """[B, 4], (w, x, y, z), of any length."""
    translation: torch.Tensor
    """[B, 3] m."""

    @classmethod
    def rest(cls, like: torch.Tensor) -> "RigidMotion":
        """No motion, for each image of ``like`` [B, ...]."""
        return cls(like.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(like), 1), like.new_zeros(len(like), 3))

    def inverse(self) -> "RigidMotion":
        """x -> R^T (x - t)."""
        quaternion = self.quaternion * self.quaternion.new_tensor([1.0, -1.0, -1.0, -1.0])
        turned = (geometry.quaternion_to_matrix(quaternion) @ self.translation[..., None])[..., 0]
        return RigidMotion(quaternion, -turned)

    def after(self, first: "RigidMotion") -> "RigidMotion":
        """x -> R (R_first x + t_first) + t."""
        quaternion = geometry.quaternion_multiply(self.quaternion, first.quaternion)
        turned = (geometry.quaternion_to_matrix(self.quaternion) @ first.translation[..., None])[..., 0]
        return RigidMotion(quaternion, turned + self.translation)


class CameraMotion(NamedTuple):
    """The camera's way."""

    next_from_prev: RigidMotion
    next_from_cur: RigidMotion
    later: tuple[RigidMotion, ...] = ()
    """From t + 1 to t + 2, and so on, as far as it is forecast in one go; then the last one repeats."""

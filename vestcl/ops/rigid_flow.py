"""How far a rigid motion of the camera moves each point (kernels/rigid_flow.cl)."""

from typing import Any, Final

import numpy as np
import torch

from vestcl import constants, geometry, opencl
from vestcl.ops._arguments import Array, as_array, check_arguments, require_ordinary, work_items
from vestcl.ops._autograd import Gradients, differentiable_by, untraced

#: Partial sums per image in the gradient of the motion, the same on every device and so the same order of additions.
#: Each is a work-item; one work-item adds the 256 up, so more of them would make that last step the longer one.
CHUNKS: Final = 256


@untraced
def rigid_flow(points_xyz: Array, quaternion: Array, translation: Array) -> Array:
    """u = R x + t - x with R = R(q / max(|q|, 1e-8)).

    A point that is not finite gets NaN, and takes no part in any gradient.

    Args:
        points_xyz: [B, N, 3] m in the source frame. Torch CPU tensor or NumPy array, float32 or float64.
        quaternion: [B, 4], (w, x, y, z), rotation of ``dst_from_src``; of any length. Of the same kind and dtype.
        translation: [B, 3] m, translation of ``dst_from_src``. Of the same kind and dtype.

    Returns:
        displacement_xyz [B, N, 3] m, of the kind and dtype that came in; differentiable in all three, any number
        of times (from the second on in plain torch).

    Raises:
        ValueError: an argument of another kind, dtype or shape.
        DeviceError: no OpenCL device, or one without float64 where that is asked for.

    Source: SPEC section 2; the rigid flow of the paper's ego-motion forecasting.
    """
    check_arguments(points_xyz=(points_xyz, "B N 3"), quaternion=(quaternion, "B 4"), translation=(translation, "B 3"))
    if not isinstance(points_xyz, torch.Tensor):
        return _forward(opencl.current(), as_array(points_xyz), as_array(quaternion), as_array(translation))
    return _RigidFlow.apply(points_xyz, quaternion, translation)


class _RigidFlow(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points_xyz: torch.Tensor, quaternion: torch.Tensor, translation: torch.Tensor
    ) -> torch.Tensor:
        ctx.session = opencl.current()
        ctx.save_for_backward(points_xyz, quaternion)
        arrays = as_array(points_xyz), as_array(quaternion), as_array(translation)
        return torch.from_numpy(_forward(ctx.session, *arrays))

    @staticmethod
    @untraced
    def backward(ctx: Any, grad_displacement_xyz: torch.Tensor) -> Gradients:
        require_ordinary("grad_displacement_xyz", grad_displacement_xyz)
        points_xyz, quaternion = ctx.saved_tensors
        arrays = as_array(points_xyz), as_array(quaternion), as_array(grad_displacement_xyz)
        grads = _backward(ctx.session, *arrays, ctx.needs_input_grad)
        translation = quaternion.new_zeros(len(quaternion), 3)  # no gradient depends on it
        return differentiable_by(_formula, (points_xyz, quaternion, translation), (grad_displacement_xyz,), grads)


def _formula(points_xyz: torch.Tensor, quaternion: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """The kernel's formula in plain torch, for the derivatives of its gradients."""
    finite = points_xyz.isfinite().all(dim=-1, keepdim=True)
    safe = torch.where(finite, points_xyz, 0)
    moved_xyz = geometry.transform_points(geometry.compose_rigid(quaternion, translation), safe)
    return torch.where(finite, moved_xyz - safe, torch.nan)


def _defines(dtype: np.dtype) -> dict[str, str | int]:
    return opencl.defines_for(dtype, CHUNKS=CHUNKS, QUATERNION_FLOOR=repr(constants.QUATERNION_FLOOR))


def _forward(
    session: opencl.Session, points_xyz: np.ndarray, quaternion: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    batch, count, _ = points_xyz.shape
    displacement_xyz = np.empty_like(points_xyz)
    if displacement_xyz.size:
        chunk, items, group = work_items(session, count)
        with session.job() as job:
            arguments: opencl.Arguments = {
                "count": np.int32(count),
                "chunk": chunk,
                "points_xyz": job.read(points_xyz),
                "quaternion": job.read(quaternion),
                "translation": job.read(translation),
                "displacement_xyz": job.write(displacement_xyz),
            }
            defines = _defines(points_xyz.dtype)
            job.launch("rigid_flow.cl", "rigid_flow", defines, (items, batch), arguments, (group, 1))
    return displacement_xyz


def _backward(
    session: opencl.Session,
    points_xyz: np.ndarray,
    quaternion: np.ndarray,
    grad_displacement_xyz: np.ndarray,
    needed: tuple[bool, bool, bool],
) -> Gradients:
    arrays = points_xyz, quaternion, grad_displacement_xyz
    points_needed, quaternion_needed, translation_needed = needed
    grad_points_xyz = grad_quaternion = grad_translation = None
    if points_needed:
        grad_points_xyz = torch.from_numpy(_backward_points(session, *arrays))
    if quaternion_needed or translation_needed:
        grad_quaternion, grad_translation = map(torch.from_numpy, _backward_motion(session, *arrays))
    return (
        grad_points_xyz,
        grad_quaternion if quaternion_needed else None,
        grad_translation if translation_needed else None,
    )


def _backward_points(
    session: opencl.Session, points_xyz: np.ndarray, quaternion: np.ndarray, grad_displacement_xyz: np.ndarray
) -> np.ndarray:
    batch, count, _ = points_xyz.shape
    grad_points_xyz = np.empty_like(points_xyz)
    if grad_points_xyz.size:
        chunk, items, group = work_items(session, count)
        with session.job() as job:
            arguments: opencl.Arguments = {
                "count": np.int32(count),
                "chunk": chunk,
                "points_xyz": job.read(points_xyz),
                "quaternion": job.read(quaternion),
                "grad_displacement_xyz": job.read(grad_displacement_xyz),
                "grad_points_xyz": job.write(grad_points_xyz),
            }
            defines = _defines(points_xyz.dtype)
            job.launch("rigid_flow.cl", "rigid_flow_backward_points", defines, (items, batch), arguments, (group, 1))
    return grad_points_xyz


def _backward_motion(
    session: opencl.Session, points_xyz: np.ndarray, quaternion: np.ndarray, grad_displacement_xyz: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of quaternion [B, 4] and translation [B, 3]: sums over the points, in an order that never changes."""
    batch, count, _ = points_xyz.shape
    grad_quaternion = np.zeros((batch, 4), points_xyz.dtype)
    grad_translation = np.zeros((batch, 3), points_xyz.dtype)
    if points_xyz.size:
        defines = _defines(points_xyz.dtype)
        with session.job() as job:
            items, group = opencl.grouped(session, CHUNKS)
            partial_sums = job.scratch(batch * CHUNKS * 3 * 4, points_xyz.dtype)
            arguments: opencl.Arguments = {
                "count": np.int32(count),
                "points_xyz": job.read(points_xyz),
                "grad_displacement_xyz": job.read(grad_displacement_xyz),
                "partial_sums": partial_sums,
            }
            job.launch("rigid_flow.cl", "rigid_flow_backward_sums", defines, (items, batch), arguments, (group, 1))
            arguments = {
                "batch": np.int32(batch),
                "quaternion": job.read(quaternion),
                "partial_sums": partial_sums,
                "grad_quaternion": job.write(grad_quaternion),
                "grad_translation": job.write(grad_translation),
            }
            items, group = opencl.grouped(session, batch)
            job.launch("rigid_flow.cl", "rigid_flow_backward_motion", defines, (items,), arguments, (group,))
    return grad_quaternion, grad_translation

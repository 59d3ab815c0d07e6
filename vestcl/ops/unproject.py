"""Pixels with depth to 3D points (kernels/unproject.cl)."""

from typing import Any

import numpy as np
import torch

from vestcl import opencl
from vestcl.ops._arguments import Array, as_array, check_arguments, require_no_grad, require_ordinary, work_items
from vestcl.ops._autograd import untraced


@untraced
def unproject(depth: Array, K: Array) -> Array:
    """p = z K^-1 (u, v, 1) at pixel centres (u, v) = (column + 0.5, row + 0.5).

    Args:
        depth: [B, 1, H, W] m, z-depth. Torch CPU tensor or NumPy array, float32 or float64.
        K: [B, 3, 3] px, invertible; its last row is (0, 0, 1). Of the same kind and dtype.

    Returns:
        points_xyz [B, H W, 3] m in the camera's frame, row after row, of the kind and dtype that came in;
        differentiable in ``depth``, any number of times.

    Raises:
        ValueError: an argument of another kind, dtype or shape, a singular ``K``, or one that requires grad.
        DeviceError: no OpenCL device, or one without float64 where that is asked for.

    Source: SPEC section 2.
    """
    check_arguments(depth=(depth, "B 1 H W"), K=(K, "B 3 3"))
    if not isinstance(depth, torch.Tensor):
        return _forward(opencl.current(), as_array(depth), _inverse(as_array(K)))
    require_no_grad("K", K)
    return _Unproject.apply(depth, opencl.current(), _inverse(as_array(K)))


class _Unproject(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, depth: torch.Tensor, session: opencl.Session, inverse_K: np.ndarray) -> torch.Tensor:
        ctx.session, ctx.shape, ctx.inverse_K = session, depth.shape, inverse_K
        return torch.from_numpy(_forward(session, as_array(depth), inverse_K))

    @staticmethod
    @untraced
    def backward(ctx: Any, grad_points_xyz: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        require_ordinary("grad_points_xyz", grad_points_xyz)
        return _UnprojectBackward.apply(grad_points_xyz, ctx.session, ctx.shape, ctx.inverse_K), None, None


class _UnprojectBackward(torch.autograd.Function):
    """Linear in the gradient of the points, as `unproject` is in the depth: each is the other's backward."""

    @staticmethod
    def forward(
        ctx: Any, grad_points_xyz: torch.Tensor, session: opencl.Session, shape: torch.Size, inverse_K: np.ndarray
    ) -> torch.Tensor:
        ctx.session, ctx.inverse_K = session, inverse_K
        return torch.from_numpy(_backward(session, shape, inverse_K, as_array(grad_points_xyz)))

    @staticmethod
    @untraced
    def backward(ctx: Any, grad_grad_depth: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        require_ordinary("grad_grad_depth", grad_grad_depth)
        return _Unproject.apply(grad_grad_depth, ctx.session, ctx.inverse_K), None, None, None


def _inverse(K: np.ndarray) -> np.ndarray:
    """K^-1 [B, 3, 3], computed in float64 and rounded once."""
    try:
        return np.linalg.inv(K.astype(np.float64)).astype(K.dtype)
    except np.linalg.LinAlgError:
        raise ValueError("`K` must be invertible, got a singular matrix") from None


def _forward(session: opencl.Session, depth: np.ndarray, inverse_K: np.ndarray) -> np.ndarray:
    batch, _, height, width = depth.shape
    points_xyz = np.empty((batch, height * width, 3), depth.dtype)
    if points_xyz.size:
        chunk, items, group = work_items(session, width)
        sizes = {"height": np.int32(height), "width": np.int32(width), "chunk": chunk}
        with session.job() as job:
            arguments: opencl.Arguments = {
                **sizes,
                "depth": job.read(depth),
                "inverse_K": job.read(inverse_K),
                "points_xyz": job.write(points_xyz),
            }
            defines = opencl.defines_for(depth.dtype)
            job.launch("unproject.cl", "unproject", defines, (items, height, batch), arguments, (group, 1, 1))
    return points_xyz


def _backward(
    session: opencl.Session, shape: torch.Size, inverse_K: np.ndarray, grad_points_xyz: np.ndarray
) -> np.ndarray:
    batch, _, height, width = shape
    grad_depth = np.empty(shape, grad_points_xyz.dtype)
    if grad_depth.size:
        chunk, items, group = work_items(session, width)
        sizes = {"height": np.int32(height), "width": np.int32(width), "chunk": chunk}
        with session.job() as job:
            arguments: opencl.Arguments = {
                **sizes,
                "inverse_K": job.read(inverse_K),
                "grad_points_xyz": job.read(grad_points_xyz),
                "grad_depth": job.write(grad_depth),
            }
            defines = opencl.defines_for(grad_depth.dtype)
            job.launch("unproject.cl", "unproject_backward", defines, (items, height, batch), arguments, (group, 1, 1))
    return grad_depth

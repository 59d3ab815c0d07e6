"""Forward 3D displacement and projection into a camera (kernels/displace.cl)."""

import functools
from typing import Any

import numpy as np
import torch

from vestcl import opencl
from vestcl.ops._arguments import Array, as_array, check_arguments, require_no_grad, require_ordinary, work_items
from vestcl.ops._autograd import differentiable_by, untraced


@untraced
def displace(
    points_xyz: Array, displacement_xyz: Array, K: Array, tgt_from_src: Array | None = None
) -> tuple[Array, Array]:
    """(a, b, c) = K q,   uv = (a / c, b / c),   z = q_z   with q = tgt_from_src (x + u).

    Nothing is clipped: a point behind the camera is projected through it. Where uv is not finite (c = 0, or a NaN
    came in), uv has no gradient.

    Args:
        points_xyz: [B, N, 3] m in the source frame. Torch CPU tensor or NumPy array, float32 or float64.
        displacement_xyz: [B, N, 3] m in the source frame. This and the others are of the same kind and dtype.
        K: [B, 3, 3] px, of the target camera.
        tgt_from_src: [B, 4, 4], last row (0, 0, 0, 1); None is the identity.

    Returns:
        points_uv [B, N, 2] px and z [B, N] m in the target camera, of the kind and dtype that came in; both
        differentiable in ``points_xyz`` and ``displacement_xyz``, any number of times (from the second on in plain
        torch).

    Raises:
        ValueError: an argument of another kind, dtype or shape, or a camera that requires grad.
        DeviceError: no OpenCL device, or one without float64 where that is asked for.

    Source: SPEC section 2; the forward 3D displacement of the paper.
    """
    check_arguments(
        points_xyz=(points_xyz, "B N 3"),
        displacement_xyz=(displacement_xyz, "B N 3"),
        K=(K, "B 3 3"),
        tgt_from_src=(tgt_from_src, "B 4 4 | None"),
    )
    projection = _projection(as_array(K), None if tgt_from_src is None else as_array(tgt_from_src))
    if not isinstance(points_xyz, torch.Tensor):
        return _forward(opencl.current(), as_array(points_xyz), as_array(displacement_xyz), projection)
    require_no_grad("K", K)
    require_no_grad("tgt_from_src", tgt_from_src)
    return _Displace.apply(points_xyz, displacement_xyz, projection)


class _Displace(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points_xyz: torch.Tensor, displacement_xyz: torch.Tensor, projection: np.ndarray
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ctx.session, ctx.projection = opencl.current(), projection
        ctx.save_for_backward(points_xyz, displacement_xyz)
        points_uv, z = _forward(ctx.session, as_array(points_xyz), as_array(displacement_xyz), projection)
        return torch.from_numpy(points_uv), torch.from_numpy(z)

    @staticmethod
    @untraced
    def backward(ctx: Any, grad_points_uv: torch.Tensor, grad_z: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        require_ordinary("grad_points_uv", grad_points_uv)
        require_ordinary("grad_z", grad_z)
        points_needed, displacement_needed, _ = ctx.needs_input_grad
        inputs, grad_outputs = ctx.saved_tensors, (grad_points_uv, grad_z)
        points_xyz, displacement_xyz, *arrays = map(as_array, (*inputs, *grad_outputs))
        grad_xyz = torch.from_numpy(_backward(ctx.session, points_xyz, displacement_xyz, ctx.projection, *arrays))
        grads = (grad_xyz if points_needed else None, grad_xyz if displacement_needed else None)
        formula = functools.partial(_formula, torch.from_numpy(ctx.projection))
        return *differentiable_by(formula, inputs, grad_outputs, grads), None


def _formula(
    projection: torch.Tensor, points_xyz: torch.Tensor, displacement_xyz: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The kernel's formula in plain torch, for the derivatives of its gradients."""
    moved_xyz = points_xyz - projection[:, 4:, :3] + displacement_xyz
    a, b, c, z = (moved_xyz @ projection[:, :4, :3].mT + projection[:, None, :4, 3]).unbind(-1)
    finite = (a / c).isfinite() & (b / c).isfinite()
    safe = torch.where(finite, c, 1)
    return torch.stack([torch.where(finite, x / safe, torch.nan) for x in (a, b)], dim=-1), z


def _projection(K: np.ndarray, tgt_from_src: np.ndarray | None) -> np.ndarray:
    """[B, 5, 4]: K [R|R o + t], the z-row of [R|R o + t], and (o, 0), where o is the target camera in the source frame.

    Computed in float64 and rounded once; R o + t is what remains of o's own rounding.
    """
    rigid = np.eye(3, 4)[None].repeat(len(K), 0) if tgt_from_src is None else tgt_from_src[:, :3].astype(np.float64)
    seen_from = np.zeros((len(K), 1, 4), K.dtype)
    if tgt_from_src is not None:
        seen_from[:, 0, :3] = _origin(rigid, K.dtype)
        rigid[..., 3] += (rigid[..., :3] @ seen_from[:, 0, :3, None].astype(np.float64))[..., 0]
    rows = np.concatenate([K.astype(np.float64) @ rigid, rigid[:, 2:]], axis=1).astype(K.dtype)
    return np.concatenate([rows, seen_from], axis=1)


def _origin(rigid: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """o [B, 3] with R o + t = 0 for [R|t] [B, 3, 4], rounded; 0 where there is none, or it is not finite."""
    with np.errstate(all="ignore"):
        try:
            found = (-np.linalg.solve(rigid[..., :3], rigid[..., 3:])[..., 0]).astype(dtype)
        except np.linalg.LinAlgError:
            return np.zeros((len(rigid), 3), dtype)
    return np.where(np.isfinite(found).all(axis=1, keepdims=True), found, dtype.type(0))


def _forward(
    session: opencl.Session, points_xyz: np.ndarray, displacement_xyz: np.ndarray, projection: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    batch, count, _ = points_xyz.shape
    points_uv = np.empty((batch, count, 2), points_xyz.dtype)
    z = np.empty((batch, count), points_xyz.dtype)
    if z.size:
        chunk, items, group = work_items(session, count)
        with session.job() as job:
            arguments: opencl.Arguments = {
                "count": np.int32(count),
                "chunk": chunk,
                "points_xyz": job.read(points_xyz),
                "displacement_xyz": job.read(displacement_xyz),
                "projection": job.read(projection),
                "points_uv": job.write(points_uv),
                "z": job.write(z),
            }
            defines = opencl.defines_for(z.dtype)
            job.launch("displace.cl", "displace", defines, (items, batch), arguments, (group, 1))
    return points_uv, z


def _backward(
    session: opencl.Session,
    points_xyz: np.ndarray,
    displacement_xyz: np.ndarray,
    projection: np.ndarray,
    grad_points_uv: np.ndarray,
    grad_z: np.ndarray,
) -> np.ndarray:
    """The gradient of the points, which is that of the displacement too."""
    batch, count, _ = points_xyz.shape
    grad_xyz = np.empty_like(points_xyz)
    if grad_xyz.size:
        chunk, items, group = work_items(session, count)
        with session.job() as job:
            arguments: opencl.Arguments = {
                "count": np.int32(count),
                "chunk": chunk,
                "points_xyz": job.read(points_xyz),
                "displacement_xyz": job.read(displacement_xyz),
                "projection": job.read(projection),
                "grad_points_uv": job.read(grad_points_uv),
                "grad_z": job.read(grad_z),
                "grad_xyz": job.write(grad_xyz),
            }
            defines = opencl.defines_for(grad_xyz.dtype)
            job.launch("displace.cl", "displace_backward", defines, (items, batch), arguments, (group, 1))
    return grad_xyz

"""Rigid motion and pinhole cameras in torch: batched, differentiable, on any device.

Camera axes are x right, y down, z forward, in metres. ``dst_from_src`` [..., 4, 4] maps x_dst = R x_src + t.
Quaternions [..., 4] are (w, x, y, z). Pixel coordinates are continuous: the pixel in row i, column j covers
[j, j + 1) x [i, i + 1), so a resize scales K and a crop shifts its principal point, with no halves to add.
"""

import torch

from vestcl import constants


def quaternion_to_matrix(quaternion: torch.Tensor) -> torch.Tensor:
    """R = I + 2 (w [v]x + [v]x [v]x) with (w, v) = q / max(|q|, 1e-8).

    Args:
        quaternion: [..., 4], (w, x, y, z), of any length.

    Returns:
        Rotation [..., 3, 3]; differentiable everywhere, any number of times, zero quaternion included (it gives I).
    """
    floor = constants.QUATERNION_FLOOR
    tiny = torch.linalg.vector_norm(quaternion.detach(), dim=-1, keepdim=True) < floor
    # Not clamp: the second derivative of |q| at 0 is NaN, and so would be its product with clamp's 0.
    norm = torch.where(tiny, floor, torch.linalg.vector_norm(torch.where(tiny, 1, quaternion), dim=-1, keepdim=True))
    w, x, y, z = (quaternion / norm).unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def matrix_to_quaternion(rotation: torch.Tensor) -> torch.Tensor:
    """The unit quaternion q with R(q) = R and w >= 0: a row of 4 q q^T, which is linear in R, brought to length 1.

    Of the four rows, 4 q_i q, the one with the largest q_i is taken: its length is 2 or more, so half turns, where
    w = 0, are as exact as any.

    Args:
        rotation: [..., 3, 3], a rotation; not checked. float64 keeps an angle to 1e-16, float32 to 1e-7.

    Returns:
        [..., 4], (w, x, y, z); differentiable. `quaternion_to_matrix` undoes it.

    Source: Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1978.
    """
    a, b, c, d, e, f, g, h, i = rotation.flatten(-2).unbind(-1)
    entries = [
        1 + a + e + i, h - f, c - g, d - b,
        h - f, 1 + a - e - i, b + d, c + g,
        c - g, b + d, 1 - a + e - i, f + h,
        d - b, c + g, f + h, 1 - a - e + i,
    ]  # fmt: skip
    rows = torch.stack(entries, dim=-1).unflatten(-1, (4, 4))
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)[..., None, None].expand(*rows.shape[:-2], 1, 4)
    row = rows.gather(-2, largest)[..., 0, :]
    row = torch.where(row[..., :1] < 0, -row, row)
    return row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)


def quaternion_multiply(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """The Hamilton product: R(first second) = R(first) R(second), so ``second`` turns a vector before ``first`` does.

    Args:
        first: [..., 4], (w, x, y, z).
        second: [..., 4]; leading dimensions broadcast.

    Returns:
        [..., 4]; its length is the product of the lengths. Differentiable in both.
    """
    a, b, c, d = first.unbind(-1)
    w, x, y, z = second.unbind(-1)
    entries = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return torch.stack(entries, dim=-1)


def compose_rigid(quaternion: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """[[R(q), t], [0, 1]].

    Args:
        quaternion: [..., 4], (w, x, y, z), of any length.
        translation: [..., 3] m.

    Returns:
        ``dst_from_src`` [..., 4, 4]; differentiable in both.
    """
    top = torch.cat([quaternion_to_matrix(quaternion), translation[..., None]], dim=-1)
    return _with_last_row(top)


def invert(dst_from_src: torch.Tensor) -> torch.Tensor:
    """``src_from_dst`` = [[R^T, -R^T t], [0, 1]] of a rigid ``dst_from_src``.

    Args:
        dst_from_src: [..., 4, 4], with R a rotation and the last row (0, 0, 0, 1); neither is checked.

    Returns:
        [..., 4, 4]; differentiable.
    """
    inverse_rotation = dst_from_src[..., :3, :3].mT
    inverse_translation = -inverse_rotation @ dst_from_src[..., :3, 3:]
    return _with_last_row(torch.cat([inverse_rotation, inverse_translation], dim=-1))


def transform_points(dst_from_src: torch.Tensor, points_xyz: torch.Tensor) -> torch.Tensor:
    """x_dst = R x_src + t.

    Args:
        dst_from_src: [..., 4, 4], last row (0, 0, 0, 1).
        points_xyz: [..., N, 3] m in the source frame; leading dimensions broadcast.

    Returns:
        [..., N, 3] m in the destination frame; differentiable in both.
    """
    return points_xyz @ dst_from_src[..., :3, :3].mT + dst_from_src[..., None, :3, 3]


def scale_intrinsics(K: torch.Tensor, sx: float, sy: float) -> torch.Tensor:
    """diag(sx, sy, 1) K: the intrinsics of an image resized by sx in width and sy in height.

    Args:
        K: [..., 3, 3] px.
        sx: new width / old width.
        sy: new height / old height.

    Returns:
        [..., 3, 3] px; differentiable in K.
    """
    return K.new_tensor([sx, sy, 1.0])[:, None] * K


def crop_intrinsics(K: torch.Tensor, left: float, top: float) -> torch.Tensor:
    """[[1, 0, -left], [0, 1, -top], [0, 0, 1]] K: the intrinsics of the part of an image that starts at (left, top).

    Args:
        K: [..., 3, 3] px.
        left: columns cut off at the left, px; negative pads.
        top: rows cut off at the top, px; negative pads.

    Returns:
        [..., 3, 3] px; differentiable in K.
    """
    return K - K.new_tensor([left, top, 0.0])[:, None] * K[..., 2:, :]


def _with_last_row(top: torch.Tensor) -> torch.Tensor:
    """[..., 3, 4] -> [..., 4, 4] with (0, 0, 0, 1) below."""
    last = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, last], dim=-2)

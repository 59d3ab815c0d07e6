"""Camera matrices and poses as data sets write them, brought to vestcl's conventions.

KITTI, Cityscapes, Virtual KITTI and OpenCV put pixel centres at integers, vestcl at +0.5: `from_integer_centres` is
the one place where the half is added. Matrices here are NumPy float64: positions in a drive need more than 24 bits.
"""

from typing import Final

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from vestcl import geometry

Matrix = NDArray[np.float64]

#: How far R R^T of a pose may be from the identity: files have six digits and more.
ROTATION_TOLERANCE: Final = 1e-4

#: Metres; positions of drives are on one planet.
FARTHEST: Final = 1e8

#: Radians below which the series of a screw motion end after their first term, to 1e-9.
_SMALL_TURN: Final = 1e-4


def from_integer_centres(K: ArrayLike) -> Matrix:
    """[[1, 0, 1/2], [0, 1, 1/2], [0, 0, 1]] K: intrinsics with pixel centres at integers to those at +0.5.

    Args:
        K: [3, 3] px.
    """
    return geometry.crop_intrinsics(torch.from_numpy(np.array(K, np.float64)), -0.5, -0.5).numpy()


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Matrix:
    """[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def intrinsics_from_fov(fov: float, height: int, width: int) -> Matrix:
    """f = width / (2 tan(fov / 2)), square pixels, principal point in the middle, centres at +0.5.

    Args:
        fov: horizontal field of view in degrees, between 0 and 180.
        height: px.
        width: px.

    Raises:
        ValueError: no such field of view.
    """
    if not 0 < fov < 180:
        raise ValueError(f"`fov` must be between 0 and 180 degrees, got {fov}")
    focal = width / 2 / np.tan(np.radians(fov) / 2)
    return intrinsics(focal, focal, width / 2, height / 2)


def split_projection(projection: Matrix) -> tuple[Matrix, Matrix]:
    """P = K [I | p4]: what a rectified KITTI camera is.

    Args:
        projection: P [3, 4], pixel centres at integers.

    Returns:
        K [3, 3] with pixel centres at +0.5, and cam_from_rect0 [4, 4]: the shift by p4 = K^-1 P[:, 3], metres.
    """
    K = projection[:, :3]
    return from_integer_centres(K), translation(np.linalg.solve(K, projection[:, 3]))


def translation(xyz: ArrayLike) -> Matrix:
    """[[I, t], [0, 1]]."""
    moved = np.eye(4)
    moved[:3, 3] = xyz
    return moved


def rigid(rotation: ArrayLike, xyz: ArrayLike = (0.0, 0.0, 0.0)) -> Matrix:
    """[[R, t], [0, 1]] of R [3, 3] or nine numbers row by row, and t [3]."""
    moved = translation(xyz)
    moved[:3, :3] = np.reshape(rotation, (3, 3))
    return moved


def invert(dst_from_src: Matrix) -> Matrix:
    """src_from_dst of a rigid [..., 4, 4]."""
    return geometry.invert(torch.from_numpy(dst_from_src)).numpy()


def power(dst_from_src: Matrix, exponent: float) -> Matrix:
    """exp(s log M): a rigid motion [4, 4] gone through for ``exponent`` s of its time at constant velocity, as a screw.

    With the rotation vector w and t = V(w) v, V(w) = integral of R(u w) over u in [0, 1]: R(s w), s V(s w) v.
    """
    if exponent == int(exponent):  # exact for 1, and the same bits as repeated products
        return np.asarray(np.linalg.matrix_power(dst_from_src, int(exponent)), np.float64)
    turn: Matrix = np.asarray(cv2.Rodrigues(dst_from_src[:3, :3])[0], np.float64)[:, 0]
    speed = np.linalg.solve(_mean_turn(turn), dst_from_src[:3, 3])
    return rigid(cv2.Rodrigues(exponent * turn)[0], exponent * _mean_turn(exponent * turn) @ speed)


def _mean_turn(turn: Matrix) -> Matrix:
    """V(w) = I + (1 - cos a) / a^2 [w]x + (a - sin a) / a^3 [w]x^2 with a = |w|."""
    a = float(np.linalg.norm(turn))
    cross = np.cross(np.eye(3), turn)
    first, second = (0.5, 1 / 6) if a < _SMALL_TURN else ((1 - np.cos(a)) / a**2, (a - np.sin(a)) / a**3)
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross, np.float64)


def check_intrinsics(K: Matrix, where: str) -> None:
    """Refuse what is not a camera.

    Raises:
        ValueError: not [3, 3], not finite, a focal length not positive, or another last row than (0, 0, 1).
    """
    if K.shape != (3, 3):
        raise ValueError(f"{where}: K must be [3, 3], got {list(K.shape)}")
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 and np.array_equal(K[2], [0, 0, 1])):
        raise ValueError(f"{where}: K must be finite, with fx, fy > 0 and the last row (0, 0, 1), got {K.tolist()}")


def check_rigid(dst_from_src: Matrix, where: str) -> None:
    """Refuse what is not a rigid motion.

    Raises:
        ValueError: not [4, 4], not finite, another last row than (0, 0, 0, 1), R no rotation, or a shift of more
            than FARTHEST.
    """
    if dst_from_src.shape != (4, 4):
        raise ValueError(f"{where}: a pose must be [4, 4], got {list(dst_from_src.shape)}")
    if not (np.isfinite(dst_from_src).all() and np.abs(dst_from_src).max() <= FARTHEST):
        raise ValueError(f"{where}: must be a rotation and a finite shift, got {dst_from_src.tolist()}")
    rotation = dst_from_src[:3, :3]
    straight = np.allclose(rotation @ rotation.T, np.eye(3), atol=ROTATION_TOLERANCE) and np.linalg.det(rotation) > 0
    if not (straight and np.array_equal(dst_from_src[3], [0, 0, 0, 1])):
        raise ValueError(f"{where}: must be a rotation and a finite shift, got {dst_from_src.tolist()}")

"""Candidate motions of each pixel's point, weighted by how well they would have forecast the frame already seen.

A candidate c gives every pixel of t - 1 a velocity v_c. With the camera's measured motion it forecasts where the
pixel's point is at t: e_c = |I_(t-1)(p) - I_t(project(K (R (x + v_c) + t)))|^2, smoothed. The velocity that it has for
t is trusted as far as the one before was right: w_c = e_c^-g / sum e^-g.
"""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.scene.correspondence import sample
from vestcl.scene.layers import SKY_DEPTH
from vestcl.scene.motion_plane import rays_of
from vestcl.scene.parallax import moved_pixels

Array = NDArray[np.float32]

#: The power g: 2 mixes more, 4 picks; on windows of six real clips 3 loses to neither by more than 0.1 dB.
_SHARPNESS: Final = 3.0

#: Squared errors beyond are of something else, and noise of the camera that all have: 0.3 % of white.
_MOST, _NOISE = 0.05, 1e-5

#: Errors are smoothed over so many pixels of an image 832 wide (standard deviations): before they are brought to t
#: along the flow, so that it need not be exact, and then.
_WIDTH, _BEFORE, _AFTER = 832, 2.0, 8.0

#: Flow that leaves the rigid motion by more pixels than that is a wrong match.
_LARGEST: Final = 40.0


class Frame(NamedTuple):
    """A frame and how its pixels came from the one before."""

    image: Array
    """[3, H, W] RGB in [0, 1]."""
    depth: Array
    """[1, H, W] m, above 0."""
    flow_uv: Array
    """[2, H, W] px, to the frame before."""
    prev_from_cur: NDArray[np.float64]
    """[4, 4] m, the camera's motion."""
    K: NDArray[np.float64]
    """[3, 3] px."""


def residual_velocity(frame: Frame) -> Array:
    """v [3, H, W] m over the interval before the frame: what flow shows beyond the camera's motion, at constant depth.

    v = -z' K^-1 (p + flow(p) - project(K (R x + t)), 0), with z' the depth in the frame before; 0 in the sky, and where
    the difference is no motion but a wrong match.
    """
    q = _moved(frame, frame.prev_from_cur, np.zeros((3, 1, 1), np.float32))
    residual = moved_pixels(frame.flow_uv) - q[:2]
    believed = (frame.depth[0] < SKY_DEPTH) & (q[2] > 0.1) & (np.hypot(*residual) < _LARGEST)
    focal = np.array([frame.K[0, 0], frame.K[1, 1]])[:, None, None]
    velocity = np.zeros_like(frame.image)
    velocity[:2] = -np.where(believed, residual * q[2] / focal, 0)
    return velocity


def backtest(candidates: Array, before: Frame, after: Frame) -> Array:
    """Errors e_c at t of candidates that knew nothing of t.

    Args:
        candidates: [C, 3, H, W] m over the interval from t - 1 to t, of the pixels of t - 1.
        before: t - 1.
        after: t.

    Returns:
        [C, H, W], above 0.
    """
    cur_from_prev = np.asarray(np.linalg.inv(after.prev_from_cur), np.float64)
    height, width = after.image.shape[1:]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    back = x + after.flow_uv[0], y + after.flow_uv[1]
    errors = []
    for velocity in candidates:
        u, v, z = _moved(before, cur_from_prev, velocity)
        found = sample(after.image, u - 0.5, v - 0.5, outside=np.nan)
        error = np.where(z > 0.1, np.square(found - before.image).mean(0), np.nan)
        error = np.minimum(np.nan_to_num(error, nan=_MOST), np.float32(_MOST)).astype(np.float32)
        brought = cv2.remap(_smooth(error, _BEFORE), *back, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        errors.append(_smooth(np.asarray(brought, np.float32), _AFTER) + np.float32(_NOISE))
    return np.stack(errors)


def mixed(candidates: Array, errors: Array) -> Array:
    """sum_c w_c v_c [3, H, W] of ``candidates`` [C, 3, H, W], by their ``errors`` [C, H, W]."""
    weights = (errors / errors.min(axis=0)) ** -_SHARPNESS
    weights /= weights.sum(axis=0)
    return np.asarray((weights[:, None] * candidates).sum(axis=0), np.float32)


def _moved(frame: Frame, dst_from_src: NDArray[np.float64], velocity: Array) -> NDArray[np.float64]:
    """[3, H, W]: u, v px and z m in another camera of what the frame's pixels show, moved by ``velocity`` before."""
    height, width = frame.depth.shape[1:]
    points = (rays_of(frame.K, height, width) * frame.depth + velocity).reshape(3, -1)
    q = frame.K @ (dst_from_src[:3, :3] @ points + dst_from_src[:3, 3:])
    return np.stack([*(q[:2] / np.maximum(q[2], 0.1)), q[2]]).reshape(3, height, width)


def _smooth(plane: Array, sigma: float) -> Array:
    return np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma * plane.shape[1] / _WIDTH), np.float32)

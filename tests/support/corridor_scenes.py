"""A corridor of known depth that a camera drives down, with a car in front of it if asked for."""

import cv2
import numpy as np
from data_files import pose

from vestcl.scene.depth.from_motion import CAMERA_HEIGHT

HEIGHT, WIDTH = 160, 288
K = np.array([[200.0, 0, WIDTH / 2], [0, 200.0, HEIGHT / 2], [0, 0, 1]])

#: The corridor: walls to either side, and one at its end, m.
ASIDE, END = 5.0, 45.0


def corridor(world_from_cam: np.ndarray, car_z: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Image [3, H, W] and depth [1, H, W] from a camera: the road is at y = CAMERA_HEIGHT; a car is 2 m wide."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T @ world_from_cam[:3, :3].T
    eye = world_from_cam[:3, 3]
    with np.errstate(divide="ignore"):
        planes = [(axis, at, (at - eye[axis]) / rays[..., axis]) for axis, at in
                  ((1, CAMERA_HEIGHT), (0, -ASIDE), (0, ASIDE), (2, END))]  # fmt: skip
    best, uv = np.full((HEIGHT, WIDTH), np.inf), np.zeros((HEIGHT, WIDTH, 2))
    for axis, at, length in planes:
        there = eye + length[..., None] * rays
        nearer = (length > 0) & (length < best)
        best = np.where(nearer, length, best)
        uv[nearer] = (np.delete(there, axis, -1) + 7.3 * axis + at)[nearer]
    if car_z is not None:
        length = (car_z - eye[2]) / rays[..., 2]
        there = eye + length[..., None] * rays
        car = (np.abs(there[..., 0]) < 1) & (there[..., 1] > 0.3) & (there[..., 1] < CAMERA_HEIGHT) & (length < best)
        best, uv[car] = np.where(car, length, best), there[car][:, :2] + 91
    depth = best * (rays @ world_from_cam[:3, 2])
    return paint(uv), depth[None].astype(np.float32)


def paint(uv: np.ndarray) -> np.ndarray:
    """Noise of blobs of 0.15 to 1 m, [3, H, W], at metres [H, W, 2]."""
    rng, grey = np.random.default_rng(4), np.zeros(uv.shape[:2])
    for size, strength in ((0.15, 0.25), (0.4, 0.3), (1.0, 0.3)):
        noise = cv2.GaussianBlur(rng.random((512, 512)).astype(np.float32), (0, 0), 0.7)
        at = np.mod(uv / size, 511).astype(np.float32)
        grey += strength * cv2.remap(noise, at[..., 0].copy(), at[..., 1].copy(), cv2.INTER_LINEAR)
    return np.repeat((0.5 + 3 * (grey - 0.425))[None], 3, 0).clip(0, 1).astype(np.float32)


def drive(poses: list[np.ndarray], cars: list[float] | None = None) -> tuple[list[np.ndarray], np.ndarray]:
    """The images of a drive down the corridor, and the last one's depth."""
    shots = [corridor(at, None if cars is None else cars[i]) for i, at in enumerate(poses)]
    return [image for image, _ in shots], shots[-1][1]


def ahead(step: float = 0.4, yaw: float = 0.0, frames: int = 4) -> list[np.ndarray]:
    """world_from_cam of a straight drive, with a turn of the camera a frame."""
    return [pose(yaw * i, (0.0, 0.0, step * i)) for i in range(frames)]


def off(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.abs(found / true - 1)

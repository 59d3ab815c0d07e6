"""Where a forecast image is wrong: the share of squared error in holes, sky, moving objects, near and far ground."""

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl.data.resize import resize_labels
from vestcl.evaluation.scores import SEEN, Truth
from vestcl.forecasting.result import Forecast, Rendered, View
from vestcl.scene.depth.road_plane import rays_of

#: The regions; a pixel belongs to the first that it fits.
REGIONS: Final = ("holes", "sky", "objects", "near", "far")

#: Farther than that (metres) is sky, nearer than that is near.
SKY: Final = 1000.0
NEAR: Final = 20.0

#: A point that moves faster than that in the world (m/s) is an object's.
MOVING: Final = 2.0


def error_shares(truth: Truth, forecast: Forecast, index: int, view: View) -> dict[str, list[float]]:
    """Each region's share of a view's squared error, and of the pixels.

    share_r = sum_(p in r) |I(p) - T(p)|^2 / sum_p |I(p) - T(p)|^2, at the size that is scored. Regions are the
    forecast's own: by its coverage, depth and motion.

    Args:
        truth: of the clip.
        forecast: of steps 1, 2, ...
        index: the current frame t.
        view: one of the forecast's.

    Returns:
        "error_in_holes", ... and "area_of_holes", ..., a number per step; NaN where the image has no error at all.
    """
    shares: dict[str, list[float]] = {f"{what}_{name}": [] for what in ("error_in", "area_of") for name in REGIONS}
    before = np.eye(4)
    for step, (frame, camera) in enumerate(zip(forecast.frames, forecast.future_from_cur, strict=True), start=1):
        image = truth.look_at([frame[view.name].image])[0].picture
        squared = torch.square(image - truth.look(view, index + step).picture).mean(dim=1)[0].numpy()
        regions = regions_of(frame[view.name], camera @ np.linalg.inv(before), view, truth)
        for name, inside in regions.items():
            there = resize_labels(inside, *truth.size)[0]
            whole = float(squared.sum())
            shares[f"error_in_{name}"].append(float(squared[there].sum()) / whole if whole > 0 else float("nan"))
            shares[f"area_of_{name}"].append(float(there.mean()))
        before = camera
    return shares


def regions_of(
    frame: Rendered, next_from_cur: NDArray[np.float64], view: View, truth: Truth
) -> dict[str, NDArray[np.bool_]]:
    """The regions of one image, a partition of its pixels.

    Args:
        frame: the image, with depth, coverage and motion.
        next_from_cur: [4, 4] m, the source camera's motion of the last interval.
        view: of the image.
        truth: of the clip.

    Returns:
        By name, [1, H, W].
    """
    clip = truth.clip
    K, interval = clip[0].K if view.K is None else view.K, clip.interval or 0.1
    holes = frame.coverage < SEEN
    speed = own_speed(frame, K, view.tgt_from_next, next_from_cur) / interval
    found = (holes, (frame.depth <= 0) | (frame.depth > SKY), speed[None] > MOVING, frame.depth < NEAR)
    left, regions = np.ones_like(holes), dict[str, NDArray[np.bool_]]()
    for name, inside in zip(REGIONS, (*found, np.ones_like(holes)), strict=True):
        regions[name] = left & inside
        left = left & ~inside
    return regions


def own_speed(
    frame: Rendered, K: NDArray[np.float64], tgt_from_next: NDArray[np.float64], next_from_cur: NDArray[np.float64]
) -> NDArray[np.float64]:
    """|motion_xyz - (x - A^-1 x)| [H, W] m per interval: the motion beyond that of the camera, A = ``next_from_cur``.

    x is the pixel's point in the source camera's axes at the frame's time, as ``motion_xyz`` has it.
    """
    height, width = frame.depth.shape[1:]
    points = (rays_of(K, height, width) * frame.depth).reshape(3, -1)
    next_from_tgt, cur_from_next = np.linalg.inv(tgt_from_next), np.linalg.inv(next_from_cur)
    points = next_from_tgt[:3, :3] @ points + next_from_tgt[:3, 3:]
    static = points - (cur_from_next[:3, :3] @ points + cur_from_next[:3, 3:])
    own = np.linalg.norm(frame.motion_xyz.reshape(3, -1) - static, axis=0)
    return np.asarray(own.reshape(height, width), np.float64)

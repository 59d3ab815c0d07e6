"""What is known of procedural streets besides images: true 3D motion, and the splatter on true scenes."""

from typing import Final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from vestcl.data import calibration
from vestcl.data.sample import Clip, Sample
from vestcl.data.street.clip import Shot, StreetImage
from vestcl.evaluation import metrics
from vestcl.forecasting.geometric.frame_cloud import FrameCloud
from vestcl.forecasting.geometric.render import show
from vestcl.forecasting.result import Forecast
from vestcl.io.labels import SKY, background

#: An object that moves by less than that in the world from frame to frame (metres) is static.
STILL: Final = 0.01

#: A point is seen where the depth map, interpolated as 1 / depth, is not nearer than the point by a larger factor.
_HIDDEN: Final = 1.03

#: Points nearer than that (metres) are not in the image, and not divided by.
_NEAREST: Final = 0.1

Array = NDArray[np.float64]


def shot(sample: Sample) -> Shot | None:
    """How the street took this sample, or None: it is not a street's."""
    return sample.image.shot if isinstance(sample.image, StreetImage) else None


def step_truth(clip: Clip, index: int) -> NDArray[np.float32]:
    """x_t - x_(t-1) of what each pixel of a street's frame t shows, each in its own time's camera.

    `Street.motion` from t back to t - 1 is x_(t-1) - x_t on the grid of t: this is minus that.

    Args:
        clip: of a street, at the street's own size.
        index: the frame t, 1 or more.

    Returns:
        [3, H, W] m.

    Raises:
        ValueError: the clip is of no street.
    """
    return -_motion(clip[index], clip[index - 1])


def motion_errors(forecast: Forecast, clip: Clip, index: int, view: str) -> dict[str, list[float]]:
    """Mean |motion_xyz - truth| over the pixels of t + k that are not sky and that the forecast covers.

    Args:
        forecast: of a street, at the street's own size.
        clip: the street's.
        index: the current frame t.
        view: name of the source view in ``forecast``.

    Returns:
        "motion_m" over all of these pixels, "moving_m" over those of them that show dynamic objects, by STILL or more
        (NaN without any), and "motion_known", their share of all pixels that are not sky.
    """
    errors: dict[str, list[float]] = {"motion_m": [], "moving_m": [], "motion_known": []}
    for step, frame in enumerate(forecast.frames, start=1):
        after, before = clip[index + step], clip[index + step - 1]
        truth, points = step_truth(clip, index + step), _points(after)
        solid = after.read_labels() != SKY
        known = solid & (frame[view].depth > 0)
        rigid_step = _rigid(after, before, points, ~solid) - points
        dynamic = np.linalg.norm(truth + rigid_step, axis=0)[None] > STILL
        made, wanted = (torch.from_numpy(each.reshape(1, 3, -1)).mT for each in (frame[view].motion_xyz, truth))
        for name, mask in (("motion_m", known), ("moving_m", known & dynamic)):
            inside = torch.from_numpy(mask.reshape(1, -1))
            errors[name].append(float(metrics.end_point_error(made, wanted, inside)))
        errors["motion_known"].append(float(known.sum() / max(solid.sum(), 1)))
    return errors


def splatter_alone(clip: Clip, index: int) -> dict[str, list[float]]:
    """PSNR of t + 1 splatted from t with everything true, and warped back from t with everything true.

    - Splatted: depth and `Street.motion` of t, with the background behind the foreground from an image without it.
    - Warped: I(p) = I_t(project(x + u)) with depth x and motion u from t + 1 back to t, bilinear.

    Both over the pixels of t + 1 whose point is in the image at t and not hidden there by something nearer.

    Args:
        clip: of a street, at the street's own size.
        index: the frame t.

    Returns:
        "splatted_db", "warped_db", "splatter_loss_db" (the second minus the first) and "seen", the pixels' share; one
        number each.

    Raises:
        ValueError: the clip is of no street.
    """
    cur, after = clip[index], clip[index + 1]
    image = cur.read_image()
    origin = _points(after) + _motion(after, cur)
    projected = np.einsum("ij,jhw->ihw", cur.K, origin)
    uv = (projected[:2] / np.maximum(projected[2], _NEAREST)).astype(np.float32)
    inside = (origin[2] > _NEAREST) & (uv > 0).all(0) & (uv[0] < cur.width) & (uv[1] < cur.height)
    hidden = origin[2] * _sample(np.float32(1) / cur.read_depth(), uv)[0] > _HIDDEN
    splatted = show(_true_clouds(cur, after), after.K, np.eye(4), after.height, after.width).planes[:3]
    mask = torch.from_numpy(inside & ~hidden)[None, None]
    truth, *made = (
        metrics.quantise(torch.from_numpy(np.ascontiguousarray(each))[None])
        for each in (after.read_image(), splatted, _sample(image, uv))
    )
    splat_db, warp_db = (float(metrics.psnr(each, truth, mask)) for each in made)
    seen = float(mask.double().mean())
    return {"splatted_db": [splat_db], "warped_db": [warp_db], "splatter_loss_db": [warp_db - splat_db], "seen": [seen]}


def _true_clouds(cur: Sample, after: Sample) -> list[FrameCloud]:
    """The frame's pixels, and the background behind its foreground, one frame later."""
    taken, points = _taken(cur), _points(cur)
    behind = Shot(taken.street, taken.t, taken.aside, taken.size, taken.samples, foreground=False).take()
    background_points = _lift(behind.depth[0], cur.K)
    hidden = ~background(cur.read_labels())[0]
    moved = _rigid(cur, after, background_points, behind.labels[0] == SKY)
    return [
        _cloud(cur.read_image(), points, points + _motion(cur, after), np.ones_like(hidden), cur.K),
        _cloud(behind.colour[0], background_points, moved, hidden, cur.K),
    ]


def _cloud(colour: NDArray[np.float32], points: Array, moved: Array, which: NDArray[np.bool_], K: Array) -> FrameCloud:
    """The pixels of ``which`` [H, W]; ``K`` is that of ``colour``."""
    rows, columns = np.nonzero(which)
    there, came = (each[:, rows, columns].T.astype(np.float32) for each in (moved, moved - points))
    z_src = points[2, rows, columns].astype(np.float32)
    return FrameCloud(there, z_src, colour, came, rows, columns, focal=float(K[0, 0]))


def _motion(cur: Sample, after: Sample) -> NDArray[np.float32]:
    """`Street.motion` from one sample to another, before or after it: x_after - x_cur, [3, H, W] m."""
    start, end = _taken(cur), _taken(after)
    cur_from_world, after_from_world = calibration.invert(_pose(cur)), calibration.invert(_pose(after))
    return start.street.motion(cur_from_world, after_from_world, cur.K, cur.height, cur.width, start.t, end.t)


def _rigid(cur: Sample, after: Sample, points: Array, sky: NDArray[np.bool_]) -> Array:
    """Static ``points`` [3, H, W] m in the camera of ``after``; the sky [1, H, W] only rotates."""
    after_from_cur = calibration.invert(_pose(after)) @ _pose(cur)
    rotated = np.einsum("ij,jhw->ihw", after_from_cur[:3, :3], points)
    return rotated + np.where(sky, 0.0, after_from_cur[:3, 3, None, None])


def _points(sample: Sample) -> Array:
    return _lift(sample.read_depth(), sample.K)


def _lift(depth: NDArray[np.float32], K: Array) -> Array:
    """[3, H, W] m: z K^-1 (u, v, 1) at pixel centres."""
    v, u = np.mgrid[: depth.shape[1], : depth.shape[2]] + 0.5
    return np.einsum("ij,jhw->ihw", np.linalg.inv(K), np.stack([u, v, np.ones_like(u)])) * depth


def _sample(planes: NDArray[np.float32], uv: NDArray[np.float32]) -> NDArray[np.float32]:
    """``planes`` [C, H, W] at ``uv`` [2, H, W] px, bilinear; the border is repeated."""
    u, v = uv - np.float32(0.5)  # OpenCV counts from pixel centres
    return np.stack([cv2.remap(plane, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in planes])


def _taken(sample: Sample) -> Shot:
    taken = shot(sample)
    if taken is None or sample.size is not None:
        raise ValueError(f"`clip` must be of a street at its own size, got sample {sample.name}")
    return taken


def _pose(sample: Sample) -> Array:
    if sample.world_from_cam is None:
        raise ValueError(f"sample {sample.name} must have a pose, got none")
    return sample.world_from_cam

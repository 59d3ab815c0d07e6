"""Depth of a plain video: one camera that drives, no network. Parallax where there is some, the road for the rest."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.constants import SKY_DEPTH
from vestcl.scene import checked
from vestcl.scene.depth import from_motion_fill as motion_fill
from vestcl.scene.depth.from_motion_measure import Measured, measure, moving_by_turn
from vestcl.scene.depth.road_plane import fit_road, rays_of
from vestcl.scene.flow.correspondence import Correspondence, correspond
from vestcl.scene.flow.parallax import epipolar
from vestcl.scene.flow.pose import relative_pose
from vestcl.scene.motion.outline import whole_objects
from vestcl.scene.sky import sky_mask

#: Height of the camera above the road, metres, where none is given: behind the windscreen of a car. KITTI's is 1.65.
CAMERA_HEIGHT: Final = 1.5

#: This many earlier images are looked at. A third takes half as long again and changes the next frame's PSNR, warped
#: by depth and motion, by 0.04 dB on KITTI odometry and not at all on a motorway.
_VIEWS: Final = 2

#: A car drives no farther between two images, metres: 216 km/h at 10 images per second.
_FARTHEST: Final = 6.0

#: Nothing is nearer, metres: the bonnet.
_NEAREST: Final = 1.0

#: Above the horizon where nothing is known: houses and trees next to a road, 1/m, and how little it counts.
_ASIDE, _ASIDE_COUNTS = 1 / 40, 0.002

#: How well a foot gives the depth of an object, as a share of its inverse.
_FOOT_STD: Final = 0.05

#: A depth that is trusted more than that separates white walls from the sky.
_SURE: Final = 0.5

Array = NDArray[np.float64]


class MotionDepth(NamedTuple):
    """The last image, in space."""

    depth: NDArray[np.float32]
    """[1, H, W] m, above 0 everywhere, SKY_DEPTH in the sky."""
    prev_from_cur: Array
    """[4, 4] m: from the last camera to the one before, in the same scale; no translation if the car is static."""
    confidence: NDArray[np.float32]
    """[1, H, W] in [0, 1]: 1 = measured, 0 = a guess from the road and from what is around."""
    speed_before: float = 0.0
    """Length of the motion before over that of this one, by parallax; 0 = unknown. The road gives each frame its own
    scale, which differs by more than a car's speed does."""


def motion_depth(
    images: Sequence[ArrayLike],
    K: ArrayLike,
    *,
    camera_height: float = CAMERA_HEIGHT,
    correspondence: Correspondence | None = None,
) -> MotionDepth:
    """1/z from p' ~ K (R K^-1 p + t/z) for the flow p -> p' to up to two earlier images; metres by the road.

    The camera's motion is the essential matrix of the flow. The plane n . x = ``camera_height`` that fits the points
    in the lower middle gives the scale. Where parallax is weak the plane is used; what moves along on it takes the
    depth of its foot; the image's edges guide what is spread over the rest. Where the camera is static or only turns,
    the depth is that of a level road, and no more than a guess.

    Args:
        images: [3, H, W] each, RGB in [0, 1], consecutive, oldest first; two or more, the last three are looked at.
        K: [3, 3] px, of all, pixel centres at +0.5.
        camera_height: m above the road.
        correspondence: from the last image to the one before, where it is known already; it takes most of the time.

    Returns:
        Depth of the last image, the motion to the one before, and how far the depth is to be trusted.

    Raises:
        ValueError: fewer than two images, shapes, numbers that aren't finite, or a height that is not positive.

    Source: SPEC section 8; Nister, An Efficient Solution to the Five-Point Relative Pose Problem, 2004.
    """
    frames = _images(images)
    K = checked.matrix("K", K, 3)
    if not camera_height > 0:
        raise ValueError(f"`camera_height` must be above 0 m, got {camera_height}")
    flow = correspond(frames[-1], frames[-2]) if correspondence is None else correspondence
    motion, measured = observe(frames, K, flow)
    rays = rays_of(K, *frames[-1].shape[1:])
    if measured is None:
        turned, _ = epipolar(K, motion, *frames[-1].shape[1:])
        found = moving_by_turn(flow, motion, K)
        moving = whole_objects(found, frames[-1], frames[-2], flow, turned[:2] / np.maximum(turned[2], 1e-3))
        nothing = Measured(rays[0] * 0, np.full_like(rays[0], np.inf), moving, [0.0])
        return _complete(nothing, _ground(None, rays, camera_height), frames[-1], motion)
    plane = fit_road(measured.inverse, measured.std, K)
    metres = _metres(measured, plane, camera_height)
    motion[:3, 3] *= metres * measured.lengths[0]
    scaled = measured._replace(inverse=measured.inverse / metres, std=measured.std / metres)
    complete = _complete(scaled, _ground(plane, rays, camera_height), frames[-1], motion)
    return complete._replace(speed_before=measured.speed_before)


def observe(
    frames: Sequence[NDArray[np.float32]], K: Array, correspondence: Correspondence | None = None
) -> tuple[Array, Measured | None]:
    """What flow from the last image to up to two earlier ones measures.

    Args:
        images: [3, H, W] each, oldest first, two or more.
        K: [3, 3] px.
        correspondence: from the last image to the one before, where it is known already.

    Returns:
        [4, 4] from the last camera to the one before, of unit length or without a translation; inverse depth, None
        where no view has a translation.
    """
    flows = [correspond(frames[-1], frames[-2]) if correspondence is None else correspondence]
    flows += [correspond(frames[-1], earlier) for earlier in frames[-3 : -2 - _VIEWS : -1]]
    poses = [relative_pose(flow, K) for flow in flows]
    return poses[0].dst_from_src.copy(), measure(frames[-1], flows, poses, K)


def _images(images: Sequence[ArrayLike]) -> list[NDArray[np.float32]]:
    if len(images) < 2:
        raise ValueError(f"`images` must be two or more, got {len(images)}")
    first = checked.planes("images[0]", images[0], 3)
    return [first, *(checked.planes(f"images[{i}]", image, 3, first) for i, image in enumerate(images) if i)]


def _metres(measured: Measured, plane: Array | None, camera_height: float) -> float:
    """Metres of the unit: the camera's height over the plane's; a car's usual speed where there is no plane."""
    metres = 1.0 if plane is None else camera_height * float(np.linalg.norm(plane))
    longest = max(length / (view + 1) for view, length in enumerate(measured.lengths))
    return min(metres, _FARTHEST / longest)


def _ground(plane: Array | None, rays: Array, camera_height: float) -> Array:
    """The road's 1/z [H, W] in 1/m, below 0 above the horizon; a level one where none was found."""
    normal = np.array([0.0, 1.0, 0.0]) if plane is None else plane / np.linalg.norm(plane)
    return np.tensordot(normal / camera_height, rays, 1)


def _complete(measured: Measured, road: Array, image: NDArray[np.float32], motion: Array) -> MotionDepth:
    at_rest = not any(measured.lengths)
    instances, feet, veiled = motion_fill.standing(measured.inverse, measured.std, measured.moving, road, at_rest)
    std = np.where((instances > 0) | measured.moving | veiled, np.inf, measured.std)
    inverse, spread = motion_fill.combine(np.maximum(measured.inverse, 0), std, road)
    inverse = np.where(instances > 0, feet[instances], inverse)
    spread = np.where(instances > 0, _FOOT_STD * feet[instances], spread)
    believed = motion_fill.confidence_of(inverse, spread)
    known = np.where(believed > _SURE, 1 / np.maximum(inverse, 1 / SKY_DEPTH), 0)
    sky = sky_mask(image, known[None].astype(np.float32))[0] & (road <= 0)
    guessed = np.isinf(spread)
    inverse = np.where(guessed, _ASIDE, inverse)
    weight = np.where(sky, 0, np.where(guessed, _ASIDE_COUNTS, believed))
    whole = motion_fill.smooth(inverse, weight, road, image)
    if instances.any():  # beyond an object its depth would hide what is farther as soon as the object has left
        around = motion_fill.smooth(inverse, np.where(instances > 0, 0, weight), road, image)
        whole = np.where(instances > 0 if at_rest else motion_fill.reach(instances, veiled), whole, around)
    depth = np.where(sky, SKY_DEPTH, 1 / np.clip(whole, 1 / motion_fill.FAR, 1 / _NEAREST))
    confidence = motion_fill.confidence_of(np.maximum(measured.inverse, 0), std)
    return MotionDepth(depth[None].astype(np.float32), motion, confidence[None].astype(np.float32))

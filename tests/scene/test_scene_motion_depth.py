"""vestcl.scene.depth.from_motion: a corridor and a street of known depth, standing still, turning, and real driving."""

from typing import Any

import cv2
import numpy as np
import pytest
import torch
from corridor_scenes import HEIGHT, WIDTH, K, ahead, drive, off
from data_files import pose, real

from vestcl.constants import SKY_DEPTH
from vestcl.data import Street, street_clip
from vestcl.data.readers.kitti_odometry import open_kitti_odometry
from vestcl.data.readers.video import open_video
from vestcl.data.sample import Clip, Sample
from vestcl.io.labels import SKY
from vestcl.scene import measurements, perception
from vestcl.scene.depth.from_motion import CAMERA_HEIGHT, MotionDepth, motion_depth
from vestcl.scene.depth.stereo import stereo_depth
from vestcl.scene.flow import optical_flow
from vestcl.scene.flow import pose as motion_pose
from vestcl.scene.flow.correspondence import correspond
from vestcl.scene.flow.parallax import moved_pixels
from vestcl.scene.motion.ego_motion import constant_velocity
from vestcl.scene.motion.mask import rigid_pixels


@pytest.mark.parametrize("frames", [2, 4])
@pytest.mark.parametrize("yaw", [0.0, 0.004])
def test_corridor(frames: int, yaw: float) -> None:
    poses = ahead(yaw=yaw, frames=frames)
    images, depth = drive(poses)
    found = motion_depth(images, K)
    true = np.linalg.inv(poses[-2]) @ poses[-1]
    assert np.abs(found.prev_from_cur[:3, 3] - true[:3, 3]).max() < (0.1 if frames == 2 else 0.05) * 0.4
    assert np.abs(found.prev_from_cur[:3, :3] - true[:3, :3]).max() < 1e-3
    assert np.median(off(found.depth, depth)) < (0.1 if frames == 2 else 0.05)
    assert (off(found.depth, depth) < 0.25).mean() > 0.9


def test_scale_is_the_cameras_height() -> None:
    images, _ = drive(ahead())
    low, high = motion_depth(images, K), motion_depth(images, K, camera_height=2 * CAMERA_HEIGHT)
    assert np.allclose(high.prev_from_cur[:3, 3], 2 * low.prev_from_cur[:3, 3])
    assert np.allclose(high.prev_from_cur[:3, :3], low.prev_from_cur[:3, :3])
    assert abs(np.median(high.depth / low.depth) - 2) < 0.05


def test_consecutive_frames_share_a_scale() -> None:
    images, _ = drive(ahead(frames=5))
    lengths = [np.linalg.norm(motion_depth(images[i : i + 4], K).prev_from_cur[:3, 3]) for i in (0, 1)]
    assert abs(lengths[0] / lengths[1] - 1) < 0.05


def along(metres: float) -> Any:
    return pose(0.0, (0.0, 0.0, metres))


def test_parallax_gives_the_ratio_of_speeds() -> None:
    steps = (0.0, 0.3, 0.8, 1.2)  # m driven: intervals of .3, .5 and .4 m
    images, _ = drive([along(step) for step in steps])
    assert abs(motion_depth(images, K).speed_before - 0.5 / 0.4) < 0.06
    assert abs(motion_depth(images[:3], K).speed_before - 0.3 / 0.5) < 0.06
    assert motion_depth(images[:2], K).speed_before == 0, "two images know one motion"


def test_a_clips_motions_have_one_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    images, _ = drive([along(0.4 * i) for i in range(4)])
    samples = [Sample.from_arrays(f"{i}", image, K) for i, image in enumerate(images)]
    factors, made = iter((1.0, 1.5, 0.7)), motion_depth

    def another_road(*args: Any, **options: Any) -> MotionDepth:
        found, factor = made(*args, **options), next(factors)
        found.prev_from_cur[:3, 3] *= factor
        return found._replace(depth=found.depth * np.float32(factor))

    monkeypatch.setattr(measurements, "motion_depth", another_road)
    seen = perception.Perception(Clip("corridor", "memory", tuple(samples)))
    lengths = [np.linalg.norm(motion[:3, 3]) for motion in seen.motions([1, 2, 3])]
    assert np.ptp(lengths) < 0.06 * lengths[-1]
    own = [np.linalg.norm(seen.prev_from_cur(i)[:3, 3]) for i in (1, 2, 3)]
    assert lengths[-1] == own[-1] and np.ptp(own) > 0.4 * own[-1]


def test_without_a_ratio_of_speeds_the_motion_before_is_as_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the first moment of a drive, of an unknown scale after a rest, is forecast as a violent start."""
    images, _ = drive([along(0.4 * max(i - 2, 0)) for i in range(4)])
    samples = [Sample.from_arrays(f"{i}", image, K) for i, image in enumerate(images)]
    made = motion_depth
    monkeypatch.setattr(
        measurements, "motion_depth", lambda *args, **options: made(*args, **options)._replace(speed_before=0.0)
    )
    seen = perception.Perception(Clip("corridor", "memory", tuple(samples)))
    assert not seen.prev_from_cur(2)[:3, 3].any()
    before, last = seen.motions([2, 3])
    assert last[:3, 3].any() and np.array_equal(before[:3, 3], last[:3, 3])


def test_same_frames_same_bits() -> None:
    images, _ = drive(ahead())
    first, second = motion_depth(images, K), motion_depth(images, K)
    assert all(np.array_equal(getattr(first, name), getattr(second, name)) for name in MotionDepth._fields)


def check_complete(found: MotionDepth) -> None:
    assert found.depth.dtype == found.confidence.dtype == np.float32
    assert found.depth.shape == found.confidence.shape == (1, HEIGHT, WIDTH)
    assert np.isfinite(found.depth).all() and found.depth.min() > 0
    assert found.confidence.min() >= 0 and found.confidence.max() <= 1


def test_standing_still_is_said() -> None:
    images, depth = drive(ahead(step=0.0))
    found = motion_depth(images, K)
    check_complete(found)
    assert not found.prev_from_cur[:3, 3].any() and not found.confidence.any()
    assert np.abs(found.prev_from_cur - np.eye(4)).max() < 1e-4
    assert off(found.depth, depth)[0, 3 * HEIGHT // 4 :, WIDTH // 2].max() < 0.05, "a level road is the guess"


def test_a_car_that_crosses_before_a_camera_at_rest_has_the_depth_of_its_foot() -> None:
    images, depth = drive(ahead(step=0.0))
    noise = np.random.default_rng(1).uniform(0.1, 0.9, (3, 24, 60)).astype(np.float32).repeat(2, 1).repeat(2, 2)
    rows = slice(HEIGHT // 2 - 8, HEIGHT // 2 + 40)  # from above the horizon down to the road
    for i, image in enumerate(images):
        image[:, rows, 40 + 5 * i : 160 + 5 * i] = noise
    found = motion_depth(images, K)
    last = slice(40 + 5 * (len(images) - 1) + 10, 160 + 5 * (len(images) - 1) - 10)
    inside, foot = found.depth[0, rows.start + 6 : rows.stop - 6, last], depth[0, rows.stop, last].mean()
    assert np.abs(inside / foot - 1).max() < 0.25 and np.abs(np.median(inside) / foot - 1) < 0.1
    below = found.depth[0, 3 * HEIGHT // 4 + 20 :, WIDTH // 2]
    assert np.abs(below / depth[0, 3 * HEIGHT // 4 + 20 :, WIDTH // 2] - 1).max() < 0.05, "the road keeps its depth"


def test_a_cars_depth_ends_with_it() -> None:
    images, depth = drive(ahead(step=0.0))
    noise = np.random.default_rng(1).uniform(0.1, 0.9, (3, 24, 60)).astype(np.float32).repeat(2, 1).repeat(2, 2)
    rows = slice(HEIGHT // 2 - 8, HEIGHT // 2 + 40)
    for i, image in enumerate(images):
        image[:] = 0.5 + 0.1 * (image - 0.5)  # few edges that depth would end at
        image[:, rows, 40 + 5 * i : 160 + 5 * i] = noise
    left, right = 40 + 5 * (len(images) - 1), 160 + 5 * (len(images) - 1)
    found, around = motion_depth(images, K), np.r_[left - 30 : left - 8, right + 8 : right + 30]
    road = np.s_[0, HEIGHT // 2 + 20 : HEIGHT // 2 + 36, WIDTH // 2]
    level = found.depth[0, HEIGHT // 2 + 20 : HEIGHT // 2 + 36][:, around]
    assert np.median(np.abs(level / depth[road][:, None] - 1)) < 0.05


def test_a_wrong_start_does_not_decide_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = ahead()
    images, _ = drive(poses)
    flow = correspond(images[-1], images[-2])
    aside = np.eye(4)  # a turn and a step aside look much like a drive ahead
    aside[:3, :3], aside[:3, 3] = cv2.Rodrigues(np.array([0.0, -0.02, 0.0]))[0], (0.95, 0.0, 0.3)
    monkeypatch.setattr(motion_pose, "_five_points", lambda *args: aside)
    found = motion_pose.relative_pose(flow, K).dst_from_src
    true = np.linalg.inv(poses[-2]) @ poses[-1]
    assert np.abs(found[:3, 3] - true[:3, 3] / np.linalg.norm(true[:3, 3])).max() < 0.05
    assert np.abs(found[:3, :3] - true[:3, :3]).max() < 1e-3


def test_pure_rotation_has_no_translation() -> None:
    poses = [pose(0.01 * i) for i in range(4)]
    found = motion_depth(drive(poses)[0], K)
    check_complete(found)
    assert not found.prev_from_cur[:3, 3].any()
    assert np.abs(found.prev_from_cur - np.linalg.inv(poses[-2]) @ poses[-1]).max() < 1e-3


def test_stop_after_a_drive_keeps_the_depth() -> None:
    poses = ahead(frames=3)
    images, depth = drive([*poses, poses[-1]])
    found = motion_depth(images, K)
    assert not found.prev_from_cur[:3, 3].any()
    assert np.median(off(found.depth, depth)) < 0.1


def test_car_that_keeps_its_distance_is_on_the_road() -> None:
    """It does not move in the image, as if it were infinitely far away."""
    poses = ahead()
    images, depth = drive(poses, [at[2, 3] + 10.0 for at in poses])
    found = motion_depth(images, K)
    car = np.abs(depth - 10) < 1e-3
    car[0, : HEIGHT // 2 + 8] = False  # its roof is hard to tell from what is behind it
    assert np.median(off(found.depth, depth)[car]) < 0.15


def test_nothing_to_see() -> None:
    found = motion_depth([np.full((3, HEIGHT, WIDTH), 0.5, np.float32)] * 2, K)
    check_complete(found)
    assert np.array_equal(found.prev_from_cur, np.eye(4)) and not found.confidence.any()


def test_images_without_common_content() -> None:
    rng = np.random.default_rng(0)
    found = motion_depth([rng.random((3, HEIGHT, WIDTH), np.float32) for _ in range(3)], K)
    check_complete(found)
    assert np.linalg.norm(found.prev_from_cur[:3, 3]) < 6.001


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": [np.zeros((3, 20, 20))]}, "`images` must be two or more, got 1"),
        ({"images": [np.zeros((3, 20, 20)), np.zeros((3, 20, 21))]}, r"`images\[1\]` must be \[3, 20, 20\]"),
        ({"images": [np.zeros((3, 20, 20)), np.full((3, 20, 20), np.nan)]}, r"`images\[1\]` must be finite"),
        ({"K": np.eye(4)}, r"`K` must be \[3, 3\], got \[4, 4\]"),
        ({"camera_height": 0.0}, "`camera_height` must be above 0 m, got 0"),
    ],
)
def test_errors(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"images": [np.zeros((3, 20, 20))] * 2, "K": K} | change
    with pytest.raises(ValueError, match=message):
        motion_depth(**arguments)


def prev_from_cur(clip: Clip, index: int) -> np.ndarray:
    """By the clip's own poses."""
    prev, cur = clip[index - 1].world_from_cam, clip[index].world_from_cam
    assert prev is not None and cur is not None
    return np.linalg.inv(prev) @ cur


def test_correspondence_may_be_given() -> None:
    images, _ = drive(ahead())
    known = correspond(images[-1], images[-2])
    assert np.array_equal(motion_depth(images, K, correspondence=known).depth, motion_depth(images, K).depth)


def test_street() -> None:
    clip = street_clip(Street.generate(3), 4, 128, 320, samples=2)
    last = clip[3]
    found = motion_depth([sample.read_image() for sample in clip], last.K, camera_height=1.65)
    depth = last.read_depth()
    near = depth < 60
    assert np.median(off(found.depth, depth)[near]) < 0.15
    true = prev_from_cur(clip, 3)
    assert np.abs(found.prev_from_cur[:3, 3] - true[:3, 3]).max() < 0.15 * np.linalg.norm(true[:3, 3])
    sky = last.read_labels() == SKY
    assert (found.depth[sky] == SKY_DEPTH).mean() > 0.8


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b) ** 2).mean()))


def test_motorway_forecast_beats_repeating() -> None:
    """The next frame of a plain video, warped by the depth and the extrapolated motion."""
    clip = open_video(real("highway.mp4"))
    images = [clip[i].read_image() for i in range(27, 32)]
    found = motion_depth(images[:-1], clip[0].K)
    assert 0.5 < found.prev_from_cur[2, 3] < 1.5, "a motorway's speed at 25 frames per second"
    motion = constant_velocity([np.asarray(np.linalg.inv(found.prev_from_cur), np.float64)])
    shape = np.zeros((2, *found.depth.shape[1:]), np.float32)
    flow = torch.from_numpy((rigid_pixels(found.depth, clip[0].K, motion) - moved_pixels(shape)).astype(np.float32))[
        None
    ]
    back = torch.zeros_like(flow)
    for _ in range(5):  # b(p) = -f(p + b(p)) by iteration
        back = -optical_flow.backward_warp(flow, back)
    warped = optical_flow.backward_warp(torch.from_numpy(images[-2])[None], back)[0].numpy()
    assert psnr(warped, images[-1]) > psnr(images[-2], images[-1]) + 1


def test_real_street_against_its_stereo_pair() -> None:
    clip = open_kitti_odometry(real("kitti_odometry"))
    found = motion_depth([clip[i].read_image() for i in range(17, 21)], clip[20].K, camera_height=1.65)
    sample = clip[20]
    assert sample.right is not None
    stereo = stereo_depth(
        sample.read_image(), sample.right.read_image(), sample.K, sample.right.right_from_left, fill=False
    )
    known = (stereo > 0) & (stereo < 80)
    assert np.median(off(found.depth[known], stereo[known])) < 0.12
    true = prev_from_cur(clip, 20)
    assert abs(np.linalg.norm(found.prev_from_cur[:3, 3]) / np.linalg.norm(true[:3, 3]) - 1) < 0.1

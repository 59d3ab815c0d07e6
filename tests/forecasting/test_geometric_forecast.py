"""vestcl.forecasting.geometric.forecast: a street's next frames, against what it really shows."""

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from data_files import pose
from geometric_scenes import HEIGHT, WIDTH, Matrix, decibels, drive, move, points

from vestcl.data import intrinsics
from vestcl.data.sample import Clip
from vestcl.forecasting.geometric.clouds import frame_clouds
from vestcl.forecasting.geometric.forecast import METHOD, forecast_clip, forecast_frames, show_frame
from vestcl.forecasting.geometric.paths import point_paths
from vestcl.forecasting.geometric.render import holes, show
from vestcl.forecasting.result import Forecast, View
from vestcl.scene.flow.correspondence import correspond
from vestcl.scene.motion.camera_forecast import forecast_camera
from vestcl.scene.perception import Perception

LEFT, RIGHT = View("left", np.eye(4)), View("right", pose(xyz=(-0.54, 0, 0)))

#: The current frame, and how many are forecast.
NOW, STEPS = 3, 3

#: A plain drive, and one past an oncoming car that fills a tenth of the image: seed and start, seconds.
PLAIN, PASSING = (4, 0.0), (0, 1.3)


@functools.cache
def perception(seed: int, start: float) -> Perception:
    return Perception(drive(seed, start=start, samples=2).clip)


def true_cameras(clip: Clip) -> list[Matrix]:
    """future_from_cur."""
    now = clip[NOW].world_from_cam
    assert now is not None
    futures = [clip[NOW + step].world_from_cam for step in range(1, STEPS + 1)]
    return [np.linalg.inv(future) @ now for future in futures if future is not None]


@functools.cache
def forecast(seed: int, start: float, true_poses: bool = False) -> Forecast:
    seen = perception(seed, start)
    cameras = true_cameras(seen.clip) if true_poses else None
    return forecast_frames(seen, NOW, STEPS, [LEFT, RIGHT], future_from_cur=cameras)


def same_bits(first: Forecast, second: Forecast) -> bool:
    parts = ("image", "depth", "coverage", "motion_xyz")
    pairs = [(a[name], b[name]) for a, b in zip(first.frames, second.frames, strict=True) for name in a]
    return all(np.array_equal(getattr(a, part), getattr(b, part)) for a, b in pairs for part in parts)


# ---------------------------------------------------------------- against the truth


@pytest.mark.parametrize("true_poses", [False, True])
@pytest.mark.parametrize("scene", [PLAIN, PASSING])
def test_better_than_the_last_frame_again(scene: tuple[int, float], true_poses: bool) -> None:
    """By 3 dB and more at every step, of about 14."""
    clip, result = perception(*scene).clip, forecast(*scene, true_poses)
    for step in range(1, STEPS + 1):
        wanted = clip[NOW + step].read_image()
        repeated = decibels(clip[NOW].read_image(), wanted)
        assert decibels(result.frames[step - 1]["left"].image, wanted) > repeated + 3


def test_true_cameras_are_taken() -> None:
    cameras = true_cameras(perception(*PLAIN).clip)
    given = forecast(*PLAIN, True).future_from_cur
    assert all(np.array_equal(a, b) for a, b in zip(given, cameras, strict=True))


def test_cameras_are_forecast_from_the_motions_before() -> None:
    cameras, seen = forecast(*PLAIN).future_from_cur, perception(*PLAIN)
    motions = [np.linalg.inv(seen.prev_from_cur(index)) for index in range(max(NOW - 3, 1), NOW + 1)]
    wanted = forecast_camera(motions, [0.1] * len(motions), [0.1, 0.2, 0.3])
    np.testing.assert_allclose(cameras[:3], wanted, atol=1e-6)
    np.testing.assert_allclose(cameras[0][:3, 3], true_cameras(perception(*PLAIN).clip)[0][:3, 3], atol=0.1)


def test_a_moving_car_drives_on() -> None:
    """Its motion is off by less than a fifth of what it would be had it stopped, and it is 5 dB nearer in colour."""
    scene, result = drive(PASSING[0], start=PASSING[1], samples=2), forecast(*PASSING)
    for step in range(1, STEPS + 1):
        sample, frame, car = scene.clip[NOW + step], result.frames[step - 1]["left"], scene.moving(NOW + step)
        assert car.mean() > 0.05
        truth = -scene.cur_to_next(NOW + step, NOW + step - 1)
        prev_from_cur = scene.camera(NOW + step - 1) @ np.linalg.inv(scene.camera(NOW + step))
        at = points(sample.read_depth(), sample.K)
        stopped = np.linalg.norm(at - move(prev_from_cur, at) - truth, axis=0)[car]
        off = np.linalg.norm(frame.motion_xyz - truth, axis=0)[car]
        assert np.median(off) < 0.2 * np.median(stopped)
        wanted = sample.read_image()
        last = decibels(scene.clip[NOW].read_image(), wanted, car)
        assert decibels(frame.image, wanted, car) > last + 5


@pytest.mark.parametrize("scene", [PLAIN, PASSING])
def test_motion_of_what_is_static(scene: tuple[int, float]) -> None:
    """To 5 cm of about 0.9 m at t+1, with the true cameras."""
    street, frame = drive(scene[0], start=scene[1], samples=2), forecast(*scene, True).frames[0]["left"]
    truth, still = -street.cur_to_next(NOW + 1, NOW), ~street.moving(NOW + 1) & (frame.depth[0] > 0)
    still &= street.clip[NOW + 1].read_depth()[0] < 40
    assert still.mean() > 0.5
    off = np.linalg.norm(frame.motion_xyz - truth, axis=0)[still]
    assert np.median(off) < 0.05 and np.median(np.linalg.norm(truth, axis=0)[still]) > 0.5


def test_depth_is_that_of_the_future_frame() -> None:
    truth, frame = perception(*PLAIN).clip[NOW + 1].read_depth(), forecast(*PLAIN, True).frames[0]["left"]
    near = (truth < 40) & (frame.depth > 0)
    assert near.mean() > 0.5 and np.median(np.abs(frame.depth / truth - 1)[near]) < 0.03


def test_what_the_frame_before_showed_is_at_its_place() -> None:
    """Its cloud only, two frame intervals on: 4 dB and more better than itself again, where it shows
    anything and in the oncoming car."""
    clip, cameras = perception(*PASSING).clip, true_cameras(perception(*PASSING).clip)
    seen = perception(*PASSING)
    before = frame_clouds(seen, NOW, point_paths(seen, NOW))[1](1, lambda step: [np.eye(4), *cameras][int(step)])
    shown = show([before], clip[NOW].K, np.eye(4), HEIGHT, WIDTH)
    seen, wanted = ~holes(shown)[0], clip[NOW + 1].read_image()
    assert seen.mean() > 0.5
    car = drive(PASSING[0], start=PASSING[1], samples=2).moving(NOW + 1) & seen
    assert car.mean() > 0.05
    for where in (seen, car):
        assert decibels(shown.planes[:3], wanted, where) > decibels(clip[NOW - 1].read_image(), wanted, where) + 4


def test_what_the_frame_before_puts_before_what_is_seen_is_left_out() -> None:
    """A patch of t-1 whose depth is too small by 40 % would stand before what t shows; what t does not show stays."""
    clip = drive(PLAIN[0], start=PLAIN[1], samples=2).clip
    depth = clip[NOW - 1].read_depth().copy()
    patch = np.zeros((1, HEIGHT, WIDTH), bool)
    patch[0, HEIGHT // 4 : HEIGHT // 2, WIDTH // 4 : WIDTH // 2] = True
    wrong = np.where(patch, np.float32(0.6) * depth, depth)
    counts = []
    for each in (depth, wrong):
        samples = list(clip.samples)
        samples[NOW - 1] = replace(clip[NOW - 1], depth=Given(each))
        seen = Perception(replace(clip, samples=tuple(samples)))
        cloud = frame_clouds(seen, NOW, point_paths(seen, NOW))[1](1, lambda step: np.eye(4))
        kept = np.zeros((HEIGHT, WIDTH), bool)
        kept[cloud.rows, cloud.columns] = True
        counts.append((kept[patch[0]].mean(), kept[~patch[0]].mean()))
    (right, elsewhere), (refuted, same) = counts
    assert right > 0.9 and refuted < right / 2  # the rest lies behind walls that are nearer there
    assert elsewhere > 0.9 and abs(same - elsewhere) < 0.02


@dataclass(frozen=True)
class Given:
    """A depth map."""

    depth: Any
    height: int = HEIGHT
    width: int = WIDTH

    def read(self) -> Any:
        return self.depth


@dataclass(frozen=True)
class Exposed:
    """An image of another exposure, 8 bit."""

    source: Any
    gain: float
    height: int = HEIGHT
    width: int = WIDTH

    def read(self) -> Any:
        return np.float32(np.round((self.gain * self.source.read()).clip(0, 1) * 255) / 255)


@pytest.mark.parametrize("gain", [1.2, 1 / 1.2])
def test_what_the_frame_before_showed_is_as_bright_as_the_current_one(gain: float) -> None:
    """Auto exposure: the frames up to t - 1 are brighter or darker than what follows."""
    clip = perception(*PASSING).clip
    earlier = [replace(sample, image=Exposed(sample.image, gain)) for sample in clip.samples[:NOW]]
    jump = replace(clip, samples=(*earlier, *clip.samples[NOW:]))
    before = frame_clouds(seen := Perception(jump), NOW, point_paths(seen, NOW))[1](1, lambda step: np.eye(4)).image
    wanted = clip[NOW - 1].read_image()
    unclipped = gain * wanted < 0.95
    assert np.abs(before - wanted)[unclipped].mean() < 0.01
    frame, same = forecast_clip(jump, NOW, 1, [LEFT]).frames[0]["left"].image, forecast(*PASSING).frames[0]["left"]
    wanted = clip[NOW + 1].read_image()
    assert decibels(frame, wanted) > decibels(same.image, wanted) - 0.3


# ---------------------------------------------------------------- views


def test_the_right_camera_sees_what_is_near_further_left() -> None:
    """By f b / z, as flow from the one view to the other measures it."""
    frame = forecast(*PLAIN, True).frames[0]
    flow = correspond(frame["left"].image, frame["right"].image)
    disparity = intrinsics(HEIGHT, WIDTH)[0, 0] * 0.54 / np.where(frame["left"].depth > 0, frame["left"].depth, np.inf)
    sure = (flow.error < 0.5) & (disparity > 5)
    assert sure.mean() > 0.2
    np.testing.assert_allclose(np.median(flow.flow_uv[0][sure[0]] / -disparity[sure]), 1, atol=0.05)


def test_the_right_view_is_what_the_right_camera_sees() -> None:
    clip, result = perception(*PLAIN).clip, forecast(*PLAIN)
    for step in range(1, STEPS + 1):
        right = clip[NOW + step].right
        assert right is not None
        wanted, frame = right.read_image(), result.frames[step - 1]
        assert decibels(frame["right"].image, wanted) > decibels(frame["left"].image, wanted) + 3


def test_a_view_with_a_camera_of_its_own() -> None:
    """The principal point 12 px further right moves the image as far."""
    K = intrinsics(HEIGHT, WIDTH)
    K[0, 2] += 12
    shifted = forecast_frames(perception(*PLAIN), NOW, 1, [View("shifted", np.eye(4), K)]).frames[0]["shifted"]
    plain = forecast(*PLAIN).frames[0]["left"]
    seen = plain.coverage[0, :, 2:-14] > 0.5  # what fills the holes depends on all of the image
    off = np.abs(shifted.image[:, :, 14:-2] - plain.image[:, :, 2:-14])[:, seen]
    assert np.quantile(off, 0.99) < 1e-3
    np.testing.assert_allclose(shifted.coverage[:, :, 14:-2], plain.coverage[:, :, 2:-14], atol=1e-2)


def test_what_a_forecast_holds() -> None:
    result = forecast(*PLAIN)
    assert result.method == METHOD and len(result.frames) == len(result.future_from_cur) == STEPS
    assert {"read", "flow", "depth", "layers", "render"} <= set(result.seconds)
    for frame in (view for step in result.frames for view in step.values()):
        for part, channels in (("image", 3), ("depth", 1), ("coverage", 1), ("motion_xyz", 3)):
            plane = getattr(frame, part)
            assert plane.shape == (channels, HEIGHT, WIDTH) and plane.dtype == np.float32
            assert np.isfinite(plane).all()
        assert frame.image.min() >= 0 and frame.image.max() <= 1
        assert frame.coverage.min() >= 0 and frame.coverage.max() <= 1 and (frame.depth >= 0).all()
    assert [set(step) for step in result.frames] == [{"left", "right"}] * STEPS


# ---------------------------------------------------------------- what it may look at


@dataclass(frozen=True)
class Unread:
    """An image that no one may look at."""

    height: int = HEIGHT
    width: int = WIDTH

    def read(self) -> Any:
        raise AssertionError("the future was read")


def test_the_future_is_never_looked_at() -> None:
    """Images that raise when read, and poses of another drive."""
    clip = perception(*PLAIN).clip
    nowhere = pose(1.0, (5, 5, 5))
    blind: dict[str, Any] = {name: Unread() for name in ("image", "depth", "labels")}
    hidden = [replace(s, **blind, right=None, world_from_cam=nowhere) for s in clip.samples[NOW + 1 :]]
    unknown = forecast_clip(replace(clip, samples=(*clip.samples[: NOW + 1], *hidden)), NOW, STEPS, [LEFT, RIGHT])
    assert same_bits(unknown, forecast(*PLAIN))


def test_it_needs_no_poses_at_all() -> None:
    clip = perception(*PLAIN).clip
    lost = replace(clip, samples=tuple(replace(s, world_from_cam=None) for s in clip))
    assert same_bits(forecast_clip(lost, NOW, 1, [LEFT]), forecast_clip(clip, NOW, 1, [LEFT]))


def test_a_pair_is_enough() -> None:
    """Neither depth nor labels: still 2 dB better than the last frame again."""
    clip = perception(*PASSING).clip
    bare = replace(clip, samples=tuple(replace(s, depth=None, labels=None, world_from_cam=None) for s in clip))
    wanted = clip[NOW + 1].read_image()
    got = forecast_clip(bare, NOW, 1, [LEFT]).frames[0]["left"].image
    assert decibels(got, wanted) > decibels(clip[NOW].read_image(), wanted) + 2


def test_from_the_second_frame_on() -> None:
    clip = perception(*PLAIN).clip
    wanted = clip[2].read_image()
    got = forecast_clip(clip[:2], 1, 1, [LEFT]).frames[0]["left"].image
    assert decibels(got, wanted) > decibels(clip[1].read_image(), wanted) + 3


def test_progress() -> None:
    reported: list[tuple[str, float]] = []
    forecast_clip(perception(*PLAIN).clip, NOW, 2, [LEFT, RIGHT], progress=lambda *stage: reported.append(stage))
    stages, shares = zip(*reported, strict=True)
    assert stages[-4:] == ("render",) * 4 and "layers" in stages[:-4]
    assert list(shares) == sorted(shares) and shares[0] == 0 and 0.8 < shares[-1] <= 1


def test_same_bits_twice() -> None:
    clip = perception(*PASSING).clip
    assert same_bits(forecast_clip(clip, NOW, 1, [RIGHT]), forecast_clip(clip, NOW, 1, [RIGHT]))


# ---------------------------------------------------------------- what it refuses


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"index": 0}, "`index` must be 1 ... 7, a frame of street 4 with one before, got 0"),
        ({"index": 8}, "`index` must be 1 ... 7, .* got 8"),
        ({"index": -1}, "`index` must be 1 ... 7, .* got -1"),
        ({"steps": 0}, "`steps` and `views` must be 1 or more, got 0 and 1"),
        ({"views": []}, "`steps` and `views` must be 1 or more, got 3 and 0"),
        ({"future_from_cur": [np.eye(4)]}, "`future_from_cur` must be .*3.*, got 1"),
    ],
)
def test_refuses(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"index": NOW, "steps": STEPS, "views": [LEFT]} | change
    with pytest.raises(ValueError, match=message):
        forecast_frames(perception(*PLAIN), **arguments)


def test_a_plain_video_beats_repeating_its_last_frame() -> None:
    clip = perception(*PLAIN).clip
    flat = replace(clip, samples=tuple(replace(s, depth=None, right=None, labels=None) for s in clip))
    shown = forecast_clip(flat, NOW, 1, [LEFT]).frames[0][LEFT.name].image
    truth, last = clip[NOW + 1].read_image(), clip[NOW].read_image()
    assert np.square(shown - truth).mean() < 0.5 * np.square(last - truth).mean()


@pytest.mark.parametrize("without", [(NOW,), (NOW - 1,), (NOW - 2, NOW - 1)])
def test_frames_without_depth_between_others(without: tuple[int, ...]) -> None:
    """Where a scan is missing depth is from motion, and flow itself is either a candidate in all tests or in none."""
    clip = drive(PLAIN[0], start=PLAIN[1], samples=1).clip
    known = [replace(sample, right=None, depth=None if i in without else sample.depth) for i, sample in enumerate(clip)]
    made = forecast_clip(replace(clip, samples=tuple(known)), NOW, 2, [LEFT])
    assert decibels(made.frames[0]["left"].image, clip[NOW + 1].read_image()) > 15


def test_the_backtest_is_a_stage_and_done_once() -> None:
    """Two forecasts of a frame share it; the frame itself, shown from the side, needs none."""
    clip = drive(PLAIN[0], start=PLAIN[1], samples=1).clip
    shown = Perception(clip)
    show_frame(shown, NOW, [RIGHT])
    assert "backtest" not in shown.seconds
    seen = Perception(clip)
    seconds = [forecast_frames(seen, NOW, 1, [LEFT]).seconds["backtest"] for _ in range(2)]
    assert 0 < seconds[0] == seconds[1]

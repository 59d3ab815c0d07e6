"""vestcl.evaluation.street: truth formulas by construction."""

import numpy as np
import pytest

from vestcl.data import Street, street_clip
from vestcl.data.calibration import invert
from vestcl.data.sample import Clip, Sample
from vestcl.evaluation import street as known
from vestcl.evaluation.motion import ego_errors, true_motion
from vestcl.evaluation.scores import SOURCE
from vestcl.forecasting.result import Forecast, Rendered
from vestcl.io.labels import SKY

SIZE = 64, 208


def clip_of_street(seed: int = 3, frames: int = 6, samples: int = 1) -> Clip:
    return street_clip(Street.generate(seed), frames, *SIZE, samples=samples)


def rendered(image: np.ndarray, motion: np.ndarray | None = None, depth: np.ndarray | None = None) -> Rendered:
    plane = np.ones((1, *image.shape[1:]), np.float32)
    step = np.zeros_like(image) if motion is None else motion
    return Rendered(image, plane if depth is None else depth, plane, step)


def true_forecast(clip: Clip, index: int, steps: int, offset: float = 0.0) -> Forecast:
    """What is true, its 3D motion ``offset`` metres wrong in every pixel."""
    shift = np.array([0, offset, 0], np.float32)[:, None, None]
    motions = true_motion(clip, index, steps)
    assert motions is not None
    frames = [
        {SOURCE: rendered(clip[index + k].read_image(), known.step_truth(clip, index + k) + shift)}
        for k in range(1, steps + 1)
    ]
    return Forecast("truth", motions, frames)


def test_true_motion_brings_a_point_of_the_world_from_camera_to_camera() -> None:
    clip = clip_of_street()
    motions = true_motion(clip, 1, 3)
    assert motions is not None and len(motions) == 3
    point = np.array([1.0, -2.0, 30.0, 1.0])
    for step, motion in enumerate(motions, start=1):
        poses = clip[1].world_from_cam, clip[1 + step].world_from_cam
        assert poses[0] is not None and poses[1] is not None
        np.testing.assert_allclose(poses[1] @ motion @ point, poses[0] @ point, atol=1e-9)
        assert motion[2, 3] < -0.5 * step  # driving forward, 8 m/s and more


def test_true_motion_needs_every_pose() -> None:
    bare = Sample.from_arrays("0", np.zeros((3, 8, 8)), np.eye(3))
    assert true_motion(Clip("bare", "arrays", (bare, bare)), 0, 1) is None


def test_step_truth_is_the_cameras_motion_where_nothing_moves() -> None:
    clip = clip_of_street()
    cur, prev = clip[3], clip[2]
    assert cur.world_from_cam is not None and prev.world_from_cam is not None
    v, u = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    points = np.einsum("ij,jhw->ihw", np.linalg.inv(cur.K), np.stack([u, v, np.ones_like(u)])) * cur.read_depth()
    before = invert(prev.world_from_cam) @ cur.world_from_cam
    static = cur.read_mask()[0] & (cur.read_labels()[0] != SKY)
    wanted = points - (np.einsum("ij,jhw->ihw", before[:3, :3], points) + before[:3, 3, None, None])
    np.testing.assert_allclose(known.step_truth(clip, 3)[:, static], wanted[:, static], atol=1e-3)
    assert known.step_truth(clip, 3)[2][static].mean() < -0.5  # static points come nearer


def test_motion_errors_are_what_was_put_in() -> None:
    clip = clip_of_street()
    errors = known.motion_errors(true_forecast(clip, 1, 2, offset=0.25), clip, 1, SOURCE)
    np.testing.assert_allclose(errors["motion_m"], 0.25, atol=1e-5)
    np.testing.assert_allclose(errors["motion_known"], 1.0)
    moving = np.array(errors["moving_m"])
    np.testing.assert_allclose(moving[~np.isnan(moving)], 0.25, atol=1e-5)
    assert not np.isnan(moving).all()


def test_pixels_without_a_motion_count_as_unknown() -> None:
    clip = clip_of_street()
    frame = true_forecast(clip, 1, 1).frames[0][SOURCE]
    depth = np.zeros((1, *SIZE), np.float32)
    depth[:, :, 100:] = 1
    half = Rendered(frame.image, depth, frame.coverage, np.where(depth > 0, frame.motion_xyz, np.float32(9)))
    errors = known.motion_errors(Forecast("half", [], [{SOURCE: half}]), clip, 1, SOURCE)
    solid = clip[2].read_labels() != SKY
    assert errors["motion_m"][0] == pytest.approx(0, abs=1e-6)
    assert errors["motion_known"][0] == pytest.approx(solid[:, :, 100:].sum() / solid.sum())


def test_ego_errors_by_hand() -> None:
    truth = np.eye(4)
    truth[2, 3] = -2.0
    estimate = truth.copy()
    estimate[0, 3] = 0.1
    at_rest = np.eye(4)
    errors = ego_errors(Forecast("", [estimate, at_rest], []), [truth, at_rest])
    assert errors["translation_percent"][0] == pytest.approx(5.0)
    assert np.isnan(errors["translation_percent"][1]) and errors["rotation_deg"] == [0.0, 0.0]


def test_the_splatter_is_close_to_warping() -> None:
    values = known.splatter_alone(clip_of_street(samples=2), 2)
    loss = values["warped_db"][0] - values["splatted_db"][0]
    assert values["splatter_loss_db"] == [pytest.approx(loss)]
    assert loss < 3 and values["warped_db"][0] > 20 and 0.7 < values["seen"][0] < 1


def test_only_streets_have_all_truth() -> None:
    bare = Sample.from_arrays("0", np.zeros((3, 8, 8)), np.eye(3))
    clip = Clip("bare", "arrays", (bare, bare))
    assert known.shot(bare) is None
    with pytest.raises(ValueError, match="must be of a street"):
        known.step_truth(clip, 1)

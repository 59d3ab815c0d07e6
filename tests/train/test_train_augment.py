"""train.data.augment: images, cameras and motions change together."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from geometric_scenes import turned
from numpy.typing import NDArray
from test_network_input import HEIGHT, MOTIONS, WIDTH, prepared

from train.data import augment
from train.data.augment import TrainingWindow
from vestcl import geometry, reference
from vestcl.forecasting.network.input import last_motions, network_input
from vestcl.models import EgoMotion, RigidMotion
from vestcl.models.config import EgoMotionConfig
from vestcl.scene.motion.ego_motion import constant_velocity

#: A camera that stands to the right of the source, turned a little, with other intrinsics and a skew.
TGT_FROM_NEXT = turned(0.01, 0.02, -0.01, (-0.54, 0.02, 0.01))
TARGET_K = np.array([[22.0, 0.3, 5.9], [0, 20.5, 4.4], [0, 0, 1]])

Change = tuple[Callable[[TrainingWindow], TrainingWindow], Callable[[float, float], tuple[float, float]], float]
"""A change, where it takes a point of the image, and the sign of x in the changed world."""

CHANGES: dict[str, Change] = {
    "crop": (lambda window: augment.crop(window, 2, 3, 5, 7), lambda u, v: (u - 3, v - 2), 1),
    "flip": (augment.flip, lambda u, v: (WIDTH - u, v), -1),
    "resize": (lambda window: augment.resize(window, 6, 9), lambda u, v: (u * 9 / WIDTH, v * 6 / HEIGHT), 1),
    "crop, resize, flip": (
        lambda window: augment.flip(augment.resize(augment.crop(window, 1, 2, 6, 9), 4, 7)),
        lambda u, v: (7 - (u - 2) * 7 / 9, (v - 1) * 4 / 6),
        -1,
    ),
}


@pytest.fixture
def window() -> TrainingWindow:
    """Two random frames, the bonnet in both, and a target from the side."""
    target = np.random.default_rng(9).random((3, HEIGHT, WIDTH), np.float32)
    prev, cur = prepared(0, MOTIONS[0], own=True), prepared(1, MOTIONS[1], own=True)
    path = MOTIONS[1], MOTIONS[0] @ MOTIONS[1]
    return TrainingWindow(prev, cur, target, TARGET_K, TGT_FROM_NEXT, path[1], path)


def shown_at(window: TrainingWindow, xyz: NDArray[Any], velocity: NDArray[Any]) -> NDArray[np.float64]:
    """Where the target shows, by the prior, a point of the current camera that moves at ``velocity``: (u, v) px."""
    next_from_cur = constant_velocity(last_motions(window.prev, window.cur))
    tgt_from_cur = window.tgt_from_next @ next_from_cur
    u, v, z = window.target_K @ (tgt_from_cur[:3, :3] @ (xyz + velocity) + tgt_from_cur[:3, 3])
    return np.array([u / z, v / z])


@pytest.mark.parametrize("name", CHANGES)
def test_points_are_projected_to_where_the_changed_target_shows_them(window: TrainingWindow, name: str) -> None:
    change, moved, sign = CHANGES[name]
    changed, side = change(window), np.array([sign, 1, 1])
    for u, v, z in ((4.5, 3.5, 6.0), (8.5, 5.5, 30.0), (6.25, 2.75, 11.0)):
        velocity = np.array([0.3, -0.1, 0.7])
        xyz = np.linalg.inv(window.cur.K) @ [u, v, 1] * z
        xyz_changed = np.linalg.inv(changed.cur.K) @ [*moved(u, v), 1] * z
        np.testing.assert_allclose(xyz_changed, side * xyz, rtol=0, atol=1e-10)
        wanted = moved(*shown_at(window, xyz, velocity))
        np.testing.assert_allclose(shown_at(changed, xyz_changed, side * velocity), wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", CHANGES)
def test_true_motion_changes_as_the_cameras_do(window: TrainingWindow, name: str) -> None:
    changed = CHANGES[name][0](window)
    assert window.future_from_cur is not None and changed.future_from_cur is not None
    composed = np.linalg.multi_dot(last_motions(changed.prev, changed.cur))
    np.testing.assert_allclose(changed.future_from_cur, composed, rtol=0, atol=1e-12)
    first, second = changed.path_from_cur
    assert np.array_equal(second, changed.future_from_cur)
    np.testing.assert_allclose(first, last_motions(changed.cur)[0], rtol=0, atol=1e-12)


def test_planes_are_cut_and_mirrored_equally(window: TrainingWindow) -> None:
    cut, mirrored = augment.crop(window, 2, 3, 5, 7), augment.flip(window)
    for frame in ("prev", "cur"):
        whole, part, other = (getattr(each, frame) for each in (window, cut, mirrored))
        for name, planes in vars(whole.layers).items():
            assert np.array_equal(getattr(part.layers, name), planes[:, 2:7, 3:10])
            assert np.array_equal(getattr(other.layers, name), planes[..., ::-1])
        assert np.array_equal(part.velocity, whole.velocity[:, 2:7, 3:10])
        assert np.array_equal(other.velocity, np.stack([-1, 1, 1])[:, None, None] * whole.velocity[..., ::-1])
        assert np.array_equal(part.own, whole.own[:, 2:7, 3:10]) and np.array_equal(other.own, whole.own[..., ::-1])
    assert np.array_equal(cut.target, window.target[:, 2:7, 3:10])
    assert np.array_equal(mirrored.target, window.target[..., ::-1])
    assert cut.size == (5, 7) and mirrored.size == window.size


def test_mirrored_motions_have_the_quaternions_of_a_mirror(window: TrainingWindow) -> None:
    prior, mirrored = (
        network_input(each.prev, each.cur, last_motions(each.prev, each.cur)).prior
        for each in (window, augment.flip(window))
    )
    for before, after in zip(prior[:3], mirrored[:3], strict=True):
        torch.testing.assert_close(after.quaternion, before.quaternion * torch.tensor([1.0, 1, -1, -1]))
        torch.testing.assert_close(after.translation, before.translation * torch.tensor([-1.0, 1, 1]))
    sides = torch.tensor([-1.0, 1, 1])[:, None, None]  # of the bonnet's velocities, which follow from the motion, too
    torch.testing.assert_close(mirrored.velocity_prev, prior.velocity_prev.flip(3) * sides, rtol=0, atol=1e-5)
    torch.testing.assert_close(mirrored.velocity_cur, prior.velocity_cur.flip(3) * sides, rtol=0, atol=1e-5)


def test_a_camera_sways_in_the_mirror_as_before_it(window: TrainingWindow) -> None:
    """Turns about x and shifts along y and z stay, all others change sign: weights that mix neither kind with the
    other forecast the mirrored path from mirrored motions."""
    network = EgoMotion(EgoMotionConfig(widths=(8, 8, 8, 8), blocks=1, heads=2, path=2), 4, "prior").double()
    assert network.swayed is not None
    signs = torch.tensor([1.0, -1, -1, -1, 1, 1]).repeat(2).double()
    with torch.no_grad():
        network.swayed.weight.copy_(torch.randn(12, 12) * (signs[:, None] == signs))
    paths = []
    for each in (window, augment.flip(window)):
        prior = network_input(each.prev, each.cur, last_motions(each.prev, each.cur)).prior
        grid, plane = torch.rand(1, 4, 2, 3).double(), torch.ones(1, 1, 2, 3).double()
        motions = [RigidMotion(*(part.double() for part in motion)) for motion in prior[:3]]
        answer = network(grid, grid, plane, plane, plane, plane, (motions[0], motions[1], motions[2]))
        paths.append([geometry.compose_rigid(*motion)[0].detach() for motion in (answer.next_from_cur, *answer.later)])
        assert not torch.allclose(paths[-1][0], geometry.compose_rigid(*motions[0])[0], atol=1e-3)
    mirror = torch.diag(torch.tensor([-1.0, 1, 1, 1])).double()
    for before, after in zip(*paths, strict=True):
        torch.testing.assert_close(after, mirror @ before @ mirror, rtol=0, atol=1e-6)  # the prior is float32


def test_a_right_camera_becomes_a_left_one(window: TrainingWindow) -> None:
    assert augment.flip(window).tgt_from_next[0, 3] == -window.tgt_from_next[0, 3] > 0


def test_flipped_twice_a_window_is_as_before(window: TrainingWindow) -> None:
    twice = augment.flip(augment.flip(window))
    for before, after in ((window.prev, twice.prev), (window.cur, twice.cur)):
        for name, planes in vars(before.layers).items():
            assert np.array_equal(getattr(after.layers, name), planes)
        assert np.array_equal(after.velocity, before.velocity) and np.array_equal(after.own, before.own)
        np.testing.assert_allclose(after.K, before.K, rtol=0, atol=1e-14)
        assert before.prev_from_cur is not None and after.prev_from_cur is not None
        assert np.array_equal(after.prev_from_cur, before.prev_from_cur)
    assert np.array_equal(twice.target, window.target) and np.array_equal(twice.tgt_from_next, window.tgt_from_next)
    np.testing.assert_allclose(twice.target_K, window.target_K, rtol=0, atol=1e-14)
    assert np.array_equal(twice.path_from_cur, window.path_from_cur)


def splatted(window: TrainingWindow) -> torch.Tensor:
    """[1, 3, H, W]: the current frame as the target's camera will see it by the prior, in float64."""
    frame = window.cur
    depth, K, target_K = (torch.from_numpy(array.copy()).double()[None] for array in (
        frame.layers.depth, frame.K, window.target_K,
    ))  # fmt: skip
    colours, velocity = (
        torch.from_numpy(planes.copy()).double().flatten(1).mT[None] for planes in (frame.layers.image, frame.velocity)
    )
    points_xyz = reference.unproject(depth, K)
    next_from_cur = torch.from_numpy(constant_velocity(last_motions(window.prev, frame)))[None]
    moved = geometry.transform_points(next_from_cur, points_xyz + velocity)
    target = torch.from_numpy(window.tgt_from_next)[None]
    points_uv, z = reference.displace(points_xyz, moved - points_xyz, target_K, target)
    radii = torch.full_like(z, 1.2)
    return reference.splat(points_uv, z, radii, 0.8 * torch.ones_like(z), colours, *window.size)[0]


def test_splat_of_the_flipped_window_is_the_flipped_splat(window: TrainingWindow) -> None:
    there, back = splatted(window), splatted(augment.flip(window)).flip(3)
    assert float(there.abs().mean()) > 0.05
    torch.testing.assert_close(back, there, rtol=0, atol=1e-9)


def test_shrinking_takes_means_of_images_and_pixels_of_all_else(window: TrainingWindow) -> None:
    small = augment.resize(window, HEIGHT // 2, WIDTH // 2)
    means = window.target.reshape(3, HEIGHT // 2, 2, WIDTH // 2, 2).mean(axis=(2, 4))
    np.testing.assert_allclose(small.target, means, rtol=0, atol=1e-6)
    assert np.array_equal(small.cur.layers.depth, window.cur.layers.depth[:, 1::2, 1::2])
    assert np.array_equal(small.cur.velocity, window.cur.velocity[:, 1::2, 1::2])
    assert small.cur.layers.mask.dtype == bool and small.size == (HEIGHT // 2, WIDTH // 2)
    assert augment.resize(window, HEIGHT, WIDTH) is window


def test_all_images_are_coloured_equally(window: TrainingWindow) -> None:
    change = augment.draw_colour(np.random.default_rng(4), 1.0, 0.4)
    coloured = augment.colour(window, change)
    assert np.array_equal(coloured.target, change(window.target))
    for before, after in ((window.prev, coloured.prev), (window.cur, coloured.cur)):
        assert np.array_equal(after.layers.image, change(before.layers.image))
        seen = before.layers.mask[0]
        assert np.array_equal(after.layers.background_image[:, seen], after.layers.image[:, seen])
        assert np.array_equal(after.layers.depth, before.layers.depth)
        assert after.layers.image.dtype == np.float32
    assert np.abs(coloured.target - window.target).mean() > 0.02


def test_colours_stay_in_range_and_without_strength_as_they_are(window: TrainingWindow) -> None:
    for seed in range(30):
        change = augment.draw_colour(np.random.default_rng(seed), 1.0, 0.5)
        image = change(window.target)
        assert image.min() >= 0 and image.max() <= 1 and np.ptp(image) > 0.2
        assert np.array_equal(image, augment.draw_colour(np.random.default_rng(seed), 1.0, 0.5)(window.target))
    nothing = augment.draw_colour(np.random.default_rng(0), 0.0, 0.5)
    np.testing.assert_allclose(nothing(window.target), window.target, rtol=0, atol=1e-6)


def test_greys_stay_grey_and_contrast_keeps_its_level() -> None:
    grey = np.full((3, 2, 2), 0.5, np.float32)
    for seed in range(10):
        change = augment.draw_colour(np.random.default_rng(seed), 1.0, 0.3)
        image = change(grey)
        assert np.ptp(image, axis=0).max() < 1e-6
        level = replace(change, gamma=1.0)(np.full((3, 1, 1), 0.3, np.float32))
        brightness = 1 + augment.BRIGHTNESS * np.random.default_rng(seed).uniform(-1, 1)
        np.testing.assert_allclose(level, 0.3 * brightness, rtol=0, atol=1e-6)


def test_luma_by_hand() -> None:
    image = np.zeros((3, 1, 2), np.float32)
    image[1, 0, 0] = 1
    assert augment.mean_luma(image) == pytest.approx(0.587 / 2)


def test_what_is_out_of_range_is_refused(window: TrainingWindow) -> None:
    with pytest.raises(ValueError, match="`crop` must lie in 8x12, got 5x7 at row 4, column 3"):
        augment.crop(window, 4, 3, 5, 7)
    with pytest.raises(ValueError, match="`crop` must lie in"):
        augment.crop(window, -1, 0, 5, 7)
    with pytest.raises(ValueError, match="`crop` must lie in"):
        augment.crop(window, 0, 0, 0, 7)
    with pytest.raises(ValueError, match=r"`strength` must be 0 \.\.\. 1, got 1\.5"):
        augment.draw_colour(np.random.default_rng(0), 1.5, 0.5)

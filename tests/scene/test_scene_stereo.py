"""vestcl.scene.depth.stereo on pairs made from known depth, and on real ones."""

from typing import Any

import cv2
import numpy as np
import pytest
import torch
from data_files import real
from numpy.typing import NDArray

from vestcl.data.open import open_sequence
from vestcl.scene.depth.stereo import stereo_depth
from vestcl.scene.flow.optical_flow import backward_warp

HEIGHT, WIDTH, FOCAL, BASELINE = 96, 256, 200.0, 0.5
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def rig(baseline: float = BASELINE) -> NDArray[np.float64]:
    right_from_left = np.eye(4)
    right_from_left[0, 3] = -baseline
    return right_from_left


def pair() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """A wall at 20 m (5 px) and before it a board at 5 m (20 px): left, right and depth."""
    noise = np.random.default_rng(0).random((2, HEIGHT, WIDTH + 20, 3), np.float32)
    wall, board = (cv2.GaussianBlur(texture, (0, 0), 1.0) for texture in noise)
    on_board = np.zeros((HEIGHT, WIDTH), bool)
    on_board[30:70, 120:170] = True
    left = np.where(on_board[..., None], board[:, 20:], wall[:, 20:])
    right = np.where(np.roll(on_board, -20, 1)[..., None], np.roll(board[:, 20:], -20, 1), np.roll(wall, -5, 1)[:, 20:])
    depth = np.where(on_board, FOCAL * BASELINE / 20, FOCAL * BASELINE / 5).astype(np.float32)
    return left.transpose(2, 0, 1), right.transpose(2, 0, 1), depth[None]


def test_wall_and_board() -> None:
    left, right, truth = pair()
    depth = stereo_depth(left, right, K, rig())
    assert depth.shape == (1, HEIGHT, WIDTH) and depth.dtype == np.float32
    wrong = np.abs(depth / truth - 1) > 0.05
    assert wrong.mean() < 0.02
    inside = np.s_[:, 34:66, 124:166]
    np.testing.assert_allclose(np.median(depth[inside]), 5, rtol=0.01)


def test_what_the_board_hides_from_the_right_has_the_depth_of_the_wall() -> None:
    left, right, _ = pair()
    assert np.median(stereo_depth(left, right, K, rig())[:, 40:60, 108:117]) == pytest.approx(20, rel=0.05)


def test_without_filling_the_check_leaves_holes_where_only_one_camera_sees() -> None:
    left, right, _ = pair()
    depth = stereo_depth(left, right, K, rig(), fill=False)
    assert (depth[:, 40:60, 108:117] == 0).mean() > 0.8
    assert (depth > 0).mean() > 0.8


@pytest.mark.parametrize("fill", [True, False])
def test_only_disparities_that_half_the_size_shows_are_searched(fill: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    left, right, _ = pair()
    create, searched = cv2.StereoSGBM.create, list[int]()

    def recorded(**settings: Any) -> cv2.StereoSGBM:
        searched.append(settings["numDisparities"])
        return create(**settings)

    monkeypatch.setattr(cv2.StereoSGBM, "create", recorded)
    depth = stereo_depth(left, right, K, rig(), max_disparity=112, fill=fill)
    assert searched == [64, 48]  # of 112 and half of it; the board has 20 px
    np.testing.assert_allclose(np.median(depth[:, 34:66, 124:166]), 5, rtol=0.01)


def test_far_is_a_limit() -> None:
    left, right, _ = pair()
    assert stereo_depth(left, right, K, rig(), far=10).max() == 10


def test_nothing_to_match() -> None:
    """An image against another's noise has no agreement worth the name; nothing breaks, and nothing is negative."""
    left, right = np.random.default_rng(1).random((2, 3, HEIGHT, WIDTH), np.float32)
    depth = stereo_depth(left, right, K, rig(), fill=False)
    assert np.isfinite(depth).all() and (depth >= 0).all() and (depth == 0).mean() > 0.5


def test_same_bits_twice() -> None:
    left, right, _ = pair()
    assert np.array_equal(stereo_depth(left, right, K, rig()), stereo_depth(left, right, K, rig()))


def test_real_pair_warps_onto_the_left() -> None:
    """KITTI odometry at full size: the right image warped by the depth is the left one, to 22 dB."""
    sample = open_sequence(real("kitti_odometry") / "sequences" / "06")[16]
    assert sample.right is not None
    left, right = sample.read_image(), sample.right.read_image()
    depth = stereo_depth(left, right, sample.K, sample.right.right_from_left)
    assert (depth > 0).all()
    disparity = sample.K[0, 0] * -sample.right.right_from_left[0, 3] / depth
    flow_uv = np.concatenate([-disparity, 0 * disparity]).astype(np.float32)
    warped = backward_warp(torch.from_numpy(right)[None], torch.from_numpy(flow_uv)[None])[0].numpy()
    in_right = np.arange(left.shape[2]) + 0.5 > disparity[0] + 1
    psnr = -10 * np.log10(((warped - left)[:, in_right] ** 2).mean())
    assert psnr > 22


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"left": np.zeros((1, 96, 256), np.float32)}, r"`left` must be \[3, H, W\], got \[1, 96, 256\]"),
        ({"right": np.zeros((3, 96, 255), np.float32)}, r"`right` must be \[3, 96, 256\], got \[3, 96, 255\]"),
        ({"left": np.full((3, 96, 256), np.nan)}, "`left` must be finite, got 73728 values that are not"),
        ({"K": np.eye(4)}, r"`K` must be \[3, 3\], got \[4, 4\]"),
        ({"right_from_left": rig(-0.5)}, "t_x < 0 .* got 0.5"),
        ({"right_from_left": rig() + 0.1 * np.eye(4)}, "rectified pair"),
        ({"max_disparity": 256}, "`max_disparity` must be 1 to 255 px, got 256"),
        ({"far": 0.0}, "`far` must be above 0 m, got 0.0"),
    ],
)
def test_refuses(change: dict[str, Any], message: str) -> None:
    left, right, _ = pair()
    arguments = {"left": left, "right": right, "K": K, "right_from_left": rig()} | change
    with pytest.raises(ValueError, match=message):
        stereo_depth(**arguments)

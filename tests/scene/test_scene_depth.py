"""vestcl.scene.depth: a network's depth and parallax combined in a corridor, and errors against scans."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from corridor_scenes import HEIGHT, WIDTH, K, ahead, drive, off
from data_files import pose, real

from vestcl.data.open import open_sequence
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.forecasting.geometric import Perception
from vestcl.scene.depth import combine_depth, depth_scores
from vestcl.scene.depth.from_motion import motion_depth
from vestcl.scene.depth.scores import DepthScores
from vestcl.scene.estimators import OnnxDepth, with_estimates

#: A network's errors that are the same over whole regions: 15 %, up on the left, down on the right.
SLOPE = np.linspace(0.85, 1.15, WIDTH)[None, None]


@pytest.fixture(scope="module")
def scene() -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Images of a drive, the last one's depth, and the true motion to the one before."""
    poses = ahead(frames=3)
    images, depth = drive(poses)
    return images, depth, np.linalg.inv(poses[-2]) @ poses[-1]


def test_the_network_gives_metres(scene: Any) -> None:
    images, depth, true = scene
    for scale in (0.5, 1.0, 3.0):
        found = combine_depth(scale * depth, images, K)
        assert np.linalg.norm(found.prev_from_cur[:3, 3]) == pytest.approx(
            scale * np.linalg.norm(true[:3, 3]), rel=0.05
        )
        assert np.median(off(found.depth, scale * depth)) < 0.02
        assert found.error is not None and found.error < 0.06


def test_parallax_corrects_what_is_wrong_over_whole_regions(scene: Any) -> None:
    images, depth, _ = scene
    network = (depth * SLOPE).astype(np.float32)
    found = combine_depth(network, images, K)
    assert depth_scores(found.depth, depth).abs_rel < 0.6 * depth_scores(network, depth).abs_rel


def test_what_moves_with_the_camera_keeps_the_networks_depth() -> None:
    """A car 8 m ahead, always: by parallax it is infinitely far, as nothing in it moves."""
    poses = ahead(frames=3)
    images, depth = drive(poses, [8 + 0.4 * i for i in range(3)])
    car = (np.abs(depth[0] - 8) < 0.5) & (np.abs(np.arange(WIDTH) - WIDTH / 2) < 20)
    assert car.sum() > 100
    found = combine_depth(depth, images, K)
    assert np.median(off(found.depth[0][car], depth[0][car])) < 0.05


def test_a_standing_camera_keeps_the_networks_depth(scene: Any) -> None:
    images, depth, _ = scene
    found = combine_depth(depth, [images[-1]] * 3, K)
    np.testing.assert_allclose(found.depth, depth, rtol=1e-5)
    assert found.error is None and np.abs(found.prev_from_cur - np.eye(4)).max() < 0.01
    single = combine_depth(depth, images[-1:], K)
    np.testing.assert_allclose(single.depth, depth, rtol=1e-5)
    assert (single.prev_from_cur == np.eye(4)).all()


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_a_network_without_a_unit_gets_metres_by_the_road(scene: Any, shift: float) -> None:
    images, depth, true = scene
    relative = (1 / (0.3 / depth + 0.3 * shift)).astype(np.float32)
    found = combine_depth(relative, images, K, metric=False)
    assert np.linalg.norm(found.prev_from_cur[:3, 3]) == pytest.approx(np.linalg.norm(true[:3, 3]), rel=0.1)
    assert np.median(off(found.depth, depth)) < 0.06
    assert np.median(off(combine_depth(relative, images[-1:], K, metric=False).depth, depth)) < (0.4 if shift else 0.05)


def test_unknown_depth_stays_unknown(scene: Any) -> None:
    images, depth, _ = scene
    holes = depth.copy()
    holes[:, 20:40, 30:90] = 0
    found = combine_depth(holes, images, K).depth
    assert ((found == 0) == (holes == 0)).all() and np.isfinite(found).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": []}, "`images` must be one or more"),
        ({"estimate": np.ones((1, 3, 3), np.float32)}, r"`images\[0\]` must be \[3, 3, 3\]"),
        ({"static": np.ones((1, 2, 2), bool)}, "`static` must be"),
        ({"K": np.eye(2)}, "`K` must be"),
    ],
)
def test_refusals(scene: Any, change: dict[str, Any], message: str) -> None:
    given = {"estimate": scene[1], "images": scene[0], "K": K} | change
    with pytest.raises(ValueError, match=message):
        combine_depth(**given)


# ---------------------------------------------------------------- of a clip


def clip_of(images: list[np.ndarray]) -> Clip:
    return Clip("drive", "test", tuple(Sample.from_arrays(str(i), image, K) for i, image in enumerate(images)))


class Network:
    """Knows each image's depth, up to a scale."""

    def __init__(self, images: list[np.ndarray], depths: list[np.ndarray], metric: bool) -> None:
        self.known, self.metric = dict(zip((image.tobytes() for image in images), depths, strict=True)), metric

    def __call__(self, image: np.ndarray) -> np.ndarray:
        return self.known[image.tobytes()] * np.float32(1 if self.metric else 7)


@pytest.mark.parametrize("metric", [True, False])
def test_a_clip_with_a_network(metric: bool) -> None:
    poses = ahead(frames=3)
    shots = [drive(poses[: i + 1]) for i in range(3)]
    images, depths = shots[-1][0], [depth for _, depth in shots]
    perception = Perception(with_estimates(clip_of(images), depth=Network(images, depths, metric)))
    for index in (0, 1, 2):
        assert np.median(off(perception.raw_depth(index), depths[index])) < 0.06
    for index in (1, 2):
        assert np.linalg.norm(perception.prev_from_cur(index)[:3, 3]) == pytest.approx(0.4, rel=0.1)
    assert perception.seen(2).layers.depth.shape == (1, HEIGHT, WIDTH)


def test_a_stereo_pair_is_replaced_by_metres_only() -> None:
    """Metric depth of a clip with a right camera stays as it is; depth without a unit gets one."""
    poses = ahead(frames=3)
    shots = [drive(poses[: i + 1]) for i in range(3)]
    images, depths = shots[-1][0], [depth for _, depth in shots]
    plain = clip_of(images)
    rig = RightCamera(plain[0].image, K, pose(xyz=(-0.5, 0, 0)))
    clip = replace(plain, samples=tuple(replace(sample, right=rig) for sample in plain))
    for metric in (True, False):
        network = Network(images, depths, metric)
        found = Perception(with_estimates(clip, depth=network)).raw_depth(2)
        assert np.array_equal(found, depths[2]) if metric else np.median(off(found, depths[2])) < 0.06


# ---------------------------------------------------------------- errors


def test_scores_by_hand() -> None:
    truth = np.array([[[10.0, 10, 10, 0, 100]]])
    depth = np.array([[[10.0, 12, 20, 5, 100]]])
    found = depth_scores(depth, truth)
    assert found == pytest.approx((1.2 / 3, 1.2, (1 / 6 + 0 + 2 / 3) / 3, 2 / 3, 3))
    assert isinstance(found, DepthScores)
    assert depth_scores(depth, truth, farthest=200).pixels == 4


def test_scores_leave_out_what_neither_knows() -> None:
    truth, depth = np.full((1, 100, 100), 5.0), np.full((1, 100, 100), 5.0)
    depth[0, :40] = 50
    assert depth_scores(depth, truth, crop=True).abs_rel == 0
    depth[0, :40] = 0
    assert depth_scores(depth, truth).pixels == 6000
    with pytest.raises(ValueError, match="must have a pixel up to 80 m in common"):
        depth_scores(depth, np.where(depth > 0, 0, truth))


def test_a_public_network_against_scans_and_combined() -> None:
    """Prints what `vestcl bench depth` does: the combination keeps the scale, and is not worse than the network."""
    clip = open_sequence(real("kitti_clip"))
    network = OnnxDepth.load(real("models") / "rtmonodepth_s_kitti.onnx")
    images = [clip[i].read_image() for i in (6, 7, 8)]
    scan, estimate = clip[8].read_depth(), network(images[-1])
    combined = combine_depth(estimate, images, clip[8].K)
    rows = {"network": estimate, "combined": combined.depth, "motion": motion_depth(images, clip[8].K).depth}
    scores = {name: depth_scores(depth, scan, crop=True) for name, depth in rows.items()}
    for name, found in scores.items():
        print(f"{name}: AbsRel {found.abs_rel:.3f}, median ratio {found.median_ratio:.3f}")
    assert 0.93 < scores["combined"].median_ratio < 1.07
    assert scores["combined"].abs_rel < 1.02 * scores["network"].abs_rel < scores["motion"].abs_rel

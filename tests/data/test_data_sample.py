"""vestcl.data.sample and what it reads with, vestcl.data.resize."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from data_files import noise_image, pose

from vestcl import io
from vestcl.data.calibration import intrinsics, translation
from vestcl.data.resize import resize_depth, resize_image, resize_labels
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import DepthFile, ImageArray, ImageFile, LabelFile
from vestcl.geometry import transform_points
from vestcl.reference import unproject

K = intrinsics(70.0, 72.0, 4.25, 3.5)


def sample(**changes: object) -> Sample:
    made = Sample.from_arrays(
        "000007",
        io.to_float(noise_image(6, 8)),
        K,
        depth=np.arange(48.0).reshape(1, 6, 8),
        train_ids=np.arange(48).reshape(1, 6, 8) % 19,
        world_from_cam=pose(0.1, (1, 2, 3)),
        timestamp=0.7,
    )
    return dataclasses.replace(made, **changes)


def test_arrays_are_copied() -> None:
    """A caller may fill its buffers again, and a reader may write to what it reads."""
    image, depth, ids = np.zeros((3, 6, 8), np.float32), np.ones((1, 6, 8), np.float32), np.ones((1, 6, 8), np.uint8)
    camera = K.copy()
    made = Sample.from_arrays("0", image, camera, depth=depth, train_ids=ids)
    for array in (image, depth, ids, camera):
        array[...] = 7
    for read in (made.read_image, made.read_depth, made.read_labels):
        wanted = read().copy()
        assert wanted.max() < 7
        read()[...] = 5
        assert np.array_equal(read(), wanted)
    assert np.array_equal(made.K, K)


def test_arrays_come_back() -> None:
    made = sample()
    assert (made.height, made.width, made.timestamp) == (6, 8, 0.7)
    assert np.array_equal(made.read_image(), io.to_float(noise_image(6, 8)))
    assert made.read_depth().shape == (1, 6, 8) and made.read_depth()[0, 0, 1] == 1
    assert made.read_labels()[0, 0].tolist() == list(range(8)) and made.read_labels().dtype == np.uint8
    assert made.read_mask()[0, 0].tolist() == [True] * 5 + [False] * 3
    assert not made.read_ego_vehicle().any() and made.read_ego_vehicle().shape == (1, 6, 8)


def test_depth_that_is_unknown_becomes_zero() -> None:
    depth = np.array([[[np.nan, np.inf, -1, 0, 5]]])
    made = Sample.from_arrays("0", np.zeros((3, 1, 5)), K, depth=depth)
    assert made.read_depth().tolist() == [[[0, 0, 0, 0, 5]]]


def test_resizing_scales_the_camera_and_all_that_is_read() -> None:
    right = RightCamera(ImageArray(io.to_float(noise_image(6, 8, 1))), K, translation((-0.5, 0, 0)))
    half = sample(right=right).resized(3, 16)
    np.testing.assert_allclose(half.K, [[140, 0, 8.5], [0, 36, 1.75], [0, 0, 1]])
    assert half.right is not None
    np.testing.assert_allclose(half.right.K, half.K)
    assert half.read_image().shape == half.right.read_image().shape == (3, 3, 16)
    assert half.read_depth().shape == half.read_labels().shape == half.read_ego_vehicle().shape == (1, 3, 16)
    again = half.resized(6, 8)
    np.testing.assert_allclose(again.K, K)
    assert np.array_equal(again.read_image(), sample().read_image())


def test_a_resized_cloud_is_where_it_was() -> None:
    """The mean of a flat wall's points does not move by a resize: half-pixel mistakes would move it."""
    made = Sample.from_arrays("0", np.zeros((3, 6, 8)), K, depth=np.full((1, 6, 8), 5.0))
    for height, width in ((3, 4), (12, 16), (2, 16), (5, 7)):
        small = made.resized(height, width)
        clouds = [unproject(torch.from_numpy(s.read_depth()[None]).double(), torch.from_numpy(s.K)[None]) for s in
                  (made, small)]  # fmt: skip
        np.testing.assert_allclose(clouds[0].mean(1), clouds[1].mean(1), atol=1e-12)


def test_files_are_read_when_asked(tmp_path: Path) -> None:
    io.write_pixels(tmp_path / "a.png", noise_image(6, 8))
    io.write_pixels(tmp_path / "wrong.png", noise_image(7, 8))
    io.write_depth(tmp_path / "half.npy", np.full((3, 4), 2.0))
    io.write_pixels(tmp_path / "tall.png", np.zeros((6, 4), np.uint8))
    made = sample(image=ImageFile(tmp_path / "a.png", 6, 8), depth=DepthFile(tmp_path / "half.npy"))
    assert np.array_equal(made.read_image(), io.to_float(noise_image(6, 8)))
    assert made.read_depth().tolist() == [[[2.0] * 8] * 6]
    with pytest.raises(ValueError, match=r"wrong\.png: must be 6 x 8 as its clip is, got 7 x 8"):
        sample(image=ImageFile(tmp_path / "wrong.png", 6, 8)).read_image()
    with pytest.raises(ValueError, match=r"tall\.png: must have the proportions of the image, 6 x 8, got 6 x 4"):
        sample(labels=LabelFile(tmp_path / "tall.png", "trainIds")).read_labels()
    with pytest.raises(ValueError, match=r"no\.png: No such file"):
        sample(image=ImageFile(tmp_path / "no.png", 6, 8)).read_image()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"image": np.zeros((6, 8, 3))}, r"`image` must be \[3, H, W\], got \[6, 8, 3\]"),
        ({"image": np.full((3, 6, 8), np.nan)}, "`image` must not have NaN"),
        ({"image": np.ones((3, 6, 8), np.uint8)}, "got uint8 of 1 ... 1; divide 8-bit values by 255"),
        ({"image": np.zeros((3, 6, 8), int)}, r"`image` must be RGB in \[0, 1\], floating-point, got int64"),
        ({"image": np.full((3, 6, 8), 255.0)}, "got 255 ... 255; divide 8-bit values by 255"),
        ({"image": np.full((3, 6, 8), -np.inf)}, "got -inf ... -inf"),
        ({"image": np.zeros((3, 6, 8), complex)}, "`image` must be an array .* an array of complex128"),
        ({"image": "a.png"}, "`image` must be an array"),
        ({"image": [[1, 2], [3]]}, "`image` must be an array"),
        ({"image": torch.zeros(3, 6, 8, requires_grad=True)}, "`image` must be an array .*detach"),
        ({"depth": "a.png"}, "`depth` must be an array"),
        ({"depth": np.zeros((6, 8))}, r"`depth` must be \[1, H, W\], got \[6, 8\]"),
        ({"K": np.eye(4)}, r"K must be \[3, 3\], got \[4, 4\]"),
        ({"K": -np.eye(3)}, "K must be finite, with fx, fy > 0"),
        ({"world_from_cam": 2 * np.eye(4)}, "must be a rotation and a finite shift"),
        ({"world_from_cam": np.eye(3)}, r"a pose must be \[4, 4\], got \[3, 3\]"),
        ({"world_from_cam": np.diag([1.0, 1, -1, 1])}, "must be a rotation"),
    ],
)
def test_refuses(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Sample.from_arrays(**({"name": "0", "image": np.zeros((3, 6, 8)), "K": K} | arguments))


def test_what_is_not_there_is_reported() -> None:
    bare = sample(depth=None, labels=None)
    for read, what in ((bare.read_depth, "depth"), (bare.read_labels, "labels"), (bare.read_mask, "labels")):
        with pytest.raises(ValueError, match=f"sample 000007 has no {what}"):
            read()
    with pytest.raises(ValueError, match="`height` must be a positive integer, got 0"):
        bare.resized(0, 8)
    with pytest.raises(ValueError, match=r"`width` must be a positive integer, got 8\.5"):
        bare.resized(8, 8.5)


def test_clip() -> None:
    samples = tuple(sample(timestamp=i / 25, world_from_cam=pose(0.1 * i, (i, 0, 3))) for i in range(6))
    clip = Clip("a", "test", samples)
    assert len(clip) == 6 and clip[-1] is samples[-1] and list(clip) == list(samples)
    assert isinstance(clip[2:4], Clip) and list(clip[2:4]) == list(samples[2:4])
    assert clip.fps == 25 and clip[:1].fps is None
    assert {s.read_image().shape for s in clip.resized(3, 4)} == {(3, 3, 4)}
    with pytest.raises(ValueError, match="has no frames"):
        clip[6:]


def test_from_first_pose_keeps_motion() -> None:
    poses = [pose(0.3, (5, 1, 2)), pose(0.5, (6, 1, 4))]
    clip = Clip("a", "test", tuple(sample(world_from_cam=p) for p in poses))
    first, second = (s.world_from_cam for s in clip.from_first_pose())
    np.testing.assert_allclose(first, np.eye(4), atol=1e-15)
    np.testing.assert_allclose(second, np.linalg.inv(poses[0]) @ poses[1], atol=1e-12)
    point = torch.tensor([[1.0, 2, 3]], dtype=torch.float64)
    moved = transform_points(torch.from_numpy(second), point)
    np.testing.assert_allclose(transform_points(torch.from_numpy(poses[0]), moved),
                               transform_points(torch.from_numpy(poses[1]), point))  # fmt: skip
    without = Clip("a", "test", (sample(world_from_cam=None),))
    assert without.from_first_pose() is without


def test_resize_image_by_hand() -> None:
    image = np.array([[[0.0, 1, 2, 3], [4, 5, 6, 7]]], np.float32)
    assert resize_image(image, 1, 2).tolist() == [[[2.5, 4.5]]]
    assert resize_image(image, 2, 4) is image
    np.testing.assert_allclose(resize_image(image, 2, 8)[0, 0], [0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3])
    np.testing.assert_allclose(resize_image(image, 4, 2)[0, :, 0], [0.5, 1.5, 3.5, 4.5])


def test_resize_keeps_a_mean_and_the_range() -> None:
    image = np.random.default_rng(0).random((3, 370, 1226)).astype(np.float32)
    image[:, :100] = 1
    image[:, -100:] = 0
    assert (resize_image(image, 256, 832).min(), resize_image(image, 256, 832).max()) == (0, 1)
    np.testing.assert_allclose(resize_image(image, 256, 832).mean((1, 2)), image.mean((1, 2)), rtol=1e-4)


def test_resize_labels_by_hand() -> None:
    labels = np.array([[[0, 1, 2, 3, 4, 5]]], np.uint8)
    assert resize_labels(labels, 1, 2).tolist() == [[[1, 4]]]
    assert resize_labels(labels, 2, 12).tolist() == [[[0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]] * 2]
    assert resize_labels(labels, 1, 4).tolist() == [[[0, 2, 3, 5]]]


def test_resize_depth_by_hand() -> None:
    depth = np.array([[[0, 0, 0, 4, 0, 0, 0, 0, 9, 0, 7, 5]]], np.float32)
    assert resize_depth(depth, 1, 4).tolist() == [[[0, 4, 9, 7]]]
    assert resize_depth(depth, 1, 2).tolist() == [[[4, 9]]]
    assert resize_depth(depth, 1, 1).tolist() == [[[4]]]
    assert resize_depth(depth[:, :, 10:], 1, 1).tolist() == [[[5]]]
    equally_near = np.array([[[7, 0, 5]]], np.float32)
    assert resize_depth(equally_near, 1, 1).tolist() == [[[5]]]
    assert resize_depth(depth, 3, 24)[0, 1].tolist() == np.repeat(depth[0, 0], 2).tolist()


@pytest.mark.parametrize(("height", "width"), [(256, 832), (50, 200), (740, 1500), (100, 1300)])
def test_resize_depth_invents_nothing(height: int, width: int) -> None:
    """Each valid target pixel has the depth of a source pixel that it covers or whose area holds its centre."""
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((1, 370, 1226)) < 0.04, 1 + np.arange(370 * 1226).reshape(1, 370, 1226), 0)
    resized = resize_depth(depth.astype(np.float32), height, width)
    rows, columns = np.nonzero(resized[0])
    sources = resized[0, rows, columns].astype(int) - 1
    for target, source, before, after in ((rows, sources // 1226, 370, height), (columns, sources % 1226, 1226, width)):
        reach = max(1, before / after)
        assert (np.abs((target + 0.5) * before / after - (source + 0.5)) <= reach / 2 + 1e-9).all()
    covered = np.zeros((height, width), bool)
    here = np.nonzero(depth[0])
    covered[(2 * here[0] + 1) * height // 740, (2 * here[1] + 1) * width // 2452] = True
    assert resized[0][covered].all()

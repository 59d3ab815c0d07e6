"""vestcl.data.calibration and vestcl.data.readers.files."""

from pathlib import Path

import numpy as np
import pytest
from data_files import noise_image, pose, row, write_images, write_text

from vestcl import io
from vestcl.data import calibration
from vestcl.data.readers import files


def test_half_a_pixel_once() -> None:
    K = calibration.from_integer_centres([[700, 1, 600], [0, 710, 180], [0, 0, 1]])
    assert K.dtype == np.float64
    assert K.tolist() == [[700, 1, 600.5], [0, 710, 180.5], [0, 0, 1]]


def test_a_pixel_has_the_same_ray_in_both_conventions() -> None:
    old = calibration.intrinsics(700, 710, 600, 180)
    ray = np.linalg.solve(old, [37, 12, 1])
    np.testing.assert_allclose(calibration.from_integer_centres(old) @ ray, [37.5, 12.5, 1])


def test_fov_by_hand() -> None:
    K = calibration.intrinsics_from_fov(90, 100, 200)
    np.testing.assert_allclose(K, [[100, 0, 100], [0, 100, 50], [0, 0, 1]])
    for fov in (0, 180, -3, float("nan")):
        with pytest.raises(ValueError, match="`fov` must be between 0 and 180"):
            calibration.intrinsics_from_fov(fov, 100, 200)


def test_projection_by_hand() -> None:
    """P = K [I | p4] with p4 = (-0.5, 0.02, 0.003): the shift comes from K before its half pixel."""
    K = np.array([[700.0, 0, 600], [0, 710, 180], [0, 0, 1]])
    p4 = np.array([-0.5, 0.02, 0.003])
    moved, cam_from_rect0 = calibration.split_projection(np.column_stack([K, K @ p4]))
    assert moved.tolist() == [[700, 0, 600.5], [0, 710, 180.5], [0, 0, 1]]
    np.testing.assert_allclose(cam_from_rect0[:3, 3], p4, atol=1e-15)
    assert np.array_equal(cam_from_rect0[:3, :3], np.eye(3))


def test_invert() -> None:
    moved = pose(0.3, (1, 2, 3))
    np.testing.assert_allclose(calibration.invert(moved) @ moved, np.eye(4), atol=1e-15)


@pytest.mark.parametrize("rows", [3, 4])
def test_poses(tmp_path: Path, rows: int) -> None:
    poses = [pose(0.1, (1, 2, 3)), pose(-0.2, (1e5, 0, -1))]
    path = write_text(tmp_path / "poses.txt", *(row(p[:rows]) for p in poses), "")
    assert np.array_equal(files.read_poses(path), poses)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "is empty"),
        (["1 2 3"], r"line 1 must be 12 or 16 finite numbers, got '1 2 3'"),
        ([row(pose()[:3]), row(pose())], "line 2 must be 12 or 16 finite numbers"),
        ([row(pose()[:3]), "x " * 12], "line 2: could not convert string to float"),
        (["nan " * 12], "line 1 must be 12 or 16 finite numbers"),
        ([row(2 * pose()[:3])], "line 1: must be a rotation and a finite shift"),
        ([row(np.diag([1, 1, -1, 1])[:3])], "line 1: must be a rotation and a finite shift"),
    ],
)
def test_bad_poses_are_named(tmp_path: Path, lines: list[str], message: str) -> None:
    path = write_text(tmp_path / "poses.txt", *lines)
    with pytest.raises(ValueError, match=rf"poses\.txt: {message}"):
        files.read_poses(path)


def test_calibration_file(tmp_path: Path) -> None:
    path = write_text(
        tmp_path / "calib.txt",
        *(
            "calib_time: 09-Jan-2012 13:57:47",
            "corner_dist: 9.95e-02",
            "R: 1 0 0 0 1 0 0 0 1",
            "T: 1 2 3",
            "bad: 1 nan",
        ),
    )
    read = files.Calibration(path)
    assert read.entry("corner_dist", 1) == 0.0995
    assert read.rigid()[:3, 3].tolist() == [1, 2, 3]
    assert "R" in read and "P2" not in read
    with pytest.raises(ValueError, match=r"calib\.txt: has no entry `P2`; it has corner_dist, R, T, bad"):
        read.projection("P2")
    with pytest.raises(ValueError, match=r"calib\.txt: `T` must be 9 finite numbers, got \[1.0, 2.0, 3.0\]"):
        read.entry("T", 9)
    with pytest.raises(ValueError, match=r"calib\.txt: `bad` must be 2 finite numbers"):
        read.entry("bad", 2)
    with pytest.raises(ValueError, match=r"no\.txt: No such file"):
        files.Calibration(tmp_path / "no.txt")
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"binary\.txt: is not text"):
        files.Calibration(tmp_path / "binary.txt")


def test_projection_that_is_no_camera(tmp_path: Path) -> None:
    path = write_text(tmp_path / "calib.txt", "P0: " + "0 " * 12)
    with pytest.raises(ValueError, match=r"calib\.txt: `P0`: K must be finite, with fx, fy > 0"):
        files.Calibration(path).projection("P0")


def test_numbered_images(tmp_path: Path) -> None:
    write_images(tmp_path / "a", ["rgb_00009.jpg", "rgb_00010.png", ".rgb_00011.png"])
    write_text(tmp_path / "a" / "notes.txt")
    found = files.numbered_images(tmp_path / "a", "rgb_")
    assert [(number, file.name) for number, file in found.items()] == [(9, "rgb_00009.jpg"), (10, "rgb_00010.png")]
    assert files.numbered_images(tmp_path / "nowhere") == {}
    with pytest.raises(ValueError, match=r"rgb_00009\.jpg: must be named by its number, as 000000\.jpg"):
        files.numbered_images(tmp_path / "a")
    io.write_pixels(tmp_path / "a" / "rgb_00012.png", noise_image())
    with pytest.raises(ValueError, match=r"a: the frame after rgb_00010\.png is missing"):
        files.numbered_images(tmp_path / "a", "rgb_")
    assert list(files.numbered_images(tmp_path / "a", "rgb_", gaps=True)) == [9, 10, 12]
    io.write_pixels(tmp_path / "a" / "rgb_12.png", noise_image())
    with pytest.raises(ValueError, match=r"rgb_12\.png: has the number of rgb_00012\.png"):
        files.numbered_images(tmp_path / "a", "rgb_", gaps=True)

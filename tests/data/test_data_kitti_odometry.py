"""vestcl.data.readers.kitti_odometry on a tiny sequence in the data set's layout, and on a real one where that is
there."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from data_files import pose, real, row, write_images, write_text

from vestcl.data.readers.kitti_odometry import open_kitti_odometry
from vestcl.data.readers.splits import windows

K = np.array([[70.0, 0, 14], [0, 70, 4], [0, 0, 1]])
#: p4 of cameras 0 to 3, metres.
SHIFTS = [(0, 0, 0), (-0.5, 0, 0), (0.06, -0.001, 0.002), (-0.48, 0.002, 0.003)]
POSES = [pose(0.01 * i, (0.1 * i, 0, 0.9 * i)) for i in range(4)]


def tree(tmp_path: Path, cameras: str = "0123") -> Path:
    folder = tmp_path / "sequences" / "03"
    lines = [f"P{i}: {row(np.column_stack([K, K @ shift]))}" for i, shift in enumerate(SHIFTS)]
    write_text(folder / "calib.txt", *lines, f"Tr: {row(pose()[:3])}")
    for camera in cameras:
        write_images(folder / f"image_{camera}", [f"{i:06}.png" for i in range(4)], 10, 30)
    write_text(folder / "times.txt", "0.0", "1.0e-01", "0.2", "0.3")
    write_text(tmp_path / "poses" / "03.txt", *(row(p[:3]) for p in POSES))
    return folder


@pytest.mark.parametrize(("rig", "left", "right"), [("colour", 2, 3), ("grey", 0, 1)])
def test_both_rigs_by_hand(tmp_path: Path, rig: str, left: int, right: int) -> None:
    clip = open_kitti_odometry(tree(tmp_path), rig=rig)
    assert (clip.kind, clip.name, len(clip)) == ("KITTI odometry", "03", 4)
    sample = clip[2]
    assert sample.image.path.parent.name == f"image_{left}"
    assert sample.K.tolist() == [[70, 0, 14.5], [0, 70, 4.5], [0, 0, 1]]
    assert (sample.name, sample.timestamp) == ("000002", 0.2)
    baseline = np.subtract(SHIFTS[right], SHIFTS[left])
    np.testing.assert_allclose(sample.right.right_from_left[:3, 3], baseline, atol=1e-12)
    left_from_cam0 = np.eye(4)
    left_from_cam0[:3, 3] = SHIFTS[left]
    np.testing.assert_allclose(sample.world_from_cam, POSES[2] @ np.linalg.inv(left_from_cam0), atol=1e-12)
    assert sample.read_image().shape == sample.right.read_image().shape == (3, 10, 30)


def test_colour_is_taken_where_it_is_there(tmp_path: Path) -> None:
    assert open_kitti_odometry(tree(tmp_path))[0].image.path.parent.name == "image_2"
    grey = open_kitti_odometry(tree(tmp_path / "b", "0"))
    assert grey[0].image.path.parent.name == "image_0" and grey[0].right is None
    with pytest.raises(ValueError, match=r"has no image_2/\*\.png"):
        open_kitti_odometry(tmp_path / "b", rig="colour")


def test_the_root_and_its_sequences(tmp_path: Path) -> None:
    tree(tmp_path)
    assert open_kitti_odometry(tmp_path).name == "03"
    (tmp_path / "sequences" / "11").mkdir()
    assert open_kitti_odometry(tmp_path, sequence="03").name == "03"
    for sequence in (None, "04"):
        with pytest.raises(ValueError, match="`sequence` must be one of 03, 11, got"):
            open_kitti_odometry(tmp_path, sequence=sequence)
    with pytest.raises(ValueError, match="has no folder `sequences` to find sequence 04 in"):
        open_kitti_odometry(tmp_path / "sequences" / "03", sequence="04")


def test_a_part_of_a_sequence_keeps_its_poses(tmp_path: Path) -> None:
    folder = tree(tmp_path, "0")
    for i in (0, 1):
        (folder / "image_0" / f"{i:06}.png").unlink()
    clip = open_kitti_odometry(folder)
    assert [s.name for s in clip] == ["000002", "000003"]
    np.testing.assert_allclose(clip[0].world_from_cam, POSES[2])


def test_without_poses_and_times(tmp_path: Path) -> None:
    folder = tree(tmp_path)
    (folder / "times.txt").unlink()
    (tmp_path / "poses" / "03.txt").unlink()
    sample = open_kitti_odometry(folder)[0]
    assert sample.timestamp is None and sample.world_from_cam is None


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("calib.txt", None, r"calib\.txt: No such file"),
        ("calib.txt", "P2: 1 2", r"calib\.txt: `P2` must be 12 finite numbers"),
        ("../../poses/03.txt", row(pose()[:3]), r"03\.txt: has 1 lines, none for frame 3"),
        ("../../poses/03.txt", "a b c", r"03\.txt: line 1: could not convert"),
        ("times.txt", "0\n1", r"times\.txt: has 2 lines, none for frame 3"),
        ("image_2/first.png", "", r"first\.png: must be named by its number"),
        ("image_2/000002.png", None, r"the frame after 000001\.png is missing"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, file: str, content: str | None, message: str) -> None:
    folder = tree(tmp_path)
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(content)
    with pytest.raises(ValueError, match=message):
        open_kitti_odometry(folder)


def test_real_sequence() -> None:
    """Grey, 10 Hz, a baseline of 0.537 m, about 1.2 m per frame straight on."""
    clip = open_kitti_odometry(real("kitti_odometry"))
    assert (clip.name, len(clip), len(list(windows(len(clip))))) == ("06", 36, 28)
    assert clip.fps == pytest.approx(10)
    sample = clip[0]
    assert (sample.height, sample.width) == (370, 1226)
    np.testing.assert_allclose(sample.K, [[707.0912, 0, 602.3873], [0, 707.0912, 183.6104], [0, 0, 1]])
    np.testing.assert_allclose(sample.right.right_from_left[:3, 3], [-0.537, 0, 0], atol=5e-4)
    np.testing.assert_allclose(sample.world_from_cam, np.eye(4), atol=1e-9)
    steps = [np.linalg.inv(a.world_from_cam) @ b.world_from_cam for a, b in itertools.pairwise(clip)]
    assert all(1.0 < step[2, 3] < 1.5 for step in steps)
    small = sample.resized(256, 832)
    image = small.read_image()
    assert image.shape == small.right.read_image().shape == (3, 256, 832) and np.array_equal(image[0], image[2])
    np.testing.assert_allclose(small.K[:2, 2], [602.3873 * 832 / 1226, 183.6104 * 256 / 370])

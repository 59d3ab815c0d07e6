"""vestcl.data.readers.virtual_kitti on a tiny scene in the data set's layout."""

from pathlib import Path

import numpy as np
import pytest
from data_files import pose, row, write_images, write_text

from vestcl import io
from vestcl.data.readers.virtual_kitti import open_virtual_kitti

#: (height, width) of the images: resized from 375 x 1242 by 0.0267 and 0.0266.
SIZE = (10, 33)

WORLD_FROM_CAM = [pose(0.02 * i, (100 + 0.1 * i, -2, 0.9 * i)) for i in range(3)]


def tree(tmp_path: Path, variant: str = "clone") -> Path:
    folder = tmp_path / "Scene01" / variant
    extrinsic, intrinsic = ["frame cameraID r1,1 r1,2 ..."], ["frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"]
    for i, world_from_cam in enumerate(WORLD_FROM_CAM):
        for camera in (0, 1):
            cam_from_world = pose(0, (-0.532725 * camera, 0, 0)) @ np.linalg.inv(world_from_cam)
            extrinsic.append(f"{i} {camera} {row(cam_from_world)}")
            intrinsic.append(f"{i} {camera} 725.0087 725.0087 620.5 187")
    write_text(folder / "extrinsic.txt", *extrinsic)
    write_text(folder / "intrinsic.txt", *intrinsic)
    frames = folder / "frames"
    for camera in ("Camera_0", "Camera_1"):
        write_images(frames / "rgb" / camera, [f"rgb_{i:05}.jpg" for i in range(3)], *SIZE)
    for i in range(3):
        io.write_pixels(frames / "depth" / "Camera_0" / f"depth_{i:05}.png", np.full(SIZE, 150 + i, np.uint16))
        classes = np.full((*SIZE, 3), (90, 200, 255), np.uint8)
        classes[5:] = (0, 139, 139)
        io.write_pixels(frames / "classSegmentation" / "Camera_0" / f"classgt_{i:05}.png", classes)
    return folder


def test_by_hand(tmp_path: Path) -> None:
    clip = open_virtual_kitti(tree(tmp_path))
    assert (clip.kind, clip.name, len(clip), clip.fps) == ("Virtual KITTI 2", "Scene01/clone", 3, 10)
    sample = clip[2]
    full = np.array([[725.0087, 0, 621], [0, 725.0087, 187.5], [0, 0, 1]])
    np.testing.assert_allclose(sample.K, np.diag([33 / 1242, 10 / 375, 1]) @ full)
    np.testing.assert_allclose(sample.world_from_cam, WORLD_FROM_CAM[2], atol=1e-10)
    assert sample.right is not None and np.array_equal(sample.right.K, sample.K)
    np.testing.assert_allclose(sample.right.right_from_left, pose(0, (-0.532725, 0, 0)), atol=1e-10)
    assert (sample.read_depth() == np.float32(1.52)).all()
    assert sample.read_labels()[0, ::5, 0].tolist() == [10, 13]
    assert sample.read_mask()[0, ::5, 0].tolist() == [True, False]
    assert sample.read_image().shape == sample.right.read_image().shape == (3, *SIZE)


def test_variants(tmp_path: Path) -> None:
    tree(tmp_path)
    assert open_virtual_kitti(tmp_path / "Scene01").name == "Scene01/clone"
    tree(tmp_path, "fog")
    assert open_virtual_kitti(tmp_path / "Scene01", variant="fog").name == "Scene01/fog"
    with pytest.raises(ValueError, match="`variant` must be one of clone, fog, got None"):
        open_virtual_kitti(tmp_path / "Scene01")
    with pytest.raises(ValueError, match="is variant fog, not clone"):
        open_virtual_kitti(tmp_path / "Scene01" / "fog", variant="clone")


def test_separate_downloads_may_be_missing(tmp_path: Path) -> None:
    folder = tree(tmp_path)
    for part in ("depth/Camera_0", "classSegmentation/Camera_0", "rgb/Camera_1"):
        for file in (folder / "frames" / part).iterdir():
            file.unlink()
    sample = open_virtual_kitti(folder)[0]
    assert sample.depth is None and sample.labels is None and sample.right is None


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("intrinsic.txt", None, r"intrinsic\.txt: No such file"),
        ("intrinsic.txt", "frame\n0 0 725 725 620 187", r"intrinsic\.txt: has no line for frame 0 of camera 1"),
        ("intrinsic.txt", "frame\n0 0 0 725 620 187", r"intrinsic\.txt: frame 0: K must be finite"),
        ("extrinsic.txt", "frame\n0 0 1 2 3", r"extrinsic\.txt: line 2 must be 18 finite numbers"),
        ("extrinsic.txt", f"frame\n0 0 {row(3 * np.eye(4))}", r"extrinsic\.txt: frame 0: must be a rotation"),
        ("frames/rgb/Camera_0/rgb_00001.jpg", None, r"the frame after rgb_00000\.jpg is missing"),
        ("frames/rgb/Camera_0/first.jpg", "", r"first\.jpg: must be named by its number, as rgb_000000\.jpg"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, file: str, content: str | None, message: str) -> None:
    folder = tree(tmp_path)
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(content)
    with pytest.raises(ValueError, match=message):
        open_virtual_kitti(folder)


def test_no_images(tmp_path: Path) -> None:
    (tmp_path / "clone" / "frames" / "rgb").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"has no frames/rgb/Camera_0/rgb_\*\.jpg"):
        open_virtual_kitti(tmp_path / "clone")

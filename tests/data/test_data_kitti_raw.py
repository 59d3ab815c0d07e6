"""vestcl.data.readers.kitti_raw on a tiny drive in the data set's layout."""

from pathlib import Path

import numpy as np
import pytest
from data_files import pose, row, write_images, write_text

from vestcl import io
from vestcl.data.readers.kitti_raw import EARTH_RADIUS, mercator_pose, open_kitti_raw
from vestcl.scene.inputs import inputs_of

#: Of 2011_09_26's published calib_cam_to_cam.txt.
P2 = "7.215377e+02 0 6.095593e+02 4.485728e+01 0 7.215377e+02 1.728540e+02 2.163791e-01 0 0 1 2.745884e-03"
P3 = "7.215377e+02 0 6.095593e+02 -3.395242e+02 0 7.215377e+02 1.728540e+02 2.199936e+00 0 0 1 2.729905e-03"
#: (height, width) of the images: resized from 375 x 1242 by 0.0267 and 0.0266.
SIZE = (10, 33)
K = np.diag([33 / 1242, 10 / 375, 1]) @ [[721.5377, 0, 610.0593], [0, 721.5377, 173.354], [0, 0, 1]]
#: Where the scanner looks along x, with y to the left and z up, the camera looks along z.
CAM_FROM_VELO = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
LATITUDE, LONGITUDE = 49.011, 8.423
SCALE = np.cos(np.radians(LATITUDE))


def oxts(east: float = 0.0, yaw: float = 0.0) -> str:
    """A box ``east`` metres on, on the data set's sphere, that looks ``yaw`` to the left of east."""
    longitude = LONGITUDE + np.degrees(east / (SCALE * EARTH_RADIUS))
    return row([LATITUDE, longitude, 116.4, 0, 0, yaw, *[0] * 24])


def drive(tmp_path: Path, frames: int = 3) -> Path:
    date = tmp_path / "2011_09_26"
    path = date / "2011_09_26_drive_0060_sync"
    identity = row(np.eye(3))
    write_text(
        date / "calib_cam_to_cam.txt",
        *("calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.95e-02", f"R_rect_00: {identity}"),
        *(f"P_rect_02: {P2}", f"P_rect_03: {P3}"),
        *("S_rect_02: 1.242000e+03 3.750000e+02", "S_rect_03: 1.242000e+03 3.750000e+02"),
    )
    write_text(date / "calib_velo_to_cam.txt", "calib_time: 15-Mar-2012", f"R: {row(CAM_FROM_VELO)}", "T: 0 0 0")
    write_text(date / "calib_imu_to_velo.txt", "calib_time: 25-May-2012", f"R: {identity}", "T: 0 0 0")
    names = [f"{i:010}.png" for i in range(frames)]
    for camera in ("02", "03"):
        write_images(path / f"image_{camera}" / "data", names, *SIZE)
    for i in range(frames):
        write_text(path / "oxts" / "data" / f"{i:010}.txt", oxts(0.8 * i, 0.05 * i))
    times = [f"2011-09-26 13:02:25.{1 + i}64389445" for i in range(frames)]
    write_text(path / "image_02" / "timestamps.txt", *times)
    return path


def test_cameras_by_hand(tmp_path: Path) -> None:
    clip = open_kitti_raw(drive(tmp_path))
    assert (clip.kind, clip.name, len(clip)) == ("KITTI raw", "2011_09_26_drive_0060_sync", 3)
    sample = clip[0]
    np.testing.assert_allclose(sample.K, K, rtol=1e-12)
    assert sample.right is not None
    np.testing.assert_allclose(sample.right.K, sample.K)
    shift = sample.right.right_from_left[:3, 3]
    assert shift[0] == pytest.approx(-0.5327, abs=5e-5)
    np.testing.assert_allclose(shift[1:], [(2.199936 - 0.2163791) / 721.5377, -1.6e-5], atol=1e-5)
    assert [s.name for s in clip] == ["0000000000", "0000000001", "0000000002"]
    assert clip[2].read_image().shape == sample.right.read_image().shape == (3, *SIZE)
    assert not np.array_equal(clip[1].read_image(), clip[2].read_image())
    assert [s.timestamp for s in clip] == pytest.approx([0, 0.1, 0.2])
    assert sample.depth is None and sample.labels is None


def test_poses_by_hand(tmp_path: Path) -> None:
    """0.8 m forward a frame, and 0.05 rad to the left, which is minus about the camera's y axis, which points down."""
    clip = open_kitti_raw(drive(tmp_path))
    p4 = np.array([0.0598, 0, 0])  # from the rectified camera 0, where the box is, to camera 2
    for i, sample in enumerate(clip):
        about_cam0 = pose(-0.05 * i, (0, 0, 0.8 * i))
        shift = about_cam0[:3, :3] @ -p4 + p4 + about_cam0[:3, 3]
        np.testing.assert_allclose(sample.world_from_cam[:3, :3], about_cam0[:3, :3], atol=1e-9)
        np.testing.assert_allclose(sample.world_from_cam[:3, 3], shift, atol=5e-4)
    assert np.array_equal(np.round(clip[0].world_from_cam, 12), np.eye(4))


def test_world_of_the_mercator_plane(tmp_path: Path) -> None:
    path = drive(tmp_path)
    absolute, relative = open_kitti_raw(path, first_pose_identity=False), open_kitti_raw(path)
    assert absolute[0].world_from_cam[0, 3] == pytest.approx(SCALE * EARTH_RADIUS * np.radians(LONGITUDE), abs=0.1)
    assert absolute[0].world_from_cam[2, 3] == pytest.approx(116.4, abs=0.1)
    again = np.linalg.inv(absolute[0].world_from_cam) @ absolute[2].world_from_cam
    np.testing.assert_allclose(again, relative[2].world_from_cam, atol=1e-7)


def test_mercator_pose_by_hand() -> None:
    level = mercator_pose(np.array([0, 90, 7, 0, 0, 0]), 1)
    np.testing.assert_allclose(level, [[1, 0, 0, EARTH_RADIUS * np.pi / 2], [0, 1, 0, 0], [0, 0, 1, 7], [0, 0, 0, 1]],
                               atol=1e-8)  # fmt: skip
    north = np.degrees(np.arcsin(np.tanh(0.5)))  # the latitude whose Mercator y is half a radius
    assert mercator_pose(np.array([north, 0, 0, 0, 0, 0]), 0.5)[1, 3] == pytest.approx(EARTH_RADIUS / 4)
    for angles, forward, up in [  # Rz Ry Rx: roll about x, pitch about y (nose down), yaw about z (left)
        ((np.pi / 2, 0, 0), (1, 0, 0), (0, -1, 0)),
        ((0, np.pi / 2, 0), (0, 0, -1), (1, 0, 0)),
        ((0, 0, np.pi / 2), (0, 1, 0), (0, 0, 1)),
        ((np.pi / 2, 0, np.pi / 2), (0, 1, 0), (1, 0, 0)),
    ]:
        rotation = mercator_pose(np.array([0, 0, 0, *angles]), 1)[:3, :3]
        np.testing.assert_allclose(rotation @ [1, 0, 0], forward, atol=1e-15)
        np.testing.assert_allclose(rotation @ [0, 0, 1], up, atol=1e-15)


def test_depth_from_the_scanner(tmp_path: Path) -> None:
    """A point 10 m ahead is at the principal point, but for camera 2's shift; the nearer of two in a pixel counts."""
    path = drive(tmp_path)
    cameras = path.parent / "calib_cam_to_cam.txt"
    text = cameras.read_text().replace(P2, "40 0 30.5 4 0 40 10.5 0 0 0 1 0")  # of 20 x 60 pixels, twice the images'
    cameras.write_text(text.replace("S_rect_02: 1.242000e+03 3.750000e+02", "S_rect_02: 60 20"))
    write_images(path / "image_02" / "data", [f"{i:010}.png" for i in range(3)], 10, 30)
    points = [(10, 0, 0, 0.5), (12, 0, 0, 0.5), (-10, 0, 0, 0.5), (5, -1, 0.5, 0.5), (1, 50, 0, 0.5)]
    scan = path / "velodyne_points" / "data" / "0000000001.bin"
    scan.parent.mkdir(parents=True)
    scan.write_bytes(np.array(points, "<f4").tobytes())
    clip = open_kitti_raw(path)
    assert clip[0].depth is None
    depth = clip[1].read_depth()
    expected = np.zeros((1, 10, 30), np.float32)
    expected[0, 5, 15] = 10  # u = 20 (0.1 / 10) + 15.5 = 15.7, v = 5.5
    expected[0, 3, 19] = 5  # u = 20 (1.1 / 5) + 15.5 = 19.9, v = -20 (0.5 / 5) + 5.5 = 3.5
    assert np.array_equal(depth, expected)
    assert clip[1].resized(20, 60).read_depth().max() == 10
    scan.write_bytes(b"123")
    with pytest.raises(ValueError, match=r"0000000001\.bin: must be float32 quadruples, got 3 bytes"):
        clip[1].read_depth()


def test_accumulated_depth_is_read_only_where_it_is_asked_for(tmp_path: Path) -> None:
    """Its maps hold the scans of later frames."""
    path = drive(tmp_path)
    maps = path / "proj_depth" / "groundtruth" / "image_02"
    with pytest.raises(ValueError, match=r"`accumulated_depth` needs KITTI's depth maps, and .*image_02 has none"):
        open_kitti_raw(path, accumulated_depth=True)
    io.write_depth(maps / "0000000001.png", np.full(SIZE, 3.0), 256)
    assert all(sample.depth is None for sample in open_kitti_raw(path))
    scan = path / "velodyne_points" / "data" / "0000000001.bin"
    scan.parent.mkdir(parents=True)
    np.array([[10, 0, 0, 0]], "<f4").tofile(scan)
    assert open_kitti_raw(path)[1].read_depth().max() == pytest.approx(10, abs=0.01)
    clip = open_kitti_raw(path, accumulated_depth=True)
    assert clip[0].depth is None and (clip[1].read_depth() == 3).all()
    assert inputs_of(clip).depth.startswith("KITTI's depth maps, accumulated from scans of frames around each, later")


def test_without_what_may_be_missing(tmp_path: Path) -> None:
    path = drive(tmp_path)
    for file in (*(path / "oxts" / "data").iterdir(), *(path / "image_03" / "data").iterdir()):
        file.unlink()
    (path / "oxts" / "data").rmdir()
    (path / "image_02" / "timestamps.txt").unlink()
    clip = open_kitti_raw(path)
    assert all(s.right is None and s.world_from_cam is None and s.timestamp is None for s in clip)
    assert clip.fps is None


def test_grey_cameras(tmp_path: Path) -> None:
    path = drive(tmp_path, 1)
    write_images(path / "image_00" / "data", ["0000000000.png"], 10, 30)
    with pytest.raises(ValueError, match=r"calib_cam_to_cam\.txt: has no entry `P_rect_00`"):
        open_kitti_raw(path, rig="grey")
    write_text(path.parent / "calib_cam_to_cam.txt", "P_rect_00: 700 0 15 0 0 700 5 0 0 0 1 0", "R_rect_00: " +
               row(np.eye(3)))  # fmt: skip
    (sample,) = open_kitti_raw(path, rig="grey")
    assert sample.K[0, 2] == 15.5 and sample.right is None
    with pytest.raises(ValueError, match="`rig` must be colour or grey, got 'gray'"):
        open_kitti_raw(path, rig="gray")


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("../calib_cam_to_cam.txt", None, r"calib_cam_to_cam\.txt: No such file"),
        (
            "../calib_cam_to_cam.txt",
            "P_rect_02: 1 2 3",
            r"calib_cam_to_cam\.txt: `P_rect_02` must be 12 finite numbers",
        ),
        ("../calib_velo_to_cam.txt", "R: 1", r"calib_velo_to_cam\.txt: `R` must be 9 finite numbers"),
        ("../calib_imu_to_velo.txt", None, r"calib_imu_to_velo\.txt: No such file"),
        ("../calib_imu_to_velo.txt", "R: 2 0 0 0 2 0 0 0 2\nT: 0 0 0", r"calib_imu_to_velo\.txt: must be a rotation"),
        ("oxts/data/0000000001.txt", "1 2 3", r"0000000001\.txt: line 1 must be 30 finite numbers"),
        ("oxts/data/0000000001.txt", None, r"0000000001\.txt: No such file"),
        ("image_02/timestamps.txt", "2011-09-26 13:02:25.1", r"timestamps\.txt: must have a date and time for each of"),
        ("image_02/data/0000000000.png", "hello", r"0000000000\.png: is not an image"),
        ("image_02/data/0000000001.png", None, r"the frame after 0000000000\.png is missing"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, file: str, content: str | None, message: str) -> None:
    path = drive(tmp_path)
    if content is None:
        (path / file).unlink()
    else:
        (path / file).write_text(content)
    with pytest.raises(ValueError, match=message):
        open_kitti_raw(path)


def test_no_images(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"has no image_02/data/\*\.png"):
        open_kitti_raw(tmp_path)

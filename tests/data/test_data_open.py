"""vestcl.data.open: the layout selects the reader; and vestcl.data.readers.video."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import test_data_cityscapes
import test_data_folder
import test_data_kitti_odometry
import test_data_kitti_raw
import test_data_virtual_kitti
from data_files import noise_image, real, write_images, write_text
from video_files import write_video

from vestcl import io
from vestcl.data.open import clips_in, open_sequence
from vestcl.data.readers.video import open_video


def movie(tmp_path: Path) -> Path:
    io.write_mp4(tmp_path / "drive.mp4", [noise_image(32, 64, i) for i in range(5)], 12.5)
    return tmp_path / "drive.mp4"


def test_every_layout_is_recognised(tmp_path: Path) -> None:
    city = test_data_cityscapes.tree(tmp_path / "city")
    frame = city / "leftImg8bit_sequence" / "val" / "frankfurt" / "frankfurt_000000_000300_leftImg8bit.png"
    odometry = test_data_kitti_odometry.tree(tmp_path / "odometry")
    virtual = test_data_virtual_kitti.tree(tmp_path / "virtual")
    for path, kind, name in [
        (test_data_kitti_raw.drive(tmp_path), "KITTI raw", "2011_09_26_drive_0060_sync"),
        (odometry, "KITTI odometry", "03"),
        (odometry.parent.parent, "KITTI odometry", "03"),
        (city, "Cityscapes", "frankfurt_000000_000294"),
        (frame, "Cityscapes", "frankfurt_000000_000294"),
        (frame.parent / "frankfurt_000000_000294", "Cityscapes", "frankfurt_000000_000294"),
        (virtual, "Virtual KITTI 2", "Scene01/clone"),
        (virtual.parent, "Virtual KITTI 2", "Scene01/clone"),
        (test_data_folder.folder(tmp_path / "folder"), "folder", "folder"),
        (movie(tmp_path), "video", "drive"),
    ]:
        clip = open_sequence(str(path))
        assert (clip.kind, clip.name) == (kind, name)
        assert clip[0].read_image().shape == (3, clip[0].height, clip[0].width)


def test_options_go_to_the_reader(tmp_path: Path) -> None:
    path = test_data_kitti_odometry.tree(tmp_path)
    assert open_sequence(path, rig="grey")[0].image.path.parent.name == "image_0"
    with pytest.raises(ValueError, match="is KITTI odometry, which takes sequence, rig, not fov"):
        open_sequence(path, fov=60)


def test_what_was_looked_for_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"nowhere: no such file or folder"):
        open_sequence(tmp_path / "nowhere")
    with pytest.raises(
        ValueError, match=r"unrecognised dataset layout\. It looked for video: .* KITTI raw: image_02/data"
    ) as e:
        open_sequence(tmp_path)
    for layout in ("KITTI odometry: calib.txt", "Cityscapes: leftImg8bit_sequence", "frames/rgb", "camera.json"):
        assert layout in str(e.value)
    with pytest.raises(ValueError, match=r"notes\.txt: unrecognised dataset layout"):
        open_sequence(write_text(tmp_path / "notes.txt", "hello"))


def test_a_date_of_kitti_raw_lists_its_drives(tmp_path: Path) -> None:
    drive = test_data_kitti_raw.drive(tmp_path)
    with pytest.raises(ValueError, match="has KITTI raw drives; open one of 2011_09_26_drive_0060_sync"):
        open_sequence(drive.parent)


def test_depth_and_labels_from_elsewhere(tmp_path: Path) -> None:
    path = test_data_kitti_odometry.tree(tmp_path)
    for i in range(4):
        io.write_depth(tmp_path / "depth" / f"{i:06}.png", np.full((10, 30), 4.0), 256)
        io.write_pixels(tmp_path / "labels" / f"{i:06}.png", np.full((10, 30), 24, np.uint8))
    clip = open_sequence(
        path, depth=tmp_path / "depth", depth_scale=256, labels=tmp_path / "labels", label_ids="labelIds"
    )
    assert (clip[3].read_depth() == 4).all() and (clip[3].read_labels() == 11).all()
    (tmp_path / "depth" / "000002.png").unlink()
    with pytest.raises(ValueError, match=r"depth: has no 000002 ending in \.png, \.exr, \.npy"):
        open_sequence(path, depth=tmp_path / "depth")


def test_video(tmp_path: Path) -> None:
    """60 degrees: f = 32 / tan 30; the principal point is the middle, without another half."""
    clip = open_video(movie(tmp_path))
    assert (len(clip), clip.fps) == (5, 12.5)
    focal = 32 * 3**0.5
    np.testing.assert_allclose(clip[0].K, [[focal, 0, 32], [0, focal, 16], [0, 0, 1]])
    np.testing.assert_allclose(open_sequence(tmp_path / "drive.mp4", fov=90)[0].K[0], [32, 0, 32])
    assert [s.timestamp for s in clip] == pytest.approx([0, 0.08, 0.16, 0.24, 0.32])
    assert [s.name for s in clip][-1] == "000004"
    assert clip[4].read_image().dtype == np.float32 and clip[4].resized(16, 16).read_image().shape == (3, 16, 16)
    with pytest.raises(ValueError, match="`fov` must be between 0 and 180"):
        open_video(tmp_path / "drive.mp4", fov=200)
    with pytest.raises(ValueError, match="which takes fov, not rig"):
        open_sequence(tmp_path / "drive.mp4", rig="grey")


@pytest.mark.parametrize("degrees", [0, 90])
def test_a_video_with_oblong_pixels(tmp_path: Path, degrees: int) -> None:
    """fy / fx is a pixel's width over its height; turned by a quarter, its height over its width. A resize scales."""
    frames = [noise_image(32, 64, i) for i in range(3)]
    clip = open_video(write_video(tmp_path / "a.mp4", frames, aspect=Fraction(5, 3), degrees=degrees), fov=90)
    height, width, aspect = (64, 32, 3 / 5) if degrees else (32, 64, 5 / 3)
    expected = np.array([[width / 2, 0, width / 2], [0, aspect * width / 2, height / 2], [0, 0, 1]])
    np.testing.assert_allclose(clip[0].K, expected)
    resized = clip.resized(16, 100)[1]
    np.testing.assert_allclose(resized.K, np.diag([100 / width, 16 / height, 1]) @ expected)
    assert resized.read_image().shape == (3, 16, 100)


def test_images_without_a_camera(tmp_path: Path) -> None:
    path = test_data_folder.folder(tmp_path)
    (path / "camera.json").unlink()
    with pytest.raises(ValueError, match=r"camera\.json: no such file; .* or give `fov` in degrees"):
        open_sequence(path)
    assert len(open_sequence(path, fov=50)) == 3


def test_real_data() -> None:
    for name, kind, frames in (
        ("kitti_odometry", "KITTI odometry", 36),
        ("kitti_clip", "folder", 58),
        ("highway.mp4", "video", 221),
    ):
        clip = open_sequence(real(name)).resized(256, 832)
        assert (clip.kind, len(clip)) == (kind, frames)
        image = clip[frames - 1].read_image() if kind != "video" else clip[3].read_image()
        assert image.shape == (3, 256, 832) and 0 <= image.min() < image.max() <= 1


def test_clips_in_a_folder(tmp_path: Path) -> None:
    """In natural order; what is no clip, or hidden, is left out; a preview next to videos is no clip."""
    for name in ("b10.mp4", "b9.MP4", ".hidden.mp4", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    write_images(tmp_path / "a", ["0.png"])
    (tmp_path / "empty").mkdir()
    wanted = [tmp_path / name for name in ("a", "b9.MP4", "b10.mp4")]
    assert clips_in(tmp_path) == wanted
    write_images(tmp_path, ["preview.jpg"])
    assert clips_in(tmp_path) == wanted
    write_text(tmp_path / "camera.json", "{}")
    assert clips_in(tmp_path) == [tmp_path]
    assert clips_in(tmp_path / "a") == [tmp_path / "a"]
    assert clips_in(tmp_path / "empty") == [tmp_path / "empty"]
    assert clips_in(tmp_path / "b10.mp4") == [tmp_path / "b10.mp4"]
    assert clips_in(tmp_path / "none") == [tmp_path / "none"]

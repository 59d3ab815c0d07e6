"""vestcl.data.readers.folder: images with one camera.json."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data_files import noise_image, pose, real, row, write_images, write_text

from vestcl import io
from vestcl.data.readers.folder import open_folder, read_camera
from vestcl.data.readers.splits import windows

CAMERA: dict[str, Any] = {"fx": 70.0, "fy": 71, "cx": 4.0, "cy": 3.0}


def folder(tmp_path: Path, where: str = "image", **camera: object) -> Path:
    write_text(tmp_path / "camera.json", json.dumps(CAMERA | camera))
    write_images(tmp_path / where, ["a.png", "b.png", "c.png"])
    return tmp_path


@pytest.mark.parametrize("where", ["image", "images", "left", "."])
def test_images(tmp_path: Path, where: str) -> None:
    clip = open_folder(folder(tmp_path, where))
    assert (clip.kind, clip.name, [s.name for s in clip]) == ("folder", tmp_path.name, ["a", "b", "c"])
    assert np.array_equal(clip[1].read_image(), io.to_float(noise_image(seed=1)))
    assert clip[0].timestamp is None and clip.fps is None
    assert clip[0].depth is None and clip[0].labels is None and clip[0].right is None


@pytest.mark.parametrize(("centre", "added"), [({}, 0.5), ({"pixel_centre": "integer"}, 0.5),
                                              ({"pixel_centre": "half"}, 0)])  # fmt: skip
def test_half_a_pixel(tmp_path: Path, centre: dict[str, str], added: float) -> None:
    K = open_folder(folder(tmp_path, **centre))[0].K
    assert K.tolist() == [[70, 0, 4 + added], [0, 71, 3 + added], [0, 0, 1]]


def test_all_that_may_lie_next_to_it(tmp_path: Path) -> None:
    right = {"fx": 60, "fy": 61, "cx": 3, "cy": 2}
    path = folder(tmp_path, depth_scale=100, label_ids="trainIds", baseline=0.4, right=right, fps=12.5)
    write_images(path / "right", ["a.jpg", "c.png"])
    io.write_depth(path / "depth" / "a.png", np.full((6, 8), 2.5), 100)
    io.write_depth(path / "depth" / "b.npy", np.full((6, 8), 2.5), 100)
    io.write_pixels(path / "labels" / "b.png", np.full((6, 8), 13, np.uint8))
    write_text(path / "poses.txt", *(row(pose(0, (0, 0, i))[:3]) for i in range(3)))
    clip = open_folder(path)
    assert [s.timestamp for s in clip] == [0, 0.08, 0.16]
    assert [s.world_from_cam[2, 3] for s in clip] == [0, 1, 2]
    assert [s.right is not None for s in clip] == [True, False, True]
    assert clip[0].right is not None and clip[0].right.right_from_left[:3, 3].tolist() == [-0.4, 0, 0]
    assert clip[0].right.K.tolist() == [[60, 0, 3.5], [0, 61, 2.5], [0, 0, 1]]
    assert (clip[0].read_depth() == 2.5).all() and (clip[1].read_depth() == 2.5).all() and clip[2].depth is None
    assert not clip[1].read_mask().any() and clip[0].labels is None
    write_text(path / "times.txt", "0", "0.2", "0.3")
    assert open_folder(path)[1].timestamp == 0.2


def test_field_of_view_in_place_of_a_camera(tmp_path: Path) -> None:
    path = folder(tmp_path)
    with pytest.raises(ValueError, match=r"camera\.json: defines the camera; leave out `fov`"):
        open_folder(path, fov=90)
    (path / "camera.json").unlink()
    np.testing.assert_allclose(open_folder(path, fov=90)[0].K, [[4, 0, 4], [0, 4, 3], [0, 0, 1]])
    with pytest.raises(ValueError, match=r"camera\.json: no such file; write one with fx, fy, cx, cy, or give `fov`"):
        open_folder(path)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"fx": None}, "must have the numbers fx"),
        ({"fx": -1}, "K must be finite"),
        ({"focal": 1}, "unknown keys focal; it may have fx, fy"),
        ({"pixel_centre": "corner"}, "`pixel_centre` must be one of integer, half, got 'corner'"),
        ({"label_ids": "coco"}, "`label_ids` must be one of trainIds, labelIds, virtual_kitti, got 'coco'"),
        ({"fps": 0}, "`fps` must be a positive number, got 0"),
        ({"baseline": "0.5"}, "`baseline` must be a positive number, got '0.5'"),
        ({"right": {"fx": 1}}, "`right` must have fx, fy, cx, cy and nothing else"),
        ({"width": 9, "height": 6}, r"is for images of \(6, 9\) \(height, width\), but they are \(6, 8\)"),
    ],
)
def test_bad_cameras_are_named(tmp_path: Path, camera: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=rf"camera\.json: {message}"):
        open_folder(folder(tmp_path, **camera))


@pytest.mark.parametrize(("text", "message"), [("{", "is not JSON"), ("[1]", "must be an object")])
def test_no_json(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=rf"camera\.json: {message}"):
        read_camera(write_text(tmp_path / "camera.json", text))


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("depth/a.png", r"camera\.json: must contain `depth_scale`, file units per metre, for .*a\.png"),
        ("labels/a.png", r"camera\.json: must contain `label_ids` for .*a\.png"),
        ("right/a.png", r"camera\.json: must contain `baseline` in metres for .*a\.png"),
    ],
)
def test_what_camera_json_must_contain(tmp_path: Path, file: str, message: str) -> None:
    path = folder(tmp_path)
    io.write_pixels(path / file, np.zeros((6, 8), np.uint8))
    with pytest.raises(ValueError, match=message):
        open_folder(path)


def test_tables_of_another_length(tmp_path: Path) -> None:
    path = folder(tmp_path)
    write_text(path / "times.txt", "0", "1")
    with pytest.raises(ValueError, match=r"times\.txt: must have a line for each of 3 frames, got 2"):
        open_folder(path)


def test_images_of_several_sizes(tmp_path: Path) -> None:
    path = folder(tmp_path)
    io.write_pixels(path / "image" / "b.png", noise_image(7, 8))
    with pytest.raises(ValueError, match=r"b\.png: must be 6 x 8 as its clip is, got 7 x 8"):
        open_folder(path)[1].read_image()


def test_no_images(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"has no images, neither next to camera\.json nor in image, images, left"):
        open_folder(tmp_path)


def test_real_clip() -> None:
    """KITTI raw's colour camera with scanner depth, a network's labels and poses, in heavy traffic."""
    clip = open_folder(real("kitti_clip"))
    assert (len(clip), clip.fps, len(list(windows(len(clip))))) == (58, 10, 50)
    sample = clip[0]
    assert (sample.height, sample.width) == (375, 1242)
    np.testing.assert_allclose(sample.K, [[721.5377, 0, 610.0593], [0, 721.5377, 173.354], [0, 0, 1]])
    assert all(s.depth and s.labels and s.world_from_cam is not None for s in clip)
    small = sample.resized(256, 832)
    assert small.read_image().shape == (3, 256, 832)
    full, resized = sample.read_depth(), small.read_depth()
    assert (resized > 0).mean() > 1.8 * (full > 0).mean() and set(resized.flat) <= set(full.flat)
    assert 0.2 < small.read_mask().mean() < 0.8
    assert small.read_mask().mean() == pytest.approx(sample.read_mask().mean(), abs=0.01)
    assert 7 < clip[57].world_from_cam[2, 3] < 8

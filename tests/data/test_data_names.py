"""Which files are a clip's: natural order, suffixes in any case, names twice, and folders of which no file fits."""

import json
import logging
import os
from pathlib import Path

import numpy as np
import pytest
import test_data_cityscapes
import test_data_folder
import test_data_kitti_odometry
import test_data_kitti_raw
import test_data_virtual_kitti
from data_files import noise_image, write_images, write_text

from vestcl import io
from vestcl.data.open import open_sequence
from vestcl.data.readers import files
from vestcl.data.readers.folder import open_folder

CAMERA = {"fx": 70.0, "fy": 71, "cx": 4.0, "cy": 3.0, "depth_scale": 100, "label_ids": "trainIds", "baseline": 0.5}


def folder(tmp_path: Path, names: list[str], where: str = "image") -> Path:
    write_text(tmp_path / "camera.json", json.dumps(CAMERA))
    write_images(tmp_path / where, names)
    return tmp_path


# ---------------------------------------------------------------- order


def test_natural_order_by_hand() -> None:
    names = ["a2b10", "a10", "a", "b1", "a2b9", "a002", "a2", "10", "9", "a2-1", ""]
    ordered = ["", "9", "10", "a", "a002", "a2", "a2-1", "a2b9", "a2b10", "a10", "b1"]
    assert sorted(names, key=files.natural) == ordered


@pytest.mark.parametrize("where", ["image", "images", "left", "."])
def test_frames_are_in_natural_order(tmp_path: Path, where: str) -> None:
    """Frame i has the noise of seed i - 1, in whatever order the folder lists them."""
    path = folder(tmp_path, [f"frame{i}.png" for i in range(1, 13)], where)
    write_text(path / "times.txt", *(str(i / 10) for i in range(12)))
    for i in range(1, 13):
        io.write_pixels(path / "right" / f"frame{i}.PNG", noise_image(seed=100 + i))
        io.write_depth(path / "depth" / f"frame{i}.npy", np.full((6, 8), float(i)))
    clip = open_sequence(path)
    assert [s.name for s in clip] == [f"frame{i}" for i in range(1, 13)]
    for i, sample in enumerate(clip, start=1):
        assert np.array_equal(sample.read_image(), io.to_float(noise_image(seed=i - 1)))
        assert (sample.read_depth() == i / 100).all() and sample.timestamp == (i - 1) / 10
        assert sample.right is not None
        assert np.array_equal(sample.right.read_image(), io.to_float(noise_image(seed=100 + i)))


def test_numbers_of_any_length(tmp_path: Path) -> None:
    path = test_data_kitti_odometry.tree(tmp_path, "01")
    for camera in (0, 1):
        for i in range(4):
            old = path / f"image_{camera}" / f"{i:06}.png"
            old.rename(old.with_name(f"{i + 8}.png"))
    for name in ("times.txt", "../../poses/03.txt"):
        lines = (path / name).read_text().splitlines()
        write_text(path / name, *lines, *lines, *lines)
    assert [s.name for s in open_sequence(path)] == ["8", "9", "10", "11"]


# ---------------------------------------------------------------- suffixes and names


@pytest.mark.parametrize("suffixes", [(".PNG", ".EXR", ".PNG"), (".Png", ".Exr", ".pNG"), (".JPG", ".NPY", ".png")])
def test_suffixes_in_any_case(tmp_path: Path, suffixes: tuple[str, str, str]) -> None:
    image, depth, labels = suffixes
    path = folder(tmp_path, [f"{i}{image}" for i in range(2)])
    for i in range(2):
        io.write_pixels(path / "right" / f"{i}{image}", noise_image())
        io.write_depth(path / "depth" / f"{i}{depth}", np.full((6, 8), 3.0), 100)
        io.write_pixels(path / "labels" / f"{i}{labels}", np.full((6, 8), 13, np.uint8))
    for clip in (
        open_sequence(path),
        open_sequence(path, depth=path / "depth", depth_scale=100, labels=path / "labels"),
    ):
        assert len(clip) == 2
        for sample in clip:
            assert np.allclose(sample.read_depth(), 3) and (sample.read_labels() == 13).all()
            assert sample.right is not None and sample.right.read_image().shape == (3, 6, 8)
    (path / "depth" / f"0{depth}").rename(path / "depth" / f"x{depth}")
    with pytest.raises(ValueError, match=r"depth: has no 0 ending in \.png, \.exr, \.npy"):
        open_sequence(path, depth=path / "depth")
    with pytest.raises(ValueError, match=r"nowhere: has no 0 ending in \.png"):
        open_sequence(path, labels=path / "nowhere")


def test_a_png_depth_in_capitals_needs_its_scale(tmp_path: Path) -> None:
    path = folder(tmp_path, ["0.png"])
    (path / "camera.json").write_text(json.dumps({key: CAMERA[key] for key in ("fx", "fy", "cx", "cy")}))
    io.write_depth(path / "depth" / "0.PNG", np.full((6, 8), 3.0), 100)
    with pytest.raises(ValueError, match="must contain `depth_scale`"):
        open_folder(path)


def test_suffixes_of_the_data_sets(tmp_path: Path) -> None:
    raw = test_data_kitti_raw.drive(tmp_path / "raw")
    odometry = test_data_kitti_odometry.tree(tmp_path / "odometry")
    virtual = test_data_virtual_kitti.tree(tmp_path / "virtual")
    city = test_data_cityscapes.tree(tmp_path / "city")
    test_data_cityscapes.tree(tmp_path / "city", side="right")
    for path in (raw, odometry, virtual, city):
        before = open_sequence(path)
        image = before[1].read_image()
        for file in [*path.rglob("*.png"), *path.rglob("*.jpg")]:
            file.rename(file.with_suffix(file.suffix.upper()))
        after = open_sequence(path)
        assert [s.name for s in after] == [s.name for s in before]
        assert np.array_equal(after[1].read_image(), image)
        assert [s.right is None for s in after] == [s.right is None for s in before]
        assert [s.depth is None for s in after] == [s.depth is None for s in before]


@pytest.mark.parametrize("kind", ["image", "right", "depth", "labels"])
def test_two_files_of_one_name(tmp_path: Path, kind: str) -> None:
    path = folder(tmp_path, ["0.png", "1.png"])
    for name in ("0.png", "1.png"):
        io.write_pixels(path / "right" / name, noise_image())
        io.write_depth(path / "depth" / name, np.full((6, 8), 3.0), 100)
        io.write_pixels(path / "labels" / name, np.full((6, 8), 13, np.uint8))
    assert len(open_folder(path)) == 2
    other = {"image": "1.JPG", "right": "1.jpeg", "depth": "1.npy", "labels": "1.PNG"}[kind]
    (path / kind / other).write_bytes(b"")
    with pytest.raises(ValueError, match=rf"{kind}/1\.\w+: has the name of 1\.\w+; one of the two must go"):
        open_sequence(path)


def test_png_and_jpeg_of_one_number(tmp_path: Path) -> None:
    path = test_data_kitti_raw.drive(tmp_path)
    write_images(path / "image_02" / "data", ["0000000001.jpg"], 10, 33)
    with pytest.raises(ValueError, match=r"0000000001\.png: has the name of 0000000001\.jpg"):
        open_sequence(path)


# ---------------------------------------------------------------- folders that do not fit


@pytest.mark.parametrize(
    ("kind", "file", "wanted"),
    [
        ("depth", "0_depth.png", r"0\.png or 0\.exr or 0\.npy, got 0_depth\.png"),
        ("depth", "0.tiff", r"0\.png or 0\.exr or 0\.npy, got 0\.tiff"),
        ("labels", "00.png", r"0\.png, got 00\.png"),
        ("right", "right_0.png", r"0\.png or 0\.jpg or 0\.jpeg, got right_0\.png"),
        ("depth", None, r"0\.png or 0\.exr or 0\.npy, got nothing"),
    ],
)
def test_a_folder_of_which_no_file_fits(tmp_path: Path, kind: str, file: str | None, wanted: str) -> None:
    path = folder(tmp_path, ["0.png", "1.png"])
    (path / kind).mkdir()
    if file is not None:
        (path / kind / file).write_bytes(b"")
    with pytest.raises(ValueError, match=rf"{kind}: has no file for any of 2 frames; the first must be {wanted}"):
        open_sequence(path)


def test_a_file_in_place_of_a_folder(tmp_path: Path) -> None:
    path = folder(tmp_path, ["0.png"])
    (path / "depth").write_text("")
    with pytest.raises(ValueError, match="depth: Not a directory"):
        open_sequence(path)


def test_a_partial_fit_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = folder(tmp_path, [f"{i}.png" for i in range(4)])
    for i in (0, 3):
        io.write_depth(path / "depth" / f"{i}.npy", np.full((6, 8), 3.0))
    with caplog.at_level(logging.WARNING):
        clip = open_sequence(path)
    assert [s.depth is not None for s in clip] == [True, False, False, True]
    assert caplog.messages == [f"{path / 'depth'}: has files for 2 of 4 frames; the first frame without one is 1"]


def test_numbers_that_do_not_fit(tmp_path: Path) -> None:
    raw = test_data_kitti_raw.drive(tmp_path / "raw")
    right = raw / "image_03" / "data"
    for i in range(3):
        (right / f"{i:010}.png").rename(right / f"{i + 50:010}.png")
    with pytest.raises(ValueError, match=r"image_03/data: has no file .* must be 0000000000\.png, got 0000000050\.png"):
        open_sequence(raw)
    odometry = test_data_kitti_odometry.tree(tmp_path / "odometry")
    for i in range(4):
        (odometry / "image_3" / f"{i:06}.png").rename(odometry / "image_3" / f"{i + 50:06}.png")
    with pytest.raises(ValueError, match=r"image_3: has no file .* must be 000000\.png, got 000050\.png"):
        open_sequence(odometry)
    virtual = test_data_virtual_kitti.tree(tmp_path / "virtual")
    depth = virtual / "frames" / "depth" / "Camera_0"
    for i in range(3):
        (depth / f"depth_{i:05}.png").rename(depth / f"depth_{i + 50:05}.png")
    with pytest.raises(ValueError, match=r"depth/Camera_0: has no file .* must be depth_00000\.png, got depth_00050"):
        open_sequence(virtual)


def test_scans(tmp_path: Path) -> None:
    path = test_data_kitti_raw.drive(tmp_path)
    scans = path / "velodyne_points" / "data"
    scans.mkdir(parents=True)
    (scans / "0000000001.BIN").write_bytes(b"")
    assert [s.depth is not None for s in open_sequence(path)] == [False, True, False]
    (scans / "first.bin").write_bytes(b"")
    with pytest.raises(ValueError, match=r"first\.bin: must be named by its number"):
        open_sequence(path)


# ---------------------------------------------------------------- what is not a file


@pytest.mark.parametrize("kind", ["image", "right", "depth", "labels"])
@pytest.mark.parametrize("what", ["directory", "fifo", "empty", "dangling"])
def test_what_is_no_image(tmp_path: Path, kind: str, what: str) -> None:
    """The second frame's: opening may pass, reading says it; nothing blocks."""
    path = folder(tmp_path, ["0.png", "1.png"])
    for name in ("0.png", "1.png"):
        io.write_pixels(path / "right" / name, noise_image())
        io.write_depth(path / "depth" / name, np.full((6, 8), 3.0), 100)
        io.write_pixels(path / "labels" / name, np.full((6, 8), 13, np.uint8))
    bad = path / kind / "1.png"
    bad.unlink()
    make = {"directory": bad.mkdir, "fifo": lambda: os.mkfifo(bad), "empty": bad.touch}
    make.get(what, lambda: bad.symlink_to("nowhere"))()
    sample = open_sequence(path)[1]
    assert sample.right is not None
    reads = {
        "image": sample.read_image,
        "right": sample.right.read_image,
        "depth": sample.read_depth,
        "labels": sample.read_labels,
    }
    with pytest.raises(ValueError, match=rf"{kind}/1\.png: "):
        reads[kind]()


@pytest.mark.parametrize("name", ["times.txt", "poses.txt"])
def test_tables_that_are_no_files(tmp_path: Path, name: str) -> None:
    path = folder(tmp_path, ["0.png"])
    os.mkfifo(path / name)
    with pytest.raises(ValueError, match=rf"{name}: must be a regular file, got a FIFO"):
        open_sequence(path)
    (path / name).unlink()
    (path / name).mkdir()
    with pytest.raises(ValueError, match=rf"{name}: Is a directory"):
        open_sequence(path)


def test_the_first_image_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(test_data_folder.folder(tmp_path) / "image" / "0.png")
    with pytest.raises(ValueError, match=r"0\.png: must be a regular file, got a FIFO"):
        open_sequence(tmp_path)

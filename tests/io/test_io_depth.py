"""vestcl.io.depth: by hand, and there and back."""

from pathlib import Path

import numpy as np
import pytest
import torch
from data_files import noise_image, real

from vestcl import io


def test_kitti_by_hand(tmp_path: Path) -> None:
    io.write_pixels(tmp_path / "a.png", np.array([[0, 1, 256, 65535]], np.uint16))
    depth = io.read_depth(tmp_path / "a.png", units_per_metre=256)
    assert depth.dtype == np.float32
    assert depth.tolist() == [[0, 1 / 256, 1, 65535 / 256]]


def test_virtual_kitti_by_hand(tmp_path: Path) -> None:
    io.write_pixels(tmp_path / "a.png", np.array([[150, 65535]], np.uint16))
    assert io.read_depth(tmp_path / "a.png", units_per_metre=100).tolist() == [[1.5, np.float32(655.35)]]


def test_disparity_by_hand(tmp_path: Path) -> None:
    """p = 2561: d = 10 px; 0 is invalid, 1 is infinitely far."""
    io.write_pixels(tmp_path / "a.png", np.array([[0, 1, 2, 2561]], np.uint16))
    depth = io.read_cityscapes_disparity(tmp_path / "a.png", baseline=0.2, fx=2000)
    assert depth.tolist() == [[0, 0, 400 * 256, 40]]


def test_disparity_round_trip(tmp_path: Path) -> None:
    disparity = np.random.default_rng(0).uniform(1, 120, (9, 11))
    io.write_pixels(tmp_path / "a.png", np.rint(disparity * 256 + 1).astype(np.uint16))
    depth = io.read_cityscapes_disparity(tmp_path / "a.png", 0.209313, 2262.52)
    assert np.abs(0.209313 * 2262.52 / depth - disparity).max() < 0.51 / 256


@pytest.mark.parametrize("units", [None, 1000.0])
@pytest.mark.parametrize("suffix", [".npy", ".exr"])
def test_round_trip_without_loss(tmp_path: Path, suffix: str, units: float | None) -> None:
    depth = np.random.default_rng(0).uniform(0.1, 900, (1, 5, 7)).astype(np.float32)
    depth[0, 0, :5] = [0, -1, np.nan, np.inf, -np.inf]
    path = tmp_path / f"a{suffix}"
    io.write_depth(path, torch.from_numpy(depth), units)
    read = io.read_depth(path, units)
    assert read.dtype == np.float32 and read[0, :5].tolist() == [0] * 5
    np.testing.assert_allclose(read.flat[5:], depth.flat[5:], rtol=0 if units is None else 2e-7)


def test_png_round_trip(tmp_path: Path) -> None:
    depth = np.random.default_rng(0).uniform(0.1, 250, (5, 7))
    depth[0, :4] = [0, np.nan, 1e-4, 1e6]
    io.write_depth(tmp_path / "a.png", depth, 256)
    read = io.read_depth(tmp_path / "a.png", 256)
    assert read[0, :4].tolist() == [0, 0, 1 / 256, 65535 / 256]
    assert np.abs(read.flat[4:] - depth.flat[4:]).max() <= 0.5 / 256


@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.uint16, np.int32, ">f4"])
def test_npy_of_other_types(tmp_path: Path, dtype: str) -> None:
    np.save(tmp_path / "a.npy", np.array([[[0, 3]]], dtype))
    assert io.read_depth(tmp_path / "a.npy").tolist() == [[0, 3]]


def test_exr_channels(tmp_path: Path) -> None:
    one, two = np.full((2, 3), 1.0), np.full((2, 3), 2.0)
    io.write_exr(tmp_path / "only.exr", {"depth": two})
    assert io.read_depth(tmp_path / "only.exr").max() == 2
    io.write_exr(tmp_path / "z.exr", {"Z": two, "R": one})
    assert io.read_depth(tmp_path / "z.exr").max() == 2
    assert io.read_depth(tmp_path / "z.exr", channel="R").max() == 1
    io.write_exr(tmp_path / "no.exr", {"Y": two, "R": one})
    with pytest.raises(ValueError, match=r"no\.exr: has no channel `Z`; it has R, Y"):
        io.read_depth(tmp_path / "no.exr")


def test_an_npy_file_that_ends_too_early_or_has_a_damaged_header_is_found(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.ones((20, 30), np.float32))
    content = path.read_bytes()
    unclosed = content.replace(b"}", b"(")
    for damaged in (*(content[:end] for end in range(0, len(content), 37)), content.replace(b"20,", b"2e,"), unclosed):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.npy: is not an NPY array, or a damaged one"):
            io.read_depth(path)


def test_a_signalling_nan_is_unknown_and_no_warning(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([[0x7FA00000, 0x3F800000]], np.uint32).view(np.float32))
    assert io.read_depth(tmp_path / "a.npy").tolist() == [[0, 1]]


def test_refuses(tmp_path: Path) -> None:
    io.write_pixels(tmp_path / "8.png", noise_image()[:, :, 0])
    io.write_pixels(tmp_path / "16.png", noise_image()[:, :, 0].astype(np.uint16))
    io.write_pixels(tmp_path / "rgb.png", noise_image().astype(np.uint16))
    (tmp_path / "text.npy").write_text("hello")
    np.save(tmp_path / "object.npy", np.array([None, {}]), allow_pickle=True)
    np.save(tmp_path / "deep.npy", np.zeros((2, 3, 4)))
    np.save(tmp_path / "words.npy", np.array([["a"]]))
    for name, units, message in [
        ("16.png", None, r"16\.png: `units_per_metre` is missing.*KITTI 256"),
        ("16.png", 0.0, "`units_per_metre` must be positive, got 0"),
        ("16.png", np.nan, "`units_per_metre` must be positive, got nan"),
        ("8.png", 256, r"8\.png: must be a 16-bit PNG of one channel, got 8 bits, \[6, 8\]"),
        ("rgb.png", 256, r"rgb\.png: must be a 16-bit PNG of one channel, got 16 bits, \[6, 8, 3\]"),
        ("no.png", 256, r"no\.png: No such file"),
        ("no.npy", None, r"no\.npy: No such file"),
        ("no.exr", None, r"no\.exr: no such file"),
        ("a.tiff", None, r"a\.tiff: a depth file must end in \.png, \.exr or \.npy"),
        ("text.npy", None, r"text\.npy: is not an NPY array"),
        ("object.npy", None, r"object\.npy: is not an NPY array"),
        ("deep.npy", None, r"deep\.npy: must be \[H, W\] or \[1, H, W\], got \[2, 3, 4\]"),
        ("words.npy", None, r"words\.npy: must hold one array of numbers"),
    ]:
        with pytest.raises(ValueError, match=message):
            io.read_depth(tmp_path / name, units)
    with pytest.raises(ValueError, match="`baseline` and `fx` must be positive, got 0 and 1"):
        io.read_cityscapes_disparity(tmp_path / "16.png", 0, 1)
    with pytest.raises(ValueError, match=r"8\.png: must be a 16-bit PNG"):
        io.read_cityscapes_disparity(tmp_path / "8.png", 1, 1)


def test_refuses_to_write(tmp_path: Path) -> None:
    for name, depth, units, message in [
        ("a.png", np.ones((2, 2)), None, "`units_per_metre` is missing"),
        ("a.npy", np.ones((2, 2)), -1.0, "`units_per_metre` must be positive"),
        ("a.jpg", np.ones((2, 2)), 256, r"must end in \.png, \.exr or \.npy"),
        ("a.npy", np.ones((2, 2, 2)), None, r"`depth` must be \[H, W\] or \[1, H, W\], got \[2, 2, 2\]"),
    ]:
        with pytest.raises(ValueError, match=message):
            io.write_depth(tmp_path / name, depth, units)
    assert not list(tmp_path.iterdir())


def test_real_lidar() -> None:
    depth = io.read_depth(real("kitti_clip/depth/000000.png"), 256)
    assert depth.shape == (375, 1242) and 0.02 < (depth > 0).mean() < 0.05
    assert depth[depth > 0].min() > 2 and depth.max() < 100

"""vestcl.data.lens: images, depth and labels of a distorted camera, read as a pinhole's."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from data_files import noise_image, write_images, write_text

from vestcl import io
from vestcl.data.lens import UndistortedImage
from vestcl.data.open import open_sequence
from vestcl.data.readers.camera_file import read_camera
from vestcl.data.readers.folder import open_folder
from vestcl.data.sources import ImageFile

HEIGHT, WIDTH = 60, 96
#: With pixel centres at integers, far enough from the middle that no two axes are equal.
PINHOLE = {"fx": 80.0, "fy": 76.0, "cx": 49.0, "cy": 28.0}
OPENCV = {"k1": -0.25, "k2": 0.06, "p1": 0.004, "p2": -0.006, "k3": 0.01}
RATIONAL = {"k1": 0.4, "k2": 0.1, "k3": 0.02, "k4": 0.6, "k5": 0.2, "k6": 0.05}
FISHEYE = {"distortion": "fisheye", "k1": 0.05, "k2": -0.02, "k3": 0.01, "k4": -0.002}
LENSES = [OPENCV, RATIONAL, FISHEYE]


def distort(lens: dict[str, Any], x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's documented models, written down a second time."""
    if lens.get("distortion") == "fisheye":
        r = np.hypot(x, y).clip(1e-12)
        t = np.arctan(r)
        bent = t * (1 + sum(lens[f"k{i}"] * t ** (2 * i) for i in range(1, 5))) / r
        return x * bent, y * bent
    k1, k2, p1, p2, k3, k4, k5, k6 = (lens.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    s = x**2 + y**2
    q = (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)
    return x * q + 2 * p1 * x * y + p2 * (s + 2 * x**2), y * q + p1 * (s + 2 * y**2) + 2 * p2 * x * y


def directions(lens: dict[str, Any], height: int = HEIGHT, width: int = WIDTH) -> tuple[np.ndarray, np.ndarray]:
    """x / z and y / z [H, W] of what each pixel of the recorded image shows, by fixed-point iteration."""
    sx, sy = width / WIDTH, height / HEIGHT
    u = (np.arange(width) + 0.5 - (PINHOLE["cx"] + 0.5) * sx) / (PINHOLE["fx"] * sx)
    v = (np.arange(height) + 0.5 - (PINHOLE["cy"] + 0.5) * sy) / (PINHOLE["fy"] * sy)
    bent = np.stack(np.broadcast_arrays(u[None], v[:, None]))
    found = bent.copy()
    for _ in range(300):
        found += 0.8 * (bent - distort(lens, *found))
    assert np.abs(bent - distort(lens, *found)).max() < 1e-9
    return found[0], found[1]


def pinhole() -> tuple[np.ndarray, np.ndarray]:
    x = (np.arange(WIDTH) - PINHOLE["cx"]) / PINHOLE["fx"]
    y = (np.arange(HEIGHT) - PINHOLE["cy"]) / PINHOLE["fy"]
    return np.broadcast_to(x, (HEIGHT, WIDTH)), np.broadcast_to(y[:, None], (HEIGHT, WIDTH))


def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint16: ramps, in which an error of a pixel is 0.005, half a pixel 0.0025."""
    planes = np.stack([0.5 + 0.4 * x, 0.5 + 0.4 * y, 0.5 + 0.2 * x - 0.2 * y], axis=-1)
    return np.rint(planes.clip(0, 1) * 65535).astype(np.uint16)


def metres(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 10 + 5 * x + 3 * y


def classes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.where(x > 0.1, 13, np.where(y > 0.1, 0, 10)).astype(np.uint8)


def folder(tmp_path: Path, lens: dict[str, Any], **camera: Any) -> Path:
    x, y = directions(lens)
    content = PINHOLE | lens | {"depth_scale": 256, "label_ids": "trainIds"} | camera
    write_text(tmp_path / "camera.json", json.dumps(content))
    for name in ("a", "b"):
        io.write_pixels(tmp_path / "image" / f"{name}.png", scene(x, y))
        io.write_depth(tmp_path / "depth" / f"{name}.exr", metres(x, y))
        io.write_pixels(tmp_path / "labels" / f"{name}.png", classes(x, y))
    return tmp_path


@pytest.mark.parametrize("lens", LENSES, ids=["opencv", "rational", "fisheye"])
def test_a_recorded_scene_is_the_pinholes(tmp_path: Path, lens: dict[str, Any]) -> None:
    sample = open_folder(folder(tmp_path, lens, depth_scale=1))[0]
    assert sample.K.tolist() == [[80, 0, 49.5], [0, 76, 28.5], [0, 0, 1]]
    shown = ~sample.read_ego_vehicle()[0]
    inner = shown & cv2.erode(shown.astype(np.uint8), np.ones((5, 5))).astype(bool)
    assert inner.mean() > 0.8
    x, y = pinhole()
    error = np.abs(sample.read_image() - io.to_float(scene(x, y)))[:, inner]
    assert error.max() < 5e-4  # a tenth of a pixel
    plain = np.abs(io.read_image(tmp_path / "image" / "a.png") - io.to_float(scene(x, y)))[:, inner]
    assert plain.max() > 10 * error.max()
    assert np.abs(sample.read_depth()[0] - metres(x, y))[inner].max() < 0.5 * 8 / 76 * 1.3  # half a pixel of its slope
    wrong = sample.read_labels()[0] != classes(x, y)
    assert wrong[inner].mean() < 0.02


def test_what_the_recorded_image_does_not_show(tmp_path: Path) -> None:
    """A pincushion's corners: black, without depth, void, and out of ego-motion as a bonnet is."""
    sample = open_folder(folder(tmp_path, {"k1": 0.3}, depth_scale=1))[0]
    outside = sample.read_ego_vehicle()
    assert outside[0, 0, 0] and outside[0, -1, -1] and not outside[0, 28, 49] and 0.05 < outside.mean() < 0.4
    assert not sample.read_image()[:, outside[0]].any() and not sample.read_depth()[outside].any()
    assert (sample.read_labels()[outside] == 255).all() and (sample.read_depth()[~outside] > 0).all()
    assert sample.resized(30, 48).read_ego_vehicle()[0, 0, 0]
    inward = open_folder(folder(tmp_path / "barrel", {"k1": -0.2}))[0]
    assert inward.ego_vehicle is None


def test_maps_of_another_size(tmp_path: Path) -> None:
    """Depth at half the size and labels at twice: the lens is the same, its pixels are not."""
    path = folder(tmp_path, OPENCV, depth_scale=1)
    io.write_depth(path / "depth" / "a.exr", metres(*directions(OPENCV, HEIGHT // 2, WIDTH // 2)))
    io.write_pixels(path / "labels" / "a.png", classes(*directions(OPENCV, 2 * HEIGHT, 2 * WIDTH)))
    sample, (x, y) = open_folder(path)[0], pinhole()
    assert np.abs(sample.read_depth()[0] - metres(x, y)).max() < 1.5 * 8 / 76 * 1.3
    assert (sample.read_labels()[0] != classes(x, y)).mean() < 0.02


def test_maps_from_elsewhere_are_of_the_recorded_image(tmp_path: Path) -> None:
    path, (x, y) = folder(tmp_path, OPENCV), pinhole()
    for kind in ("depth", "labels"):
        (path / kind).rename(path / f"other_{kind}")
    clip = open_sequence(path, depth=path / "other_depth", labels=path / "other_labels")
    assert np.abs(clip[1].read_depth()[0] - metres(x, y)).max() < 0.5 * 8 / 76 * 1.3
    assert (clip[1].read_labels()[0] != classes(x, y)).mean() < 0.02


def test_resized_images_have_the_same_lens(tmp_path: Path) -> None:
    """Images of half the calibration's size: K is halved, the coefficients are not."""
    twice = {"fx": 160.0, "fy": 152.0, "cx": 98.5, "cy": 56.5, "width": 2 * WIDTH, "height": 2 * HEIGHT}
    half = open_folder(folder(tmp_path / "half", OPENCV, **twice))[0]
    full = open_folder(folder(tmp_path / "full", OPENCV))[0]
    np.testing.assert_allclose(half.K, full.K)
    np.testing.assert_allclose(half.read_image(), full.read_image(), atol=1e-5)


def test_the_right_camera_has_a_lens_of_its_own(tmp_path: Path) -> None:
    right = PINHOLE | FISHEYE
    path = folder(tmp_path, OPENCV, baseline=0.5, right=right)
    for name in ("a", "b"):
        io.write_pixels(path / "right" / f"{name}.png", scene(*directions(FISHEYE)))
    sample = open_folder(path)[0]
    assert sample.right is not None and isinstance(sample.right.image, UndistortedImage)
    image = sample.right.read_image()
    assert np.abs(image - io.to_float(scene(*pinhole())))[:, 5:-5, 5:-5].max() < 5e-4
    content = json.loads((path / "camera.json").read_text())
    for changed, message in [
        ({"right": PINHOLE}, "`right` must have its own distortion, as the left camera has"),
        ({"right": PINHOLE | {"k9": 1}}, "`right` must have fx, fy, cx, cy and nothing else but width"),
    ]:
        write_text(path / "camera.json", json.dumps(content | changed))
        with pytest.raises(ValueError, match=message):
            open_folder(path)
    del content["right"]  # as the left one
    write_text(path / "camera.json", json.dumps(content))
    for name in ("a", "b"):
        io.write_pixels(path / "right" / f"{name}.png", scene(*directions(OPENCV)))
    image = open_folder(path)[0].right.read_image()
    assert np.abs(image - io.to_float(scene(*pinhole()))).max() < 5e-4


def test_coefficients_of_zero_change_no_bit(tmp_path: Path) -> None:
    write_text(tmp_path / "camera.json", json.dumps(PINHOLE | {"distortion": "opencv", "k1": 0, "k2": 0.0, "p1": 0}))
    write_images(tmp_path / "image", ["a.png"], HEIGHT, WIDTH)
    sample = open_folder(tmp_path)[0]
    assert isinstance(sample.image, ImageFile)
    assert np.array_equal(sample.read_image(), io.to_float(noise_image(HEIGHT, WIDTH)))


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        ({"k1": "a"}, "`k1` must be a number, got 'a'"),
        ({"k1": True}, "`k1` must be a number, got True"),
        ({"k2": 1e300}, r"`k2` must be at most 10000, got 1e\+300"),
        ({"k1": -900}, "undistorted, .*% of the image would be outside the recorded one"),
        ({"k1": 900}, "undistorted, .*% of the image would be outside the recorded one"),
        ({"p1": 500}, "undistorted, .*% of the image would be outside the recorded one"),
        ({"k1": 0.1, "k4": 0.1}, '`k4` needs "distortion": "fisheye", or "opencv"'),
        ({"distortion": "fisheye"}, "`distortion` fisheye must come with its coefficients"),
        ({"distortion": "fisheye", "k1": 0.1, "p1": 0.1}, "a fisheye has k1, k2, k3, k4, not p1"),
        ({"distortion": "brown"}, "`distortion` must be one of opencv, fisheye, got 'brown'"),
        ({"distortion": [-0.3, 0.1]}, r"`distortion` must be one of opencv, fisheye, got \[-0\.3, 0\.1\]"),
        ({"distorsion": "fisheye", "k1": 0.1}, r"unknown keys distorsion \(did you mean distortion\?\)"),
        ({"dist_coeffs": [-0.3, 0.1]}, "unknown keys dist_coeffs"),
        ({"K1": 0.1}, r"unknown keys K1"),
    ],
)
def test_lenses_that_are_refused(tmp_path: Path, lens: dict[str, Any], message: str) -> None:
    write_text(tmp_path / "camera.json", json.dumps(PINHOLE | lens))
    write_images(tmp_path / "image", ["a.png"], HEIGHT, WIDTH)
    with pytest.raises(ValueError, match=rf"camera\.json: {message}"):
        open_folder(tmp_path)


def test_a_lens_that_folds_shows_nothing_twice(tmp_path: Path) -> None:
    """r (1 - 0.9 r^2) grows up to r = 0.61: farther out the polynomial comes back, the lens does not."""
    write_text(tmp_path / "camera.json", json.dumps(PINHOLE | {"k1": -0.9}))
    write_images(tmp_path / "image", ["a.png"], HEIGHT, WIDTH)
    sample, (x, y) = open_folder(tmp_path)[0], pinhole()
    outside, radius, last = sample.read_ego_vehicle()[0], np.hypot(x, y), (1 / 2.7) ** 0.5
    assert outside[radius > last + 0.001].all() and not outside[radius < last - 0.001].any() and outside.any()


def test_read_camera(tmp_path: Path) -> None:
    camera = read_camera(write_text(tmp_path / "camera.json", json.dumps(PINHOLE | FISHEYE))).camera
    assert camera.distortion is not None and camera.distortion.fisheye
    assert camera.distortion.coefficients == (0.05, -0.02, 0.01, -0.002)
    camera = read_camera(write_text(tmp_path / "camera.json", json.dumps(PINHOLE | OPENCV))).camera
    assert camera.distortion is not None
    assert camera.distortion.coefficients == (-0.25, 0.06, 0.004, -0.006, 0.01, 0, 0, 0)

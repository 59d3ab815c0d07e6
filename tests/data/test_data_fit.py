"""vestcl.data.fit through every reader: K for images of another size than the one that their calibration is for."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import test_data_cityscapes
import test_data_folder
import test_data_kitti_odometry
import test_data_kitti_raw
import test_data_virtual_kitti
from data_files import noise_image, row, write_images, write_text

from vestcl import io
from vestcl.data import fit
from vestcl.data.calibration import Matrix, intrinsics
from vestcl.data.open import open_sequence
from vestcl.data.readers.folder import open_folder
from vestcl.data.sample import Clip

KITTI = np.array([[721.5377, 0, 610.0593], [0, 721.5377, 173.354], [0, 0, 1]])


def scaled(K: Matrix, sx: float, sy: float) -> Matrix:
    return np.diag([sx, sy, 1]) @ K


def settled(message: str, folder: Path, size: tuple[int, int]) -> Clip:
    """The clip of images of ``size`` with the camera.json that an error's text has."""
    (text,) = re.findall(r"\{[^{}]*\}", message.split(" if they were cropped")[0])
    write_text(folder / "camera.json", text)
    write_images(folder / "image", ["0.png"], *size)
    return open_folder(folder)


def kitti_raw(tmp_path: Path, size: tuple[int, int], name: str = "2011_09_26_drive_0060_sync") -> Path:
    path = test_data_kitti_raw.drive(tmp_path, 2)
    for camera in ("02", "03"):
        write_images(path / f"image_{camera}" / "data", [f"{i:010}.png" for i in range(2)], *size)
    return path.rename(path.with_name(name))


# ---------------------------------------------------------------- KITTI raw


@pytest.mark.parametrize("size", [(188, 621), (94, 310), (192, 640), (38, 125)])
def test_kitti_raw_resized(tmp_path: Path, size: tuple[int, int]) -> None:
    """621 x 188 is half of 1242 x 375 but for the rounding, 640 x 192 is 0.5153 and 0.5120 of it."""
    sample = open_sequence(kitti_raw(tmp_path, size))[0]
    expected = scaled(KITTI, size[1] / 1242, size[0] / 375)
    np.testing.assert_allclose(sample.K, expected, rtol=1e-12)
    assert sample.right is not None
    np.testing.assert_allclose(sample.right.K, expected, rtol=1e-12)
    assert sample.right.right_from_left[0, 3] == pytest.approx(-0.5327, abs=5e-5)  # metres, whatever the size


def test_kitti_raw_sides_of_their_own(tmp_path: Path) -> None:
    path = kitti_raw(tmp_path, (94, 310))
    write_images(path / "image_03" / "data", [f"{i:010}.png" for i in range(2)], 188, 621)
    sample = open_sequence(path)[0]
    assert sample.right is not None
    np.testing.assert_allclose(sample.K, scaled(KITTI, 310 / 1242, 94 / 375))
    np.testing.assert_allclose(sample.right.K, scaled(KITTI, 621 / 1242, 188 / 375))


@pytest.mark.parametrize("size", [(200, 640), (375, 1000), (256, 1242), (375, 1224)])
def test_kitti_raw_of_other_proportions(tmp_path: Path, size: tuple[int, int]) -> None:
    path = kitti_raw(tmp_path, size)
    numbers = rf"`P_rect_02`: is for images of \(375, 1242\) \(height, width\), but they are \({size[0]}, {size[1]}\)"
    with pytest.raises(ValueError, match=numbers) as error:
        open_sequence(path)
    clip = settled(str(error.value), tmp_path / "settled", size)
    np.testing.assert_allclose(clip[0].K, scaled(KITTI, size[1] / 1242, size[0] / 375), atol=1e-3)


def test_kitti_raw_with_a_right_camera_of_other_proportions(tmp_path: Path) -> None:
    path = kitti_raw(tmp_path, (94, 310))
    write_images(path / "image_03" / "data", ["0000000000.png"], 94, 200)
    with pytest.raises(ValueError, match="`P_rect_03`: is for images of"):
        open_sequence(path)


def recorded(path: Path) -> None:
    """Adds what the data set says of the images before they are rectified."""
    cameras = path.parent / "calib_cam_to_cam.txt"
    for camera in ("02", "03"):
        lines = (
            f"S_{camera}: 1392 512\nK_{camera}: 960 0 696 0 961 224 0 0 1\nD_{camera}: -0.37 0.2 0.001 0.002 -0.07\n"
        )
        cameras.write_text(cameras.read_text() + lines)


@pytest.mark.parametrize(("size", "kind"), [((512, 1392), "sync"), ((256, 696), "sync"), ((94, 310), "extract")])
def test_kitti_raw_that_is_not_rectified(tmp_path: Path, size: tuple[int, int], kind: str) -> None:
    path = kitti_raw(tmp_path, size, f"2011_09_26_drive_0060_{kind}")
    recorded(path)
    with pytest.raises(ValueError, match=r"rectified .* open the drive's _sync folder, or a folder") as error:
        open_sequence(path)
    (text,) = re.findall(r"\{.*\}", str(error.value))
    assert json.loads(text) == {
        **{"fx": 960, "fy": 961, "cx": 696, "cy": 224, "width": 1392, "height": 512},
        **{"k1": -0.37, "k2": 0.2, "p1": 0.001, "p2": 0.002, "k3": -0.07},
    }


def test_kitti_raw_without_s_rect(tmp_path: Path) -> None:
    """A published K is for one size; without the size in the file, images of no other are taken."""
    path = kitti_raw(tmp_path, (188, 621))
    cameras = path.parent / "calib_cam_to_cam.txt"
    lines = [line for line in cameras.read_text().splitlines() if not line.startswith("S_")]
    cameras.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"`P_rect_02`: is for images of \(375, 1242\)") as error:
        open_sequence(path)
    np.testing.assert_allclose(settled(str(error.value), tmp_path / "s", (188, 621))[0].K, scaled(KITTI, .5, 188 / 375),
                               atol=1e-3)  # fmt: skip
    cameras.write_text("\n".join([*lines, "S_rect_02: 1242.5 375"]))
    with pytest.raises(ValueError, match="`S_rect_02` must be a width and a height in pixels"):
        open_sequence(path)


def test_laser_scans_follow_the_size(tmp_path: Path) -> None:
    """A return at 10 m on the axis, 1 m to the right: at twice the size in twice the column."""
    path = kitti_raw(tmp_path, (94, 310))
    scan = path / "velodyne_points" / "data" / "0000000000.bin"
    scan.parent.mkdir(parents=True)
    points = [(10, -1, 0.5, 0), (np.nan, 1, 1, 0), (np.inf, 0, 0, 0), (1e-30, 1, 1, 0), (3e38, 3e38, -3e38, 0)]
    scan.write_bytes(np.array(points, "<f4").tobytes())
    places = []
    for size in ((94, 310), (188, 621)):
        write_images(path / "image_02" / "data", [f"{i:010}.png" for i in range(2)], *size)
        depth = open_sequence(path)[0].read_depth()
        (at,) = np.argwhere(depth[0])
        K = scaled(KITTI, size[1] / 1242, size[0] / 375)
        assert tuple(at) == (int(K[1, 1] * -0.05 + K[1, 2]), int(K[0, 0] * 0.106 + K[0, 2]))
        places.append(at)
    assert np.abs(2 * places[0] + 1 - places[1]).max() <= 1


# ---------------------------------------------------------------- KITTI odometry


def odometry(tmp_path: Path, K: Matrix, size: tuple[int, int]) -> Path:
    folder = test_data_kitti_odometry.tree(tmp_path)
    lines = [f"P{i}: {row(np.column_stack([K, [0, 0, 0]]))}" for i in range(4)]
    write_text(folder / "calib.txt", *lines)
    for camera in range(4):
        for i in range(4):
            io.write_pixels(folder / f"image_{camera}" / f"{i:06}.png", np.zeros(size, np.uint8))
    return folder


@pytest.mark.parametrize(("numbers", "size"), fit.KITTI_SIZES.items())
def test_odometry_of_published_sizes(tmp_path: Path, numbers: tuple[float, ...], size: tuple[int, int]) -> None:
    K = intrinsics(numbers[0], *numbers)
    np.testing.assert_allclose(open_sequence(odometry(tmp_path, K, size))[0].K[:2, 2], np.add(numbers[1:], 0.5))
    half = (size[0] // 2, size[1] // 2)
    with pytest.raises(ValueError, match=rf"`P2`: is for images of \({size[0]}, {size[1]}\)") as error:
        open_sequence(odometry(tmp_path, K, half))
    found = settled(str(error.value), tmp_path / "settled", half)[0].K
    np.testing.assert_allclose(found[0], [half[1] / size[1] * numbers[0], 0, half[1] / size[1] * (numbers[1] + 0.5)],
                               atol=1e-3)  # fmt: skip


@pytest.mark.parametrize(
    ("cx", "cy", "message"),
    [
        (607, 40, r"principal point \(607\.5, 40\.5\) px is outside the images, which are \(80, 240\)"),
        (180, 40, "is far from the middle of the images, .* seems to be for another size, which it does not state"),
        (120, 70, "is far from the middle"),
        (120, -3, "is outside the images"),
    ],
)
def test_odometry_of_implausible_cameras(tmp_path: Path, cx: float, cy: float, message: str) -> None:
    with pytest.raises(ValueError, match=rf"calib\.txt: `P2`: its .*{message[:20]}") as error:
        open_sequence(odometry(tmp_path, intrinsics(150, 150, cx, cy), (80, 240)))
    assert re.search(message, str(error.value)) and '"width": WIDTH, "height": HEIGHT}' in str(error.value)


def test_odometry_of_a_plausible_camera(tmp_path: Path) -> None:
    clip = open_sequence(odometry(tmp_path, intrinsics(150, 150, 115, 50), (80, 240)))
    assert clip[0].K[:2, 2].tolist() == [115.5, 50.5]


# ---------------------------------------------------------------- Virtual KITTI, Cityscapes


def test_virtual_kitti(tmp_path: Path) -> None:
    folder = test_data_virtual_kitti.tree(tmp_path)
    rgb = folder / "frames" / "rgb"
    write_images(rgb / "Camera_1", [f"rgb_{i:05}.jpg" for i in range(3)], 20, 66)
    sample = open_sequence(folder)[0]
    full = np.array([[725.0087, 0, 621], [0, 725.0087, 187.5], [0, 0, 1]])
    assert sample.right is not None
    np.testing.assert_allclose(sample.right.K, scaled(full, 66 / 1242, 20 / 375))
    write_images(rgb / "Camera_0", [f"rgb_{i:05}.jpg" for i in range(3)], 10, 30)
    with pytest.raises(ValueError, match=r"intrinsic\.txt: frame 0 of camera 0: is for images of \(375, 1242\)"):
        open_sequence(folder)


def test_cityscapes(tmp_path: Path) -> None:
    """Cut below 2048 x 800, which is half of it here: the bonnet has ended, and so are the proportions."""
    test_data_cityscapes.tree(tmp_path)
    folder = tmp_path / "leftImg8bit_sequence" / "val" / "frankfurt"
    for path in folder.iterdir():
        io.write_pixels(path, noise_image(400, 1024))
    with pytest.raises(ValueError, match=r"_camera\.json: is for images of \(1024, 2048\).*cy = 513\.137 - rows cut"):
        open_sequence(tmp_path)


# ---------------------------------------------------------------- folders


def test_a_folder_of_resized_images(tmp_path: Path) -> None:
    path = test_data_folder.folder(tmp_path, fx=140, fy=144, cx=7.5, cy=5.5, width=16, height=12)
    np.testing.assert_allclose(open_folder(path)[0].K, [[70, 0, 4], [0, 72, 3], [0, 0, 1]])


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"cx": 5000}, r"principal point \(5000\.5, 3\.5\) px is outside the images"),
        ({"cx": 5000, "width": 8, "height": 6}, "is outside the images"),
        ({"cx": -1}, "is outside the images"),
        ({"cx": 6.5}, "is far from the middle of the images, .*width.: WIDTH"),
        ({"fx": 1e5}, r"fx must be 0\.08 \.\.\. 8000 px"),
        ({"fy": 1e-5}, r"fy must be 0\.06 \.\.\. 6000 px"),
        ({"width": 9, "height": 6}, r"is for images of \(6, 9\) \(height, width\), but they are \(6, 8\)"),
        ({"width": 960}, "must have both `width` and `height`, or neither, got `width` only"),
        ({"height": 6}, "must have both `width` and `height`, or neither, got `height` only"),
        ({"width": 8.5, "height": 6}, "`width` and `height` must be whole numbers"),
    ],
)
def test_folders_that_can_not_be(tmp_path: Path, camera: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=rf"camera\.json: .*{message}"):
        open_folder(test_data_folder.folder(tmp_path, **camera))


def test_a_folder_with_published_numbers(tmp_path: Path) -> None:
    """KITTI's K without its size, images of 0.82 of it: near enough to the middle, and wrong."""
    numbers = {"fx": 721.5377, "fy": 721.5377, "cx": 609.5593, "cy": 172.854}
    path = test_data_folder.folder(tmp_path, **numbers)
    write_images(path / "image", ["a.png", "b.png", "c.png"], 309, 1024)
    with pytest.raises(ValueError, match=r"camera\.json: is for images of \(375, 1242\)") as error:
        open_folder(path)
    K = settled(str(error.value), tmp_path / "settled", (309, 1024))[0].K
    np.testing.assert_allclose(K, scaled(KITTI, 1024 / 1242, 309 / 375), atol=1e-3)
    write_text(path / "camera.json", json.dumps(numbers | {"width": 1242, "height": 375}))
    np.testing.assert_allclose(open_folder(path)[0].K, scaled(KITTI, 1024 / 1242, 309 / 375))


def test_off_the_middle_where_the_size_is_stated(tmp_path: Path) -> None:
    path = test_data_folder.folder(tmp_path, cx=6.5, cy=0.5, width=8, height=6)
    assert open_folder(path)[0].K[:2, 2].tolist() == [7, 1]


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({}, [[140, 0, 9], [0, 142, 7], [0, 0, 1]]),  # as the left camera of 6 x 8
        ({"right": {"fx": 150, "fy": 151, "cx": 8, "cy": 6}}, [[150, 0, 8.5], [0, 151, 6.5], [0, 0, 1]]),
        (
            {"right": {"fx": 75, "fy": 76, "cx": 4, "cy": 3, "width": 8, "height": 6}},
            [[150, 0, 9], [0, 152, 7], [0, 0, 1]],
        ),
        (
            {"right": {"fx": 75, "fy": 76, "cx": 4, "cy": 3}, "width": 8, "height": 6},
            [[150, 0, 9], [0, 152, 7], [0, 0, 1]],
        ),
    ],
)
def test_a_right_camera_of_another_size(tmp_path: Path, more: dict[str, object], expected: list[list[float]]) -> None:
    path = test_data_folder.folder(tmp_path, baseline=0.5, **more)
    write_images(path / "right", ["a.png", "b.png", "c.png"], 12, 16)
    sample = open_folder(path)[0]
    assert sample.right is not None
    np.testing.assert_allclose(sample.right.K, expected)
    write_images(path / "right", ["a.png", "b.png", "c.png"], 12, 12)
    with pytest.raises(ValueError, match=r"camera\.json: (is for images of|its principal point)"):
        open_folder(path)


def test_a_right_camera_as_the_left_one_sees(tmp_path: Path) -> None:
    """A ramp over x / z: read with the left K, both cameras have the same value in the same column."""
    left, right = intrinsics(40, 40, 20, 12), intrinsics(50, 60, 35, 20)
    path = test_data_folder.folder(tmp_path, baseline=0.5)
    (path / "camera.json").write_text(
        json.dumps(
            {"fx": 40, "fy": 40, "cx": 20, "cy": 12, "pixel_centre": "half", "baseline": 0.5}
            | {"right": {"fx": 50, "fy": 60, "cx": 35, "cy": 20}}
        )
    )

    def ramp(K: Matrix, height: int, width: int) -> np.ndarray:
        x = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
        return np.broadcast_to(np.rint((0.5 + 0.4 * x) * 65535), (height, width)).astype(np.uint16)

    for name in "abc":
        io.write_pixels(path / "image" / f"{name}.png", ramp(left, 24, 40))
        io.write_pixels(path / "right" / f"{name}.png", ramp(right, 40, 70))
    sample = open_folder(path)[0]
    assert sample.right is not None
    seen = sample.right.read_as(sample.K, 24, 40)
    np.testing.assert_allclose(seen[:, 3:-3, 3:-3], sample.read_image()[:, 3:-3, 3:-3], atol=1e-3)
    same = sample.right.resized(40, 70)
    assert np.array_equal(same.read_as(same.K, 40, 70), same.read_image())


def test_maps_of_about_the_same_proportions(tmp_path: Path) -> None:
    """KITTI at 640 x 192 with depth at 1242 x 375: 0.6 % apart, 1.2 px."""
    path = test_data_folder.folder(tmp_path, depth_scale=256, fx=371.8, fy=369.4, cx=313.9, cy=88.3)
    for name in "abc":
        io.write_pixels(path / "image" / f"{name}.png", noise_image(192, 640))
        io.write_depth(path / "depth" / f"{name}.png", np.full((375, 1242), 5.0), 256)
    assert (open_folder(path)[0].read_depth() == 5).all()
    io.write_depth(path / "depth" / "a.png", np.full((375, 1200), 5.0), 256)
    with pytest.raises(ValueError, match="must have the proportions of the image"):
        open_folder(path)[0].read_depth()


@pytest.mark.parametrize("seed", range(20))
def test_factors_that_agree_scale_and_others_do_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    calibrated = tuple(int(side) for side in rng.integers(100, 3000, 2))
    K = intrinsics(*rng.uniform(0.5, 2, 2) * calibrated[1], calibrated[1] * 0.51, calibrated[0] * 0.48)
    factor = rng.uniform(0.2, 3)
    size = tuple(max(round(side * factor), 1) for side in calibrated)
    sy, sx = size[0] / calibrated[0], size[1] / calibrated[1]
    if abs(sx / sy - 1) <= 0.0099:
        np.testing.assert_allclose(fit.fit_intrinsics(K, calibrated, size, "x"), scaled(K, sx, sy))
    wrong = size[0], round(size[1] * 1.03) + 1
    with pytest.raises(ValueError, match="is for images of"):
        fit.fit_intrinsics(K, calibrated, wrong, "x")

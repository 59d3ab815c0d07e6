"""vestcl.io.labels: ids, colours and the background mask of SPEC section 3.2."""

from pathlib import Path

import numpy as np
import pytest
from data_files import noise_image, real
from PIL import Image

from vestcl import io
from vestcl.io.labels import FOREGROUND, VIRTUAL_KITTI, VOID


def test_background_by_hand() -> None:
    static = [0, 1, 2, 3, 4, 8, 9, 10, VOID]
    ids = np.array([[*range(19), VOID]], np.uint8)
    assert np.nonzero(io.background(ids)[0])[0].tolist() == [*static[:-1], 19]
    assert not io.background(np.array(FOREGROUND)).any()


def test_train_ids(tmp_path: Path) -> None:
    ids = np.array([[*range(19), VOID]], np.uint8)
    io.write_pixels(tmp_path / "a.png", ids)
    assert np.array_equal(io.read_train_ids(tmp_path / "a.png", "trainIds"), ids)


def test_label_ids_by_hand(tmp_path: Path) -> None:
    """0 unlabelled, 1 ego vehicle, 7 road, 11 building, 17 pole, 23 sky, 24 person, 26 car, 29 caravan, 33 bicycle."""
    io.write_pixels(tmp_path / "a.png", np.array([[0, 1, 7, 11, 17, 23, 24, 26, 29, 33, 255]], np.uint8))
    ids = io.read_train_ids(tmp_path / "a.png", "labelIds")
    assert ids.tolist() == [[255, 255, 0, 2, 5, 10, 11, 13, 255, 18, 255]]
    assert io.background(ids)[0].tolist() == [True] * 4 + [False, True, False, False, True, False, True]
    assert io.read_ego_vehicle(tmp_path / "a.png")[0].tolist() == [False, True] + [False] * 9


def test_every_train_id_has_one_label_id(tmp_path: Path) -> None:
    io.write_pixels(tmp_path / "a.png", np.arange(34, dtype=np.uint8)[None])
    ids = io.read_train_ids(tmp_path / "a.png", "labelIds")[0]
    assert ids[ids != VOID].tolist() == list(range(19))


def test_a_palette_is_not_applied(tmp_path: Path) -> None:
    image = Image.fromarray(np.array([[13, 10, 255]], np.uint8), "L").convert("P")
    image.putpalette([7, 8, 9] * 256)
    image.save(tmp_path / "a.png")
    assert io.read_train_ids(tmp_path / "a.png", "trainIds").tolist() == [[13, 10, 255]]


def test_virtual_kitti(tmp_path: Path) -> None:
    io.write_pixels(tmp_path / "a.png", np.array([[colour for colour, _ in VIRTUAL_KITTI.values()]], np.uint8))
    ids = io.read_train_ids(tmp_path / "a.png", "virtual_kitti")
    assert ids[0].tolist() == [train_id for _, train_id in VIRTUAL_KITTI.values()]
    foreground = [name for name, static in zip(VIRTUAL_KITTI, io.background(ids)[0], strict=True) if not static]
    assert foreground == ["TrafficSign", "TrafficLight", "Pole", "Truck", "Car", "Van"]


def test_refuses(tmp_path: Path) -> None:
    io.write_pixels(tmp_path / "rgb.png", noise_image())
    io.write_pixels(tmp_path / "16.png", np.zeros((2, 2), np.uint16))
    io.write_pixels(tmp_path / "19.png", np.full((2, 2), 19, np.uint8))
    io.write_pixels(tmp_path / "34.png", np.full((2, 2), 34, np.uint8))
    half = (tmp_path / "34.png").read_bytes()
    (tmp_path / "half.png").write_bytes(half[: len(half) - 20])
    for name, kind, message in [
        ("rgb.png", "trainIds", r"rgb\.png: label ids must be an 8-bit image of one channel, got mode RGB"),
        ("16.png", "labelIds", r"16\.png: label ids must be an 8-bit image of one channel, got mode I"),
        ("19.png", "trainIds", r"19\.png: 19 is not one of the trainIds \(0 \.\.\. 18, 255\)"),
        ("34.png", "labelIds", r"34\.png: 34 is not one of the labelIds \(0 \.\.\. 33, 255\)"),
        ("34.png", "colours", "`kind` must be trainIds, labelIds or virtual_kitti, got 'colours'"),
        ("19.png", "virtual_kitti", r"19\.png: Virtual KITTI's classes must be 8-bit RGB"),
        ("rgb.png", "virtual_kitti", r"rgb\.png: \(\d+, \d+, \d+\) is not a colour of Virtual KITTI's classes"),
        ("half.png", "trainIds", r"half\.png: is not an image, or a damaged one$"),
        ("no.png", "trainIds", r"no\.png: No such file"),
        ("no.png", "virtual_kitti", r"no\.png: No such file"),
    ]:
        with pytest.raises(ValueError, match=message):
            io.read_train_ids(tmp_path / name, kind)


def test_real_labels() -> None:
    ids = io.read_train_ids(real("kitti_clip/labels/000000.png"), "trainIds")
    assert ids.shape == (375, 1242) and {0, 2, 10, 13} <= set(ids.flat)
    assert 0.2 < io.background(ids).mean() < 0.8

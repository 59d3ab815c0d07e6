"""vestcl.data.readers.cityscapes on a tiny tree in the data set's layout."""

import json
from pathlib import Path

import numpy as np
import pytest
from data_files import noise_image, write_images, write_text

from vestcl import io
from vestcl.data.readers.cityscapes import is_frame, open_cityscapes, snippets

NAME = "frankfurt_000000_000294"
CAMERA = {
    "extrinsic": {"baseline": 0.209313, "pitch": 0.03, "roll": 0.0, "x": 1.7, "y": 0.1, "yaw": -0.02, "z": 1.2},
    "intrinsic": {"fx": 2262.52, "fy": 2265.3, "u0": 1096.98, "v0": 513.137},
}


def tree(tmp_path: Path, name: str = NAME, side: str = "left", frames: range = range(-19, 11)) -> Path:
    """ROOT with one snippet, its images 64 times smaller than the original ones."""
    city, sequence, annotated = name.split("_")
    folder = tmp_path / f"{side}Img8bit_sequence" / "val" / city
    names = [f"{city}_{sequence}_{int(annotated) + i:06}_{side}Img8bit.png" for i in frames]
    write_images(folder, names, 16, 32)
    write_text(tmp_path / "camera" / "val" / city / f"{name}_camera.json", json.dumps(CAMERA))
    return tmp_path


def test_camera_by_hand(tmp_path: Path) -> None:
    clip = open_cityscapes(tree(tmp_path))
    assert (clip.kind, clip.name, len(clip), clip.fps) == ("Cityscapes", NAME, 30, 17)
    sample = clip[0]
    assert sample.name == "frankfurt_000000_000275" and clip[19].name == NAME
    expected = np.array([[2262.52, 0, 1097.48], [0, 2265.3, 513.637], [0, 0, 1]])
    np.testing.assert_allclose(sample.K, np.diag([1 / 64, 1 / 64, 1]) @ expected)
    full = sample.resized(1024, 2048)
    np.testing.assert_allclose(full.K, expected)
    np.testing.assert_allclose(sample.resized(512, 1024).K, np.diag([0.5, 0.5, 1]) @ expected)
    assert sample.right is None and sample.depth is None and sample.labels is None and sample.world_from_cam is None
    assert sample.read_image().shape == (3, 16, 32)


def test_full_size(tmp_path: Path) -> None:
    tree(tmp_path, frames=range(0))
    folder = tmp_path / "leftImg8bit_sequence" / "val" / "frankfurt"
    io.write_pixels(folder / f"{NAME}_leftImg8bit.png", np.zeros((1024, 2048, 3), np.uint8))
    (sample,) = open_cityscapes(tmp_path)
    np.testing.assert_allclose(sample.K, [[2262.52, 0, 1097.48], [0, 2265.3, 513.637], [0, 0, 1]])


def test_right_camera(tmp_path: Path) -> None:
    tree(tmp_path, side="right")
    sample = open_cityscapes(tree(tmp_path))[5]
    assert sample.right is not None
    np.testing.assert_allclose(sample.right.right_from_left[:3], np.eye(3, 4) - [[0, 0, 0, 0.209313], [0] * 4, [0] * 4])
    assert np.array_equal(sample.right.K, sample.K)
    assert np.array_equal(sample.right.read_image(), io.to_float(noise_image(16, 32, 5)))


@pytest.mark.parametrize("folder", ["disparity", "disparity_sequence"])
def test_depth_from_disparity(tmp_path: Path, folder: str) -> None:
    """p = 2561: 10 px of the 2048 pixels wide image, whatever this image's width."""
    tree(tmp_path)
    path = tmp_path / folder / "val" / "frankfurt" / f"{NAME}_disparity.png"
    io.write_pixels(path, np.full((16, 32), 2561, np.uint16))
    clip = open_cityscapes(tmp_path)
    assert [s.depth is not None for s in clip] == [i == 19 for i in range(30)]
    np.testing.assert_allclose(clip[19].read_depth(), 0.209313 * 2262.52 / 10, rtol=1e-6)
    assert clip[19].resized(8, 20).read_depth().shape == (1, 8, 20)


def test_labels_and_bonnet(tmp_path: Path) -> None:
    """Only the 20th frame is annotated, but the bonnet stays where it is."""
    tree(tmp_path)
    label_ids = np.full((16, 32), 7, np.uint8)
    label_ids[12:] = 1
    label_ids[:2] = 26
    folder = tmp_path / "gtFine" / "val" / "frankfurt"
    io.write_pixels(folder / f"{NAME}_gtFine_labelIds.png", label_ids)
    clip = open_cityscapes(tmp_path)
    assert [s.labels is not None for s in clip] == [i == 19 for i in range(30)]
    assert clip[19].read_labels()[0, ::4, 0].tolist() == [13, 0, 0, 255]
    assert clip[19].read_mask()[0, ::4, 0].tolist() == [False, True, True, True]
    assert clip[3].resized(8, 16).read_ego_vehicle()[0, :, 0].tolist() == [False] * 6 + [True] * 2
    io.write_pixels(folder / f"{NAME}_gtFine_labelTrainIds.png", np.full((16, 32), 2, np.uint8))
    assert (open_cityscapes(tmp_path)[19].read_labels() == 2).all()


def test_every_way_to_name_a_snippet(tmp_path: Path) -> None:
    tree(tmp_path)
    tree(tmp_path, "frankfurt_000000_000576")
    tree(tmp_path, "lindau_000005_000019")
    left = tmp_path / "leftImg8bit_sequence"
    names = ["frankfurt_000000_000294", "frankfurt_000000_000576", "lindau_000005_000019"]
    assert snippets(tmp_path) == snippets(left) == snippets(left / "val") == names
    assert snippets(left / "val" / "frankfurt") == names[:2]
    for path in (tmp_path, left, left / "val", left / "val" / "frankfurt"):
        assert open_cityscapes(path, snippet=names[1]).name == names[1]
        with pytest.raises(
            ValueError, match=r"`snippet` must be one of its [23]: frankfurt_000000_000294, .*; got None"
        ):
            open_cityscapes(path)
    assert open_cityscapes(left / "val" / "lindau")[0].name == "lindau_000005_000000"
    for number, name in (("000275", names[0]), ("000304", names[0]), ("000580", names[1])):
        frame = left / "val" / "frankfurt" / f"frankfurt_000000_{number}_leftImg8bit.png"
        assert is_frame(frame) and open_cityscapes(frame).name == name
    assert open_cityscapes(left / "val" / "frankfurt" / names[0]).name == names[0]
    with pytest.raises(ValueError, match="belongs to no snippet with a camera file"):
        open_cityscapes(left / "val" / "frankfurt" / "frankfurt_000000_000400_leftImg8bit.png")
    assert not is_frame(left / "val" / "frankfurt") and not is_frame(tmp_path / names[0])


def test_bad_files_are_named(tmp_path: Path) -> None:
    tree(tmp_path)
    camera = tmp_path / "camera" / "val" / "frankfurt" / f"{NAME}_camera.json"
    for content, message in [
        ("{", "is not a Cityscapes camera file"),
        ("[1]", "is not a Cityscapes camera file"),
        ("{}", "has no 'intrinsic'"),
        (json.dumps(CAMERA | {"extrinsic": {}}), "has no 'baseline'"),
        (json.dumps(CAMERA | {"extrinsic": {"baseline": 0}}), "`baseline` must be positive, got 0"),
        (json.dumps(CAMERA | {"intrinsic": CAMERA["intrinsic"] | {"fx": -1}}), "K must be finite"),
        (json.dumps(CAMERA | {"intrinsic": CAMERA["intrinsic"] | {"fx": "wide"}}), "is not a Cityscapes camera file"),
    ]:
        camera.write_text(content)
        with pytest.raises(ValueError, match=rf"{NAME}_camera\.json: {message}"):
            open_cityscapes(tmp_path)
    camera.write_text(json.dumps(CAMERA))
    frame = tmp_path / "leftImg8bit_sequence" / "val" / "frankfurt" / "frankfurt_000000_000300_leftImg8bit.png"
    frame.unlink()
    with pytest.raises(ValueError, match=r"frankfurt_000000_000300_leftImg8bit\.png: no such file"):
        open_cityscapes(tmp_path)
    with pytest.raises(ValueError, match=r"has no snippet: frames in leftImg8bit_sequence/SPLIT/CITY"):
        open_cityscapes(tmp_path / "camera")

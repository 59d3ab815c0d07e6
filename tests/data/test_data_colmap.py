"""COLMAP's text model by hand: where it may be, names, cameras, what is malformed. test_data_posed.py reprojects it."""

import re
from pathlib import Path

import posed_scenes
import pytest
from data_files import write_images
from posed_scenes import FRAMES, write_colmap

from vestcl.data.open import open_sequence
from vestcl.data.readers.colmap import open_colmap
from vestcl.data.sample import Clip


@pytest.fixture(scope="module")
def street() -> Clip:
    return posed_scenes.street()


IMAGE = "1 1 0 0 0 0 0 0 1 a.png"
CAMERA = "1 PINHOLE 8 6 7 7.5 4.25 3.25"


def model_of(folder: Path, cameras: str = CAMERA, images: str = f"{IMAGE}\n\n2 1 0 0 0 0 0 -1 1 b.png\n\n") -> Path:
    write_images(folder / "images", ["a.png", "b.png"])
    (folder / "cameras.txt").write_text(cameras, encoding="utf-8")
    (folder / "images.txt").write_text(images, encoding="utf-8")
    return folder


def test_a_model_by_hand(tmp_path: Path) -> None:
    """camera_from_world with t_z = -1 is a camera 1 ahead; a quaternion of another length is normalised."""
    clip = open_colmap(model_of(tmp_path, images="1 2 0 0 0 0 0 -1 1 b.png"), fps=5, scale=3)
    assert clip[0].K.tolist() == [[7, 0, 4.25], [0, 7.5, 3.25], [0, 0, 1]]
    pose = clip[0].world_from_cam
    assert pose is not None and pose[:3, 3].tolist() == [0, 0, 3]


@pytest.mark.parametrize("where", ["sparse/0", "sparse", "", "colmap/sparse/0"])
def test_where_a_model_may_be(where: str, street: Clip, tmp_path: Path) -> None:
    text = write_colmap(tmp_path / "scene", street, where=where)
    if where == "colmap/sparse/0":
        (tmp_path / "scene" / "images").rename(tmp_path / "scene" / "colmap" / "images")
    assert len(open_sequence(tmp_path / "scene")) == FRAMES
    assert len(open_sequence(text)) == FRAMES


def test_names_with_spaces_and_folders(tmp_path: Path) -> None:
    folder = model_of(tmp_path, images="1 1 0 0 0 0 0 0 1 links/Bild 2.png\n\n2 1 0 0 0 0 0 0 1 links/Bild 10.png\n")
    write_images(folder / "images" / "links", ["Bild 2.png", "Bild 10.png"])
    assert [sample.name for sample in open_sequence(folder)] == ["Bild 2", "Bild 10"]


@pytest.mark.parametrize(
    ("cameras", "words"),
    [
        ("1 FOV 8 6 7 7 4 3 0.1", "RADIAL, OPENCV, OPENCV_FISHEYE, got FOV"),
        ("1 PINHOLE 8", "line 1 must be CAMERA_ID MODEL WIDTH HEIGHT PARAMS"),
        ("1 PINHOLE 8 6 7", "line 1: PINHOLE must have 4 parameters, got 1"),
        ("x PINHOLE 8 6 7 7 4 3", "must have a whole number in place of 'x'"),
        ("1 PINHOLE 8 -6 7 7 4 3", "must have a whole number in place of '-6'"),
        ("1 PINHOLE 0 6 7 7 4 3", "WIDTH and HEIGHT must be 1 or more"),
        ("1 PINHOLE 8 6 7 7 4 three", "line 1: could not convert"),
        ("1 PINHOLE 8 6 nan 7 4 3", "must have finite numbers"),
        ("1 PINHOLE 8 6 -7 7 4 3", "fx, fy > 0"),
        (f"{CAMERA}\n{CAMERA}", "line 2: there is another camera 1"),
        ("# none", "its camera must be one of cameras.txt, none, got 1"),
        ("1 PINHOLE 9 6 7 7 4 3", "is for images of (6, 9)"),
    ],
)  # fmt: skip
def test_malformed_cameras(cameras: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        open_sequence(model_of(tmp_path, cameras))


@pytest.mark.parametrize(
    ("images", "words"),
    [
        ("", "images.txt: must have one image or more, got none"),
        ("# only a comment\n", "must have one image or more"),
        ("1 1 0 0 0 0 0 0 1", "line 1 must be IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"),
        ("1 0 0 0 0 0 0 0 1 a.png", "a quaternion must be finite and not 0"),
        ("1 1e200 1e200 0 0 1e12 0 0 1 a.png", "line 1: must be a rotation and a finite shift"),
        ("1 1 0 0 0 inf 0 0 1 a.png", "must have finite numbers"),
        ("1 1 0 0 zero 0 0 0 1 a.png", "could not convert"),
        ("1 1 0 0 0 0 0 0 7 a.png", "its camera must be one of cameras.txt, 1, got 7"),
        ("1 1 0 0 0 0 0 0 1 c.png", "there is no image c.png; it looked in"),
        (f"{IMAGE}\n\n2 1 0 0 0 0 0 0 1 c.png", "line 3: there is no image"),
        (f"{IMAGE}\n\n{IMAGE}", "frames must have different names"),
        (f"{IMAGE}\n2 1 0 0 0 0 0 0 1 b.png", "line 2 must be the points X Y POINT3D_ID of the image before, or empty"),
        (f"{IMAGE}\n1.5 2.5 -1 7", "images.txt has two lines per image"),
        (f"{IMAGE}\n1.5 2.5 x", "line 2 must be the points"),
        (IMAGE.replace("1 0 0", "1_0 0 0", 1), "must have a number in place of '1_0'"),
        (IMAGE.replace("1 0 0", "\u0661 0 0", 1), "must have a number in place of '\u0661'"),
    ],
)
def test_malformed_images(images: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        open_sequence(model_of(tmp_path, images=images))


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_ends_of_lines_and_names_with_other_ones(end: str, tmp_path: Path) -> None:
    lines = [IMAGE, "1.5 2.5 -1 3e0 4 12", "2 1 0 0 0 0 0 0 1 a\u2028b.png", ""]
    folder = model_of(tmp_path)
    (folder / "images.txt").write_bytes(end.join(lines).encode("utf-8-sig"))
    write_images(folder / "images", ["a\u2028b.png"])
    assert [sample.name for sample in open_sequence(folder)] == ["a", "a\u2028b"]


@pytest.mark.parametrize("missing", ["images.txt", "cameras.txt"])
def test_one_text_file_is_missing(missing: str, street: Clip, tmp_path: Path) -> None:
    (write_colmap(tmp_path / "scene", street, where="sparse/0") / missing).unlink()
    with pytest.raises(ValueError, match=missing):
        open_sequence(tmp_path / "scene")


def test_cameras_of_two_sizes(tmp_path: Path) -> None:
    cameras = f"{CAMERA}\n2 PINHOLE 16 6 7 7 4 3"
    folder = model_of(tmp_path, cameras, f"{IMAGE}\n\n2 1 0 0 0 0 0 0 2 b.png\n")
    with pytest.raises(ValueError, match="one size, got 6 x 8 and 6 x 16"):
        open_sequence(folder)


def test_a_binary_model_names_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "images.bin").write_bytes(b"\0")
    with pytest.raises(ValueError, match=r"colmap model_converter .* --output_type TXT"):
        open_sequence(tmp_path)


def test_no_text(tmp_path: Path) -> None:
    folder = model_of(tmp_path)
    (folder / "images.txt").write_bytes(b"\xff\xfe1")
    with pytest.raises(ValueError, match=r"images\.txt: is not text"):
        open_sequence(folder)

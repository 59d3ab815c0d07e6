"""Cameras from words: each matrix is worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from vestcl.data.calibration import rigid, translation
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import ImageArray
from vestcl.forecasting.views import parse_view, parse_views, seen_by

K = np.array([[40.0, 0, 33], [0, 50, 17], [0, 0, 1]])
K_RIGHT = np.array([[41.0, 0, 30], [0, 51, 18], [0, 0, 1]])
HALF = np.sqrt(0.5)


@pytest.fixture
def mono() -> Sample:
    return Sample.from_arrays("000007", np.zeros((3, 36, 64)), K)


@pytest.fixture
def stereo(mono: Sample) -> Sample:
    right = RightCamera(ImageArray(np.zeros((3, 36, 64), np.float32)), K_RIGHT, translation((-0.54, 0, 0)))
    return replace(mono, right=right)


def test_source(mono: Sample) -> None:
    view = parse_view("source", mono)
    assert view.name == "source"
    assert view.K is None
    assert np.array_equal(view.tgt_from_next, np.eye(4))


def test_right_is_the_rigs_camera(stereo: Sample) -> None:
    view = parse_view("right", stereo)
    assert view.name == "right"
    assert view.K is not None
    assert np.array_equal(view.K, K_RIGHT)
    assert view.tgt_from_next[:3, 3].tolist() == [-0.54, 0, 0]


def test_right_follows_a_resize(stereo: Sample) -> None:
    view = parse_view("right", Clip("clip", "arrays", (stereo.resized(72, 64),)))
    assert view.K is not None
    assert np.allclose(view.K, [[41, 0, 30], [0, 102, 36], [0, 0, 1]])


def test_left_mirrors_right(stereo: Sample) -> None:
    view = parse_view("left", stereo)
    assert view.name == "left"
    assert view.K is None
    assert np.allclose(view.tgt_from_next, translation((0.54, 0, 0)))


@pytest.mark.parametrize(("word", "numbers"), [("right", '"0.5,0,0"'), ("left", '"-0.5,0,0"')])
def test_without_a_right_camera_numbers_are_suggested(word: str, numbers: str, mono: Sample) -> None:
    with pytest.raises(ValueError, match=f"`view` '{word}' needs a stereo clip, .* 000007 .*{numbers}"):
        parse_view(word, mono)


def test_a_move_shifts_the_world_the_other_way(mono: Sample) -> None:
    view = parse_view(" 0.5, -0.25,2 ", mono)
    assert view.name == "x0.5_y-0.25_z2"
    assert np.allclose(view.tgt_from_next, translation((-0.5, 0.25, -2)))


@pytest.mark.parametrize(
    ("turn", "tgt_from_next"),
    [
        # What is ahead moves to the left of a camera that turns right, ...
        ("yaw=90", [[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
        # down (y > 0) for one that looks up, ...
        ("pitch=90", [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
        # and what is to the right goes up (y < 0) for one that rolls clockwise.
        ("roll=90", [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
        ("yaw=45", [[HALF, 0, -HALF], [0, 1, 0], [HALF, 0, HALF]]),
    ],
)
def test_turns(turn: str, tgt_from_next: list[list[float]], mono: Sample) -> None:
    assert np.allclose(parse_view(f"0,0,0,{turn}", mono).tgt_from_next, rigid(tgt_from_next), atol=1e-15)


def test_a_turned_camera_is_where_it_was_put(mono: Sample) -> None:
    view = parse_view("0.5,1,2,roll=90,yaw=90,name=odd_corner", mono)
    assert view.name == "odd_corner"
    assert np.allclose(view.tgt_from_next @ [0.5, 1, 2, 1], [0, 0, 0, 1])
    # Roll first, then yaw: the camera's x axis points down, its y axis ahead, its z axis to the right.
    assert np.allclose(view.tgt_from_next[:3, :3], [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-15)


def test_fov_keeps_the_pixels_shape_and_the_principal_point(mono: Sample) -> None:
    view = parse_view("0,0,0,fov=90", mono)
    assert view.name == "fov90"
    assert view.K is not None
    assert np.allclose(view.K, [[32, 0, 33], [0, 40, 17], [0, 0, 1]])  # 64 / 2 / tan 45, and times 50 / 40


def test_still_camera_has_a_name(mono: Sample) -> None:
    assert parse_view("0,0,0", mono).name == "x0"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("above", "`view` must be \"source\", .*, got 'above'"),
        ("", "got ''"),
        ("1,2", "got '1,2'"),
        ("1,2,up", "'up' is not a finite number"),
        ("1,2,nan", "'nan' is not a finite number"),
        ("1,2,3,4", "may have yaw=, pitch=, roll=, fov=, name=, each once, got '4'"),
        ("1,2,3,yaw=", "got 'yaw='"),
        ("1,2,3,yaw=a", "'a' is not a finite number"),
        ("1,2,3,yaw=1,yaw=2", "each once, got 'yaw=2'"),
        ("1,2,3,spin=1", "got 'spin=1'"),
        ("1,2,3,fov=180", "`fov` must be between 0 and 180 degrees, got 180"),
        ("1,2,3,name=../up", "name of letters.* got '../up'"),
        ("1,2,3,name=.hidden", "got '.hidden'"),
        ("1,2,3,name=", "got 'name='"),
    ],
)
def test_mistakes_are_reported(text: str, message: str, mono: Sample) -> None:
    with pytest.raises(ValueError, match=message):
        parse_view(text, mono)


def test_views_need_names_of_their_own(stereo: Sample) -> None:
    views = parse_views(["source", "right", "1,0,0", "1,0,0,name=other"], stereo)
    assert [view.name for view in views] == ["source", "right", "x1", "other"]
    with pytest.raises(ValueError, match=r"`view` must have different names, got right twice; add name="):
        parse_views(["right", "source", "right"], stereo)


def test_whose_images_are_a_views_truth(stereo: Sample) -> None:
    assert seen_by(parse_view("source", stereo), stereo) is stereo
    assert seen_by(parse_view("0,0,0", stereo), stereo) is stereo
    assert seen_by(parse_view("0,0,0,fov=50", stereo), stereo) is None
    assert seen_by(parse_view("left", stereo), stereo) is None
    assert seen_by(parse_view("0.54,0,0,name=right", stereo), stereo) is None  # its K is the left camera's
    small = stereo.resized(18, 32)
    right = seen_by(parse_view("right", small), small)
    assert isinstance(right, RightCamera)
    assert right.read_image().shape == (3, 18, 32)


def test_a_right_camera_of_another_size_is_brought_to_the_sources(mono: Sample) -> None:
    right = RightCamera(ImageArray(np.zeros((3, 72, 64), np.float32)), K_RIGHT, translation((-0.54, 0, 0)))
    sample = replace(mono, right=right)
    view = parse_view("right", sample)
    assert view.K is not None
    assert np.allclose(view.K, np.array([[41, 0, 30], [0, 25.5, 9], [0, 0, 1]]))
    truth = seen_by(view, sample)
    assert truth is not None
    assert truth.read_image().shape == (3, 36, 64)

"""nerfstudio's transforms.json and COLMAP's text model, exported from a procedural street and reprojected."""

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import posed_scenes
import pytest
from data_files import write_images, write_text
from posed_scenes import FRAMES, HEIGHT, LENSES, SCALE, WIDTH, write_colmap, write_json, write_nerfstudio

import vestcl
from vestcl.data.open import open_sequence
from vestcl.data.readers.colmap import open_colmap
from vestcl.data.readers.nerfstudio import open_nerfstudio
from vestcl.data.sample import Clip


@pytest.fixture(scope="module")
def street() -> Clip:
    return posed_scenes.street()


def opened(kind: str, folder: Path, street: Clip, model: str) -> Clip:
    if kind == "COLMAP":
        write_colmap(folder, street, model)
    else:
        write_nerfstudio(folder, street, model)
    return vestcl.open(folder, fps=10, scale=SCALE)


def warped(clip: Clip, depth: np.ndarray, later: int) -> np.ndarray:
    """Frame ``later`` as frame 0 sees it: each of its points, by the street's depth, is looked up there."""
    first, then = clip[0], clip[later]
    assert first.world_from_cam is not None and then.world_from_cam is not None
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
    points = np.linalg.inv(first.K) @ rays * depth.reshape(-1)
    then_from_first = np.linalg.inv(then.world_from_cam) @ first.world_from_cam
    q = then.K @ (then_from_first[:3, :3] @ points + then_from_first[:3, 3:])
    at = (q[:2] / q[2] - 0.5).reshape(2, HEIGHT, WIDTH).astype(np.float32)
    image = np.where(then.read_ego_vehicle(), np.float32(np.nan), then.read_image())
    planes = [cv2.remap(plane, at[0], at[1], cv2.INTER_LINEAR, borderValue=np.nan) for plane in image]
    return np.stack(planes)


@pytest.mark.parametrize("kind", ["nerfstudio", "COLMAP"])
@pytest.mark.parametrize("model", LENSES)
def test_a_street_comes_back_by_reprojection(kind: str, model: str, street: Clip, tmp_path: Path) -> None:
    """Poses and K are the street's; undistorted images show what the street's do; another frame fits in by its pose."""
    clip = opened(kind, tmp_path / "Straße", street, model)
    assert (clip.kind, clip.name, len(clip), clip.fps) == (kind, "Straße", FRAMES, 10)
    assert [sample.name for sample in clip] == [f"frame_{i:05}" for i in range(FRAMES)]
    for got, wanted in zip(clip, street, strict=True):
        np.testing.assert_allclose(got.K, wanted.K)
        np.testing.assert_allclose(got.world_from_cam, wanted.world_from_cam, atol=1e-6)
        inside = ~got.read_ego_vehicle()
        assert inside.mean() > 0.8
        difference = np.abs(got.read_image() - wanted.read_image()).mean(axis=0, keepdims=True)
        assert difference[inside].mean() < (0.003 if not LENSES[model] else 0.03)  # bilinear twice
    depth, first = street[0].read_depth()[0], street[0].read_image()
    error = np.abs(warped(clip, depth, 1) - first).mean(axis=0)
    shown = np.isfinite(error) & street[0].read_mask()[0] & (depth < 60)
    assert shown.mean() > 0.3
    still = np.abs(street[1].read_image() - first).mean(axis=0)
    assert np.median(error[shown]) < 0.6 * np.median(still[shown])


def test_without_rate_and_scale(street: Clip, tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, street)
    clip = open_sequence(tmp_path)
    assert clip.fps is None
    first, last = clip[0].world_from_cam, clip[3].world_from_cam
    wanted = np.linalg.norm(street[3].world_from_cam[:3, 3] - street[0].world_from_cam[:3, 3]) / SCALE  # type: ignore[index]
    assert first is not None and last is not None
    assert np.linalg.norm(last[:3, 3] - first[:3, 3]) == pytest.approx(wanted)
    assert len(open_sequence(tmp_path / "transforms.json")) == FRAMES


# ---------------------------------------------------------------- nerfstudio


def content_of(folder: Path, **more: Any) -> dict[str, Any]:
    """Two frames of noise, 6 x 8 px."""
    write_images(folder / "images", ["a.png", "b.png"])
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": np.eye(4).tolist()} for name in "ab"]
    return {"fl_x": 7.0, "fl_y": 7.5, "cx": 4.25, "cy": 3.25, "w": 8, "h": 6, "frames": frames} | more


def test_pixel_centres_are_at_half_integers(tmp_path: Path) -> None:
    write_json(tmp_path, content_of(tmp_path))
    assert open_nerfstudio(tmp_path)[0].K.tolist() == [[7, 0, 4.25], [0, 7.5, 3.25], [0, 0, 1]]


def test_opengl_axes_by_hand(tmp_path: Path) -> None:
    """The file's camera looks along its -z: ours has z there, and y down."""
    write_json(tmp_path, content_of(tmp_path))
    pose = open_nerfstudio(tmp_path)[0].world_from_cam
    assert pose is not None and pose[:3, :3].tolist() == [[1, 0, 0], [0, -1, 0], [0, 0, -1]]


def test_a_frames_own_numbers(tmp_path: Path) -> None:
    content = content_of(tmp_path)
    content["frames"][1] |= {"fl_x": 9.0, "cx": 4.5}
    write_json(tmp_path, content)
    clip = open_nerfstudio(tmp_path)
    assert clip[0].K.tolist() == [[7, 0, 4.25], [0, 7.5, 3.25], [0, 0, 1]]
    assert clip[1].K.tolist() == [[9, 0, 4.5], [0, 7.5, 3.25], [0, 0, 1]]


def test_numbers_of_larger_images_are_scaled(tmp_path: Path) -> None:
    write_json(tmp_path, content_of(tmp_path, w=16, h=12))
    assert open_nerfstudio(tmp_path)[0].K.tolist() == [[3.5, 0, 2.125], [0, 3.75, 1.625], [0, 0, 1]]


def test_an_angle_and_no_suffix(tmp_path: Path) -> None:
    """As Blender's exporters write it: 90 degrees over 8 px is a focal length of 4 px."""
    content = content_of(tmp_path)
    frames = [{**frame, "file_path": f"./images/{name}"} for frame, name in zip(content["frames"], "ab", strict=True)]
    (tmp_path / "images" / "b.png").rename(tmp_path / "images" / "b.PNG")
    write_json(tmp_path, {"camera_angle_x": np.pi / 2, "frames": frames})
    clip = open_nerfstudio(tmp_path)
    np.testing.assert_allclose(clip[1].K, [[4, 0, 4], [0, 4, 3], [0, 0, 1]], atol=1e-9)
    assert clip[1].read_image().shape == (3, 6, 8)


def test_applied_scale(tmp_path: Path) -> None:
    content = content_of(tmp_path, applied_scale=0.5)
    content["frames"][1]["transform_matrix"][0][3] = 3.0
    write_json(tmp_path, content)
    pose = open_nerfstudio(tmp_path, scale=10)[1].world_from_cam
    assert pose is not None and pose[0, 3] == pytest.approx(60)


def changed(**more: Any) -> Any:
    return lambda content: content | more


def frame_with(**more: Any) -> Any:
    return lambda content: content | {"frames": [content["frames"][0], content["frames"][1] | more]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (changed(frames=[]), "`frames` must be a list of one frame or more, got []"),
        (changed(frames={"a": 1}), "`frames` must be a list"),
        (changed(frames=None), "`frames` must be a list"),
        (changed(frames=[3]), "frame 0: must be an object, got 3"),
        (changed(fl_x="7"), "frame 0: `fl_x` must be a finite number, at most 1e+12, got '7'"),
        (changed(fl_x=True), "`fl_x` must be a finite number, at most 1e+12, got True"),
        (changed(fl_x=-7), "fx, fy > 0"),
        (changed(fl_x=None), "must have `fl_x` in pixels or `camera_angle_x` in radians"),
        (changed(fl_x=None, camera_angle_x=4), "`camera_angle_x` must be between 0 and pi radians, got 4"),
        (changed(w=None), "must have both `w` and `h`, or neither"),
        (changed(w=8.5), "`w` and `h` must be whole numbers of 1 or more, got 8.5 and 6"),
        (changed(w=0), "whole numbers of 1 or more"),
        (changed(w=16), "is for images of (6, 16) (height, width), but they are (6, 8)"),
        (changed(k1="x"), "`k1` must be a finite number"),
        (changed(k4=0.1), "camera model OPENCV takes k1, k2, p1, p2, k3; `k4` must be 0, got 0.1"),
        (changed(camera_model="PINHOLE", k1=0.1), "camera model PINHOLE takes no distortion; `k1` must be 0, got 0.1"),
        (changed(camera_model="EQUIRECTANGULAR"), "must be one of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL"),
        (changed(camera_model=["OPENCV"]), "`camera_model` must be one of"),
        (changed(camera_model=[]), "`camera_model` must be one of"),
        (changed(camera_model=0), "`camera_model` must be one of"),
        (changed(camera_model=""), "`camera_model` must be one of"),
        (changed(applied_transform=[[1, 0], [0, 1]]), "`applied_transform` must be [3, 4] or [4, 4] finite numbers"),
        (changed(applied_transform=np.diag([1, 1, -1, 1]).tolist()), "`applied_transform` must be a rotation"),
        (changed(applied_scale=0), "`applied_scale` must be 1e-09 or more, got 0"),
        (changed(applied_scale=1e-320), "`applied_scale` must be 1e-09 or more"),
        (changed(fl_x=10**400), "`fl_x` must be a finite number, at most 1e+12, got 1000"),
        (frame_with(transform_matrix=np.diag([1e200, 1, 1, 1]).tolist()), "`transform_matrix` must be [4, 4]"),
        (frame_with(transform_matrix=np.diag([1, 1e11, 1, 1]).tolist()), "`transform_matrix`: must be a rotation"),
        (frame_with(file_path="images"), "there is no image"),
        (frame_with(file_path="images/" + 300 * "x" + ".png"), "there is no image"),
        (frame_with(file_path=None), "frame 1: `file_path` must be the path of an image, got None"),
        (frame_with(file_path=7), "frame 1: `file_path` must be the path of an image, got 7"),
        (frame_with(file_path="images/c.png"), "frame 1: there is no image"),
        (frame_with(file_path="images/c"), "with one of the suffixes .png, .jpg, .jpeg"),
        (frame_with(file_path="images/a.png"), "frames must have different names"),
        (frame_with(transform_matrix=None), "`transform_matrix` must be [4, 4] or [3, 4] finite numbers, got None"),
        (frame_with(transform_matrix=[[1, 2], [3]]), "frame 1: `transform_matrix` must be"),
        (frame_with(transform_matrix=np.zeros((4, 4)).tolist()), "must have the last row (0, 0, 0, 1)"),
        (frame_with(transform_matrix=np.diag([1, 2, 3, 1]).tolist()), "`transform_matrix`: must be a rotation"),
        (frame_with(w=9), "the images of a clip must have one size, got 6 x 8 and 6 x 9"),
    ],
)  # fmt: skip
def test_malformed_transforms(change: Any, words: str, tmp_path: Path) -> None:
    write_json(tmp_path, change(content_of(tmp_path)))
    with pytest.raises(ValueError, match=re.escape(words)):
        open_sequence(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"frames": NaN}', '{"fl_x": 1, "fl_x": 2}', "\xff"])
def test_bad_json(text: str, tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=r"transforms\.json"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("opens", [open_nerfstudio, open_colmap])
@pytest.mark.parametrize(
    ("options", "words"),
    [({"fps": -1.0}, "`fps` must be positive and finite, got -1"), ({"fps": 0.0}, "`fps`"), ({"scale": 0.0}, "`scale`"),
     ({"scale": float("nan")}, "`scale` must be positive and finite, got nan")],
)  # fmt: skip
def test_rate_and_scale_out_of_range(opens: Any, options: dict[str, float], words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        opens(tmp_path, **options)


def test_a_camera_json_next_to_it_comes_first(tmp_path: Path) -> None:
    write_json(tmp_path, content_of(tmp_path))
    write_text(tmp_path / "camera.json", json.dumps({"fx": 7, "fy": 7, "cx": 4, "cy": 3}))
    assert open_sequence(tmp_path).kind == "folder"

"""The browser's camera as a view: by hand, on canvases of any aspect, and paths through keyframes."""

import math

import numpy as np
import pytest

from vestcl.data.calibration import intrinsics
from vestcl.forecasting.views import parse_view
from vestcl.viewer.camera import Keyframe, Pose, camera_path, fov_of, on_canvas, quaternion_of, view_of

K = intrinsics(400.0, 400.0, 400.0, 100.0)
SIZE = 200, 800
UNTURNED = (1.0, 0.0, 0.0, 0.0)


def test_a_canvas_that_is_as_wide_as_the_source() -> None:
    """tan(fov / 2) = 1 on a canvas of 2:1: 90 degrees from top to bottom, fx = 800 / (2 * 1 * 2)."""
    view = view_of(Pose(UNTURNED, (1.0, 2.0, 3.0), math.pi / 2, 2.0), K, *SIZE)
    np.testing.assert_allclose(view.K, [[200, 0, 400], [0, 200, 100], [0, 0, 1]])
    np.testing.assert_allclose(view.tgt_from_next[:3, 3], [-1, -2, -3])


def test_a_canvas_that_is_wider_than_the_picture() -> None:
    """Then the image is as high as the canvas: fy = 200 / 2."""
    view = view_of(Pose(UNTURNED, (0.0, 0.0, 0.0), math.pi / 2, 5.0), K, *SIZE)
    assert view.K is not None
    np.testing.assert_allclose(np.diag(view.K), [100, 100, 1])


@pytest.mark.parametrize("aspect", [0.5, 1.3, 4.0, 7.0])
def test_the_first_view_is_the_source_camera(aspect: float) -> None:
    uneven = intrinsics(400.0, 500.0, 400.0, 100.0)
    view = view_of(Pose(UNTURNED, (0.0, 0.0, 0.0), fov_of(uneven, *SIZE, aspect), aspect), uneven, *SIZE)
    np.testing.assert_allclose(view.K, uneven)
    np.testing.assert_array_equal(view.tgt_from_next, np.eye(4))


def test_turned_as_views_are() -> None:
    wanted = parse_view_of("0.5,-1,2,yaw=10,pitch=5,roll=3")
    next_from_tgt = np.linalg.inv(wanted)
    position = tuple(float(each) for each in next_from_tgt[:3, 3])
    view = view_of(Pose(quaternion_of(next_from_tgt), position, 1.0, 1.5), K, *SIZE)  # type: ignore[arg-type]
    np.testing.assert_allclose(view.tgt_from_next, wanted, atol=1e-12)


def parse_view_of(text: str) -> np.ndarray:
    from vestcl.data.sample import Sample

    sample = Sample.from_arrays("a", np.zeros((3, *SIZE), np.float32), K)
    return parse_view(text, sample).tgt_from_next


@pytest.mark.parametrize(("aspect", "shape"), [(2.0, (400, 800, 3)), (8.0, (200, 1600, 3)), (4.0, (200, 800, 3))])
def test_bars(aspect: float, shape: tuple[int, int, int]) -> None:
    canvas = on_canvas(np.full((*SIZE, 3), 9, np.uint8), aspect)
    assert canvas.shape == shape
    assert (canvas == 9).sum() == 200 * 800 * 3 and canvas[shape[0] // 2, shape[1] // 2, 0] == 9


def test_a_path_goes_through_its_keyframes() -> None:
    turned = quaternion_of(np.linalg.inv(parse_view_of("0,0,0,yaw=40")))
    keys = [
        Keyframe(Pose(UNTURNED, (0.0, 0.0, 0.0), 1.0, 2.0), 0.0),
        Keyframe(Pose(turned, (1.0, 0.0, 0.0), 0.8, 2.0), 4.0),
        Keyframe(Pose(turned, (1.0, 0.0, 0.0), 0.8, 2.0), 10.0),
    ]
    path = camera_path(keys, 9)
    assert len(path) == 9
    for key, frame in zip(keys, path[::4], strict=True):
        np.testing.assert_allclose(np.hstack([*frame.pose[:2]]), np.hstack([*key.pose[:2]]), atol=1e-12)
        assert frame.ahead == pytest.approx(key.ahead) and frame.pose.fov == pytest.approx(key.pose.fov)
    half = quaternion_of(np.linalg.inv(parse_view_of("0,0,0,yaw=20")))
    np.testing.assert_allclose(path[2].pose.wxyz, half, atol=1e-12)
    assert all(0 <= frame.pose.position[0] <= 1 + 1e-12 for frame in path), "no overshoot"
    with pytest.raises(ValueError, match="must be 2 or more, got 1 and 9"):
        camera_path(keys[:1], 9)

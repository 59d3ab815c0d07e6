"""vestcl.scene.motion.mask: a box that moves, and all that must not look like one."""

from typing import Any

import numpy as np
import pytest
from geometric_scenes import HEIGHT, WIDTH, Floats, K, drive, exact_flow, flat, move, points, room, turned, with_noise

from vestcl.data import street_clip
from vestcl.scene.flow.correspondence import Correspondence, correspond
from vestcl.scene.motion.mask import motion_mask, rigid_pixels

FORWARD = turned(0.01, -0.005, 0.002, (0.05, 0.0, -0.9))

#: Where `room` has its box.
BOX = np.zeros((1, HEIGHT, WIDTH), bool)
BOX[:, 30:70, 40:100] = True


def with_moving_box(metres: float = 0.5) -> Correspondence:
    """The box steps aside; the camera drives on."""
    return exact_flow(room(), FORWARD, np.where(BOX, np.array([metres, 0, 0])[:, None, None], 0))


def overlap(mask: np.ndarray, wanted: np.ndarray) -> float:
    """Intersection over union of what is not background."""
    return float((~mask & wanted).sum() / (~mask | wanted).sum())


def test_a_moving_box_is_found() -> None:
    mask = motion_mask(room(), with_moving_box(), FORWARD, K)
    assert mask.dtype == np.bool_ and mask.shape == (1, HEIGHT, WIDTH)
    assert overlap(mask, BOX) > 0.98


def test_holes_in_it_are_closed_and_specks_elsewhere_are_dropped() -> None:
    correspondence, still = with_moving_box(), exact_flow(room(), FORWARD)
    for y, x in ((40, 60), (50, 80), (60, 70)):
        correspondence.flow_uv[:, y, x] = still.flow_uv[:, y, x]
    correspondence.flow_uv[:, 20:80:20, 200:300:20] += 9
    assert overlap(motion_mask(room(), correspondence, FORWARD, K), BOX) > 0.98


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_nothing_moves_in_a_static_scene(noise: float) -> None:
    assert motion_mask(room(), with_noise(exact_flow(room(), FORWARD), noise), FORWARD, K).all()


@pytest.mark.parametrize("factor", [0.92, 1.08])
def test_errors_of_depth_do_not_move(factor: float) -> None:
    """8 % either way, while 2 m go by: up to 5 px of flow that may be explained so."""
    far = turned(0.0, 0.0, 0.0, (0.0, 0.0, -2.0))
    depth, correspondence = (room() * factor).astype(np.float32), exact_flow(room(), far)
    off = correspondence.flow_uv - exact_flow(depth, far).flow_uv
    assert np.quantile(np.hypot(*off), 0.95) > 2
    assert motion_mask(depth, correspondence, far, K).all()


@pytest.mark.parametrize("why", ["no depth", "does not return"])
def test_of_what_is_not_known_nothing_is_said(why: str) -> None:
    depth, correspondence = room(), with_moving_box()
    if why == "no depth":
        depth[BOX] = 0
    else:
        correspondence.error[BOX] = np.inf
    assert motion_mask(depth, correspondence, FORWARD, K).all()


def test_empty_streets_as_they_are_seen() -> None:
    """Flow as it is measured, with neither cars nor people: less than 3 % looks as if it moved, most of it road."""
    shares = []
    for seed in range(3):
        prev, cur = street_clip(drive(seed).street, 2, HEIGHT, WIDTH, foreground=False, samples=2)
        assert cur.world_from_cam is not None and prev.world_from_cam is not None
        prev_from_cur = np.linalg.inv(prev.world_from_cam) @ cur.world_from_cam
        flow = correspond(cur.read_image(), prev.read_image())
        shares.append(float((~motion_mask(cur.read_depth(), flow, prev_from_cur, cur.K)).mean()))
    assert np.mean(shares) < 0.03


def test_what_seems_to_move_on_the_road_is_not_an_object() -> None:
    """The same wrong flow, on a road and on a wall that stands on it."""
    focal, down = K[1, 1], np.arange(HEIGHT)[:, None] + 0.5 - K[1, 2]
    road = np.minimum(focal * 1.5 / np.maximum(down, 1), 40).astype(np.float32)
    for depth, found in (
        (np.broadcast_to(road, (HEIGHT, WIDTH)), False),
        (np.full((HEIGHT, WIDTH), 9, np.float32), True),
    ):
        depth = np.ascontiguousarray(depth)[None]
        correspondence = exact_flow(depth, FORWARD)
        correspondence.flow_uv[:, 65:90, 100:200] += 12
        assert (~motion_mask(depth, correspondence, FORWARD, K)).any() == found


def test_rigid_pixels_are_the_projection_of_what_moved() -> None:
    x, y, z = move(FORWARD, points(room()))
    wanted = np.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])
    np.testing.assert_allclose(rigid_pixels(room(), K, FORWARD), wanted, atol=1e-3)


def test_invalid_depth_only_turns() -> None:
    depth, turn = flat(0), turned(0.02, 0, 0, (0, 0, 0))
    wanted = rigid_pixels(flat(5), K, turn)
    np.testing.assert_allclose(rigid_pixels(depth, K, turned(0.02, 0, 0, (0.3, 0, -1))), wanted, atol=1e-9)


def cropped(depth: Floats) -> Correspondence:
    return exact_flow(depth[..., 1:], FORWARD)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": room()[0]}, r"`depth` must be \[1, H, W\], got \[96, 320\]"),
        ({"depth": np.full_like(room(), np.inf)}, "`depth` must be finite"),
        ({"dst_from_src": np.eye(3)}, r"`dst_from_src` must be \[4, 4\], got \[3, 3\]"),
        ({"K": np.eye(4)}, r"`K` must be \[3, 3\], got \[4, 4\]"),
        ({"correspondence": cropped(room())}, r"`correspondence` .*\[., 96, 320\], got \[., 96, 319\]"),
    ],
)
def test_refuses(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"depth": room(), "dst_from_src": FORWARD, "K": K}
    arguments["correspondence"] = exact_flow(room(), FORWARD)
    with pytest.raises(ValueError, match=message):
        motion_mask(**arguments | change)

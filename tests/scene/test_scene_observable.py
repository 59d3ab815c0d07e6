"""vestcl.scene.motion.observable: the aperture problem, by hand, and on a road."""

import numpy as np
import pytest
from data_files import pose

from vestcl.scene.motion.observable import observable, on_the_road

HEIGHT, WIDTH = 60, 80
K = np.array([[80.0, 0, 40], [0, 80.0, 20], [0, 0, 1]])


def uniform(u: float, v: float) -> np.ndarray:
    """[2, H, W] px."""
    return np.broadcast_to(np.float32([u, v])[:, None, None], (2, HEIGHT, WIDTH)).copy()


def grey(plane: np.ndarray) -> np.ndarray:
    """[3, H, W]."""
    return np.broadcast_to(plane.astype(np.float32), (3, HEIGHT, WIDTH)).copy()


@pytest.mark.parametrize(("across", "wanted"), [(0.0, (3.0, 0.0)), (90.0, (0.0, -2.0)), (45.0, (0.5, 0.5))])
def test_of_a_line_the_motion_across_it(across: float, wanted: tuple[float, float]) -> None:
    """Of the flow (3, -2) its projection on the direction that brightness changes along, degrees from the row."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    phase = np.cos(np.radians(across)) * x + np.sin(np.radians(across)) * y
    found = observable(uniform(3, -2), grey(0.5 + 0.4 * np.sin(phase / 2)))[:, 10:-10, 10:-10]
    np.testing.assert_allclose(found, uniform(*wanted)[:, 10:-10, 10:-10], atol=0.1)


def test_of_texture_all_and_of_asphalt_nothing() -> None:
    noise = np.random.default_rng(0).random((HEIGHT, WIDTH))
    np.testing.assert_allclose(observable(uniform(3, -2), grey(noise)), uniform(3, -2), atol=0.1)
    assert np.abs(observable(uniform(3, -2), grey(0.3 + 0.005 * noise))).max() < 0.5
    assert not observable(uniform(3, -2), grey(np.full((HEIGHT, WIDTH), 0.3))).any()


def test_asphalt_stays_part_of_the_road() -> None:
    """A level road 1.5 m below, 2 m per interval, whose flow was not found: 0. A wall and an object keep their flow."""
    y = np.arange(HEIGHT)[:, None] + 0.5 - K[1, 2]
    depth = np.broadcast_to(np.where(y > 4, 1.5 * K[1, 1] / np.maximum(y, 1), 30.0), (1, HEIGHT, WIDTH))
    depth, mask = depth.astype(np.float32), np.ones((1, HEIGHT, WIDTH), bool)
    mask[:, 40:50, 30:40] = False
    image, back = grey(np.full((HEIGHT, WIDTH), 0.4)), pose(xyz=(0, 0, 2.0))
    found = on_the_road(uniform(0, 0), image, depth, mask, back, K)
    z, road = depth[0, 30:], np.s_[:, 30:-3, 3:-3]
    wanted = np.stack([np.arange(WIDTH) + 0.5 - K[0, 2] + 0 * z, y[30:] + 0 * z]) * (z / (z + 2) - 1)
    known = mask[0, 30:-3, 3:-3]
    np.testing.assert_allclose(found[road][:, known], wanted[:, :-3, 3:-3][:, known], atol=1e-3)
    assert not found[:, 40:50, 30:40].any() and not found[:, :20].any()

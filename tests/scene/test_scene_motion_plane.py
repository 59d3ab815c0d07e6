"""vestcl.scene.depth.road_plane: the road's plane from inverse depth."""

import numpy as np
import pytest
from numpy.typing import NDArray

from vestcl.scene.depth.road_plane import fit_road, rays_of

HEIGHT, WIDTH = 96, 320
K = np.array([[190.0, 0.0, 157.5], [0.0, 180.0, 45.25], [0.0, 0.0, 1.0]])

#: 1.65 m below the camera, leaning a little both ways.
ROAD = np.array([0.02, 1 / 1.65, -0.03])

Array = NDArray[np.float64]


def inverse_depth(road: Array = ROAD, share: float = 1.0, noise: float = 0.02) -> Array:
    """[H, W] 1/m of a road, with errors; a share of the pixels is of something else."""
    rng = np.random.default_rng(0)
    inverse = np.maximum(np.tensordot(road, rays_of(K, HEIGHT, WIDTH), 1), 1e-3)
    inverse *= 1 + noise * rng.normal(size=inverse.shape)
    return np.where(rng.random(inverse.shape) < share, inverse, inverse * rng.uniform(0.3, 3, inverse.shape))


@pytest.mark.parametrize("share", [1.0, 0.6, 0.4])
def test_the_plane_that_most_points_are_on(share: float) -> None:
    inverse = inverse_depth(share=share)
    plane = fit_road(inverse, 0.02 * inverse, K)
    assert plane is not None
    np.testing.assert_allclose(plane, ROAD, atol=0.004)


@pytest.mark.parametrize(
    "inverse",
    [
        np.full((HEIGHT, WIDTH), 0.1),
        inverse_depth(np.array([0.3, 0.6, 0.0])),
        inverse_depth(np.array([0.0, 0.6, 0.3])),
        inverse_depth(share=0.0),
        np.zeros((HEIGHT, WIDTH)),
    ],
    ids=["wall", "leans to a side", "steep", "no plane", "nothing known"],
)
def test_no_level_plane(inverse: Array) -> None:
    assert fit_road(inverse, np.where(inverse > 0, 0.02 * inverse, np.inf), K) is None


def test_what_is_unknown_takes_no_part() -> None:
    inverse = inverse_depth()
    std = 0.02 * inverse
    unknown = np.random.default_rng(1).random(inverse.shape) < 0.5
    inverse[unknown], std[unknown] = 5.0, np.inf
    plane = fit_road(inverse, std, K)
    assert plane is not None
    np.testing.assert_allclose(plane, ROAD, atol=0.004)


def test_same_bits_twice() -> None:
    inverse = inverse_depth(share=0.5)
    first, second = (fit_road(inverse, 0.02 * inverse, K) for _ in range(2))
    assert first is not None and np.array_equal(first, second)

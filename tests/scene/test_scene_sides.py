"""vestcl.scene.inpainting.sides: at an image's sides a street continues towards the camera."""

import numpy as np

from vestcl.scene.inpainting.holes import fill_holes
from vestcl.scene.inpainting.sides import carry_on

HEIGHT, WIDTH = 96, 320
CENTRE = np.array([150.0, 40.0])
Y, X = np.mgrid[:HEIGHT, :WIDTH] + 0.5
ACROSS, DOWN = X - CENTRE[0], Y - CENTRE[1]
R = np.hypot(ACROSS, DOWN)
NEXT_TO = np.broadcast_to(X > 270, (HEIGHT, WIDTH))
HERE = np.s_[..., 10:-10, 271:285]


def filled(image: np.ndarray, hole: np.ndarray, centre: np.ndarray | None = CENTRE) -> np.ndarray:
    return fill_holes(
        np.where(hole, 0, image).astype(np.float32), np.full((1, HEIGHT, WIDTH), 0.1, np.float32), hole, centre
    )


def test_what_runs_along_the_road_continues() -> None:
    """A kerb: dark below a line through the vanishing point. Next to the hole its error is less than a quarter."""
    image = np.broadcast_to(DOWN < 0.25 * ACROSS, (3, HEIGHT, WIDTH)).astype(np.float32)
    hole = NEXT_TO[None]
    errors = [np.abs(filled(image, hole, centre) - image)[HERE].mean() for centre in (None, CENTRE)]
    assert errors[1] < 0.75 * errors[0]
    assert np.array_equal(filled(image, hole)[:, ~hole[0]], image[:, ~hole[0]])


def test_it_is_mirrored_in_depth() -> None:
    """Colour = r, so that it shows where it is from: 1/r' = 2/r_0 - 1/r, on the row of the vanishing point."""
    radial = (R / 400).astype(np.float32)[None]
    carried = carry_on(radial, NEXT_TO, NEXT_TO, CENTRE)[0, 40, 290] * 400
    edge, r = 120.0, 290.5 - 150.0
    weight = np.exp(-(r / edge - 1) / 0.5)
    wanted = weight / (2 / edge - 1 / r) + (1 - weight) * r
    assert abs(carried - wanted) < 1.5


def test_far_in_the_hole_the_smooth_fill_is_left() -> None:
    radial = (R / 400).astype(np.float32)[None]
    hole = X > 160
    carried = carry_on(radial, hole, hole, CENTRE)
    np.testing.assert_allclose(carried[0, 35:45, 300:], radial[0, 35:45, 300:], atol=0.01)


def test_holes_inside_and_known_pixels_stay() -> None:
    image = np.random.default_rng(0).random((3, HEIGHT, WIDTH), np.float32)
    hole = np.zeros((1, HEIGHT, WIDTH), bool)
    hole[:, 40:60, 100:140] = True
    assert np.array_equal(filled(image, hole), filled(image, hole, None))


def test_any_vanishing_point_gives_numbers() -> None:
    image = np.random.default_rng(0).random((3, HEIGHT, WIDTH), np.float32)
    for centre in ((150.5, 40.5), (-3000.0, 50.0), (300.0, 40.0), (5000.0, -2000.0)):
        for hole in (NEXT_TO[None], np.ones((1, HEIGHT, WIDTH), bool)):
            found = filled(image, hole, np.array(centre))
            assert np.isfinite(found).all() and found.min() >= -1e-6 and found.max() <= 1 + 1e-6

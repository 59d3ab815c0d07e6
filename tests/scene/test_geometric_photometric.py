"""vestcl.scene.motion.photometric: velocities that the images confirm."""

import numpy as np
import pytest
from geometric_scenes import HEIGHT, WIDTH, Floats, K, Matrix, flat, move, noise, planes, points, turned

from vestcl.scene.flow.correspondence import sample
from vestcl.scene.motion.photometric import Pair, confirmed, search

PREV_FROM_CUR = turned(0.01, -0.004, 0.002, (0.03, -0.01, 0.9))

#: Where the object is, and how far, metres.
BOX, BOX_DEPTH = np.s_[35:65, 100:150], 10.0

STILL = np.zeros((2, 3))


def scene() -> tuple[np.ndarray, Floats]:
    """A box before a wall, as objects and as depth."""
    instances, depth = np.zeros((HEIGHT, WIDTH), np.int32), flat(40)
    instances[BOX], depth[0][BOX] = 1, BOX_DEPTH
    return instances, depth


def seen_moving(v: tuple[float, float, float], grain: float = 0.0) -> Pair:
    """Both images of a box that moves by v, with so much noise in them."""
    instances, depth = scene()
    before = noise(seed=5, blur=2.0)
    x, y, z = move(PREV_FROM_CUR, points(depth) - (instances > 0) * np.array(v)[:, None, None])
    now = sample(before, K[0, 0] * x / z + K[0, 2] - 0.5, K[1, 1] * y / z + K[1, 2] - 0.5, outside=0.5)
    rng = np.random.default_rng(1)
    grainy = [np.float32(image + rng.normal(0, grain, image.shape)).clip(0, 1) for image in (now, before)]
    return Pair(grainy[0], grainy[1], PREV_FROM_CUR, K)


def found(v: tuple[float, float, float], by_flow: Matrix = STILL, grain: float = 0.0) -> Matrix:
    return search(*(scene()[0], by_flow, scene()[1]), seen_moving(v, grain))


@pytest.mark.parametrize("v", [(0.0, 0.0, 0.9), (0.0, 0.0, -2.3), (0.6, 0.0, 0.0), (-0.1, 0.0, 1.4)])
@pytest.mark.parametrize("grain", [0.0, 0.02])
def test_a_velocity_that_flow_knows_nothing_of(v: tuple[float, float, float], grain: float) -> None:
    velocity = found(v, grain=grain)
    assert velocity.shape == (2, 3) and not velocity[0].any()
    np.testing.assert_allclose(velocity[1], v, atol=0.06)


@pytest.mark.parametrize("gain", [1.2, 1 / 1.2])
@pytest.mark.parametrize("v", [(0.0, 0.0, 0.9), (0.6, 0.0, 0.0), (0.0, 0.0, -2.3), (0.0, 0.0, 0.0)])
def test_exposure_may_change_between_the_frames(v: tuple[float, float, float], gain: float) -> None:
    (labels, depth), pair = scene(), seen_moving(v)
    pair = pair._replace(image=0.1 + 0.6 * pair.image, image_prev=gain * (0.1 + 0.6 * pair.image_prev))
    np.testing.assert_allclose(search(labels, STILL, depth, pair)[1], v, atol=0.06)


@pytest.mark.parametrize("gain", [1.2, 1 / 1.2])
def test_a_correction_counts_whatever_the_exposure(gain: float) -> None:
    v, still = (0.4, 0.0, 0.0), np.zeros((3, HEIGHT, WIDTH), np.float32)
    plain = seen_moving(v)
    plain = plain._replace(image=0.1 + 0.6 * plain.image, image_prev=0.1 + 0.6 * plain.image_prev)
    other = plain._replace(image_prev=np.float32(gain) * plain.image_prev)
    wanted, got = (confirmed(still + planes(*v), still, scene()[1], pair) for pair in (plain, other))
    np.testing.assert_allclose(got, wanted, atol=0.02)


def test_what_flow_says_is_tried_too() -> None:
    """A bump of 5 cm, which is not searched for."""
    v = np.array([0.4, 0.05, 0.9])
    np.testing.assert_allclose(found((0.4, 0.05, 0.9), np.stack([STILL[0], v]))[1], v, atol=0.03)


@pytest.mark.parametrize("grain", [0.0, 0.02])
def test_a_parked_car_is_static_whatever_flow_says(grain: float) -> None:
    assert not found((0.0, 0.0, 0.0), np.array([[0.0, 0, 0], [2.4, 0.0, -2.1]]), grain).any()


@pytest.mark.parametrize("v", [(0.0, 0.0, -5.6), (4.6, 0.0, 0.5)])
def test_impossible_speeds_are_not_believed(v: tuple[float, float, float]) -> None:
    """Half of the way to the camera, or 46 m/s aside, within a frame: they burst in the next one."""
    velocity = found(v, np.stack([STILL[0], np.array(v)]))
    assert np.linalg.norm(velocity[1]) < 4.5 and velocity[1, 2] > -0.5 * BOX_DEPTH


def test_what_creeps_is_static() -> None:
    assert not found((0.0, 0.0, 0.03)).any()


@pytest.mark.parametrize("why", ["no depth", "too small", "no colour"])
def test_of_what_can_not_be_measured_nothing_is_said(why: str) -> None:
    (instances, depth), pair = scene(), seen_moving((0.0, 0.0, 0.9))
    if why == "no depth":
        depth[0][BOX] = 0
    if why == "too small":
        instances[:] = 0
        instances[40:45, 110:115] = 1
    if why == "no colour":
        pair = pair._replace(image=np.full_like(pair.image, 0.5), image_prev=np.full_like(pair.image, 0.5))
    assert not search(instances, np.array([[0.0, 0, 0], [0.3, 0.0, 0.9]]), depth, pair).any()


def test_nothing_outside_the_frame_before_counts() -> None:
    """A velocity by which the box would come from beyond the border is not taken, similar or not."""
    pair = seen_moving((0.0, 0.0, 0.0))
    dark = pair._replace(image_prev=np.zeros_like(pair.image))
    beyond = np.array([[0.0, 0, 0], [60.0, 0.0, 0.0]])
    assert not search(scene()[0], beyond, scene()[1], dark)[1, 0] > 10


def corrected(v: tuple[float, float, float], correction: tuple[float, float, float]) -> Floats:
    """`confirmed` of a correction everywhere, from no velocity, where the box moves by v."""
    pair, still = seen_moving(v), np.zeros((3, HEIGHT, WIDTH), np.float32)
    return confirmed(still + planes(*correction), still, scene()[1], pair)


def test_a_correction_counts_where_it_is_seen() -> None:
    v = (0.4, 0.0, 0.0)
    velocity = corrected(v, v)
    inner = velocity[:, 40:60, 106:144]
    np.testing.assert_allclose(inner, np.broadcast_to(planes(*v), inner.shape), atol=0.02)
    outside = np.ones((HEIGHT, WIDTH), bool)
    outside[20:80, 80:170] = False
    assert np.abs(velocity[:, outside]).mean() < 0.02


def test_a_wrong_correction_does_not_count() -> None:
    assert np.abs(corrected((0.0, 0.0, 0.0), (0.4, 0.0, 0.0))).max() < 0.02


def test_same_bits_twice() -> None:
    assert np.array_equal(found((0.0, 0.0, 0.9), grain=0.02), found((0.0, 0.0, 0.9), grain=0.02))

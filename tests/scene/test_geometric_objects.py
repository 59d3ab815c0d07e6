"""vestcl.scene.motion.objects: foreground cut into objects, and the velocity of each."""

import numpy as np
import pytest
from data_files import pose
from geometric_scenes import (
    HEIGHT,
    WIDTH,
    Floats,
    K,
    Matrix,
    exact_flow,
    flat,
    move,
    planes,
    points,
    turned,
    with_noise,
)

from vestcl.constants import SKY_DEPTH
from vestcl.scene.flow.correspondence import Correspondence
from vestcl.scene.motion.objects import follow_flow, segment, velocities

#: Of the inverse depth, 1/m.
INVERSE_STD = 0.002

PREV_FROM_CUR = turned(0.01, -0.004, 0.002, (0.03, -0.01, 0.9))

#: Where the object is, and how far, metres.
BOX, BOX_DEPTH = np.s_[35:65, 100:150], 10.0

NOTHING = np.zeros((HEIGHT, WIDTH), np.int32)


def with_box(value: float, elsewhere: float = 40.0) -> Floats:
    plane = flat(elsewhere)
    plane[0][BOX] = value
    return plane


def the_object() -> np.ndarray:
    instances = NOTHING.copy()
    instances[BOX] = 1
    return instances


def seen_moving(v: tuple[float, float, float]) -> tuple[Correspondence, Floats]:
    """Flow to the frame before, and its depth there, of a box that moves by v a frame."""
    depth, shift = with_box(BOX_DEPTH), np.zeros((3, HEIGHT, WIDTH))
    shift[(slice(None), *BOX)] = -np.array(v)[:, None, None]
    correspondence = exact_flow(depth, PREV_FROM_CUR, shift)
    z = move(PREV_FROM_CUR, points(depth) + shift)[2]
    y, x = np.mgrid[:HEIGHT, :WIDTH][(slice(None), *BOX)]
    u, w = correspondence.flow_uv[(slice(None), *BOX)]
    before = flat(float(z[0].mean()))
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):  # flow ends between four pixels
        before[0, np.int_(np.floor(y + w)) + down, np.int_(np.floor(x + u)) + right] = z[BOX]
    return correspondence, before


def measure(v: tuple[float, float, float], noise: float = 0.0, depth_prev: Floats | None = None) -> Matrix:
    correspondence, before = seen_moving(v)
    before = before if depth_prev is None else depth_prev
    noisy = with_noise(correspondence, noise)
    return velocities(the_object(), with_box(BOX_DEPTH), before, INVERSE_STD, noisy, PREV_FROM_CUR, K)


# ---------------------------------------------------------------- objects


def test_objects_are_cut_where_depth_jumps() -> None:
    """Two boxes side by side, at 8 and 12 m, and a third apart from them."""
    mask, depth = np.ones((1, HEIGHT, WIDTH), bool), flat(40)
    for columns, metres in ((slice(100, 130), 8), (slice(130, 160), 12), (slice(200, 230), 12)):
        mask[:, 40:70, columns], depth[:, 40:70, columns] = False, metres
    instances = segment(mask, depth)
    assert instances.dtype == np.int32 and instances.shape == (HEIGHT, WIDTH)
    assert np.array_equal(instances > 0, ~mask[0])  # those at a jump found their owner, and no one else did
    first, second, third = (np.unique(instances[40:70, a:b]) for a, b in ((100, 129), (132, 160), (200, 230)))
    assert len(first) == len(second) == len(third) == 1
    assert sorted([first[0], second[0], third[0]]) == [1, 2, 3]


def test_a_slope_is_one_object() -> None:
    """A lorry along the road: 6 to 20 m."""
    mask, depth = np.ones((1, HEIGHT, WIDTH), bool), flat(40)
    mask[:, 40:70, 100:180] = False
    depth[:, 40:70, 100:180] = np.linspace(6, 20, 80)
    assert np.array_equal(segment(mask, depth) == 1, ~mask[0])


def test_spray_between_two_objects_goes_to_the_nearest() -> None:
    mask, depth = np.ones((1, HEIGHT, WIDTH), bool), flat(40)
    mask[:, 40:70, 100:160] = False
    depth[:, 40:70, 100:130], depth[:, 40:70, 130:160] = 8, 20
    depth[:, 40:70, 128:132] = np.random.default_rng(0).uniform(8, 20, (30, 4))
    instances = segment(mask, depth)
    assert set(np.unique(instances[40:70, 100:160])) == {1, 2}
    assert (instances[42:68, 128] == instances[50, 110]).all() and (instances[42:68, 131] == instances[50, 150]).all()


def test_nothing_in_the_foreground() -> None:
    assert not segment(np.ones((1, HEIGHT, WIDTH), bool), flat(40)).any()


def test_what_is_too_small_to_measure_is_not_an_object() -> None:
    mask = np.ones((1, HEIGHT, WIDTH), bool)
    mask[:, 40:42, 100:102] = False
    assert not segment(mask, flat(40)).any()


def test_what_is_too_small_to_measure_does_not_join_an_object_elsewhere() -> None:
    """A distant sign keeps off the car's velocity, 60 pixels away."""
    mask, depth = np.ones((1, HEIGHT, WIDTH), bool), with_box(BOX_DEPTH)
    mask[0][BOX] = False
    mask[:, 40:42, 210:212] = False
    instances = segment(mask, depth)
    assert np.array_equal(instances == 1, the_object() == 1)


# ---------------------------------------------------------------- velocities


@pytest.mark.parametrize("v", [(0.4, 0.0, 0.9), (-0.2, 0.05, -1.8), (1.0, 0.0, 0.0)])
def test_a_known_velocity_is_recovered(v: tuple[float, float, float]) -> None:
    found = measure(v)
    assert found.shape == (2, 3) and not found[0].any()
    np.testing.assert_allclose(found[1], v, atol=0.05)


@pytest.mark.parametrize("v", [(0.4, 0.0, 0.9), (-0.2, 0.05, -1.8)])
def test_flow_gives_it_too(v: tuple[float, float, float]) -> None:
    """Without the depth before, how the object grows shows how it comes nearer."""
    np.testing.assert_allclose(measure(v, depth_prev=np.zeros_like(flat(1)))[1], v, atol=0.1)


def test_noise_and_outliers_do_not_carry_it_away() -> None:
    v = (0.4, 0.0, 0.9)
    correspondence, before = seen_moving(v)
    noisy = with_noise(correspondence, 0.3)
    noisy.flow_uv[:, 35:65:5, 100:150] += 6  # one row in five
    found = velocities(the_object(), with_box(BOX_DEPTH), before, INVERSE_STD, noisy, PREV_FROM_CUR, K)
    np.testing.assert_allclose(found[1], v, atol=0.15)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_what_is_static_has_exactly_no_velocity(noise: float) -> None:
    assert not measure((0.0, 0.0, 0.0), noise).any()


def test_static_next_to_dynamic_objects() -> None:
    correspondence, before = seen_moving((0.4, 0.0, 0.9))
    instances = the_object()
    instances[40:60, 200:240] = 2
    found = velocities(instances, with_box(BOX_DEPTH), before, INVERSE_STD, correspondence, PREV_FROM_CUR, K)
    assert found.shape == (3, 3) and found[1].any() and not found[2].any()


@pytest.mark.parametrize("why", ["flow does not return", "no depth"])
def test_of_what_is_not_seen_nothing_is_said(why: str) -> None:
    correspondence, before = seen_moving((0.4, 0.0, 0.9))
    depth = with_box(0.0 if why == "no depth" else BOX_DEPTH)
    if why == "flow does not return":
        correspondence.error[0][BOX] = np.inf
    assert not velocities(the_object(), depth, before, INVERSE_STD, correspondence, PREV_FROM_CUR, K).any()


def test_no_objects() -> None:
    found = velocities(NOTHING, flat(40), flat(40), INVERSE_STD, exact_flow(flat(40), pose()), pose(), K)
    assert found.shape == (1, 3) and not found.any()


def test_same_bits_twice() -> None:
    assert np.array_equal(measure((0.4, 0.0, 0.9), 0.3), measure((0.4, 0.0, 0.9), 0.3))


# ---------------------------------------------------------------- what flow shows beyond it


def corrected(velocity: Floats, v: tuple[float, float, float], noise: float = 0.0) -> Floats:
    """`follow_flow` of a bright box that moves by v."""
    image = np.full((3, HEIGHT, WIDTH), 0.2, np.float32)
    image[(slice(None), *BOX)] = 0.8
    flow = with_noise(seen_moving(v)[0], noise)
    return follow_flow(velocity, image, with_box(BOX_DEPTH), flow, PREV_FROM_CUR, K)


def of_the_box(v: tuple[float, float, float]) -> Floats:
    velocity = np.zeros((3, HEIGHT, WIDTH), np.float32)
    velocity[(slice(None), *BOX)] = planes(*v)
    return velocity


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_velocity_that_explains_the_flow_stays(noise: float) -> None:
    velocity = of_the_box((0.4, 0.0, 0.9))
    np.testing.assert_allclose(corrected(velocity, (0.4, 0.0, 0.9), noise), velocity, atol=1e-5)


def test_flow_beyond_the_velocity_corrects_it() -> None:
    """A step of 0.4 m aside at 10 m, 8 px, that no one knew of: inside the box, and only there."""
    velocity = corrected(np.zeros((3, HEIGHT, WIDTH), np.float32), (0.4, 0.0, 0.0))
    inner = np.s_[:, 38:62, 104:146]
    np.testing.assert_allclose(velocity[inner], of_the_box((0.4, 0, 0))[inner], atol=0.03)
    outside = np.ones((HEIGHT, WIDTH), bool)
    outside[32:68, 97:153] = False
    assert np.abs(velocity[:, outside]).max() < 0.01


@pytest.mark.parametrize("why", ["sky", "does not return", "wrong match"])
def test_such_flow_corrects_nothing(why: str) -> None:
    still = np.zeros((3, HEIGHT, WIDTH), np.float32)
    depth = flat(SKY_DEPTH if why == "sky" else 40.0)
    flow = exact_flow(depth, PREV_FROM_CUR)
    flow.flow_uv[0] += 60 if why == "wrong match" else 5
    flow.error[:] = np.inf if why == "does not return" else 0
    assert not follow_flow(still, np.full_like(still, 0.5), depth, flow, PREV_FROM_CUR, K).any()

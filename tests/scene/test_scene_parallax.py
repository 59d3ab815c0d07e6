"""vestcl.scene.flow.parallax: depth against exact flow, gains, refuted depth, and what stays unchanged."""

from typing import Any

import numpy as np
import pytest
from geometric_scenes import HEIGHT, WIDTH, Floats, K, exact_flow, flat, planes, room, turned, with_noise

from vestcl.scene.flow.parallax import OtherFrame, refine_depth

FORWARD = turned(0.01, -0.005, 0.002, (0.05, 0.0, -0.9))
EVERYWHERE = np.ones((1, HEIGHT, WIDTH), bool)

#: Standard deviation of dense inverse search, px, as vestcl.scene.flow.parallax takes it.
FLOW_STD = 0.25

#: Of the inverse depths here, 1/m.
INVERSE_STD = 1e-3

#: A step to the side, metres, after which flow is worth as much as those depths: f t FLOW_STD^-1 = INVERSE_STD^-1.
SIDE = FLOW_STD / INVERSE_STD / K[0, 0]
SIDEWAYS = turned(0, 0, 0, (-SIDE, 0.0, 0.0))

#: A block of more pixels than an island has.
BLOCK = np.s_[:, 40:60, 150:175]


def view(depth: Floats, motion: Any = SIDEWAYS) -> OtherFrame:
    return OtherFrame(exact_flow(depth, motion), motion)


def test_exact_inputs_stay() -> None:
    refined = refine_depth(room(), INVERSE_STD, K, [view(room(), FORWARD)], EVERYWHERE)
    np.testing.assert_allclose(refined, room(), rtol=1e-4)
    assert refined.dtype == np.float32


@pytest.mark.parametrize("views", [1, 2])
def test_noisy_depth_gets_better_by_the_predicted_factor(views: int) -> None:
    """Each view knows as much as the depth: 1 / sqrt(1 + views) of the error is left."""
    truth = flat(15)
    error = np.random.default_rng(0).normal(0, INVERSE_STD, truth.shape)
    depth = (1 / (1 / truth + error)).astype(np.float32)
    seen = [
        OtherFrame(with_noise(exact_flow(truth, SIDEWAYS), FLOW_STD, seed), SIDEWAYS) for seed in range(1, 1 + views)
    ]
    refined = refine_depth(depth, INVERSE_STD, K, seen, EVERYWHERE)
    kept = refined > 0
    assert kept.mean() > 0.999  # one flow in 16,000 is off its line by 4 standard deviations, and refuted
    left = np.std(1 / refined[kept] - 1 / truth[kept]) / np.std(error)
    assert left == pytest.approx((1 + views) ** -0.5, rel=0.02)


def test_a_poor_depth_follows_the_flow() -> None:
    depth = (1 / (1 / flat(15) + 0.003)).astype(np.float32)
    refined = refine_depth(depth, 0.1, K, [view(flat(15))], EVERYWHERE)
    np.testing.assert_allclose(refined, 15, rtol=1e-3)


def test_wrong_depth_is_refuted() -> None:
    depth = room()
    depth[BLOCK] /= 2
    refined = refine_depth(depth, INVERSE_STD, K, [view(room())], EVERYWHERE)
    assert not refined[BLOCK].any()
    refined[BLOCK] = room()[BLOCK]
    np.testing.assert_allclose(refined, room(), rtol=1e-4)


def test_missing_depth_is_found_from_flow() -> None:
    depth = room()
    depth[BLOCK] = 0
    refined = refine_depth(depth, INVERSE_STD, K, [view(room())], EVERYWHERE)
    np.testing.assert_allclose(refined, room(), rtol=1e-3)


@pytest.mark.parametrize("why", ["weak", "does not return", "off its line", "moves"])
def test_missing_depth_stays_missing(why: str) -> None:
    motion = turned(0, 0, 0, (-0.2, 0.0, 0.0)) if why == "weak" else SIDEWAYS
    depth, static, seen = room(), EVERYWHERE.copy(), view(room(), motion)
    depth[BLOCK] = 0
    if why == "does not return":
        seen.correspondence.error[BLOCK] = np.inf
    elif why == "off its line":
        seen.correspondence.flow_uv[BLOCK] += planes(0, 3)
    elif why == "moves":
        static[BLOCK] = False
    refined = refine_depth(depth, INVERSE_STD, K, [seen], static)
    assert not refined[BLOCK].any() and (refined > 0).mean() > 0.95


def test_flow_off_its_line_refutes_depth() -> None:
    seen = view(room())
    seen.correspondence.flow_uv[BLOCK] += planes(0, 3)
    refined = refine_depth(room(), INVERSE_STD, K, [seen], EVERYWHERE)
    assert not refined[BLOCK].any() and (refined > 0).sum() == refined.size - refined[BLOCK].size


def test_flow_that_does_not_return_changes_nothing() -> None:
    depth, seen = room(), view(room())
    depth[BLOCK] /= 2
    seen.correspondence.error[BLOCK] = np.inf
    refined = refine_depth(depth, INVERSE_STD, K, [seen], EVERYWHERE)
    np.testing.assert_allclose(refined[BLOCK], depth[BLOCK], rtol=1e-6)


def test_what_moves_is_unchanged() -> None:
    depth, static = room(), EVERYWHERE.copy()
    depth[BLOCK] /= 2
    static[BLOCK] = False
    refined = refine_depth(depth, INVERSE_STD, K, [view(room())], static)
    np.testing.assert_allclose(refined[BLOCK], depth[BLOCK], rtol=1e-6)


def test_even_a_small_object_that_moves_is_unchanged() -> None:
    """A pedestrian of 8 x 16 pixels at 6 m before a wall at 40 m is not an island."""
    depth, static = flat(40), EVERYWHERE.copy()
    small = np.s_[:, 40:56, 150:158]
    depth[small], static[small] = 6, False
    refined = refine_depth(depth, INVERSE_STD, K, [view(flat(40))], static)
    np.testing.assert_allclose(refined[small], 6, rtol=1e-6)


def test_islands_are_removed() -> None:
    """Where flow says nothing, 10 x 10 pixels that stick out of their surroundings go, 20 x 25 stay."""
    depth, seen = room(), view(room())
    small = np.s_[:, 10:20, 200:210]
    depth[small] /= 2
    depth[BLOCK] /= 2
    for block in (small, BLOCK):
        seen.correspondence.error[block] = np.inf
    refined = refine_depth(depth, INVERSE_STD, K, [seen], EVERYWHERE)
    assert not refined[small].any()
    np.testing.assert_allclose(refined[BLOCK], depth[BLOCK], rtol=1e-6)


def test_without_views_all_stays() -> None:
    """Islands and gaps, too."""
    depth = room()
    depth[:, 10:20, 200:210] /= 2
    depth[:, 10:20, 100:110] = 0
    np.testing.assert_allclose(refine_depth(depth, INVERSE_STD, K, [], EVERYWHERE), depth, rtol=1e-6)


def test_what_is_far_away_stays() -> None:
    """A sky at 10 km has a depth, too."""
    np.testing.assert_allclose(refine_depth(flat(10_000), 1e-5, K, [view(flat(10_000))], EVERYWHERE), 10_000, rtol=0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": room()[0]}, r"`depth` must be \[1, H, W\], got \[96, 320\]"),
        ({"depth": -room()}, r"`depth` must be 0 \(invalid\) or more, got -40 m"),
        ({"static": EVERYWHERE[..., 1:]}, r"`static` must be \[1, 96, 320\], got \[1, 96, 319\]"),
        ({"static": room()}, "`static` must be bool, got float32"),
        ({"K": np.eye(4)}, r"`K` must be \[3, 3\], got \[4, 4\]"),
        ({"inverse_std": 0.0}, "`inverse_std` must be above 0, got 0.0"),
        ({"inverse_std": float("nan")}, "`inverse_std` must be above 0, got nan"),
        (
            {"views": [OtherFrame(exact_flow(room()[..., 1:], SIDEWAYS), SIDEWAYS)]},
            r"\[., 96, 320\], got \[., 96, 319\]",
        ),
    ],
)
def test_refuses(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"depth": room(), "inverse_std": INVERSE_STD, "K": K, "views": [], "static": EVERYWHERE}
    with pytest.raises(ValueError, match=message):
        refine_depth(**arguments | change)

"""The forecaster that starts from measured motion: by hand, and further on."""

import dataclasses
from typing import Any

import pytest
import torch
from forecaster_scenes import (
    PAINTING,
    SMALL,
    TINY,
    camera,
    correct,
    measured,
    pair_of,
    plain,
    push,
    stir,
    turning,
    wall,
)

from vestcl import geometry
from vestcl.models import RigidMotion
from vestcl.models.forecaster import Forecaster, Step
from vestcl.models.steps.prior import MotionPrior
from vestcl.ops.unproject import unproject
from vestcl.scene.layers import LayerBatch

# ---------------------------------------------------------------- where it starts


def test_untrained_it_forecasts_the_prior() -> None:
    """x -> R (x + n v) + t, with n = 2 intervals from t - 1 and one from t."""
    pair, K, prior = pair_of(2, 32, 48), camera(2, 32, 48), turning(2, 32, 48)
    motion = Forecaster(SMALL)(*pair, K, prior=prior).motion
    rigids = prior.next_from_cur.after(prior.cur_from_prev), prior.next_from_cur
    velocities = prior.velocity_prev, prior.velocity_cur
    for side in range(2):
        points = unproject(pair[side].depth, K)
        rigid = geometry.compose_rigid(*rigids[side])
        moved = points + (2, 1)[side] * velocities[side].flatten(2).mT
        wanted = geometry.transform_points(rigid, moved) - points
        got = motion.objects.flow[:, 3 * side : 3 * side + 3].flatten(2).mT
        assert torch.allclose(got, wanted, atol=1e-5)
        still = motion.flow0[:, 3 * side : 3 * side + 3].flatten(2).mT
        assert torch.allclose(still, geometry.transform_points(rigid, points) - points, atol=1e-5)
    assert torch.allclose(motion.rigid, geometry.compose_rigid(*prior.next_from_cur), atol=1e-6)
    assert torch.equal(motion.start, motion.objects.flow)


def test_without_ego_motion_objects_move_as_measured() -> None:
    pair, K, prior = pair_of(1, 32, 48), camera(1, 32, 48), turning(1, 32, 48)
    motion = Forecaster(dataclasses.replace(SMALL, ego_motion=None))(*pair, K, prior=prior).motion
    assert torch.allclose(motion.objects.flow, torch.cat([2 * prior.velocity_prev, prior.velocity_cur], dim=1))


def test_without_object_motion_objects_are_static() -> None:
    pair, K, prior = pair_of(1, 32, 48), camera(1, 32, 48), turning(1, 32, 48)
    motion = Forecaster(dataclasses.replace(SMALL, object_motion=None))(*pair, K, prior=prior).motion
    assert torch.equal(motion.objects.flow, motion.flow0) and motion.flow0.abs().max() > 0.5


def test_the_camera_is_corrected_after_the_prior() -> None:
    """The network's motion is made in the axes that the prior leads to."""
    model, prior, still = Forecaster(SMALL), turning(1, 32, 48), [0.0] * 6
    motion = correct(model, [0, 2.0, 0, 5, 0, 2], still, still)(
        *pair_of(1, 32, 48), camera(1, 32, 48), prior=prior
    ).motion
    correction = RigidMotion(torch.tensor([[1.0, 0, 0.03, 0]]), torch.tensor([[0.5, 0, 0.2]]))
    wanted = geometry.compose_rigid(*correction) @ geometry.compose_rigid(*prior.next_from_cur)
    assert torch.allclose(motion.rigid, wanted, atol=1e-5)
    from_prev = wanted @ geometry.compose_rigid(*prior.cur_from_prev)
    assert torch.allclose(geometry.compose_rigid(*motion.next_from_prev), from_prev, atol=1e-5)
    for later in motion.later:
        assert torch.equal(geometry.compose_rigid(*later), geometry.compose_rigid(*prior.next_from_cur))


def test_the_network_is_shown_the_prior() -> None:
    """The last two motions; a turn counts by its rotation, not by its quaternion's length or sign."""
    model = stir(Forecaster(SMALL))
    prev, cur = (model.encode(one) for one in pair_of(1, 32, 48))

    def correction(prior: MotionPrior) -> torch.Tensor:
        moved = geometry.compose_rigid(*model.move_camera(prev, cur, prior)[1])
        return moved @ geometry.invert(geometry.compose_rigid(*prior.next_from_cur))

    prior = turning(1, 32, 48)
    for name in ("cur_from_prev", "prev_from_before"):
        motion = getattr(prior, name)
        same = prior._replace(**{name: motion._replace(quaternion=-3 * motion.quaternion)})
        faster = prior._replace(**{name: motion._replace(translation=2 * motion.translation)})
        assert torch.allclose(correction(same), correction(prior), atol=1e-5), name
        assert not torch.allclose(correction(faster), correction(prior), atol=1e-4), name


def test_a_prior_is_given_where_it_is_wanted() -> None:
    pair, K, prior = pair_of(2, 32, 48), camera(2, 32, 48), measured(2, 32, 48)
    with pytest.raises(ValueError, match="`prior` must be a `MotionPrior` for tiny, which starts from prior"):
        Forecaster(SMALL)(*pair, K)
    with pytest.raises(ValueError, match="`prior` must be None for tiny, which starts from rest"):
        Forecaster(TINY)(*pair, K, prior=prior)
    short = prior._replace(velocity_cur=torch.zeros(2, 3, 32, 40))
    with pytest.raises(ValueError, match=r"`prior.velocity_cur` must be \[2, 3, 32, 48\], got \[2, 3, 32, 40\]"):
        Forecaster(SMALL)(*pair, K, prior=short)
    for name in ("next_from_cur", "cur_from_prev", "prev_from_before"):
        change: dict[str, Any] = {name: RigidMotion(torch.ones(1, 4), torch.zeros(2, 3))}
        one = prior._replace(**change)
        with pytest.raises(ValueError, match=rf"`prior.{name}.quaternion` must be \[2, 4\], got \[1, 4\]"):
            Forecaster(SMALL)(*pair, K, prior=one)


# ---------------------------------------------------------------- further on


def before_a_wall(layers: LayerBatch, behind: float) -> LayerBatch:
    """All of it foreground, with background that much further away behind it."""
    return layers._replace(mask=torch.zeros_like(layers.mask), background_depth=behind * layers.depth)


@pytest.mark.parametrize("mode", ["feedback", "compose"])
def test_what_moves_once_moves_on(mode: Any) -> None:
    """The camera moves 1 m per frame to the left, an object at 10 m 0.5 m to the right: 4.5 px per frame."""
    prior = measured(1, 32, 64, cur=(1, 0, 0), velocity=(0.5, 0, 0))
    model, scene = Forecaster(PAINTING).eval(), before_a_wall(wall(32, 64, 10.0), 10)

    def perceive(*seen: torch.Tensor) -> LayerBatch:
        return before_a_wall(plain(*seen), 10)

    with torch.no_grad():
        steps = model.forecast(scene, scene, camera(1, 32, 64), 4, None, mode, perceive, prior=prior)
    for k, step in enumerate(steps, start=1):
        motion_xyz = step.views[0].motion_xyz[..., 4:-4, 28:-4]  # 18 px are uncovered in the end
        assert torch.allclose(motion_xyz, torch.tensor([1.5, 0, 0])[:, None, None], atol=0.02), k
        assert step.future_from_cur[0, :3, 3].tolist() == pytest.approx([k, 0, 0], abs=1e-5)


def test_feedback_continues_as_composed_while_the_camera_turns() -> None:
    """What is seen at t + 2 and t + 3 is where constant velocity in the world takes it, in both modes."""
    turn = RigidMotion(torch.tensor([[1.0, 0, 0.01, 0]]), torch.tensor([[0.0, 0, -0.5]]))
    velocity = torch.tensor([0.2, 0.0, -0.1])[:, None, None].expand(1, 3, 32, 64)
    prior = MotionPrior(turn, turn, turn, velocity, velocity)
    model, scene = Forecaster(PAINTING).eval(), before_a_wall(wall(32, 64, 10.0), 1.02)

    def run(mode: Any) -> list[Step]:
        def perceive(*seen: torch.Tensor) -> LayerBatch:
            return before_a_wall(plain(*seen), 1.02)

        with torch.no_grad():
            return model.forecast(scene, scene, camera(1, 32, 64), 3, None, mode, perceive, prior=prior)

    for fed, composed in zip(run("feedback"), run("compose"), strict=True):
        assert torch.allclose(fed.future_from_cur, composed.future_from_cur, atol=1e-5)
        for name in ("depth", "motion_xyz"):
            got, wanted = (getattr(step.views[0], name)[..., 6:-6, 16:-16] for step in (fed, composed))
            assert (got - wanted).abs().median() < 0.05, name


@pytest.mark.parametrize("metres", [0.0, 0.3])
def test_all_that_moved_moves_on_in_feedback(metres: float) -> None:
    """What the mask says is background, too: velocities are also of shadows and errors of depth. None comes of none."""
    model, seen = push(Forecaster(SMALL), *(metres,) * 6).eval(), []
    original = model.move

    def move(*arguments: Any) -> Any:
        seen.append(arguments[3])
        return original(*arguments)

    model.move = move  # type: ignore[assignment, method-assign]
    with torch.no_grad():
        prior = measured(1, 32, 48, cur=(0, 0, -1))
        steps = model.forecast(*pair_of(1, 32, 48), camera(1, 32, 48), 2, mode="feedback", prior=prior)
    (_, later), depth = seen, steps[0].views[0].depth
    moving = (later.velocity_cur.abs().amax(dim=1, keepdim=True) > 1e-3)[depth > 0]
    assert moving.float().mean() == (1.0 if metres else 0.0)
    assert torch.allclose(later.velocity_prev, torch.tensor(metres), atol=1e-4)
    assert not later.is_corrected and torch.equal(steps[1].motion.objects.flow, steps[1].motion.start)
    for motion in later[:3]:  # forecast once and measured twice, all the same
        assert torch.allclose(motion.translation, torch.tensor([[0.0, 0, -1]]), atol=1e-5)

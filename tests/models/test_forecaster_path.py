"""The forecaster's camera, several intervals ahead in one go: along the path, and on from its end."""

import dataclasses
from typing import Any

import pytest
import torch
from forecaster_scenes import (
    SHARP,
    SMALL,
    camera,
    correct,
    measured,
    pair_of,
    plain,
    stir,
    turning,
    wall,
)

from vestcl import geometry
from vestcl.models.forecaster import Forecaster
from vestcl.models.networks.ego_motion import RigidMotion

#: What is said of three intervals, turn and shift: a metre to the side, one more metre, and one back again.
SIDEWAYS = [0.0, 0, 0, 10, 0, 0], [0.0, 0, 0, 20, 0, 0], [0.0, 0, 0, -10, 0, 0]

#: Every colour shown by its own pixel only, with a path of three intervals.
SHARP_PATH = dataclasses.replace(SHARP, start="prior", ego_motion=SMALL.ego_motion)


def test_a_path_by_hand() -> None:
    """Each motion after those before it; beyond the last one forecast, that one repeats."""
    with torch.no_grad():
        motion = stir(Forecaster(SMALL))(*pair_of(2, 32, 48), camera(2, 32, 48), prior=turning(2, 32, 48)).motion
    first, second, third = (geometry.compose_rigid(*one) for one in (motion.next_from_cur, *motion.later))
    assert not torch.allclose(first, second, atol=1e-4) and not torch.allclose(second, third, atol=1e-4)
    wanted = [first, second @ first, third @ second @ first, third @ third @ second @ first]
    assert torch.allclose(motion.path(4), torch.stack(wanted, dim=1), atol=1e-5)
    for steps in (1, 3):  # all that was forecast, however few are asked for
        assert torch.equal(motion.path(steps), motion.path(4)[:, :3])
    after = motion.following()
    assert torch.equal(after.rigid, second) and len(after.later) == 1
    assert torch.equal(after.following().following().rigid, third)
    assert torch.equal(after.flow0, motion.flow0)


def test_composed_frames_go_along_the_path() -> None:
    """On a wall 10 m away a metre is 3 px: shifts by 3, 9, 6 and, the last motion once more, 3."""
    model, scene = correct(Forecaster(SHARP_PATH), *SIDEWAYS).eval(), wall(32, 64, 10.0)
    rolling = RigidMotion(torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[0.0, 1, 0]]))  # or nothing is corrected
    prior = measured(1, 32, 64)._replace(cur_from_prev=rolling)
    with torch.no_grad():
        steps = model.forecast(scene, scene, camera(1, 32, 64), 4, None, "compose", prior=prior)
    for step, shift, moved in zip(steps, (3, 9, 6, 3), (1.0, 2.0, -1.0, -1.0), strict=True):
        view = step.views[0]
        inside = slice(shift + 12, -6)
        assert torch.allclose(view.colour[..., inside], scene.image[..., 12 : -6 - shift], atol=5e-3)
        motion_xyz = view.motion_xyz[..., inside]
        assert torch.allclose(motion_xyz, torch.tensor([moved, 0, 0])[:, None, None], atol=2e-3)
        assert step.future_from_cur[0, 0, 3].item() == pytest.approx(shift / 3, abs=1e-5)
        assert step.motion.rigid[0, 0, 3].item() == pytest.approx(moved, abs=1e-5)


@pytest.mark.parametrize("mode", ["feedback", "compose"])
def test_every_step_reports_the_path_of_the_first(mode: Any) -> None:
    """Composed or fed back, the steps follow it: a forecast motion is not corrected again."""
    model, scene, prior = stir(Forecaster(SMALL)).eval(), pair_of(2, 32, 48), turning(2, 32, 48)
    with torch.no_grad():
        steps = model.forecast(*scene, camera(2, 32, 48), 5, None, mode, plain, prior=prior)
    for k, step in enumerate(steps):
        assert step.path_from_cur.shape == (2, 5, 4, 4) and torch.equal(step.path_from_cur, steps[0].path_from_cur)
        assert torch.allclose(step.future_from_cur, step.path_from_cur[:, k], atol=1e-5)
    assert torch.allclose(steps[0].path_from_cur, steps[0].motion.path(5))


def test_a_horizon_learns_from_each_interval_before_it() -> None:
    """The image at t + 2 is about two corrections; the third interval's has no gradient."""
    model, K = stir(Forecaster(SMALL)), camera(1, 32, 48)
    step = model(*pair_of(1, 32, 48), K, prior=turning(1, 32, 48), horizon=2)
    step.views[0].image.square().sum().backward()
    assert model.ego_motion is not None and model.ego_motion.swayed is not None
    for weight in (model.ego_motion.motion.weight, model.ego_motion.swayed.weight):
        assert weight.grad is not None and weight.grad.isfinite().all()
        assert [bool(grad.any()) for grad in weight.grad.split(6)] == [True, True, False]

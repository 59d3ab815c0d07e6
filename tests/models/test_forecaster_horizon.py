"""The forecaster as training uses it: any horizon, gradients from there, what may be left out or be less precise."""

import dataclasses
from typing import Any

import pytest
import torch
from forecaster_scenes import (
    SMALL,
    TINY,
    camera,
    frame,
    measured,
    pair_of,
    plain,
    push,
    stir,
    turning,
    wall,
)
from torch import nn
from torch.nn import functional

from vestcl.constants import SKY_DEPTH
from vestcl.models import EgoMotion, ObjectMotion
from vestcl.models.forecaster import Forecaster, Step

# ---------------------------------------------------------------- horizons, and what is shown


@pytest.mark.parametrize("name", ["small", "tiny"])
def test_a_horizon_is_the_forecasts_last_step(name: str) -> None:
    model, K = stir(Forecaster(SMALL if name == "small" else TINY)).eval(), camera(2, 32, 48)
    pair, prior = pair_of(2, 32, 48), measured(2, 32, 48, cur=(0.1, 0, -0.5)) if name == "small" else None
    offset = torch.eye(4).repeat(2, 1, 1)
    offset[:, 0, 3] = -0.5
    with torch.no_grad():
        steps = model.forecast(*pair, K, 3, [(offset, K)], "compose", prior=prior)
        for k in (1, 2, 3):
            assert_same(model(*pair, K, [(offset, K)], prior=prior, horizon=k), steps[k - 1])


@pytest.mark.parametrize("mode", ["feedback", "compose"])
def test_only_what_is_shown_is_rendered(mode: Any) -> None:
    model, pair, K = stir(Forecaster(SMALL)).eval(), pair_of(1, 32, 48), camera(1, 32, 48)
    prior, painted = measured(1, 32, 48, cur=(0, 0, -0.5)), []
    model.refine.register_forward_hook(lambda *_: painted.append(1))
    with torch.no_grad():
        whole = model.forecast(*pair, K, 3, None, mode, plain, prior=prior)
        painted.clear()
        some = model.forecast(*pair, K, 3, None, mode, plain, prior=prior, shown=(1, 3))
    assert [len(step.views) for step in some] == [1, 0, 1]
    assert len(painted) == (2 if mode == "compose" else 3)  # feedback has to see what it continues from
    assert_same(some[0], whole[0])
    assert_same(some[2], whole[2])
    assert torch.equal(some[1].future_from_cur, whole[1].future_from_cur)


def assert_same(got: Step, wanted: Step) -> None:
    for one, other in zip(got.views, wanted.views, strict=True):
        assert all(torch.equal(getattr(one, name), getattr(other, name)) for name in one._fields)
    assert torch.equal(got.future_from_cur, wanted.future_from_cur)


# ---------------------------------------------------------------- gradients


@pytest.mark.parametrize("horizon", [1, 3])
def test_a_gradient_for_every_tensor(horizon: int) -> None:
    """From the image, and at t + 3 through what moved relative to the world, too."""
    model, pair, K = stir(Forecaster(SMALL)), pair_of(2, 32, 48), camera(2, 32, 48)
    nn.init.normal_(model.refine.out.weight, std=0.1)
    assert isinstance(model.ego_motion, EgoMotion)
    view = model(*pair, K, prior=measured(2, 32, 48, cur=(0.1, 0, -0.5)), horizon=horizon).views[0]
    functional.l1_loss(view.image, pair[1].image).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all() and parameter.grad.abs().max() > 0, name


def test_later_steps_count_an_objects_velocity_as_often() -> None:
    """A wall that moves s a frame is k s further at t + k, and so is the derivative of where it is."""
    model, scene, K = push(Forecaster(SMALL), *(0.0,) * 6), wall(16, 24, 10.0), camera(1, 16, 24)
    assert isinstance(model.object_motion, ObjectMotion)
    bias = model.object_motion.blocks[-1].get_parameter("out.bias")
    for k in (1, 3):
        depth = model(scene, scene, K, prior=measured(1, 16, 24), horizon=k).views[0].depth
        (grad,) = torch.autograd.grad(depth.mean(), bias)
        assert grad[5].item() == pytest.approx(k, rel=0.02)


# ---------------------------------------------------------------- cheaper


def test_a_cascade_that_changes_nothing_is_left_out() -> None:
    """The same bits as when it runs; it runs where it is to learn."""
    model, pair, K = Forecaster(SMALL), pair_of(2, 32, 48), camera(2, 32, 48)
    assert isinstance(model.object_motion, ObjectMotion)
    ran, prior = [], turning(2, 32, 48)
    model.object_motion.register_forward_hook(lambda *_: ran.append(1))
    learning = model(*pair, K, prior=prior)
    assert len(ran) == 1
    ran.clear()
    with torch.no_grad():
        skipped = model(*pair, K, prior=prior)
    assert not ran and torch.equal(skipped.motion.objects.flow, learning.motion.objects.flow)
    assert torch.equal(skipped.views[0].image, learning.views[0].image)
    model.object_motion.requires_grad_(False)
    push(model, *(0.1,) * 6)
    model(*pair, K, prior=prior)
    assert ran


def test_the_sky_is_as_still_with_the_cascade_as_without() -> None:
    sky, K, prior = wall(32, 48, SKY_DEPTH), camera(1, 32, 48), measured(1, 32, 48, cur=(0, 0, -1))
    turned = prior._replace(next_from_cur=prior.next_from_cur._replace(quaternion=torch.tensor([[1.0, 0, 0.02, 0]])))
    model = Forecaster(SMALL)
    ran = model(sky, sky, K, prior=turned).motion.objects.flow
    with torch.no_grad():
        left_out = model(sky, sky, K, prior=turned).motion.objects.flow
    assert torch.allclose(ran, left_out, rtol=1e-6, atol=1e-4)


def test_bfloat16_changes_the_image_a_little_and_motion_only_through_features() -> None:
    model, pair, K = Forecaster(SMALL).eval(), pair_of(2, 32, 48), camera(2, 32, 48)
    nn.init.normal_(model.refine.out.weight, std=0.1)
    prior = turning(2, 32, 48)
    with torch.no_grad():
        wanted = model(*pair, K, prior=prior)
        model.options = dataclasses.replace(model.options, autocast="bfloat16")
        got = model(*pair, K, prior=prior)
    assert torch.equal(got.motion.objects.flow, wanted.motion.objects.flow)
    assert torch.equal(got.motion.rigid, wanted.motion.rigid)
    view, exact = got.views[0], wanted.views[0]
    assert view.image.dtype == torch.float32
    assert 0 < (view.image - exact.image).abs().mean() < 0.01  # bfloat16 has 8 bits
    for name in ("colour", "coverage", "depth", "motion_xyz"):
        assert torch.equal(getattr(view, name), getattr(exact, name)), name


def test_bfloat16_goes_back_to_every_tensor() -> None:
    model, pair, K = stir(Forecaster(SMALL)), pair_of(1, 32, 48), camera(1, 32, 48)
    nn.init.normal_(model.refine.out.weight, std=0.1)
    grads = []
    for precision in (None, "bfloat16"):
        model.options = dataclasses.replace(model.options, autocast=precision)
        model.zero_grad()
        view = model(*pair, K, prior=measured(1, 32, 48, cur=(0.1, 0, -0.5))).views[0]
        functional.mse_loss(view.image, pair[1].image).backward()
        grads.append(torch.cat([p.grad.flatten() for p in model.refine.parameters() if p.grad is not None]))
        assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in model.parameters())
    assert functional.cosine_similarity(grads[0], grads[1], dim=0) > 0.98


def test_frames_of_an_untrained_model_are_the_splatted_ones() -> None:
    """At rest before a scene that is shown by its own pixels, the filled image is the current frame."""
    scene = frame(2, 33, 50, foreground=False)
    model = Forecaster(SMALL).eval()
    with torch.no_grad():
        view = model(scene, scene, camera(2, 33, 50), prior=measured(2, 33, 50)).views[0]
    assert torch.allclose(view.image, scene.image, atol=2e-3)

"""What a network computes more coarsely: knobs off are what was, knobs on are near it, and nonsense is refused."""

import dataclasses
from typing import Any

import pytest
import torch
from forecaster_scenes import PAINTING, SMALL, camera, measured, pair_of, stir

from vestcl.models import ObjectMotion
from vestcl.models.forecaster import Forecaster, Step
from vestcl.models.inference.options import InferenceOptions
from vestcl.models.inference.resolution import enlarged, fraction, reduced
from vestcl.scene.layers import LayerBatch

HEIGHT, WIDTH = 48, 64


def network() -> Forecaster:
    torch.manual_seed(0)
    return stir(Forecaster(SMALL)).eval()


def scene() -> tuple[LayerBatch, LayerBatch]:
    torch.manual_seed(3)
    return pair_of(1, HEIGHT, WIDTH)


def forecast(model: Forecaster, pair: tuple[LayerBatch, LayerBatch], learns: bool = False, **options: Any) -> Step:
    model.options = InferenceOptions(**options)
    prior = measured(1, HEIGHT, WIDTH, cur=(0.1, 0, -0.8), velocity=(0.3, 0, 0.2))
    with torch.set_grad_enabled(learns):
        return model(*pair, camera(1, HEIGHT, WIDTH), prior=prior)


def smooth(pair: tuple[LayerBatch, LayerBatch]) -> tuple[LayerBatch, LayerBatch]:
    """The same with one colour a frame and one depth: nothing that a coarser grid would miss."""
    flat = [
        frame._replace(
            image=torch.full_like(frame.image, 0.4), background_image=torch.full_like(frame.image, 0.4),
            depth=torch.full_like(frame.depth, 20.0), background_depth=torch.full_like(frame.depth, 20.0),
            mask=torch.ones_like(frame.mask),
        )
        for frame in pair
    ]  # fmt: skip
    return flat[0], flat[1]


@pytest.mark.parametrize("knob", [{"splat_scale": 0.5}, {"splat_scale": 0.7}, {"paint_scale": 0.5}, {"blocks": 1}])
def test_views_keep_their_size_and_a_flat_wall_its_colour(knob: dict[str, Any]) -> None:
    model, pair = network(), smooth(scene())
    exact, coarse = (
        forecast(model, pair).views[0],
        forecast(model, pair, **knob).views[0],
    )
    assert all(one.shape == other.shape for one, other in zip(exact, coarse, strict=True))
    inside = (slice(None), slice(None), slice(8, -8), slice(8, -8))  # what comes in at the border is guessed
    assert (coarse.image[inside] - exact.image[inside]).abs().max() < 0.05
    assert ((coarse.depth - exact.depth)[inside].abs() < 0.05 * exact.depth[inside]).all()


@pytest.mark.parametrize(
    "knob", [{"min_transmittance": 0.3}, {"splat_scale": 0.5}, {"paint_scale": 0.5}, {"blocks": 0}, {"blocks": 1}]
)
def test_each_knob_changes_something(knob: dict[str, Any]) -> None:
    model, pair = network(), scene()
    torch.nn.init.normal_(model.refine.out.weight, std=0.1)
    exact, coarse = (
        forecast(model, pair).views[0].image,
        forecast(model, pair, **knob).views[0].image,
    )
    assert not torch.equal(exact, coarse)
    assert torch.equal(exact, forecast(model, pair).views[0].image)


def test_transmittance_keeps_its_bound() -> None:
    model, pair = network(), scene()
    exact, coarse = (forecast(model, pair, min_transmittance=t).views[0] for t in (0.0, 0.1))
    for name, largest in (("colour", 1.0), ("coverage", 1.0)):  # of values in [0, 1], over two sides
        assert (getattr(exact, name) - getattr(coarse, name)).abs().max() <= 2 * 0.1 * largest


def test_no_block_is_no_object_motion() -> None:
    model, pair = network(), scene()
    motion = forecast(model, pair, blocks=0).motion
    assert torch.equal(motion.objects.flow, motion.start) and motion.objects.ran.shape == (1, 0)
    first, every = (forecast(model, pair, True, blocks=count).motion.objects for count in (1, 2))
    assert first.ran.tolist() == [[True, False]] and every.ran.tolist() == [[True, True]]
    assert torch.allclose(every.flow, forecast(model, pair).motion.objects.flow)
    assert torch.allclose(first.flow, every.candidates[0], atol=1e-5) and not torch.allclose(first.flow, every.flow)


def test_fewer_blocks_reach_less() -> None:
    network = Forecaster(SMALL).object_motion
    assert isinstance(network, ObjectMotion)
    assert network.reach == network.reach_of(2) > network.reach_of(1) > network.reach_of(0) == 0


def test_a_network_that_predicts_rgb_has_nothing_to_enlarge() -> None:
    model = stir(Forecaster(dataclasses.replace(PAINTING))).eval()
    with pytest.raises(ValueError, match=r"`options\.paint_scale` must be 1 for tiny, which predicts RGB directly"):
        forecast(model, scene(), paint_scale=0.5)


@pytest.mark.parametrize(
    ("knob", "message"),
    [
        ({"min_transmittance": 1.0}, r"`min_transmittance` must be in \[0, 1\), got 1.0"),
        ({"min_transmittance": -0.1}, r"`min_transmittance` must be in \[0, 1\), got -0.1"),
        ({"splat_scale": 0.0}, r"`splat_scale` must be in \(0, 1\], got 0.0"),
        ({"paint_scale": 1.5}, r"`paint_scale` must be in \(0, 1\], got 1.5"),
        ({"blocks": -1}, "`blocks` must be a whole number, 0 or more, or None, got -1"),
        ({"blocks": 1.5}, "`blocks` must be a whole number, 0 or more, or None, got 1.5"),
    ],
)
def test_refuses(knob: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        InferenceOptions(**knob)


def test_sizes_by_hand() -> None:
    assert fraction(256, 832, 0.5) == (128, 416) and fraction(5, 7, 0.5) == (3, 4) and fraction(5, 7, 1) == (5, 7)
    image = torch.arange(8.0).view(1, 1, 2, 4)
    assert reduced(image, 2, 4) is image and enlarged(image, 2, 4) is image
    assert reduced(image, 1, 2).tolist() == [[[[2.5, 4.5]]]]
    assert enlarged(torch.tensor([[[[0.0, 1.0]]]]), 1, 4).tolist() == [[[[0.0, 0.25, 0.75, 1.0]]]]

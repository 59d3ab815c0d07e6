"""What is skipped changes nothing: each switch against everything computed, on scenes with and without foreground."""

import dataclasses
import itertools
from pathlib import Path

import pytest
import torch
from forecaster_scenes import OBJECTS, SMALL, camera, frame, measured, pair_of, stir, wall
from torch import nn
from torch.nn import functional

from vestcl.models import configuration
from vestcl.models.config import EncoderConfig, RenderConfig
from vestcl.models.forecaster import Forecaster, Step
from vestcl.models.inference import skipping
from vestcl.models.inference.options import InferenceOptions
from vestcl.models.inference.skipping import Box, Tally, boxes, count_skips
from vestcl.models.networks.encoder import STRIDE, Encoder, reach
from vestcl.models.networks.object_motion import ObjectMotion
from vestcl.models.steps.encode import encode
from vestcl.models.steps.render import _reaching
from vestcl.scene.layers import LayerBatch

#: As vest-s in all that can be skipped, and with convolutions that reach so little that an image has space around it.
ENCODER = EncoderConfig(widths=(8, 8, 8), blocks=(1, 1, 1), decoder=(8, 8), features=4, background="frame")
SPARE = dataclasses.replace(
    SMALL,
    encoder=ENCODER,
    object_motion=dataclasses.replace(OBJECTS, where="foreground"),
    render=dataclasses.replace(SMALL.render, stretched=True, inpainted="last", previous="uncovered"),
)
NOTHING = InferenceOptions().without_skips()
HEIGHT, WIDTH = 64, 480


def scene(batch: int = 1, *, foreground: bool = True) -> tuple[LayerBatch, LayerBatch]:
    torch.manual_seed(3)
    return pair_of(batch, HEIGHT, WIDTH, foreground)


def forecast(model: Forecaster, pair: tuple[LayerBatch, LayerBatch], options: InferenceOptions) -> tuple[Step, Tally]:
    batch = len(pair[0].image)
    model.options = options
    K = camera(batch, HEIGHT, WIDTH)
    aside = torch.eye(4).repeat(batch, 1, 1)
    aside[:, 0, 3] = 0.4
    prior = measured(batch, HEIGHT, WIDTH, cur=(0.1, 0, -0.8), velocity=(0.3, 0, 0.2))
    views = [(aside, K), (torch.eye(4).repeat(batch, 1, 1), K), (aside, K)]
    with torch.no_grad(), count_skips() as tally:
        return model(*pair, K, views, prior=prior), tally


@pytest.fixture(autouse=True)
def small_boxes(monkeypatch: pytest.MonkeyPatch) -> None:
    """In so small images, too."""
    monkeypatch.setattr(skipping, "_PASS", 0)
    monkeypatch.setattr(skipping, "_WHOLE", 1.0)


def model() -> Forecaster:
    torch.manual_seed(0)
    return stir(Forecaster(SPARE)).eval()


def test_vest_s_can_skip() -> None:
    config = configuration("vest-s")
    assert config.object_motion is not None
    assert (config.encoder.background, config.object_motion.where) == ("frame", "foreground")
    assert (config.render.inpainted, config.render.previous) == ("inner", "uncovered")


@pytest.mark.parametrize("switch", ["background", "objects", "covered", "views"])
@pytest.mark.parametrize(("batch", "foreground"), [(1, True), (1, False), (2, True)])
def test_a_switch_changes_nothing_but_rounding(switch: str, batch: int, foreground: bool) -> None:
    network, pair = model(), scene(batch, foreground=foreground)
    whole, _ = forecast(network, pair, NOTHING)
    some, tally = forecast(network, pair, dataclasses.replace(NOTHING, **{switch: True}))
    for view, other in zip(whole.views, some.views, strict=True):
        for name in view._fields:
            one, two = getattr(view, name), getattr(other, name)
            assert torch.allclose(one, two, rtol=1e-4, atol=1e-4 * one.abs().max().item()), name
    count = tally.counts[switch]
    assert 0 < count.skipped < count.of or (not foreground and count.skipped == count.of)


def test_without_foreground_nothing_is_dynamic() -> None:
    """u = rigid flow and what was measured, bit by bit; neither backgrounds nor object motion run."""
    network, ran = model(), list[str]()
    assert network.object_motion is not None
    network.encoder.register_forward_hook(lambda *_: ran.append("encoder"))
    network.object_motion.register_forward_hook(lambda *_: ran.append("objects"))
    step, tally = forecast(network, scene(foreground=False), InferenceOptions())
    assert torch.equal(step.motion.objects.flow, step.motion.start)
    assert ran == ["encoder", "encoder"]
    for switch in ("background", "objects"):
        assert tally.counts[switch].skipped == tally.counts[switch].of > 0


def test_what_is_static_is_kept_static() -> None:
    """Of two cars the one that was measured to move; a single pixel does not."""
    network, (prev, cur), K = model(), scene(), camera(1, HEIGHT, WIDTH)
    for one in (prev, cur):
        one.mask.fill_(1)
        one.mask[..., 32:64, 32:80] = one.mask[..., 32:64, 208:256] = 0
    prior = measured(1, HEIGHT, WIDTH)
    for velocity in (prior.velocity_prev, prior.velocity_cur):
        velocity[:, 2, 32:64, 32:80] = 0.8
        velocity[:, 2, 40, 210] = 0.8
    network.options = InferenceOptions(margin=0, still=True)
    with torch.no_grad(), count_skips() as tally:
        motion = network.forecast(prev, cur, K, 1, [], "compose", prior=prior)[0].motion
    moved = (motion.objects.flow != motion.start).any(dim=1)[0]
    assert moved[32:64, 32:80].float().mean() > 0.9
    moved[32:64, 32:80] = False
    assert not moved.any()
    count = tally.counts["objects"]
    assert count.skipped > count.of * 0.7


def test_static_background_keeps_its_motion() -> None:
    network, pair = model(), scene()
    step, _ = forecast(network, pair, NOTHING)
    moved = (step.motion.objects.flow != step.motion.start).unflatten(1, (2, 3)).any(dim=2)
    foreground = torch.cat([one.mask for one in pair], dim=1) == 0
    assert torch.equal(moved & ~foreground, torch.zeros_like(moved)) and moved[foreground].float().mean() > 0.9


def test_background_features_are_those_of_the_whole_image() -> None:
    """Of a crop with the receptive field as margin, inside; a margin too small shows."""
    torch.manual_seed(1)
    encoder, (one, _) = Encoder(ENCODER), scene()
    one.mask[..., 20:30, 240:250] = 0
    layers = one._replace(background_image=one.image * one.mask)
    whole = encode(encoder, ENCODER, layers, NOTHING, Tally()).background_grid
    part = encode(encoder, ENCODER, layers, InferenceOptions(), tally := Tally()).background_grid
    assert 0 < tally.counts["background"].skipped < tally.counts["background"].of
    assert torch.allclose(part, whole, atol=1e-5)
    narrow = encode(encoder, ENCODER, layers, InferenceOptions(margin=0), Tally()).background_grid
    assert (narrow - whole).abs().max() > 1e-3


def test_the_encoders_reach() -> None:
    """Gradients of one cell end within it, and come near it."""
    encoder, size = Encoder(ENCODER), 8 * reach(ENCODER) // 16 * 4
    image = torch.rand(1, 3, size, size, requires_grad=True)
    at = size // 2 // STRIDE
    with torch.no_grad():
        for parameter in encoder.parameters():
            parameter.abs_()
    encoder(image, lambda norm, x: x * norm.weight[:, None, None])[0, :, at, at].sum().backward()
    assert image.grad is not None
    touched = image.grad[0].abs().sum(dim=0).nonzero()
    farthest = (touched - (at * STRIDE + STRIDE / 2)).abs().max().item()
    assert 0.6 * reach(ENCODER) < farthest <= reach(ENCODER)


@pytest.mark.parametrize("shape", ["paper", "dmvfn"])
def test_object_motions_reach(shape: str) -> None:
    torch.manual_seed(0)
    network = ObjectMotion(dataclasses.replace(OBJECTS, shape=shape), 4)  # type: ignore[arg-type]
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.rand_like(parameter) * 0.1)
    size = 4 * network.reach // 16 * 16
    inputs = [torch.rand(1, c, size, size, requires_grad=True) for c in (4, 4, 1, 1, 1, 1, 6)]
    inputs[2:4] = [(depth.detach() + 5).requires_grad_() for depth in inputs[2:4]]
    network(*inputs).flow[0, :, size // 2, size // 2].sum().backward()
    farthest = [
        (one.grad[0].abs().sum(dim=0).nonzero() - (size / 2 + 0.5)).abs().max().item()
        for one in inputs
        if one.grad is not None
    ]
    assert len(farthest) == 7 and 0.4 * network.reach < max(farthest) <= network.reach


def test_a_frame_seen_before_is_not_encoded_again() -> None:
    network, K = model(), camera(1, HEIGHT, WIDTH)
    first, second = scene()
    third, prior = frame(1, HEIGHT, WIDTH), measured(1, HEIGHT, WIDTH)
    calls: list[int] = []
    network.encoder.register_forward_hook(lambda *_: calls.append(1))

    def run(prev: LayerBatch, cur: LayerBatch) -> torch.Tensor:
        calls.clear()
        again = LayerBatch(*(tensor.clone() for tensor in prev)), LayerBatch(*(tensor.clone() for tensor in cur))
        return network(*again, K, prior=prior).views[0].image

    with torch.no_grad(), count_skips() as tally:
        fresh = run(first, second), len(calls)
        run(second, third)
        assert len(calls) == fresh[1] // 2
        assert tally.counts["seen"] == (1, 4, "frames")
        assert torch.equal(run(first, second), fresh[0]) and len(calls) == fresh[1], "two are remembered"
        assert torch.equal(run(first, second), fresh[0]) and not calls
        network.encoder.out.bias.add_(1)
        assert not torch.equal(run(first, second), fresh[0]) and len(calls) == fresh[1]
    run(first, second)
    assert len(calls) == fresh[1], "with gradients, it has to be"


def test_every_tensor_still_gets_its_gradient_without_foreground() -> None:
    """DistributedDataParallel waits for all of them."""
    network = stir(Forecaster(SPARE))
    pair, K = scene(foreground=False), camera(1, HEIGHT, WIDTH)
    step = network(*pair, K, prior=measured(1, HEIGHT, WIDTH))
    functional.l1_loss(step.views[0].image, pair[1].image).backward()
    assert network.object_motion is not None
    for name, parameter in network.object_motion.named_parameters():
        assert parameter.grad is not None and not parameter.grad.any(), name


def test_gradients_are_those_of_everything_computed() -> None:
    pair, K = scene(), camera(1, HEIGHT, WIDTH)
    gradients = []
    for options in (NOTHING, InferenceOptions()):
        network = model().double().train()
        network.options = options
        one, other = (LayerBatch(*(tensor.double() for tensor in layers)) for layers in pair)
        prior = measured(1, HEIGHT, WIDTH, cur=(0.1, 0, -0.8))
        prior = prior._replace(velocity_prev=prior.velocity_prev.double(), velocity_cur=prior.velocity_cur.double())
        rigid = {
            name: type(motion)(*(t.double() for t in motion))
            for name, motion in zip(prior._fields[:3], prior[:3], strict=True)
        }
        view = network(one, other, K.double(), prior=prior._replace(**rigid)).views[0]
        functional.mse_loss(view.image, other.image).backward()
        gradients.append({name: parameter.grad for name, parameter in network.named_parameters()})
    for name, wanted in gradients[0].items():
        got = gradients[1][name]
        assert wanted is not None and got is not None, name
        assert torch.allclose(got, wanted, rtol=1e-6, atol=1e-9 + 1e-6 * wanted.abs().max().item()), name


def test_boxes_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(skipping, "_PASS", 16384)
    monkeypatch.setattr(skipping, "_WHOLE", 0.6)
    wanted = torch.zeros(300, 601, dtype=torch.bool)
    assert boxes(wanted, 4, 8) == []
    wanted[10, 20] = wanted[290, 595] = True
    assert boxes(wanted, 0, 8) == [Box(8, 16, 16, 24), Box(288, 296, 592, 600)]
    assert boxes(wanted, 10, 8) == [Box(0, 24, 8, 32), Box(280, 300, 584, 601)]
    wanted[200, 20] = True  # below the first: one box is cheaper than two
    assert boxes(wanted, 0, 8) == [Box(8, 208, 16, 24), Box(288, 296, 592, 600)]
    wanted[10, 400] = True  # the three corners of 384 x 192 pixels
    assert len(boxes(wanted, 0, 8)) == 3
    assert boxes(wanted, 145, 8) == [Box(0, 300, 0, 601)]  # most of it: all
    assert Box(8, 16, 16, 25).cut(torch.zeros(10, 25), 4).shape == (2, 3)


def test_boxes_hold_what_is_wanted_and_do_not_touch() -> None:
    for seed in range(20):
        torch.manual_seed(seed)
        wanted = torch.rand(256, 832) > 0.99999
        found, left = boxes(wanted, 16, 16), wanted.clone()
        for box in found:
            box.cut(left).zero_()
            assert all(edge % 16 == 0 or edge == size for edge, size in zip(box, (0, 256, 0, 832), strict=True))
        assert not left.any()
        assert not any(one.touches(other) for one, other in itertools.combinations(found, 2))


def test_a_margin_below_nothing() -> None:
    with pytest.raises(ValueError, match="`margin` must be 0 px or more, or None, got -1"):
        InferenceOptions(margin=-1)


def test_a_copy_remembers_nothing_of_other_weights(tmp_path: Path) -> None:
    network, pair = model(), scene()
    before, _ = forecast(network, pair, InferenceOptions())
    nn.init.constant_(network.encoder.out.bias, 0.5)
    network.save(tmp_path / "m.safetensors")
    loaded, _ = forecast(Forecaster.load(tmp_path / "m.safetensors"), pair, InferenceOptions())
    again, _ = forecast(network, pair, InferenceOptions())
    assert torch.equal(loaded.views[0].image, again.views[0].image)
    assert not torch.equal(before.views[0].image, again.views[0].image)


def test_the_inpainted_shows_in_inner_holes_only() -> None:
    """A block in the middle and one at the border leave holes; the splatted background is behind the first only."""
    torch.manual_seed(2)
    network, K = Forecaster(SPARE).eval(), camera(1, HEIGHT, WIDTH)
    rear = wall(HEIGHT, WIDTH, 20.0)
    depth, mask = rear.depth.clone(), rear.mask.clone()
    for columns in (slice(200, 240), slice(440, 480)):
        depth[..., 20:40, columns], mask[..., 20:40, columns] = 5.0, 0.0
    cur = rear._replace(depth=depth, mask=mask, image=torch.where(mask > 0, rear.image, 0.5))
    gone = measured(1, HEIGHT, WIDTH, velocity=(0, 0, 0))
    aside = gone.velocity_cur.clone()
    aside[:, 1] = torch.where(mask[:, 0] > 0, 0.0, 60.0)  # both leave the image, as all of the frame before
    gone = gone._replace(velocity_prev=torch.full_like(aside, 60.0) * torch.tensor([0.0, 1, 0])[:, None, None])
    gone = gone._replace(velocity_cur=aside)
    seen = {}
    for rule in ("last", "inner"):
        render = dataclasses.replace(SPARE.render, inpainted=rule)
        network.config = dataclasses.replace(network.config, render=render)
        with torch.no_grad():
            steps = network.forecast(rear, cur, K, prior=gone)
        seen[rule] = steps[0].views[0].coverage[0, 0]
    inside, border = (slice(24, 36), slice(206, 234)), (slice(24, 36), slice(446, 460))
    assert seen["last"][inside].min() > 0.5 and seen["last"][border].min() > 0.5
    assert seen["inner"][inside].min() > 0.5 and seen["inner"][border].max() < 0.5


def test_inner_holes_need_to_know_what_is_open() -> None:
    with pytest.raises(ValueError, match='`inpainted` may be "inner" with `previous` "uncovered" only'):
        RenderConfig(inpainted="inner")


def test_no_point_is_left_out_that_reaches_an_open_pixel() -> None:
    """Of two images, with points next to them, at their borders and nowhere; transparent ones reach nothing."""
    generator = torch.Generator().manual_seed(0)
    open_ = torch.rand(2, 1, 40, 60, generator=generator) < 0.004
    points_uv = torch.rand(6000, 2, generator=generator) * torch.tensor([80.0, 60]) - 10
    points_uv[::500] = torch.nan
    radii = 0.5 + 7.5 * torch.rand(6000, generator=generator)
    opacities, starts = (torch.arange(6000) % 7 > 0).float(), torch.tensor([0, 2500, 6000])
    kept = torch.zeros(6000, dtype=torch.bool)
    kept[_reaching(points_uv, radii, opacities, starts, open_)] = True
    for b, (start, end) in enumerate(itertools.pairwise(starts.tolist())):
        centres = open_[b, 0].nonzero().flip(1) + 0.5
        reach = (torch.cdist(points_uv[start:end], centres) < radii[start:end, None]).any(dim=1)
        wanted = reach & (opacities[start:end] > 0)
        assert wanted.sum() > 300 and kept[start:end][wanted].all()
        assert (kept[start:end] & ~wanted).sum() < 0.2 * len(wanted)
    assert not kept[opacities == 0].any()
    nothing = _reaching(points_uv, radii, opacities, starts, torch.zeros_like(open_))
    assert len(nothing) == 0

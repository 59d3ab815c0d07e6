"""vestcl.models.networks.object_motion: its size, the rigid flow at the start, metres at every scale, routing."""

from typing import Any

import pytest
import torch
from tolerances import assert_close
from torch import nn
from torch.nn import functional

from vestcl.models import ObjectMotion, budget_loss, configuration
from vestcl.models.config import ObjectMotionConfig, RoutingConfig
from vestcl.models.networks.object_motion import MotionBlock, MotionConv, shrink

FEATURES = 3


def small(shape: Any = "dmvfn", routing: RoutingConfig | None = None) -> ObjectMotionConfig:
    return ObjectMotionConfig(shape, scales=(4, 2, 1), widths=(16, 8, 4), detail=4, routing=routing)


def scene(batch: int, height: int, width: int, features: int = FEATURES) -> dict[str, torch.Tensor]:
    shape = (batch, 1, height, width)
    return {
        "features_prev": torch.randn(batch, features, height, width),
        "features_cur": torch.randn(batch, features, height, width),
        "depth_prev": torch.rand(shape) * 50 + 2,
        "depth_cur": torch.rand(shape) * 50 + 2,
        "mask_prev": (torch.rand(shape) > 0.3).float(),
        "mask_cur": (torch.rand(shape) > 0.3).float(),
        "flow0": torch.randn(batch, 6, height, width),
    }


def moving(config: ObjectMotionConfig) -> ObjectMotion:
    """A network whose blocks no longer end in zero."""
    network = ObjectMotion(config, FEATURES)
    for block in network.blocks:
        assert isinstance(block, MotionBlock) and block.out.bias is not None
        nn.init.normal_(block.out.weight, std=0.1)
        nn.init.normal_(block.out.bias, std=0.1)
    return network


def choose(network: ObjectMotion, *blocks: int, certain: float = 20.0) -> None:
    """Make the routing choose these blocks for every scene."""
    assert network.routing is not None
    with torch.no_grad():
        network.routing.choose.weight.zero_()
        network.routing.choose.bias.fill_(-certain)
        network.routing.choose.bias[list(blocks)] = certain


def count_calls(network: ObjectMotion) -> list[int]:
    """Batch sizes that each block is called with, one list for all blocks in order."""
    sizes: list[int] = []
    for block in network.blocks:
        block.register_forward_hook(lambda _module, _inputs, output: sizes.append(len(output)))
    return sizes


@pytest.mark.parametrize(("name", "count"), [("vest-paper", 3_792_507), ("vest-paper+omf-dmvfn", 3_808_668)])
def test_number_of_parameters(name: str, count: int) -> None:
    network = ObjectMotion(configuration(name).object_motion)
    assert sum(parameter.numel() for parameter in network.parameters()) == count


@pytest.mark.parametrize(("name", "giga"), [("vest-paper", 141.1), ("vest-paper+omf-dmvfn", 15.1)])
def test_multiply_adds_of_the_published_shapes(name: str, giga: float) -> None:
    """At 256 x 832: a weight counts once per pixel that a conv gives, or that a transposed conv takes.

    The device "meta" has shapes and computes nothing.
    """
    counted = []

    def count(module: nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        weight = module.weight
        assert isinstance(weight, torch.Tensor)
        grid = inputs[0] if isinstance(module, nn.ConvTranspose2d) else output
        counted.append(weight.numel() * grid.shape[2] * grid.shape[3])

    with torch.device("meta"):
        network, arguments = ObjectMotion(configuration(name).object_motion), scene(1, 256, 832, 32)
        for module in network.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                module.register_forward_hook(count)
        network.eval()(**arguments)
    assert sum(counted) / 1e9 == pytest.approx(giga, abs=0.05)


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("name", ["vest-paper", "vest-s", "vest-s+omf-paper", "vest-s+routing"])
def test_named_models_start_at_the_rigid_flow(name: str, training: bool) -> None:
    config = configuration(name)
    network = ObjectMotion(config.object_motion, config.encoder.features).train(training)
    arguments = scene(1, 16, 16, config.encoder.features)
    assert torch.equal(network(**arguments).flow, arguments["flow0"])


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize(("height", "width"), [(16, 32), (19, 33), (1, 1)])
@pytest.mark.parametrize("routing", [None, RoutingConfig(width=4, budget=1.5)])
@pytest.mark.parametrize("shape", ["paper", "dmvfn"])
def test_starts_at_the_rigid_flow(
    shape: str, routing: RoutingConfig | None, height: int, width: int, training: bool
) -> None:
    network, arguments = ObjectMotion(small(shape, routing), FEATURES).train(training), scene(2, height, width)
    forecast = network(**arguments)
    for flow in (forecast.flow, *forecast.candidates):
        assert torch.equal(flow, arguments["flow0"])


@pytest.mark.parametrize(("height", "width"), [(16, 32), (19, 33), (5, 2), (1, 1)])
@pytest.mark.parametrize("shape", ["paper", "dmvfn"])
def test_any_size(shape: str, height: int, width: int) -> None:
    forecast = moving(small(shape))(**scene(2, height, width))
    assert forecast.flow.shape == (2, 6, height, width) and forecast.flow.isfinite().all()
    assert [flow.shape for flow in forecast.candidates] == [forecast.flow.shape] * 3
    assert torch.equal(forecast.candidates[-1], forecast.flow)
    assert forecast.ran.tolist() == [[True] * 3] * 2 and forecast.probabilities is None


def test_an_odd_size_is_padded_by_its_borders_and_cut() -> None:
    network, arguments = moving(small()), scene(1, 18, 30)
    padded = {name: functional.pad(value, (0, 2, 0, 14), mode="replicate") for name, value in arguments.items()}
    assert torch.allclose(network(**arguments).flow, network(**padded).flow[..., :18, :30], atol=1e-5)


@pytest.mark.parametrize("shape", ["paper", "dmvfn"])
def test_metres_at_every_scale(shape: str) -> None:
    """A constant motion reaches both branches of each block as it is."""
    network, arguments = ObjectMotion(small(shape), FEATURES), scene(1, 32, 48)
    arguments["flow0"] = torch.tensor([1.0, -2, 3, 0.5, 0, -30])[:, None, None].expand(1, 6, 32, 48)
    seen: list[torch.Tensor] = []
    for module in network.modules():
        if isinstance(module, MotionConv):
            module.register_forward_hook(lambda _module, inputs, _output: seen.append(inputs[1]))
    network(**arguments)
    assert [flow.shape[-1] for flow in seen] == [12, 48, 24, 48, 48, 48]
    for flow in seen:
        assert torch.equal(flow, arguments["flow0"][..., : flow.shape[-2], : flow.shape[-1]])


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_a_block_as_it_is_written(scale: int) -> None:
    """The paper's shape, step by step on the concatenated input."""
    block = MotionBlock(4, "paper", scale, 8, 4).double()
    for parameter in block.parameters():
        nn.init.normal_(parameter, std=0.2)
    frames, flow = torch.randn(2, 4, 8, 12).double(), torch.randn(2, 6, 8, 12).double()

    def conv(x: torch.Tensor, layer: Any) -> torch.Tensor:
        return functional.conv2d(x, layer.weight, layer.bias, padding=1)

    both = torch.cat([frames, flow], dim=1)
    a = functional.interpolate(both, scale_factor=1 / scale, mode="bilinear") if scale > 1 else both
    c = conv(conv(a, block.shrunk_in).relu(), block.down[0]).relu()
    inner = c
    for layer in block.inner:
        assert isinstance(layer, nn.Sequential)
        inner = conv(inner, layer[0]).relu()
    a = conv(c + inner, block.squeeze[0]).relu()
    a = functional.interpolate(a, scale_factor=scale, mode="bilinear") if scale > 1 else a
    b = conv(conv(both, block.full_in).relu(), block.full[0]).relu()
    assert_close(block(frames, shrink(frames, scale), flow), conv(torch.cat([a, b], dim=1), block.out))


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_dmvfns_block_works_at_half_of_a_quarter(scale: int) -> None:
    block = MotionBlock(4, "dmvfn", scale, 8, 4)
    sizes: dict[str, tuple[int, int]] = {}
    for name in ("shrunk_in", "squeeze", "full_in", "full", "out"):
        module = block.get_submodule(name)
        module.register_forward_hook(lambda _m, _i, o, name=name: sizes.update({name: tuple(o.shape[1:3])}))
    frames = torch.randn(1, 4, 32, 64)
    assert block(frames, shrink(frames, scale), torch.randn(1, 6, 32, 64)).shape == (1, 6, 32, 64)
    wanted = {"shrunk_in": (4, 16 // scale), "squeeze": (2, 8 // scale)}
    assert sizes == wanted | {"full_in": (4, 16), "full": (4, 16), "out": (6, 32)}
    slopes = [module.weight for module in block.modules() if isinstance(module, nn.PReLU)]
    assert [len(slope) for slope in slopes] == [4, 8, 8, 8, 8, 2, 4, 4]


@pytest.mark.parametrize("routing", [None, RoutingConfig(width=4, budget=1.5)])
@pytest.mark.parametrize("shape", ["paper", "dmvfn"])
def test_a_gradient_for_every_tensor(shape: str, routing: RoutingConfig | None) -> None:
    network = moving(small(shape, routing)).double()
    if network.routing:
        choose(network, 0, 1, 2, certain=3.0)
        nn.init.normal_(network.routing.choose.weight)
    arguments = {name: value.double().requires_grad_() for name, value in scene(2, 19, 33).items()}
    forecast = network(**arguments)
    sum((flow * torch.randn_like(flow)).sum() for flow in (forecast.flow, *forecast.candidates)).backward()
    for name, tensor in [*arguments.items(), *network.named_parameters()]:
        assert tensor.grad is not None and tensor.grad.abs().max() > 1e-9, name


@pytest.mark.parametrize("shape", ["paper", "dmvfn"])
def test_every_block_leaves_the_start(shape: str) -> None:
    network, arguments = ObjectMotion(small(shape), FEATURES), scene(1, 16, 32)
    (network(**arguments).flow - torch.randn(1, 6, 16, 32)).square().sum().backward()
    for block in network.blocks:
        assert isinstance(block, MotionBlock)
        assert block.out.weight.grad is not None and block.out.weight.grad.abs().max() > 1e-3


def test_float64() -> None:
    network, arguments = moving(small()), scene(1, 19, 33)
    flow = network(**arguments).flow
    exact = network.double()(**{name: value.double() for name, value in arguments.items()}).flow
    assert exact.dtype == torch.float64 and torch.allclose(flow, exact.float(), atol=1e-4)


def test_blocks_that_are_not_chosen_are_not_computed() -> None:
    network, arguments = moving(small(routing=RoutingConfig(width=4, budget=1.5))).eval(), scene(2, 16, 32)
    choose(network, 0, 2)
    sizes = count_calls(network)
    forecast = network(**arguments)
    assert sizes == [2, 2] and len(forecast.candidates) == 2
    assert forecast.ran.tolist() == [[True, False, True]] * 2
    choose(network)
    sizes.clear()
    forecast = network(**arguments)
    assert not sizes and not forecast.candidates and not forecast.ran.any()
    assert torch.equal(forecast.flow, arguments["flow0"])


def test_each_scene_of_a_batch_has_its_own_blocks() -> None:
    network, arguments = moving(small(routing=RoutingConfig(width=4, budget=1.5))).eval(), scene(8, 16, 32)
    assert network.routing is not None
    nn.init.normal_(network.routing.choose.weight, std=30)
    sizes = count_calls(network)
    together = network(**arguments)
    assert len({tuple(ran) for ran in together.ran.tolist()}) > 1
    assert sizes == [count for count in together.ran.sum(dim=0).tolist() if count]
    for i in range(8):
        single = network(**{name: value[i : i + 1] for name, value in arguments.items()})
        assert torch.equal(single.ran[0], together.ran[i])
        assert torch.allclose(single.flow[0], together.flow[i], atol=1e-5)


def test_training_draws_the_blocks_and_judges_all_of_them() -> None:
    network, arguments = moving(small(routing=RoutingConfig(width=4, budget=1.5))), scene(64, 16, 16)
    forecast = network(**arguments)
    assert len(forecast.candidates) == 3
    assert 0.3 < forecast.ran.float().mean() < 0.7
    none = ~forecast.ran.any(dim=1)
    assert none.any() and torch.equal(forecast.flow[none], arguments["flow0"][none])
    first = forecast.ran[:, 0] & ~forecast.ran[:, 1:].any(dim=1)
    assert first.any() and torch.equal(forecast.flow[first], forecast.candidates[0][first])
    torch.manual_seed(1)
    again = network(**arguments)
    torch.manual_seed(1)
    assert torch.equal(network(**arguments).flow, again.flow)


def test_the_gradient_passes_straight_through_the_draw() -> None:
    """With one block, U = U^0 + g dU: dL/dp = sum(dL/dU dU), drawn or not."""
    config = ObjectMotionConfig("paper", scales=(1,), widths=(4,), detail=4, routing=RoutingConfig(4, budget=0.5))
    network, arguments = moving(config).double(), {n: v.double() for n, v in scene(4, 8, 8).items()}
    forecast = network(**arguments)
    weight = torch.randn_like(forecast.flow)
    assert forecast.probabilities is not None
    (grad,) = torch.autograd.grad((forecast.flow * weight).sum(), forecast.probabilities)
    residual = forecast.candidates[0] - arguments["flow0"]
    assert_close(grad[:, 0], (weight * residual).sum(dim=(1, 2, 3)))


def test_the_most_probable_blocks_of_a_budget() -> None:
    routing = RoutingConfig(width=4, budget=4.5, rule="top")
    config = ObjectMotionConfig("dmvfn", scales=(1,) * 9, widths=(4,) * 9, detail=4, routing=routing)
    network = ObjectMotion(config, FEATURES).eval()
    assert network.routing is not None
    nn.init.normal_(network.routing.choose.weight)
    forecast = network(**scene(3, 16, 16))
    assert forecast.probabilities is not None
    assert forecast.ran.sum(dim=1).tolist() == [5, 5, 5]
    for ran, probability in zip(forecast.ran, forecast.probabilities, strict=True):
        assert probability[ran].min() >= probability[~ran].max()


def test_routing_starts_at_its_budget() -> None:
    config = configuration("vest-s+routing")
    forecast = ObjectMotion(config.object_motion, config.encoder.features)(**scene(2, 16, 32, config.encoder.features))
    assert forecast.probabilities is not None and forecast.probabilities.shape == (2, 6)
    assert 4 < forecast.probabilities.sum(dim=1).mean() < 5


def test_budget_loss_by_hand() -> None:
    probabilities = torch.tensor([[1.0, 1, 1, 0], [0.5, 0.5, 0, 0]], requires_grad=True)
    loss = budget_loss(probabilities, 1.0)
    assert loss.item() == 0.0625  # ((3 + 1) / 2 - 1)^2 / 4^2
    loss.backward()
    assert probabilities.grad is not None and probabilities.grad.tolist() == [[0.0625] * 4] * 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"flow0": torch.rand(2, 3, 8, 9)}, r"`flow0` must be \[2, 6, 8, 9\], got \[2, 3, 8, 9\]"),
        ({"features_prev": torch.rand(2, 3, 2, 3)}, r"`features_cur` must be \[2, 3, 2, 3\], got \[2, 3, 8, 9\]"),
        ({"mask_prev": torch.ones(2, 1, 8, 9).int()}, "`mask_prev` must be a floating-point tensor, got torch.int32"),
    ],
)
def test_refuses(change: dict[str, torch.Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ObjectMotion(small(), FEATURES)(**(scene(2, 8, 9) | change))

"""vestcl.models.refine: its size, its shapes, and what it adds to."""

from typing import Any

import pytest
import torch
from tolerances import assert_close

from vestcl.models import Refine, configuration
from vestcl.models.config import RefineConfig, RenderConfig

FEATURES = 3


def small(render: RenderConfig | None = None, residual: bool = False) -> Refine:
    return Refine(RefineConfig(stem=4, stem_kernel=3, widths=(6, 8), residual=residual), render, FEATURES)


@pytest.mark.parametrize(
    ("name", "channels", "count"),
    [
        ("vest-paper", 74, 18_950_006),
        ("vest-paper+features-only", 64, 18_934_326),
        ("vest-paper+joint", 37, 18_891_990),
    ],
)
def test_number_of_parameters(name: str, channels: int, count: int) -> None:
    config = configuration(name)
    network = Refine(config.refine, config.render)
    assert network.channels == channels
    assert sum(parameter.numel() for parameter in network.parameters()) == count


@pytest.mark.parametrize("name", ["vest-paper", "vest-s", "vest-s+joint", "vest-s+features-only", "vest-s+residual"])
def test_named_models(name: str) -> None:
    config = configuration(name)
    network = Refine(config.refine, config.render, config.encoder.features)
    image = network(torch.rand(1, network.channels, 32, 48))
    assert image.shape == (1, 3, 32, 48) and image.isfinite().all()


@pytest.mark.parametrize(("height", "width"), [(32, 48), (37, 53), (5, 2), (1, 1)])
def test_any_size(height: int, width: int) -> None:
    image = small()(torch.rand(2, 16, height, width))
    assert image.shape == (2, 3, height, width)
    assert (image > 0).all() and (image < 1).all()


def test_levels() -> None:
    """The stem keeps the size, each down halves it and rounds up, and the bottleneck is a down, too."""
    network, sizes = small(), []
    for down in network.downs:
        down.register_forward_hook(lambda _m, _i, outputs: sizes.append([tuple(o.shape[1:]) for o in outputs]))
    network(torch.rand(1, 16, 21, 40))
    assert sizes == [[(6, 11, 20)] * 2, [(8, 6, 10)] * 2, [(8, 3, 5)] * 2]


def test_images_do_not_see_each_other() -> None:
    network, rendered = small(), torch.rand(3, 16, 16, 24)
    alone = torch.cat([network(one[None]) for one in rendered])
    assert torch.allclose(network(rendered), alone, atol=1e-5)


@pytest.mark.parametrize("residual", [False, True])
def test_a_gradient_for_every_tensor(residual: bool) -> None:
    network, rendered = small(residual=residual).double(), torch.rand(2, 16, 19, 24).double().requires_grad_()
    torch.nn.init.normal_(network.out.weight)
    image = network(rendered)
    (image * torch.randn_like(image)).sum().backward()
    for name, tensor in [("rendered", rendered), *network.named_parameters()]:
        assert tensor.grad is not None and tensor.grad.abs().max() > 1e-9, name


def test_float64() -> None:
    network, rendered = small(), torch.rand(1, 16, 19, 24)
    image = network(rendered)
    exact = network.double()(rendered.double())
    assert exact.dtype == torch.float64 and torch.allclose(image, exact.float(), atol=1e-4)


def test_residual_starts_at_the_splatted_colour() -> None:
    """Current over previous frame: 0.3 where it covers 3/4, and a quarter of the previous one's 0.8 behind it."""
    rendered = torch.rand(1, 16, 9, 10)
    rendered[:, 3:6], rendered[:, 6], rendered[:, 11:14], rendered[:, 14] = 0.8, 1, 0.3, 0.75
    assert_close(small(residual=True)(rendered), torch.full((1, 3, 9, 10), 0.5))
    rendered[:, 14] = 1
    assert_close(small(residual=True)(rendered), torch.full((1, 3, 9, 10), 0.3))
    rendered[:, 11:15] = 0
    assert_close(small(residual=True)(rendered), torch.full((1, 3, 9, 10), 0.8))


def test_residual_starts_at_the_joint_colour() -> None:
    rendered = torch.rand(2, 8, 9, 10)
    assert torch.equal(small(RenderConfig(joint=True), residual=True)(rendered), rendered[:, 3:6])


def test_residual_is_clamped_out_of_training() -> None:
    network, rendered = small(residual=True), torch.rand(1, 16, 9, 10)
    torch.nn.init.normal_(network.out.weight, std=5)
    free, clamped = network(rendered), network.eval()(rendered)
    assert free.min() < 0 and free.max() > 1
    assert torch.equal(clamped, free.clamp(0, 1))


@pytest.mark.parametrize(
    ("rendered", "message"),
    [
        (torch.rand(1, 15, 8, 8), r"`rendered` must be \[B, 16, H, W\], got \[1, 15, 8, 8\]"),
        (torch.rand(16, 8, 8), r"`rendered` must be \[B, 16, H, W\], got \[16, 8, 8\]"),
    ],
)
def test_refuses(rendered: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small()(rendered)


def test_a_residual_needs_colour() -> None:
    with pytest.raises(ValueError, match=r"needs `render.colour`"):
        small(RenderConfig(colour=False), residual=True)

"""vestcl.models.networks.refine: its size, its shapes, and what it adds to."""

from typing import Any

import pytest
import torch
from tolerances import assert_close
from torch.autograd import gradcheck

from vestcl.models import Refine, configuration
from vestcl.models.config import (
    FORECAST_PLANES,
    LEAST_COVERAGE,
    MOST_CHANGE,
    OPAQUE,
    RefineConfig,
    RenderConfig,
)
from vestcl.models.networks.refine import fill

FEATURES = 3


#: What the base "filled" goes with.
FILLED = RenderConfig(normalised=True)


def small(render: RenderConfig | None = None, base: Any = "none") -> Refine:
    return Refine(RefineConfig(stem=4, stem_kernel=3, widths=(6, 8), base=base), render, FEATURES)


@pytest.mark.parametrize(
    ("name", "channels", "count"),
    [
        ("vest-paper", 64, 18_934_326),
        ("vest-paper+features-only", 64, 18_934_326),
        ("vest-paper+colour", 74, 18_950_006),
        ("vest-paper+colour+joint", 37, 18_891_990),
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
    single = torch.cat([network(one[None]) for one in rendered])
    assert torch.allclose(network(rendered), single, atol=1e-5)


@pytest.mark.parametrize("base", ["none", "splatted", "filled"])
def test_a_gradient_for_every_tensor(base: str) -> None:
    network = small(FILLED if base == "filled" else None, base).double()
    rendered = torch.rand(2, 16, 19, 24).double().requires_grad_()
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
    assert_close(small(base="splatted")(rendered), torch.full((1, 3, 9, 10), 0.5))
    rendered[:, 14] = 1
    assert_close(small(base="splatted")(rendered), torch.full((1, 3, 9, 10), 0.3))
    rendered[:, 11:15] = 0
    assert_close(small(base="splatted")(rendered), torch.full((1, 3, 9, 10), 0.8))


def test_residual_starts_at_the_joint_colour() -> None:
    rendered = torch.rand(2, 8, 9, 10)
    assert torch.equal(small(RenderConfig(joint=True), base="splatted")(rendered), rendered[:, 3:6])


def test_residual_is_clamped_out_of_training() -> None:
    network, rendered = small(base="splatted"), torch.rand(1, 16, 9, 10)
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
        small(RenderConfig(colour=False), base="splatted")


# ---------------------------------------------------------------- filled


def normalised(sides: list[tuple[torch.Tensor, torch.Tensor]]) -> torch.Tensor:
    """What refinement is given: (colour [1, 3, H, W], divided by coverage; coverage [1, 1, H, W]) of each side."""
    planes = []
    for colour, coverage in sides:
        planes += [torch.rand(1, FEATURES, *colour.shape[2:]), colour, coverage, torch.rand_like(coverage)]
    return torch.cat(planes, dim=1)


def test_filled_starts_at_the_splatted_colour_where_all_is_covered() -> None:
    """From a coverage of half on a side is opaque: the current frame's colour, wherever it is."""
    first, second = torch.rand(2, 1, 3, 9, 10)
    for coverage in (1.0, 0.5):
        cover = torch.full((1, 1, 9, 10), coverage)
        assert_close(small(FILLED, "filled")(normalised([(first, cover), (second, cover)])), second)
    nothing = torch.full((1, 1, 9, 10), LEAST_COVERAGE)
    assert_close(small(FILLED, "filled")(normalised([(first, cover), (second, nothing)])), first)


def test_filled_mixes_what_is_half_covered() -> None:
    """Half way from LEAST_COVERAGE to half, the current frame's 0.2 and the previous one's 0.6 are mixed."""
    size = (1, 3, 4, 6)
    middle = torch.full((1, 1, 4, 6), (LEAST_COVERAGE + 0.5) / 2)
    sides = [(torch.full(size, 0.6), torch.ones(1, 1, 4, 6)), (torch.full(size, 0.2), middle)]
    assert torch.allclose(small(FILLED, "filled")(normalised(sides)), torch.full(size, 0.4))


def test_filled_paints_holes_like_what_is_around_them() -> None:
    """A hole in one colour is of that colour; one in two colours is between them."""
    cover = torch.ones(1, 1, 16, 16)
    cover[..., 5:11, 4:12] = 0
    one = torch.full((1, 3, 16, 16), 0.7)
    joint = RenderConfig(joint=True, normalised=True)
    image = small(joint, "filled")(normalised([(one * (cover > 0), cover)]))
    assert torch.allclose(image, one, atol=1e-6)
    two = one.clone()
    two[..., 8:] = 0.1
    image = small(joint, "filled")(normalised([(two * (cover > 0), cover)]))
    hole = image[..., 5:11, 4:12]
    assert hole.min() >= 0.1 - 1e-6 and hole.max() <= 0.7 + 1e-6
    assert hole[..., 0].mean() > 0.5 and hole[..., -1].mean() < 0.3


@pytest.mark.parametrize(("height", "width"), [(8, 8), (7, 5), (1, 9), (5, 1), (1, 1), (2, 3)])
def test_what_is_opaque_is_not_filled(height: int, width: int) -> None:
    image = torch.rand(2, 3, height, width)
    assert torch.equal(fill(image, torch.ones(2, 1, height, width)), image)
    assert not fill(torch.zeros(2, 3, height, width), torch.zeros(2, 1, height, width)).any()


@pytest.mark.parametrize(("height", "width"), [(16, 16), (13, 7), (1, 9), (5, 1)])
def test_one_pixel_fills_all(height: int, width: int) -> None:
    """Wherever it is, and however thin: what surrounds a hole is all there is to fill it with."""
    colour = torch.tensor([0.2, 0.5, 0.9])[:, None]
    for opacity in (1.0, 0.3):
        for place in (0, height * width // 2, height * width - 1):
            alpha = torch.zeros(1, 1, height * width)
            alpha[..., place] = opacity
            filled = fill((colour * alpha).unflatten(-1, (height, width)), alpha.unflatten(-1, (height, width)))
            assert torch.allclose(filled, colour[None, :, :, None].expand_as(filled), atol=1e-5)


def test_gradients_of_filling() -> None:
    """Opacities away from 0 and 1: a pixel of a coarser level is clamped where its four are as opaque as one."""
    image = torch.rand(1, 2, 5, 6, dtype=torch.float64, requires_grad=True)
    opacity = (0.05 + 0.1 * torch.rand(1, 1, 5, 6, dtype=torch.float64)).requires_grad_()
    assert gradcheck(fill, (image, opacity))


# ---------------------------------------------------------------- of geometric forecasts


def of_forecast() -> Refine:
    return Refine(RefineConfig(stem=4, stem_kernel=3, widths=(6, 8), base="filled", refines="forecast"), FILLED)


def test_a_forecast_is_unchanged_at_the_start() -> None:
    planes = torch.rand(2, FORECAST_PLANES, 20, 28)
    assert torch.equal(of_forecast()(planes), planes[:, :3])


def test_covered_pixels_change_modestly() -> None:
    """y is huge: a covered pixel changes by MOST_CHANGE, half as much coverage as OPAQUE lets half of the rest."""
    network = of_forecast().train()
    assert network.out.bias is not None
    torch.nn.init.constant_(network.out.bias, 50.0)
    planes = torch.zeros(1, FORECAST_PLANES, 6, 6)
    planes[:, 3, 0], planes[:, 3, 1] = 1.0, OPAQUE / 2
    image = network(planes)
    for row, wanted in ((0, MOST_CHANGE), (1, (1 + MOST_CHANGE) / 2), (2, 1.0)):
        torch.testing.assert_close(image[:, :, row], torch.full((1, 3, 6), wanted))


def test_a_forecast_has_an_image_to_add_to() -> None:
    with pytest.raises(ValueError, match='`base` must not be "none"'):
        RefineConfig(refines="forecast")
    with pytest.raises(ValueError, match='`refines` must be "clouds" or "forecast"'):
        RefineConfig(refines="clods")  # type: ignore[arg-type]

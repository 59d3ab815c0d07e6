"""vestcl.models.ego_motion: its size, rest at the start, positions and masks."""

import math
from typing import Any

import pytest
import torch
from tolerances import assert_close

from vestcl import geometry
from vestcl.models import EgoMotion, RigidMotion, configuration
from vestcl.models.config import EgoMotionConfig
from vestcl.models.ego_motion import background_tokens, sinusoidal_positions

SMALL = EgoMotionConfig(widths=(8, 8, 12, 16), heads=2, mlp_ratio=2)


def scene(batch: int, height: int, width: int, features: int = 4, dtype: torch.dtype = torch.float32) -> dict[str, Any]:
    shape = (batch, 1, height, width)
    return {
        "features_prev": torch.randn(batch, features, height, width, dtype=dtype),
        "features_cur": torch.randn(batch, features, height, width, dtype=dtype),
        "depth_prev": torch.rand(shape, dtype=dtype) * 50 + 2,
        "depth_cur": torch.rand(shape, dtype=dtype) * 50 + 2,
        "mask_prev": torch.ones(shape, dtype=dtype),
        "mask_cur": torch.ones(shape, dtype=dtype),
    }


def moving(dtype: torch.dtype = torch.float32) -> EgoMotion:
    """A network whose last layer is no longer zero."""
    network = EgoMotion(SMALL, features=4).to(dtype)
    torch.nn.init.normal_(network.motion.weight)
    return network


def numbers(network: EgoMotion, arguments: dict[str, torch.Tensor]) -> torch.Tensor:
    """[B, 14]."""
    return torch.cat([part for motion in network(**arguments) for part in motion], dim=1)


def test_number_of_parameters() -> None:
    assert sum(parameter.numel() for parameter in EgoMotion().parameters()) == 1_861_646


@pytest.mark.parametrize("name", ["vest-paper", "vest-s"])
def test_named_models_start_at_rest(name: str) -> None:
    config = configuration(name)
    network = EgoMotion(config.ego_motion, config.encoder.features)
    for quaternion, translation in network(**scene(2, 16, 24, config.encoder.features)):
        assert quaternion.tolist() == [[1, 0, 0, 0]] * 2 and translation.tolist() == [[0, 0, 0]] * 2


def test_named_models_start_at_the_prior() -> None:
    """vest-s answers what it is given: exactly, for any length and sign of the quaternion."""
    config = configuration("vest-s")
    network = EgoMotion(config.ego_motion, config.encoder.features, config.start)
    prior = tuple(RigidMotion(torch.randn(2, 4), torch.randn(2, 3)) for _ in range(2))
    for got, wanted in zip(network(**scene(2, 16, 24, config.encoder.features), prior=prior), prior, strict=True):
        assert torch.equal(got.quaternion, wanted.quaternion) and torch.equal(got.translation, wanted.translation)


def test_one_motion_after_another() -> None:
    """x -> R (R_first x + t_first) + t."""
    first, second = (RigidMotion(torch.randn(2, 4).double(), torch.randn(2, 3).double()) for _ in range(2))
    wanted = geometry.compose_rigid(*second) @ geometry.compose_rigid(*first)
    assert_close(geometry.compose_rigid(*second.after(first)), wanted)


def test_the_prior_has_a_gradient_and_every_tensor() -> None:
    network = EgoMotion(SMALL, 4, "prior").double()
    torch.nn.init.normal_(network.motion.weight)
    prior = tuple(RigidMotion(*(torch.randn(2, n).double().requires_grad_() for n in (4, 3))) for _ in range(2))
    output = torch.cat([part for motion in network(**scene(2, 16, 24, dtype=torch.float64), prior=prior)
                        for part in motion], dim=1)  # fmt: skip
    (output * torch.randn_like(output)).sum().backward()
    given = [(f"prior {i}", part) for i, motion in enumerate(prior) for part in motion]
    for name, tensor in [*given, *network.named_parameters()]:
        assert tensor.grad is not None and tensor.grad.abs().max() > 1e-9, name


@pytest.mark.parametrize("start", ["rest", "prior"])
def test_a_prior_where_it_is_wanted(start: str) -> None:
    rest = RigidMotion(torch.tensor([[1.0, 0, 0, 0]] * 2), torch.zeros(2, 3))
    prior = (rest, rest) if start == "rest" else None
    with pytest.raises(ValueError, match=f"`prior` must be {'none' if start == 'rest' else 'given'}"):
        EgoMotion(SMALL, 4, start)(**scene(2, 8, 9), prior=prior)


@pytest.mark.parametrize(("height", "width"), [(16, 24), (17, 23), (5, 2), (1, 1)])
def test_any_size(height: int, width: int) -> None:
    next_from_prev, next_from_cur = moving()(**scene(2, height, width))
    for quaternion, translation in (next_from_prev, next_from_cur):
        assert quaternion.shape == (2, 4) and translation.shape == (2, 3)
        assert quaternion.isfinite().all() and translation.isfinite().all()
    assert not torch.equal(next_from_prev.translation, next_from_cur.translation)


def test_tokens_of_a_frame() -> None:
    """832 of them at 256 x 832; one sees 11 cells to either side, and so 23 of them."""
    network, frame = EgoMotion(), torch.zeros(1, 34, 64, 208, requires_grad=True)
    tokens = network.frame(frame)
    assert tokens.shape == (1, 128, 16, 52)
    (grad,) = torch.autograd.grad(tokens[0, :, 8, 20].sum(), frame)
    rows, columns = grad.abs().sum(dim=(0, 1)).nonzero().T
    assert (rows.min(), rows.max()) == (8 * 4 - 11, 8 * 4 + 11)
    assert (columns.min(), columns.max()) == (20 * 4 - 11, 20 * 4 + 11)


def test_float64() -> None:
    network, arguments = moving(), scene(2, 13, 18)
    inexact = numbers(network, arguments)
    exact = numbers(network.double(), {name: value.double() for name, value in arguments.items()})
    assert exact.dtype == torch.float64
    assert torch.allclose(inexact, exact.float(), atol=1e-4)


def test_a_gradient_for_every_tensor() -> None:
    network, arguments = moving(torch.float64), scene(2, 16, 24, dtype=torch.float64)
    for value in arguments.values():
        value.requires_grad_()
    output = numbers(network, arguments)
    (output * torch.randn_like(output)).sum().backward()
    for name, tensor in [*arguments.items(), *network.named_parameters()]:
        assert tensor.grad is not None and tensor.grad.abs().max() > 1e-9, name


def test_rest_is_left_by_the_first_step() -> None:
    network, arguments = EgoMotion(SMALL, features=4), scene(1, 16, 24)
    (numbers(network, arguments) - torch.randn(1, 14)).square().sum().backward()
    assert network.motion.weight.grad is not None and network.motion.weight.grad.abs().max() > 1e-3


def test_depth_is_clamped() -> None:
    network, arguments = moving(), scene(1, 16, 24)
    near, far = (
        arguments | {"depth_cur": torch.zeros(1, 1, 16, 24)},
        arguments | {"depth_cur": torch.full((1, 1, 16, 24), math.inf)},
    )
    limits = [arguments | {"depth_cur": torch.full((1, 1, 16, 24), limit)} for limit in (0.1, 1000.0)]
    for beyond, limit in zip((near, far), limits, strict=True):
        assert torch.equal(numbers(network, beyond), numbers(network, limit))


@pytest.mark.parametrize("frame", ["prev", "cur"])
def test_nothing_is_learned_from_the_foreground(frame: str) -> None:
    """The left half is foreground in one frame; its far left, which no token on the right sees, then plays no part."""
    network, arguments = moving(), scene(1, 48, 96)
    arguments[f"mask_{frame}"][..., :48] = 0
    changed = {name: value.clone() for name, value in arguments.items()}
    for name in ("features_prev", "features_cur", "depth_prev", "depth_cur"):
        changed[name][..., :32] += 1
    assert torch.allclose(numbers(network, arguments), numbers(network, changed), atol=1e-5)
    for each in (arguments, changed):
        each[f"mask_{frame}"] = torch.ones(1, 1, 48, 96)
    assert not torch.allclose(numbers(network, arguments), numbers(network, changed), atol=1e-2)


def test_all_is_looked_at_where_no_background_is_left() -> None:
    """One sample of the batch is all foreground: it is not NaN, and each sample stays what it is alone."""
    network, arguments = moving(), scene(2, 16, 24)
    arguments["mask_cur"][1] = 0
    together = numbers(network, arguments)
    assert together.isfinite().all()
    for i in range(2):
        alone = numbers(network, {name: value[i : i + 1] for name, value in arguments.items()})
        assert torch.allclose(together[i : i + 1], alone, atol=1e-5)
    changed = arguments | {"features_cur": arguments["features_cur"] + 1}
    assert not torch.allclose(numbers(network, changed)[1], together[1], atol=1e-2)


def test_background_tokens_by_hand() -> None:
    """A token is 2 x 2 cells: half a background is enough in each frame, but it has to be so in both."""
    mask_prev = torch.tensor([[1.0, 1, 1, 0, 0, 0], [1, 1, 0, 1, 0, 1]])[None, None]
    mask_cur = torch.tensor([[1.0, 0, 1, 1, 1, 1], [1, 1, 1, 1, 1, 1]])[None, None]
    assert background_tokens(mask_prev, mask_cur, 1, 3).tolist() == [[True, True, False]]
    assert background_tokens(mask_prev, 0 * mask_cur, 1, 3).tolist() == [[True, True, True]]


def test_positions_by_hand() -> None:
    """8 channels: sine and cosine of the row at the frequencies 1 and 1/100, then those of the column."""
    positions = sinusoidal_positions(torch.zeros(1, 8, 4, 5, dtype=torch.float64))
    assert positions.shape == (8, 4, 5)
    wanted = [f(p * w) for p in (3, 2) for w in (1, 0.01) for f in (math.sin, math.cos)]
    assert_close(positions[:, 3, 2], torch.tensor(wanted, dtype=torch.float64))


def test_the_order_of_tokens_counts() -> None:
    network, arguments = moving(), scene(1, 16, 24)
    mirrored = {name: value.flip(-1) for name, value in arguments.items()}
    assert not torch.allclose(numbers(network, arguments), numbers(network, mirrored), atol=1e-2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features_cur": torch.rand(2, 5, 8, 9)}, r"`features_cur` must be \[2, 4, 8, 9\], got \[2, 5, 8, 9\]"),
        ({"depth_prev": torch.rand(2, 1, 32, 36)}, r"`depth_prev` must be \[2, 1, 8, 9\], got \[2, 1, 32, 36\]"),
        ({"mask_cur": torch.ones(2, 8, 9)}, r"`mask_cur` must be \[2, 1, 8, 9\], got \[2, 8, 9\]"),
        ({"mask_cur": torch.ones(2, 1, 8, 9).bool()}, "`mask_cur` must be a floating-point tensor, got torch.bool"),
    ],
)
def test_refuses(change: dict[str, torch.Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EgoMotion(SMALL, features=4)(**(scene(2, 8, 9) | change))

"""vestcl.models.networks.ego_motion: its size, where it starts, the path, positions and masks."""

import math
from typing import Any

import pytest
import torch
from tolerances import assert_close

from vestcl import geometry
from vestcl.models import EgoMotion, RigidMotion, configuration
from vestcl.models.config import EgoMotionConfig
from vestcl.models.networks.ego_motion import CameraMotion, background_tokens, sinusoidal_positions

SMALL = EgoMotionConfig(widths=(8, 8, 12, 16), heads=2, mlp_ratio=2)

#: The same, with three intervals at once.
PATH = EgoMotionConfig(widths=(8, 8, 12, 16), heads=2, mlp_ratio=2, path=3)

Prior = tuple[RigidMotion, RigidMotion, RigidMotion]


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


def numbers(network: EgoMotion, arguments: dict[str, Any]) -> torch.Tensor:
    """[B, 7 motions]: from t - 1, and of each interval."""
    answer = network(**arguments)
    return torch.cat([part for motion in (*answer[:2], *answer.later) for part in motion], dim=1)


def random_prior(batch: int = 2) -> Prior:
    """Motions of any size and length of quaternion."""
    first, second, third = (RigidMotion(torch.randn(batch, 4), torch.randn(batch, 3)) for _ in range(3))
    return first, second, third


def intervals(answer: CameraMotion) -> list[torch.Tensor]:
    """[B, 4, 4] of each interval ahead."""
    return [geometry.compose_rigid(*motion) for motion in (answer.next_from_cur, *answer.later)]


def test_number_of_parameters() -> None:
    assert sum(parameter.numel() for parameter in EgoMotion().parameters()) == 1_861_646


@pytest.mark.parametrize("name", ["vest-paper", "vest-s"])
def test_named_models_start_at_rest(name: str) -> None:
    config = configuration(f"{name}+from-rest")
    network = EgoMotion(config.ego_motion, config.encoder.features, config.start)
    *to_next, later = network(**scene(2, 16, 24, config.encoder.features))
    assert not later
    for quaternion, translation in to_next:
        assert quaternion.tolist() == [[1, 0, 0, 0]] * 2 and translation.tolist() == [[0, 0, 0]] * 2


def test_named_models_start_at_the_prior() -> None:
    """vest-s answers what it is given for all five intervals: exactly, for any length and sign of the quaternion."""
    config = configuration("vest-s")
    network, prior = EgoMotion(config.ego_motion, config.encoder.features, config.start), random_prior()
    answer = network(**scene(2, 16, 24, config.encoder.features), prior=prior)
    assert len(answer.later) == 4
    for got in (answer.next_from_cur, *answer.later):
        assert torch.equal(got.quaternion, prior[0].quaternion) and torch.equal(got.translation, prior[0].translation)
    from_prev = prior[0].after(prior[1])
    assert all(torch.equal(got, wanted) for got, wanted in zip(answer.next_from_prev, from_prev, strict=True))


def test_a_path_by_hand() -> None:
    """Each interval is corrected on its own, after the prior: what is said is times 0.03 rad and 0.1 m."""
    network, prior = EgoMotion(PATH, 4, "prior"), random_prior(1)
    said = torch.tensor([[1.0, 0, 0, 0, 0, 0], [0, -2, 0, 0, 0, 3], [0, 0, 0, 5, -4, 0]])
    with torch.no_grad():
        network.motion.bias.copy_(said.flatten())
    answer = network(**scene(1, 16, 24), prior=prior)
    turns = torch.tensor([[1.0, 0.015, 0, 0], [1, 0, -0.03, 0], [1, 0, 0, 0]])  # half the angle
    shifts = torch.tensor([[0.0, 0, 0], [0, 0, 0.3], [0.5, -0.4, 0]])
    before = geometry.compose_rigid(*prior[0])
    got = intervals(answer)
    for one, correction in zip(got, geometry.compose_rigid(turns, shifts), strict=True):
        assert_close(one[0], correction @ before[0])
    assert_close(geometry.compose_rigid(*answer.next_from_prev), got[0] @ geometry.compose_rigid(*prior[1]))
    angle = torch.linalg.matrix_norm(got[0] @ geometry.invert(before) - torch.eye(4)) / 2**0.5  # of a small turn
    assert angle.item() == pytest.approx(0.03, rel=1e-3)


def test_how_the_camera_swayed_counts_in_a_line() -> None:
    """With the last layer at 0, only the motions' numbers: 100 v of a small turn and the translation, of either."""
    network, sizes = EgoMotion(PATH, 4, "prior"), torch.tensor([1.0, -2.0])[:, None]
    assert network.swayed is not None
    weight = torch.zeros(3, 6, 2, 6)
    weight[0, 1, 0, 1] = 0.5  # the first interval's turn about y, from the last motion's
    weight[2, 5, 1, 3] = 2.0  # the third one's z, from the x of the motion before
    with torch.no_grad():
        network.swayed.weight.copy_(weight.flatten(0, 1).flatten(1))
    still, none = torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1), torch.zeros(2, 3)
    ahead = torch.tensor([[0.0, 0, 1]]).repeat(2, 1)
    turning = RigidMotion(-3 * (still + sizes * torch.tensor([[0.0, 0, 0.001, 0]])), ahead)
    sliding = RigidMotion(still, sizes * torch.tensor([[0.25, 0, 0]]))
    first, second, third = intervals(network(**scene(2, 16, 24), prior=(RigidMotion(still, none), turning, sliding)))
    angle = 0.002 * sizes[:, 0]  # twice the half, and of that said 100 * 0.5 * 0.03
    assert torch.allclose(first[:, 0, 2], 100 * 0.5 * 0.03 * angle, rtol=1e-3)
    assert torch.equal(second, torch.eye(4).repeat(2, 1, 1))
    assert torch.allclose(third[:, :3, 3], 0.1 * 2.0 * 0.25 * sizes * torch.tensor([[0.0, 0, 1]]))


@pytest.mark.parametrize(("metres", "share"), [(0.0, 0.0), (0.1, 0.2), (0.5, 1.0), (2.0, 1.0)])
def test_a_static_camera_is_not_corrected(metres: float, share: float) -> None:
    """Below half a metre per interval a correction counts by what was measured of it."""
    network, (next_from_cur, cur_from_prev, before) = EgoMotion(PATH, 4, "prior"), random_prior(1)
    with torch.no_grad():
        network.motion.bias.copy_(torch.tensor([[0.0, 0, 0, 0, 0, 1]] * PATH.path).flatten())
    rolling = RigidMotion(cur_from_prev.quaternion, torch.tensor([[0.0, 0, metres]]))
    answer = network(**scene(1, 16, 24), prior=(next_from_cur, rolling, before))
    for motion in (answer.next_from_cur, *answer.later):
        assert torch.equal(motion.quaternion, next_from_cur.quaternion)
        assert_close(motion.translation - next_from_cur.translation, torch.tensor([[0.0, 0, 0.1 * share]]))


def test_adams_first_step_is_a_small_motion() -> None:
    """It moves each weight of the last layers by the learning rate, whatever the loss: millimetres and milliradians."""
    network, arguments = EgoMotion(PATH, 4, "prior"), scene(2, 16, 24)
    driving = RigidMotion(torch.tensor([[1.0, 0, 0.01, 0]] * 2), torch.ones(2, 3))
    prior = (driving, driving, driving)
    adam = torch.optim.Adam(network.parameters(), lr=1e-3)
    before = intervals(network(**arguments, prior=prior))
    torch.stack([(motion * torch.randn(2, 4, 4)).sum() for motion in before]).sum().backward()
    adam.step()
    assert network.swayed is not None and network.swayed.weight.any() and network.motion.weight.any()
    for one, other in zip(before, intervals(network(**arguments, prior=prior)), strict=True):
        assert 0 < (other @ geometry.invert(one) - torch.eye(4)).abs().max().item() < 0.01


def test_one_motion_after_another() -> None:
    """x -> R (R_first x + t_first) + t."""
    first, second = (RigidMotion(torch.randn(2, 4).double(), torch.randn(2, 3).double()) for _ in range(2))
    wanted = geometry.compose_rigid(*second) @ geometry.compose_rigid(*first)
    assert_close(geometry.compose_rigid(*second.after(first)), wanted)


def test_the_prior_has_a_gradient_and_every_tensor() -> None:
    network = EgoMotion(PATH, 4, "prior").double()
    torch.nn.init.normal_(network.motion.weight)
    prior = [RigidMotion(*(part.double().requires_grad_() for part in motion)) for motion in random_prior()]
    output = numbers(network, {**scene(2, 16, 24, dtype=torch.float64), "prior": tuple(prior)})
    assert output.shape == (2, 7 * 4)
    (output * torch.randn_like(output)).sum().backward()
    given = [(f"prior {i}", part) for i, motion in enumerate(prior) for part in motion]
    for name, tensor in [*given, *network.named_parameters()]:
        assert tensor.grad is not None and tensor.grad.abs().max() > 1e-9, name


@pytest.mark.parametrize("start", ["rest", "prior"])
def test_a_prior_where_it_is_wanted(start: str) -> None:
    rest = RigidMotion(torch.tensor([[1.0, 0, 0, 0]] * 2), torch.zeros(2, 3))
    prior = (rest, rest, rest) if start == "rest" else None
    with pytest.raises(ValueError, match=f"`prior` must be {'none' if start == 'rest' else 'given'}"):
        EgoMotion(SMALL, 4, start)(**scene(2, 8, 9), prior=prior)


@pytest.mark.parametrize(("height", "width"), [(16, 24), (17, 23), (5, 2), (1, 1)])
def test_any_size(height: int, width: int) -> None:
    next_from_prev, next_from_cur, later = moving()(**scene(2, height, width))
    assert not later
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
    """One sample of the batch is all foreground: it is not NaN, and each sample is the same as in a batch of one."""
    network, arguments = moving(), scene(2, 16, 24)
    arguments["mask_cur"][1] = 0
    together = numbers(network, arguments)
    assert together.isfinite().all()
    for i in range(2):
        single = numbers(network, {name: value[i : i + 1] for name, value in arguments.items()})
        assert torch.allclose(together[i : i + 1], single, atol=1e-5)
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

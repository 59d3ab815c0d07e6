"""EMF's bounded correction of a forecast motion: the time between frames, its limits, its gate."""

import math

import pytest
import torch
from forecaster_scenes import change, frame, turning
from torch import nn

from vestcl import geometry
from vestcl.models import EgoMotion, RigidMotion, configuration
from vestcl.models.config import EgoMotionConfig
from vestcl.models.forecaster import Forecaster
from vestcl.models.networks.camera_correction import (
    ACCELERATION,
    MEASURED,
    RATES,
    TURN_RATE,
    BoundedCorrection,
    CameraPrior,
    rates_of,
)

PATH = 3
SECONDS = (1 / 30, 0.1, 1 / 8)

#: A network with a bounded correction, of two tokens' width.
BOUNDED = EgoMotionConfig(widths=(8, 8, 8, 8), blocks=1, heads=2, path=PATH, correction="bounded")


def motion(turn: tuple[float, ...], shift: tuple[float, ...], batch: int) -> RigidMotion:
    quaternion = torch.tensor([[1.0, *(angle / 2 for angle in turn)]]).repeat(batch, 1)
    return RigidMotion(quaternion, torch.tensor([shift]).repeat(batch, 1))


def prior(seconds: tuple[float, ...] = SECONDS, speed: float = 10.0) -> CameraPrior:
    """A bend at ``speed`` m/s, for samples of different intervals between frames."""
    dt = torch.tensor(seconds)[:, None]
    once = RigidMotion(
        torch.cat([torch.ones_like(dt), 0 * dt, 0.05 * dt, 0 * dt], dim=1), torch.cat([0 * dt, 0 * dt, -speed * dt], 1)
    )
    later = RigidMotion(
        once.quaternion[:, None].repeat(1, PATH - 1, 1), once.translation[:, None].repeat(1, PATH - 1, 1)
    )
    return CameraPrior(once, once, once, later, rates_of([once] * 4, dt), dt[:, 0])


def correction(gate: float = 1.0) -> BoundedCorrection:
    torch.manual_seed(0)
    network = BoundedCorrection(PATH, 8)
    nn.init.constant_(network.gate, gate)
    return network


def corrected(network: BoundedCorrection, given: CameraPrior, said: float) -> list[torch.Tensor]:
    """[B, 4, 4] by interval, if the mean token leads to ``said`` before the tanh, everywhere."""
    with torch.no_grad():
        network.seen.weight.zero_()
        network.seen.bias.fill_(said)
        network.swayed.weight.zero_()
        moved = network(torch.zeros(len(given.dt), 8), network.numbers(given), given)
    return [geometry.compose_rigid(*one) for one in moved]


def test_the_gate_starts_at_0_and_learns() -> None:
    """The correction is exactly none, and only the gate has a gradient: then it opens."""
    network, given = BoundedCorrection(PATH, 8), prior()
    assert network.changes_nothing and not network.gate.any()
    moved = network(torch.randn(3, 8), network.numbers(given), given)
    for k, one in enumerate(moved):
        assert all(torch.equal(got, wanted) for got, wanted in zip(one, given.interval(k), strict=True))
    torch.stack([part.sum() for one in moved for part in one]).sum().backward()
    assert network.gate.grad is not None and network.gate.grad[:, 3:].abs().min() > 0
    adam = torch.optim.Adam(network.parameters(), lr=1e-2)
    adam.step()
    assert not network.changes_nothing and network.gate.abs().max() <= 0.011


def test_a_closed_gate_below_0_opens_again() -> None:
    """The gradient goes past the limits, so that a gate that once fell below 0 is not lost."""
    network, given = correction(gate=-0.5), prior()
    assert network.changes_nothing
    moved = network(torch.randn(3, 8), network.numbers(given), given)
    assert torch.equal(moved[0].translation, given.next_from_cur.translation)
    moved[0].translation.sum().backward()
    assert network.gate.grad is not None and network.gate.grad[0, 3:].abs().min() > 0


@pytest.mark.parametrize("said", [-1e4, -0.3, 0.2, 1e4])
@pytest.mark.parametrize("gate", [0.5, 1.0, 7.0])
def test_the_correction_by_hand(said: float, gate: float) -> None:
    """g b tanh(a), with b = 0.25 rad/s dt and 6 m/s^2 dt (k dt): per sample's own time between frames."""
    given = prior()
    for k, got in enumerate(corrected(correction(gate), given, said), start=1):
        share = min(gate, 1.0) * math.tanh(said)
        between = got @ geometry.invert(geometry.compose_rigid(*given.interval(k - 1)))
        for sample, dt in enumerate(SECONDS):
            turn = share * TURN_RATE * dt * math.sqrt(3)
            angle = math.acos(min(1.0, (between[sample, :3, :3].double().trace().item() - 1) / 2))
            assert angle == pytest.approx(abs(turn), abs=2e-3 * abs(turn) + 5e-4)
            shift = between[sample, :3, 3]
            assert shift.tolist() == pytest.approx([share * ACCELERATION * dt * dt * k] * 3, abs=1e-5)


def test_a_static_camera_is_not_corrected() -> None:
    """Below 5 m/s it counts by the speed; at rest not at all."""
    for speed, share in ((0.0, 0.0), (2.5, 0.5), (5.0, 1.0), (20.0, 1.0)):
        given = prior(speed=speed)
        (first, *_) = corrected(correction(), given, 1e4)
        between = first @ geometry.invert(geometry.compose_rigid(*given.next_from_cur))
        wanted = [share * ACCELERATION * dt * dt for dt in SECONDS]
        assert between[:, 0, 3].tolist() == pytest.approx(wanted, abs=1e-5)


def test_samples_of_different_intervals_share_a_batch() -> None:
    """A batch gives what each sample gives separately, and the same rates at another frame rate give another input."""
    network, given = correction(), prior()
    mean = torch.randn(3, 8)
    together = network(mean, network.numbers(given), given)
    for sample, seconds in enumerate(SECONDS):
        single = prior((seconds,))
        moved = network(mean[sample : sample + 1], network.numbers(single), single)
        for one, other in zip(moved, together, strict=True):
            torch.testing.assert_close(one.translation[0], other.translation[sample])
            torch.testing.assert_close(one.quaternion[0], other.quaternion[sample])
    numbers = network.numbers(given)
    torch.testing.assert_close(numbers[0, :-1], numbers[1, :-1], atol=1e-4, rtol=1e-4)  # of one drive, per second
    assert numbers[:, -1].tolist() == pytest.approx([math.log(dt / 0.1) for dt in SECONDS], abs=1e-6)


def test_rates_of_fewer_motions_have_zeros() -> None:
    once = motion((0.0, 0.02, 0.0), (0.0, 0.0, -1.0), 1)
    rates = rates_of([once, once], torch.tensor([[0.1, 0.2]]))
    assert rates.shape == (1, MEASURED, RATES) and not rates[0, :2].any()
    assert rates[0, 2].tolist() == pytest.approx([0, 0.2, 0, 0, 0, -10, 1], abs=1e-4)
    assert rates[0, 3].tolist() == pytest.approx([0, 0.1, 0, 0, 0, -5, 1], abs=1e-4)


def test_two_frames_have_a_prior_too() -> None:
    """Without a path, rates are those of the two motions, and the last motion repeats."""
    full = prior()
    few = CameraPrior(*full[:3])
    assert few.intervals == 1 and few.rates[:, :2].any().item() is False and (few.rates[:, 2:, -1] == 1).all()
    assert torch.equal(few.interval(4).translation, few.next_from_cur.translation)
    moved = correction()(torch.randn(3, 8), correction().numbers(few), few)
    assert len(moved) == PATH


def test_the_last_correction_holds_for_later_intervals() -> None:
    given = prior()
    longer = RigidMotion(*(torch.cat([part, part], dim=1) for part in given.later or ()))
    moved = corrected(correction(), given._replace(later=longer), 1e4)
    assert len(moved) == 1 + longer.translation.shape[1] == 5
    torch.testing.assert_close(moved[3], moved[2])


def test_emf_is_shown_the_interval_and_all_motions() -> None:
    """Every number of the prior reaches the correction, with a gradient."""
    torch.manual_seed(1)
    network = EgoMotion(BOUNDED, 4, "prior").double()
    assert network.bounded is not None and network.swayed is None
    nn.init.ones_(network.bounded.gate)
    given = prior()
    leaves = [given.measured, given.seconds, *given.next_from_cur, *(given.later or ())]
    doubles = [leaf.double().requires_grad_() for leaf in leaves if leaf is not None]
    known = CameraPrior(
        RigidMotion(doubles[2], doubles[3]), *(RigidMotion(*(p.double() for p in one)) for one in given[1:3]),
        RigidMotion(doubles[4], doubles[5]), doubles[0], doubles[1],
    )  # fmt: skip
    planes = [torch.rand(3, c, 16, 24, dtype=torch.float64) + 0.5 for c in (4, 4, 1, 1)]
    masks = [torch.ones(3, 1, 16, 24, dtype=torch.float64)] * 2
    answer = network(*planes, *masks, prior=known)
    torch.stack([p.sum() for one in (answer.next_from_cur, *answer.later) for p in one]).sum().backward()
    assert all(leaf.grad is not None and leaf.grad.abs().max() > 1e-9 for leaf in doubles)


def test_a_model_knows_which_prior_and_emf_it_has() -> None:
    """vest-s, as it is trained now, starts from the forecast motion; from rest nothing changes."""
    config = configuration("vest-s")
    assert config.ego_motion is not None
    assert (config.prior, config.ego_motion.correction) == ("forecast", "bounded")
    assert configuration("vest-paper").ego_motion == EgoMotionConfig()
    with pytest.raises(ValueError, match="`correction` must be"):
        EgoMotionConfig(correction="other")  # type: ignore[arg-type]
    assert config.knows(0.1) and config.knows(0.115) and not config.knows(0.04)


def test_a_whole_network_at_several_frame_rates() -> None:
    """A batch of 30 and 8 Hz through all of the model, recursion included; what it forecasts for both differs."""
    torch.manual_seed(0)
    config = change(start="prior", prior="forecast", ego_motion=BOUNDED)
    model = Forecaster(config).eval()
    assert model.ego_motion is not None and model.ego_motion.bounded is not None
    nn.init.ones_(model.ego_motion.bounded.gate)
    one = frame(1, 16, 24)
    pair = type(one)(*(torch.cat([part, part]) for part in one))
    given = turning(1, 16, 24)
    both = type(given)(
        *(RigidMotion(*(torch.cat([p, p]) for p in rigid)) for rigid in given[:3]),
        *(torch.cat([p, p]) for p in given[3:5]),
        seconds=torch.tensor([1 / 30, 1 / 8]),
    )
    K = torch.tensor([[[30.0, 0, 12], [0, 30, 8], [0, 0, 1]]]).repeat(2, 1, 1)
    with torch.no_grad():
        for mode in ("compose", "feedback"):
            steps = model.forecast(pair, pair, K, 3, mode=mode, prior=both)  # type: ignore[arg-type]
            futures = torch.stack([step.future_from_cur for step in steps])
            assert futures.isfinite().all()
            assert not torch.allclose(futures[:, 0, :3, 3], futures[:, 1, :3, 3])
    same = both._replace(seconds=torch.tensor([0.1, 0.1]))
    (alike,) = model.forecast(pair, pair, K, 1, [], "compose", prior=same)
    torch.testing.assert_close(alike.future_from_cur[0], alike.future_from_cur[1])

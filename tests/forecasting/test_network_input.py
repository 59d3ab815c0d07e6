"""vestcl.forecasting.network.input: two prepared frames as the networks take them."""

import dataclasses

import numpy as np
import pytest
import torch
from forecaster_scenes import change
from geometric_scenes import turned
from numpy.typing import NDArray

from vestcl import geometry
from vestcl.data import Street, street_clip
from vestcl.forecasting.geometric import Perception
from vestcl.forecasting.network.input import as_motion, last_motions, network_input
from vestcl.models.forecaster import Forecaster
from vestcl.models.networks.ego_motion import RigidMotion
from vestcl.scene.layers import Layers
from vestcl.scene.motion.ego_motion import constant_velocity
from vestcl.scene.perceived import PerceivedFrame

HEIGHT, WIDTH = 8, 12

#: cur_from_prev of the last two intervals: a drive forward through a bend, over a bump.
MOTIONS = [turned(0.02, 0.004, -0.003, (0.01, 0.02, -0.9)), turned(0.03, -0.006, 0.002, (0.02, -0.01, -1.1))]


def prepared(seed: int, cur_from_prev: NDArray[np.float64] | None, own: bool = False) -> PerceivedFrame:
    """A random frame; with ``own`` the two lowest rows are the recording car's."""
    rng = np.random.default_rng(seed)
    image, back = rng.random((2, 3, HEIGHT, WIDTH), np.float32)
    depth = rng.uniform(2, 40, (1, HEIGHT, WIDTH)).astype(np.float32)
    mask = rng.random((1, HEIGHT, WIDTH)) < 0.7
    bonnet = np.zeros((1, HEIGHT, WIDTH), bool)
    bonnet[:, -2:] = own
    return PerceivedFrame(
        name=f"{seed:03}",
        K=np.array([[20.0, 0, 6.3], [0, 21, 3.8], [0, 0, 1]]),
        layers=Layers(image, depth, mask, np.where(mask, image, back), np.where(mask, depth, depth + 3)),
        velocity=rng.normal(0, 0.5, (3, HEIGHT, WIDTH)).astype(np.float32),
        own=bonnet,
        prev_from_cur=None if cur_from_prev is None else np.asarray(np.linalg.inv(cur_from_prev), np.float64),
    )


def points(frame: PerceivedFrame) -> torch.Tensor:
    """[H W, 3] m."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.linalg.inv(frame.K) @ np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
    return torch.from_numpy((rays * frame.layers.depth.reshape(1, -1)).T)


def displaced(frame: PerceivedFrame, rigid: RigidMotion, velocity: torch.Tensor, intervals: int) -> torch.Tensor:
    """U = R (x + n v) + t - x [H W, 3] m."""
    start = points(frame)
    moved = start + intervals * velocity[0].flatten(1).mT
    return geometry.transform_points(geometry.compose_rigid(*rigid)[0].double(), moved) - start


def test_layers_and_camera_are_those_of_the_frames() -> None:
    prev, cur = prepared(0, None), prepared(1, MOTIONS[0])
    got = network_input(prev, cur, last_motions(prev, cur))
    for frame, batch in ((prev, got.frame_prev), (cur, got.frame_cur)):
        for name, tensor in batch._asdict().items():
            assert tensor.dtype == torch.float32 and np.array_equal(tensor[0].numpy(), getattr(frame.layers, name))
    torch.testing.assert_close(got.K, torch.from_numpy(cur.K)[None].float(), rtol=0, atol=0)
    assert np.array_equal(got.prior.velocity_prev[0], prev.velocity)
    assert np.array_equal(got.prior.velocity_cur[0], cur.velocity)


def test_the_recording_car_is_where_either_frame_has_it() -> None:
    frames = prepared(0, None, own=True), prepared(1, MOTIONS[0])
    for prev, cur in (frames, frames[::-1]):
        cur = dataclasses.replace(cur, prev_from_cur=np.linalg.inv(MOTIONS[0]))
        own = network_input(prev, cur, last_motions(cur)).own
        assert own is not None and own.dtype == torch.float32 and own.shape == (1, 1, HEIGHT, WIDTH)
        assert own[:, :, -2:].all() and not own[:, :, :-2].any()


def test_input_has_memory_of_its_own() -> None:
    prev, cur = prepared(0, None), prepared(1, MOTIONS[0])
    got, kept = network_input(prev, cur, last_motions(prev, cur)), cur.velocity.copy()
    got.prior.velocity_cur.zero_()
    got.frame_cur.image.zero_()
    assert np.array_equal(cur.velocity, kept) and cur.layers.image.any()


def test_the_last_two_motions_are_given() -> None:
    prev, cur = prepared(0, MOTIONS[0]), prepared(1, MOTIONS[1])
    prior = network_input(prev, cur, last_motions(prev, cur)).prior
    from_cur, last, before = (geometry.compose_rigid(*rigid)[0].double().numpy() for rigid in prior[:3])
    np.testing.assert_allclose(last, MOTIONS[1], rtol=0, atol=1e-6)
    np.testing.assert_allclose(before, MOTIONS[0], rtol=0, atol=1e-6)
    assert from_cur[2, 3] == pytest.approx((MOTIONS[0][2, 3] + MOTIONS[1][2, 3]) / 2)
    prior = network_input(prepared(0, None), cur, MOTIONS[1:]).prior  # of a clip's first two frames
    assert all(torch.equal(one, other) for one, other in zip(prior[1], prior[2], strict=True))


def test_prior_is_the_measured_motion_at_constant_velocity() -> None:
    perception = Perception(street_clip(Street.generate(3), 4, 48, 160, samples=1))
    prev, cur = perception.seen(1), perception.seen(2)
    got = geometry.compose_rigid(*network_input(prev, cur, last_motions(prev, cur)).prior.next_from_cur)[0]
    wanted = constant_velocity([np.linalg.inv(perception.prev_from_cur(index)) for index in (1, 2)])
    np.testing.assert_allclose(got.numpy(), wanted, rtol=0, atol=1e-6)
    assert abs(wanted[2, 3]) > 0.1


def test_recording_car_rides_along_and_nothing_else_does() -> None:
    prev, cur = prepared(0, MOTIONS[0], own=True), prepared(1, MOTIONS[1], own=True)
    prior = network_input(prev, cur, last_motions(prev, cur)).prior
    for frame, rigid, velocity, intervals in (
        (prev, prior.next_from_cur.after(prior.cur_from_prev), prior.velocity_prev, 2),
        (cur, prior.next_from_cur, prior.velocity_cur, 1),
    ):
        own = torch.from_numpy(frame.own.ravel())
        moved = displaced(frame, rigid, velocity, intervals).norm(dim=1)
        assert float(moved[own].max()) < 1e-5 and float(moved[~own].median()) > 0.5
        assert np.array_equal(velocity[0].numpy()[:, ~frame.own[0]], frame.velocity[:, ~frame.own[0]])


def test_networks_that_start_from_the_prior_leave_the_recording_car_where_it_is() -> None:
    prev, cur = prepared(0, MOTIONS[0], own=True), prepared(1, MOTIONS[1], own=True)
    given = network_input(prev, cur, last_motions(prev, cur))
    with torch.no_grad():
        step = Forecaster(change(start="prior")).forecast(*given[:3], prior=given.prior)[0]
    flows = step.motion.objects.flow[0]  # before training nothing is added to where they start
    for frame, flow in ((prev, flows[:3]), (cur, flows[3:])):
        own = torch.from_numpy(frame.own[0])
        assert float(flow[:, own].abs().max()) < 1e-4 and float(flow[:, ~own].norm(dim=0).median()) > 0.5


def test_first_frame_has_no_motion_to_give() -> None:
    first, second, third = prepared(0, None), prepared(1, MOTIONS[0]), prepared(2, MOTIONS[1])
    assert last_motions(first) == []
    np.testing.assert_allclose(last_motions(first, second), MOTIONS[:1], rtol=0, atol=1e-14)
    np.testing.assert_allclose(last_motions(second, third), MOTIONS, rtol=0, atol=1e-14)


def test_motion_as_the_networks_have_it() -> None:
    motion = as_motion(MOTIONS[1])
    assert motion.quaternion.shape == (1, 4) and float(motion.quaternion[0, 0]) > 0
    np.testing.assert_allclose(geometry.compose_rigid(*motion)[0].numpy(), MOTIONS[1], rtol=0, atol=1e-7)


def test_frames_that_do_not_go_together_are_refused() -> None:
    prev, cur = prepared(0, None), prepared(1, MOTIONS[0])
    with pytest.raises(ValueError, match="`prev` and `cur` must have one K"):
        network_input(dataclasses.replace(prev, K=prev.K * [[1.01], [1], [1]]), cur, MOTIONS[:1])
    small = {name: value[:, :4] for name, value in vars(prev.layers).items()}
    with pytest.raises(ValueError, match="`prev` and `cur` must be of one size, got 4x12 and 8x12"):
        network_input(dataclasses.replace(prev, layers=Layers(**small)), cur, MOTIONS[:1])
    with pytest.raises(ValueError, match="`motions` must have at least one"):
        network_input(prev, cur, [])
    with pytest.raises(ValueError, match=r"`motions` must be \[4, 4\], got \[3, 4\]"):
        network_input(prev, cur, [MOTIONS[0][:3]])

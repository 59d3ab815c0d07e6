"""vestcl.ops.displace against the reference implementation and by hand."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from tolerances import assert_close, assert_like_reference
from torch.autograd import gradcheck

from vestcl import geometry, opencl, reference
from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.unproject import unproject


def scene(batch: int, count: int, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    """Points 5 to 60 m ahead, small displacements, and a target camera a step aside."""
    low, size = torch.tensor([-10.0, -2, 5]), torch.tensor([20.0, 4, 55])
    turn = torch.tensor([1.0, 0.01, -0.02, 0.03]).repeat(batch, 1)
    K = torch.tensor([[70.0, 0.5, 50.3], [0, 72, 33.1], [0, 0, 1]]).repeat(batch, 1, 1)
    return {
        "points_xyz": (torch.rand(batch, count, 3, dtype=dtype) * size + low).to(dtype).requires_grad_(),
        "displacement_xyz": (torch.randn(batch, count, 3, dtype=dtype) * 0.5).requires_grad_(),
        "K": geometry.scale_intrinsics(K, 1.5, 0.8).to(dtype),
        "tgt_from_src": geometry.compose_rigid(turn, torch.tensor([-0.5, 0.1, 0.8]).repeat(batch, 1)).to(dtype),
    }


def test_by_hand(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    points_xyz = torch.tensor([[[1.0, 2, 3], [0, 0, 1]]], dtype=dtype)
    displacement_xyz = torch.tensor([[[1.0, -1, 1], [0, 0, 0]]], dtype=dtype)
    K = torch.tensor([[[8.0, 0, 10], [0, 16, 20], [0, 0, 1]]], dtype=dtype)
    points_uv, z = displace(points_xyz, displacement_xyz, K)
    assert points_uv.tolist() == [[[14, 24], [10, 20]]]
    assert z.tolist() == [[4, 1]]
    tgt_from_src = torch.eye(4, dtype=dtype)[None].clone()
    tgt_from_src[0, :3, 3] = torch.tensor([2, 0, 4])
    points_uv, z = displace(points_xyz, displacement_xyz, K, tgt_from_src)
    assert points_uv.tolist() == [[[14, 22], [13.2 if dtype == torch.float64 else pytest.approx(13.2), 20]]]
    assert z.tolist() == [[8, 5]]


@pytest.mark.parametrize("moved_camera", [True, False])
@pytest.mark.parametrize(("batch", "count"), [(1, 1), (3, 100), (2, 5000)])
def test_like_reference(
    mapped_session: opencl.Session, dtype: torch.dtype, batch: int, count: int, moved_camera: bool
) -> None:
    arguments = scene(batch, count, dtype)
    if not moved_camera:
        del arguments["tgt_from_src"]
    assert_like_reference(displace, reference.displace, **arguments)


def test_any_last_row_of_the_intrinsics(session: opencl.Session, dtype: torch.dtype) -> None:
    arguments = scene(2, 100, dtype)
    arguments["K"][:, 2] = torch.tensor([0.01, -0.02, 1.5], dtype=dtype)
    assert_like_reference(displace, reference.displace, **arguments)


def test_gradcheck(mapped_session: opencl.Session, float64: torch.dtype) -> None:
    arguments = scene(2, 5, float64)
    assert gradcheck(displace, tuple(arguments.values()))
    assert gradcheck(displace, tuple(arguments.values())[:3])


@pytest.mark.parametrize("asked", ["points_xyz", "displacement_xyz"])
def test_only_the_gradient_asked_for(session: opencl.Session, asked: str) -> None:
    arguments = {name: value.detach() for name, value in scene(2, 50, torch.float32).items()}
    arguments[asked].requires_grad_()
    assert_like_reference(displace, reference.displace, **arguments)


def test_the_two_gradients_are_equal_and_not_the_same_memory(session: opencl.Session) -> None:
    arguments = scene(2, 50, torch.float32)
    points_uv, z = displace(**arguments)
    (points_uv.sum() + z.sum()).backward()
    first, second = arguments["points_xyz"].grad, arguments["displacement_xyz"].grad
    assert first is not None and second is not None
    assert torch.equal(first, second) and first.data_ptr() != second.data_ptr()


@pytest.mark.parametrize("output", [0, 1])
def test_gradient_of_one_output_only(session: opencl.Session, output: int) -> None:
    arguments = scene(2, 50, torch.float32)
    assert_like_reference(lambda **a: displace(**a)[output], lambda **a: reference.displace(**a)[output], **arguments)


def test_unprojected_pixels_come_back_to_their_centres(session: opencl.Session, dtype: torch.dtype) -> None:
    K = scene(2, 0, dtype)["K"]
    depth = torch.rand(2, 1, 5, 7, dtype=dtype) * 50 + 1
    points_xyz = unproject(depth, K)
    points_uv, z = displace(points_xyz, torch.zeros_like(points_xyz), K)
    v, u = torch.meshgrid(torch.arange(5.0) + 0.5, torch.arange(7.0) + 0.5, indexing="ij")
    assert_close(points_uv, torch.stack([u, v], dim=-1).reshape(1, 35, 2).expand(2, 35, 2))
    assert_close(z, depth.reshape(2, 35))


def test_moving_the_camera_is_moving_the_points(session: opencl.Session, float64: torch.dtype) -> None:
    arguments = scene(2, 50, float64)
    quaternion = torch.tensor([[1.0, 0.01, -0.02, 0.03]], dtype=float64).repeat(2, 1)
    translation = torch.tensor([[-0.5, 0.1, 0.8]], dtype=float64).repeat(2, 1)
    arguments["tgt_from_src"] = geometry.compose_rigid(quaternion, translation)
    arguments["displacement_xyz"] = torch.zeros(2, 50, 3, dtype=float64)
    flow = rigid_flow(arguments["points_xyz"], quaternion, translation)
    for moved_camera, moved_points in zip(
        displace(**arguments), displace(arguments["points_xyz"], flow, arguments["K"]), strict=True
    ):
        assert_close(moved_camera, moved_points)


@pytest.mark.parametrize("kilometres", [0.0, 1, 10])
def test_far_from_the_origin_it_is_as_exact(mapped_session: opencl.Session, kilometres: float) -> None:
    """A camera and its points, both that far away: float32 is off by the rounding of uv only, not by 0.1 px."""
    given = {name: value.detach() for name, value in scene(2, 500, torch.float32).items()}
    away = torch.tensor([700.0, 40, -710]) * kilometres
    given["points_xyz"] = given["points_xyz"] + away
    given["tgt_from_src"][:, :3, 3] -= given["tgt_from_src"][:, :3, :3] @ away
    points_uv, z = displace(**given)
    wanted_uv, wanted_z = reference.displace(**{name: value.double() for name, value in given.items()})
    torch.testing.assert_close(points_uv.double(), wanted_uv, rtol=2e-6, atol=1e-4)
    torch.testing.assert_close(z.double(), wanted_z, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "rows", [torch.zeros(3, 4), torch.cat([1e-30 * torch.eye(3), torch.full((3, 1), 1e15)], dim=1)]
)
def test_a_motion_that_can_not_be_undone(session: opencl.Session, rows: torch.Tensor) -> None:
    given = {name: value.detach() for name, value in scene(1, 4, torch.float32).items()}
    given["tgt_from_src"][0, :3] = rows
    wanted_uv, wanted_z = reference.displace(**given)
    points_uv, z = displace(**given)
    assert torch.equal(points_uv.isfinite(), wanted_uv.isfinite()) and torch.equal(z.isfinite(), wanted_z.isfinite())


def test_behind_the_camera_is_projected_through_it(session: opencl.Session, dtype: torch.dtype) -> None:
    arguments = scene(1, 50, dtype)
    with torch.no_grad():
        arguments["points_xyz"] *= -1
    assert (displace(**arguments)[1] < 0).all()
    assert_like_reference(displace, reference.displace, **arguments)


def test_points_that_have_no_image_touch_nothing_else(mapped_session: opencl.Session) -> None:
    """z = 0 on the axis (0 / 0) and off it (x / 0), and NaN: no gradient through uv, an exact one through z."""
    arguments = scene(1, 50, torch.float32)
    del arguments["tgt_from_src"]
    with torch.no_grad():
        arguments["displacement_xyz"][0, :4] = 0
        arguments["points_xyz"][0, :4] = torch.tensor([[0.0, 0, 0], [1, 2, 0], [math.nan] * 3, [1, 2, math.nan]])
    points_uv, z = displace(**arguments)
    expected_uv, expected_z = reference.displace(**arguments)
    assert not points_uv[0, :4].isfinite().any() and points_uv[0, 4:].isfinite().all()
    assert z[0, :2].tolist() == [0, 0] and z[0, 2:4].isnan().all() and z[0, 4:].isfinite().all()
    torch.testing.assert_close((points_uv, z), (expected_uv, expected_z), equal_nan=True)
    loss, expected_loss = 2 * points_uv.sum() + 3 * z.sum(), 2 * expected_uv.sum() + 3 * expected_z.sum()
    (grad,) = torch.autograd.grad(loss, arguments["points_xyz"])
    (truth,) = torch.autograd.grad(expected_loss, arguments["points_xyz"])
    torch.testing.assert_close(grad, truth)
    assert grad[0, :4].tolist() == [[0, 0, 3]] * 4


def test_numpy_in_numpy_out(session: opencl.Session, dtype: torch.dtype) -> None:
    arguments = {name: value.detach() for name, value in scene(2, 50, dtype).items()}
    outputs = displace(**{name: value.numpy() for name, value in arguments.items()})
    for array, tensor in zip(outputs, displace(**arguments), strict=True):
        assert isinstance(array, np.ndarray) and np.array_equal(array, tensor.numpy())


def test_one_array_as_both_arguments(session: opencl.Session) -> None:
    arguments = scene(1, 50, torch.float32)
    arguments["displacement_xyz"] = arguments["points_xyz"]
    twice = arguments | {"displacement_xyz": arguments["points_xyz"].detach().clone()}
    assert torch.equal(displace(**arguments)[0], displace(**twice)[0])


@pytest.mark.parametrize(("batch", "count"), [(0, 5), (2, 0)])
def test_nothing_to_do(session: opencl.Session, batch: int, count: int) -> None:
    arguments = scene(batch, count, torch.float32)
    points_uv, z = displace(**arguments)
    assert points_uv.shape == (batch, count, 2) and z.shape == (batch, count)
    (points_uv.sum() + z.sum()).backward()
    assert arguments["points_xyz"].grad is not None and arguments["points_xyz"].grad.shape == (batch, count, 3)


def test_same_bits_twice(mapped_session: opencl.Session) -> None:
    arguments = scene(2, 3000, torch.float32)
    (first_uv, first_z), (second_uv, second_z) = displace(**arguments), displace(**arguments)
    assert torch.equal(first_uv, second_uv) and torch.equal(first_z, second_z)
    weight = torch.randn_like(first_uv)
    grads = [torch.autograd.grad(uv, arguments["points_xyz"], weight)[0] for uv in (first_uv, second_uv)]
    assert torch.equal(*grads)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": torch.eye(3)}, r"`K` must be \[B, 3, 3\], got \[3, 3\]"),
        (
            {"displacement_xyz": torch.ones(2, 4, 3)},
            r"`displacement_xyz` must be \[B, N, 3\] with N = 3 as in `points_xyz`, got \[2, 4, 3\]",
        ),
        ({"tgt_from_src": torch.ones(2, 3, 4)}, r"`tgt_from_src` must be \[B, 4, 4\], got \[2, 3, 4\]"),
        ({"tgt_from_src": np.ones((2, 4, 4), np.float32)}, "`tgt_from_src` must be a torch tensor as `points_xyz` is"),
        ({"points_xyz": None}, "`points_xyz` must be a torch tensor or a NumPy array, got NoneType"),
        ({"K": torch.ones(2, 3, 3, requires_grad=True)}, "`K` must not require grad"),
        ({"tgt_from_src": torch.ones(2, 4, 4, requires_grad=True)}, "`tgt_from_src` must not require grad"),
    ],
)
def test_refuses(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        displace(**(scene(2, 3, torch.float32) | change))


def test_a_camera_that_requires_grad_is_welcome_where_none_is_recorded(session: opencl.Session) -> None:
    arguments = scene(2, 3, torch.float32)
    with torch.no_grad():
        assert displace(**(arguments | {"K": arguments["K"].requires_grad_()}))[0].isfinite().all()

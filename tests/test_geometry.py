"""vestcl.geometry: rigid motion and intrinsics."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck

from vestcl import geometry

quaternions = st.lists(st.floats(-3, 3), min_size=4, max_size=4).map(
    lambda numbers: torch.tensor(numbers, dtype=torch.float64)
).filter(lambda q: float(q.norm()) > 1e-3)  # fmt: skip
vectors = st.lists(st.floats(-50, 50), min_size=3, max_size=3).map(
    lambda numbers: torch.tensor(numbers, dtype=torch.float64)
)


def test_quarter_turn_about_z_by_hand() -> None:
    half = math.sqrt(0.5)
    rotation = geometry.quaternion_to_matrix(torch.tensor([half, 0, 0, half], dtype=torch.float64))
    wanted = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(rotation, wanted, rtol=0, atol=1e-15)


@given(quaternions, st.floats(0.01, 100))
@settings(max_examples=50, deadline=None)
def test_rotation_is_orthonormal_and_ignores_the_quaternions_length(q: torch.Tensor, scale: float) -> None:
    rotation = geometry.quaternion_to_matrix(q)
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(rotation)) == pytest.approx(1)
    torch.testing.assert_close(geometry.quaternion_to_matrix(scale * q), rotation)
    torch.testing.assert_close(geometry.quaternion_to_matrix(-q), rotation)


def test_zero_quaternion_is_the_identity_with_finite_gradient() -> None:
    q = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    rotation = geometry.quaternion_to_matrix(q)
    assert torch.equal(rotation, torch.eye(3, dtype=torch.float64))
    rotation.sum().backward()
    assert q.grad is not None and q.grad.isfinite().all()


@given(quaternions, quaternions)
@settings(max_examples=50, deadline=None)
def test_product_of_quaternions_is_the_product_of_rotations(first: torch.Tensor, second: torch.Tensor) -> None:
    product = geometry.quaternion_to_matrix(geometry.quaternion_multiply(first, second))
    wanted = geometry.quaternion_to_matrix(first) @ geometry.quaternion_to_matrix(second)
    torch.testing.assert_close(product, wanted, rtol=0, atol=1e-9)


@given(quaternions)
@settings(max_examples=100, deadline=None)
def test_a_rotation_gives_its_quaternion_back(q: torch.Tensor) -> None:
    unit = q / q.norm()
    got = geometry.matrix_to_quaternion(geometry.quaternion_to_matrix(q))
    assert float(got[0]) >= 0 and float(got.norm()) == pytest.approx(1, abs=1e-15)
    assert min(float((got - unit).norm()), float((got + unit).norm())) < 1e-14


@pytest.mark.parametrize("short_of_half_a_turn", [0.0, 1e-3, 1e-6, 1e-9, 1e-12])
def test_quaternions_near_half_a_turn_keep_the_axis_and_the_angle(short_of_half_a_turn: float) -> None:
    axes = torch.nn.functional.normalize(torch.randn(64, 3, dtype=torch.float64), dim=-1)
    axes[:3] = torch.eye(3, dtype=torch.float64)
    half = torch.tensor((math.pi - short_of_half_a_turn) / 2, dtype=torch.float64)
    q = torch.cat([half.cos().expand(64, 1), half.sin() * axes], dim=-1)
    got = geometry.matrix_to_quaternion(geometry.quaternion_to_matrix(q))
    assert float(torch.minimum((got - q).norm(dim=-1), (got + q).norm(dim=-1)).max()) < 1e-14
    assert got.shape == (64, 4) and (got[:, 0] >= 0).all()


def test_quaternion_of_rest_and_of_a_quarter_turn_by_hand() -> None:
    assert geometry.matrix_to_quaternion(torch.eye(3)).tolist() == [1, 0, 0, 0]
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)  # about z
    half = math.sqrt(0.5)
    torch.testing.assert_close(geometry.matrix_to_quaternion(quarter), torch.tensor([half, 0, 0, half]).double())


@given(quaternions, vectors, vectors)
@settings(max_examples=50, deadline=None)
def test_inverse_brings_points_back(q: torch.Tensor, t: torch.Tensor, point: torch.Tensor) -> None:
    dst_from_src = geometry.compose_rigid(q, t)
    back = geometry.transform_points(
        geometry.invert(dst_from_src), geometry.transform_points(dst_from_src, point[None])
    )
    torch.testing.assert_close(back, point[None], rtol=0, atol=1e-10)
    torch.testing.assert_close(geometry.invert(dst_from_src), torch.linalg.inv(dst_from_src), rtol=0, atol=1e-10)


def test_transforms_compose_and_batch() -> None:
    q, t = torch.randn(2, 5, 4, dtype=torch.float64), torch.randn(2, 5, 3, dtype=torch.float64)
    second_from_first, third_from_second = geometry.compose_rigid(q, t)
    points_xyz = torch.randn(5, 7, 3, dtype=torch.float64)
    one_by_one = geometry.transform_points(third_from_second, geometry.transform_points(second_from_first, points_xyz))
    at_once = geometry.transform_points(third_from_second @ second_from_first, points_xyz)
    torch.testing.assert_close(at_once, one_by_one)
    assert second_from_first.shape == (5, 4, 4)


def test_translation_by_hand() -> None:
    dst_from_src = geometry.compose_rigid(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, -3]))
    assert geometry.transform_points(dst_from_src, torch.tensor([[10.0, 20, 30]])).tolist() == [[11, 22, 27]]


def test_resize_and_crop_move_the_projection_as_they_move_the_pixels() -> None:
    K = torch.tensor([[700.0, 0, 600], [0, 710, 180], [0, 0, 1]], dtype=torch.float64)
    point = torch.tensor([1.0, -2, 10], dtype=torch.float64)
    u, v, _ = K @ point / 10
    resized = geometry.scale_intrinsics(K, 0.5, 0.25) @ point / 10
    cropped = geometry.crop_intrinsics(K, 40, -8) @ point / 10
    assert resized.tolist() == pytest.approx([float(u) * 0.5, float(v) * 0.25, 1])
    assert cropped.tolist() == pytest.approx([float(u) - 40, float(v) + 8, 1])
    assert geometry.crop_intrinsics(K.expand(3, 3, 3), 1, 2).shape == (3, 3, 3)
    assert geometry.scale_intrinsics(K.expand(3, 3, 3), 1, 2).shape == (3, 3, 3)


def test_gradients() -> None:
    q, t = torch.randn(2, 4, dtype=torch.float64), torch.randn(2, 3, dtype=torch.float64)
    points_xyz, K = torch.randn(2, 3, 3, dtype=torch.float64), torch.randn(2, 3, 3, dtype=torch.float64)
    for tensor in (q, t, points_xyz, K):
        tensor.requires_grad_()
    assert gradcheck(lambda q, t, p: geometry.transform_points(geometry.compose_rigid(q, t), p), (q, t, points_xyz))
    assert gradcheck(lambda q, t: geometry.invert(geometry.compose_rigid(q, t)), (q, t))
    rotations = geometry.quaternion_to_matrix(q.detach()).requires_grad_()
    assert gradcheck(geometry.matrix_to_quaternion, (rotations,))
    assert gradcheck(geometry.quaternion_multiply, (q, q.detach().flip(0).requires_grad_()))
    assert gradcheck(lambda K: geometry.crop_intrinsics(geometry.scale_intrinsics(K, 0.5, 2), 3, 4), (K,))

"""vestcl.ops.rigid_flow against the reference implementation and by hand."""

import hashlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from processes import Process
from tolerances import assert_close, assert_like_reference
from torch.autograd import gradcheck

from vestcl import geometry, opencl, reference
from vestcl.ops.rigid_flow import rigid_flow


def scene(batch: int, count: int, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    """A street's worth of points, and motions as a car's: a short way, a small turn, quaternions of any length."""
    generator = torch.Generator().manual_seed(1)
    normal = torch.randn(batch, count, 3, generator=generator, dtype=torch.float64)
    points_xyz = normal * torch.tensor([10.0, 2, 15]) + torch.tensor([0.0, 1, 30])
    turn = torch.randn(batch, 4, generator=generator, dtype=torch.float64) * 0.05
    turn[:, 0] += 1 + torch.arange(batch)
    translation = torch.randn(batch, 3, generator=generator, dtype=torch.float64)
    values = {"points_xyz": points_xyz, "quaternion": turn, "translation": translation}
    return {name: value.to(dtype).requires_grad_() for name, value in values.items()}


def test_by_hand(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    points_xyz = torch.tensor([[[1.0, 2, 3], [0, 0, 0]]], dtype=dtype)
    half_turn_about_y = torch.tensor([[0.0, 0, 2, 0]], dtype=dtype)
    translation = torch.tensor([[10.0, 20, 30]], dtype=dtype)
    assert rigid_flow(points_xyz, half_turn_about_y, translation).tolist() == [[[8, 20, 24], [10, 20, 30]]]


@pytest.mark.parametrize(("batch", "count"), [(1, 1), (3, 100), (2, 5000)])
def test_like_reference(mapped_session: opencl.Session, dtype: torch.dtype, batch: int, count: int) -> None:
    assert_like_reference(rigid_flow, reference.rigid_flow, **scene(batch, count, dtype))


def test_sums_keep_float32_over_many_points(mapped_session: opencl.Session) -> None:
    """Equal terms are the worst case of a plain float32 sum: it is off by 1e-3 here."""
    arguments = scene(1, 1, torch.float32)
    arguments["points_xyz"] = torch.full((1, 1_000_001, 3), 1 / 3, requires_grad=True)
    exact = {name: value.detach().double().requires_grad_() for name, value in arguments.items()}
    rigid_flow(**arguments).sum().backward()
    reference.rigid_flow(**exact).sum().backward()
    for name in ("quaternion", "translation"):
        got, wanted = arguments[name].grad, exact[name].grad
        assert got is not None and wanted is not None
        assert_close(got, wanted, name)


def test_gradcheck(mapped_session: opencl.Session, float64: torch.dtype) -> None:
    assert gradcheck(rigid_flow, tuple(scene(2, 5, float64).values()))


@pytest.mark.parametrize("length", [1e-5, 1e-7, 1e-9, 1e-20])
def test_gradcheck_of_short_quaternions(session: opencl.Session, float64: torch.dtype, length: float) -> None:
    """Above the floor of 1e-8 only the direction counts, below it q is divided by the floor only."""
    arguments = scene(2, 5, float64)
    shape = torch.nn.functional.normalize(arguments["quaternion"].detach()).requires_grad_()
    points_xyz, translation = arguments["points_xyz"], arguments["translation"]
    assert gradcheck(lambda shape: rigid_flow(points_xyz, length * shape, translation), (shape,))


def test_zero_quaternion(session: opencl.Session, dtype: torch.dtype) -> None:
    arguments = scene(2, 5, dtype)
    arguments["quaternion"] = torch.zeros(2, 4, dtype=dtype, requires_grad=True)
    displacement_xyz = rigid_flow(**arguments)
    assert torch.equal(displacement_xyz, arguments["translation"][:, None].expand(2, 5, 3))
    displacement_xyz.square().sum().backward()
    assert arguments["quaternion"].grad is not None and not arguments["quaternion"].grad.any()


@pytest.mark.parametrize("asked", ["points_xyz", "quaternion", "translation"])
def test_only_the_gradients_asked_for(session: opencl.Session, asked: str) -> None:
    arguments = {name: value.detach() for name, value in scene(2, 50, torch.float32).items()}
    arguments[asked].requires_grad_()
    assert_like_reference(rigid_flow, reference.rigid_flow, **arguments)
    displacement_xyz = rigid_flow(**arguments)
    with session.profile() as times:
        displacement_xyz.sum().backward()
    assert ("rigid_flow_backward_points" in [time.name for time in times]) == (asked == "points_xyz")


def test_identity_moves_nothing(session: opencl.Session, dtype: torch.dtype) -> None:
    points_xyz = scene(2, 50, dtype)["points_xyz"]
    identity = torch.tensor([[3.0, 0, 0, 0]], dtype=dtype).repeat(2, 1)
    assert not rigid_flow(points_xyz, identity, torch.zeros(2, 3, dtype=dtype)).any()


def test_there_and_back(session: opencl.Session, float64: torch.dtype) -> None:
    points_xyz, quaternion, translation = scene(2, 50, float64).values()
    moved_xyz = points_xyz + rigid_flow(points_xyz, quaternion, translation)
    conjugate = quaternion * torch.tensor([1.0, -1, -1, -1])
    src_from_dst = geometry.invert(geometry.compose_rigid(quaternion, translation))
    assert_close(moved_xyz + rigid_flow(moved_xyz, conjugate, src_from_dst[:, :3, 3]), points_xyz)


def test_two_motions_are_one(session: opencl.Session, float64: torch.dtype) -> None:
    points_xyz, first, translation = scene(2, 50, float64).values()
    half = torch.tensor([[math.sqrt(0.5), 0, math.sqrt(0.5), 0]], dtype=float64).repeat(2, 1)
    zero = torch.zeros_like(translation)
    moved_xyz = points_xyz + rigid_flow(points_xyz, first, zero)
    one_by_one = moved_xyz + rigid_flow(moved_xyz, half, translation)
    at_once = points_xyz + rigid_flow(points_xyz, geometry.quaternion_multiply(half, first), translation)
    assert_close(one_by_one, at_once)


def test_numpy_in_numpy_out(session: opencl.Session, dtype: torch.dtype) -> None:
    arguments = {name: value.detach() for name, value in scene(2, 50, dtype).items()}
    displacement_xyz = rigid_flow(**{name: value.numpy() for name, value in arguments.items()})
    assert isinstance(displacement_xyz, np.ndarray)
    assert np.array_equal(displacement_xyz, rigid_flow(**arguments).numpy())


@pytest.mark.parametrize(("batch", "count"), [(0, 5), (2, 0)])
def test_nothing_to_do(session: opencl.Session, batch: int, count: int) -> None:
    arguments = scene(batch, count, torch.float32)
    displacement_xyz = rigid_flow(**arguments)
    assert displacement_xyz.shape == (batch, count, 3)
    displacement_xyz.sum().backward()
    for value in arguments.values():
        assert value.grad is not None and value.grad.shape == value.shape and not value.grad.any()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_points_that_are_not_finite_touch_nothing_else(mapped_session: opencl.Session, bad: float) -> None:
    arguments = scene(2, 50, torch.float32)
    with torch.no_grad():
        arguments["points_xyz"][1, 7, 2] = bad
    displacement_xyz = rigid_flow(**arguments)
    expected = reference.rigid_flow(**arguments)
    assert displacement_xyz.isnan().nonzero().tolist() == [[1, 7, 0], [1, 7, 1], [1, 7, 2]]
    assert torch.equal(displacement_xyz.isnan(), expected.isnan())
    grads = torch.autograd.grad(displacement_xyz.sum(), list(arguments.values()))
    truths = torch.autograd.grad(expected.sum(), list(arguments.values()))
    for grad, truth in zip(grads, truths, strict=True):
        assert grad.isfinite().all()
        torch.testing.assert_close(grad, truth, rtol=1e-5, atol=1e-4)
    assert not grads[0][1, 7].any()


def bits() -> str:
    """Digest of output and gradients on the default device."""
    arguments = scene(2, 20_000, torch.float32)
    displacement_xyz = rigid_flow(**arguments)
    weight = torch.randn(displacement_xyz.shape, generator=torch.Generator().manual_seed(2))
    grads = torch.autograd.grad(displacement_xyz, list(arguments.values()), weight)
    return hashlib.sha256(b"".join(t.detach().numpy().tobytes() for t in (displacement_xyz, *grads))).hexdigest()


def test_same_bits_twice(mapped_session: opencl.Session) -> None:
    assert bits() == bits()


def print_bits() -> None:
    print(bits())


def test_same_bits_on_one_compute_unit(tmp_path: Path) -> None:
    one_unit = {"POCL_MAX_PTHREAD_COUNT": "1", "POCL_CPU_MAX_CU_COUNT": "1"}
    process = Process(tmp_path / "log", print_bits, environment=one_unit)
    assert process.wait() == 0 and process.output.strip() == bits()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quaternion": torch.ones(2, 3)}, r"`quaternion` must be \[B, 4\], got \[2, 3\]"),
        (
            {"quaternion": torch.ones(1, 4)},
            r"`quaternion` must be \[B, 4\] with B = 2 as in `points_xyz`, got \[1, 4\]",
        ),
        ({"translation": torch.ones(2, 3, 1)}, r"`translation` must be \[B, 3\], got \[2, 3, 1\]"),
        ({"points_xyz": torch.ones(6, 3)}, r"`points_xyz` must be \[B, N, 3\], got \[6, 3\]"),
        ({"translation": torch.ones(2, 3).half()}, "`translation` must be float32 or float64, got float16"),
        ({"translation": None}, "`translation` must be a torch tensor or a NumPy array, got NoneType"),
    ],
)
def test_refuses(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rigid_flow(**(scene(2, 3, torch.float32) | change))

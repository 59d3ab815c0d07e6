"""vestcl.ops.unproject against the reference implementation and by hand."""

from typing import Any

import numpy as np
import pytest
import torch
from tolerances import assert_close, assert_like_reference
from torch.autograd import gradcheck

from vestcl import opencl, reference
from vestcl.ops.unproject import unproject


def camera(batch: int, dtype: torch.dtype) -> torch.Tensor:
    K = torch.tensor([[70.0, 0, 50.3], [0, 72, 33.1], [0, 0, 1]], dtype=dtype).repeat(batch, 1, 1)
    return K + torch.arange(batch, dtype=dtype)[:, None, None] * torch.tensor([[2.0, 0.5, 1], [0, 3, 1], [0, 0, 0]])


def depth_map(batch: int, height: int, width: int, dtype: torch.dtype) -> torch.Tensor:
    return (torch.rand(batch, 1, height, width, dtype=dtype) * 60 + 2).requires_grad_()


def test_by_hand(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    K = torch.tensor([[[2.0, 0, 1], [0, 4, 1], [0, 0, 1]]], dtype=dtype)
    depth = torch.tensor([[[[2.0, 4], [8, 0]]]], dtype=dtype)
    wanted = [[-0.5, -0.25, 2], [1, -0.5, 4], [-2, 1, 8], [0, 0, 0]]
    assert unproject(depth, K).tolist() == [wanted]


@pytest.mark.parametrize(("batch", "height", "width"), [(1, 1, 1), (3, 11, 17), (2, 2, 5000)])
def test_like_reference(
    mapped_session: opencl.Session, dtype: torch.dtype, batch: int, height: int, width: int
) -> None:
    depth, K = depth_map(batch, height, width, dtype), camera(batch, dtype)
    assert_like_reference(unproject, reference.unproject, depth=depth, K=K)


def test_gradcheck(mapped_session: opencl.Session, float64: torch.dtype) -> None:
    assert gradcheck(unproject, (depth_map(2, 3, 4, float64), camera(2, float64)))


def test_numpy_in_numpy_out(session: opencl.Session, dtype: torch.dtype) -> None:
    depth, K = depth_map(2, 3, 4, dtype).detach(), camera(2, dtype)
    points_xyz = unproject(depth.numpy(), K.numpy())
    assert isinstance(points_xyz, np.ndarray) and points_xyz.shape == (2, 12, 3)
    assert np.array_equal(points_xyz, unproject(depth, K).numpy())


def test_any_strides(session: opencl.Session) -> None:
    depth, K = depth_map(2, 6, 8, torch.float32).detach(), camera(2, torch.float32)
    wanted = unproject(depth, K)
    slanted = depth.transpose(2, 3).contiguous().transpose(2, 3)
    padded = torch.zeros(2, 1, 6, 9)
    padded[..., 1:] = depth
    assert torch.equal(unproject(slanted, K.mT.contiguous().mT), wanted)
    assert torch.equal(unproject(padded[..., 1:], K), wanted)
    assert np.array_equal(unproject(slanted.numpy(), K.numpy()), wanted.numpy())
    frozen = depth.numpy().copy()
    frozen.setflags(write=False)
    assert np.array_equal(unproject(frozen, K.numpy()), wanted.numpy())


def test_gradient_of_an_expanded_loss(session: opencl.Session) -> None:
    depth, K = depth_map(1, 2, 3, torch.float32), camera(1, torch.float32)
    unproject(depth, K).sum().backward()
    assert depth.grad is not None
    assert_close(depth.grad, reference.unproject(torch.ones(1, 1, 2, 3), K).sum(-1).reshape(1, 1, 2, 3))


@pytest.mark.parametrize("shape", [(0, 1, 2, 3), (2, 1, 0, 3), (2, 1, 2, 0)])
def test_nothing_to_do(session: opencl.Session, shape: tuple[int, ...]) -> None:
    depth = torch.zeros(shape, requires_grad=True)
    points_xyz = unproject(depth, camera(shape[0], torch.float32))
    assert points_xyz.shape == (shape[0], shape[2] * shape[3], 3)
    points_xyz.sum().backward()
    assert depth.grad is not None and depth.grad.shape == shape


def test_nan_stays_in_its_point(session: opencl.Session) -> None:
    depth, K = depth_map(1, 3, 4, torch.float32), camera(1, torch.float32)
    with torch.no_grad():
        depth[0, 0, 1, 2] = torch.nan
    points_xyz = unproject(depth, K)
    assert points_xyz.isnan().any(-1).nonzero().tolist() == [[0, 6]]
    points_xyz.nansum().backward()
    assert depth.grad is not None and depth.grad.isfinite().all()


def test_same_bits_twice(mapped_session: opencl.Session) -> None:
    depth, K = depth_map(2, 40, 70, torch.float32), camera(2, torch.float32)
    first, second = unproject(depth, K), unproject(depth, K)
    assert torch.equal(first, second)
    weight = torch.randn_like(first)
    assert torch.equal(*(torch.autograd.grad(points, depth, weight)[0] for points in (first, second)))


def test_backward_runs_where_forward_ran() -> None:
    depth = depth_map(1, 2, 3, torch.float32)
    with opencl.use(mapping="pixel") as session:
        points_xyz = unproject(depth, camera(1, torch.float32))
    assert opencl.current() is not session
    with session.profile() as times:
        points_xyz.sum().backward()
    assert [time.name for time in times] == ["unproject_backward"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": torch.eye(3)}, r"`K` must be \[B, 3, 3\], got \[3, 3\]"),
        ({"K": torch.eye(4)[None].repeat(2, 1, 1)}, r"`K` must be \[B, 3, 3\], got \[2, 4, 4\]"),
        ({"K": torch.eye(3)[None]}, r"`K` must be \[B, 3, 3\] with B = 2 as in `depth`, got \[1, 3, 3\]"),
        ({"depth": torch.ones(2, 4, 5)}, r"`depth` must be \[B, 1, H, W\], got \[2, 4, 5\]"),
        ({"depth": torch.ones(2, 3, 4, 5)}, r"`depth` must be \[B, 1, H, W\], got \[2, 3, 4, 5\]"),
        ({"depth": [[1.0]]}, "`depth` must be a torch tensor or a NumPy array, got list"),
        ({"depth": torch.ones(2, 1, 4, 5, dtype=torch.int32)}, "`depth` must be float32 or float64, got int32"),
        ({"depth": torch.ones(2, 1, 4, 5, device="meta")}, "`depth` must be on the CPU .*, got device meta"),
        ({"depth": torch.ones(2, 1, 4, 5).to_sparse()}, "`depth` must be a dense tensor, got layout torch.sparse_coo"),
        ({"K": torch.eye(3).repeat(2, 1, 1).double()}, "`K` must be float32 as `depth` is, got float64"),
        ({"K": np.ones((2, 3, 3), np.float32)}, "`K` must be a torch tensor as `depth` is, got a NumPy array"),
        ({"K": torch.zeros(2, 3, 3)}, "`K` must be invertible, got a singular matrix"),
        ({"K": torch.eye(3).repeat(2, 1, 1).requires_grad_()}, r"`K` must not require grad .* pass K.detach\(\)"),
    ],
)
def test_refuses(change: dict[str, Any], message: str) -> None:
    arguments = {"depth": torch.ones(2, 1, 4, 5), "K": camera(2, torch.float32)} | change
    with pytest.raises(ValueError, match=message):
        unproject(**arguments)


def test_refuses_a_foreign_byte_order() -> None:
    with pytest.raises(ValueError, match=r"`depth` must be float32 or float64, got [<>]f4"):
        unproject(np.ones((1, 1, 2, 2), np.dtype(np.float32).newbyteorder()), np.eye(3, dtype=np.float32)[None])

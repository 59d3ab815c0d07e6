"""vestcl.ops.stretch against the reference implementation and by hand."""

import numpy as np
import pytest
import torch
from tolerances import assert_like_reference

from vestcl import constants, opencl, reference
from vestcl.ops.stretch import stretch


def warped(batch: int, height: int, width: int, dtype: torch.dtype) -> torch.Tensor:
    """[B, H, W, 2] px: an image whose right half moved away, below it a row that left, and steps of 1 to 2 px."""
    steps = 1 + torch.rand(2, batch, height, width, dtype=dtype)
    points_uv = torch.stack([steps[0].cumsum(2), steps[1].cumsum(1)], dim=3)
    points_uv[:, :, width // 2 :, 0] += 30
    points_uv[:, height // 2 :, :, 1] += 70
    return points_uv


@pytest.mark.parametrize("size", [(1, 1, 1), (2, 1, 9), (2, 9, 1), (3, 11, 17), (1, 3, 5000)])
def test_like_reference(mapped_session: opencl.Session, dtype: torch.dtype, size: tuple[int, int, int]) -> None:
    magnified = 0.4 + 1.2 * torch.rand(size, dtype=dtype)
    assert_like_reference(stretch, reference.stretch, points_uv=warped(*size, dtype), magnified=magnified)


def test_by_hand(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    columns = torch.tensor([0.0, 2, 3, 13], dtype=dtype)  # the last one is isolated
    points_uv = torch.stack([columns, torch.zeros(4, dtype=dtype)], dim=1)[None, None]
    factor, opacity = stretch(points_uv, torch.full((1, 1, 4), 0.5, dtype=dtype))
    assert factor.tolist() == [[[4.0, 2.0, 2.0, 1.0]]]
    assert opacity.tolist() == [[[1.0, 1.0, 1.0, 0.0]]]


def test_the_limit_grows_with_the_magnification(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    gap = constants.TORN * 3
    points_uv = torch.tensor([[[[0.0, 0], [gap, 0]]]], dtype=dtype)
    for magnified, together in ((2.9, 0.0), (3.1, 1.0)):
        _, opacity = stretch(points_uv, torch.full((1, 1, 2), magnified, dtype=dtype))
        assert opacity.tolist() == [[[together, together]]]


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_what_is_not_finite_is_nobodys_neighbour(
    mapped_session: opencl.Session, dtype: torch.dtype, bad: float
) -> None:
    points_uv = warped(1, 4, 4, dtype)
    points_uv[0, 1, 1, 0] = bad
    magnified = torch.ones(1, 4, 4, dtype=dtype)
    assert_like_reference(stretch, reference.stretch, points_uv=points_uv, magnified=magnified)
    assert stretch(points_uv, magnified)[1][0, 1, 1] == 0


def test_a_size_that_is_no_number_stays_one(session: opencl.Session) -> None:
    magnified = torch.ones(1, 4, 4)
    magnified[0, 2, 2] = torch.nan
    for operator in (stretch, reference.stretch):
        factor, opacity = operator(warped(1, 4, 4, torch.float32), magnified)
        assert factor[0, 2, 2].isnan() and opacity[0, 2, 2] == 0


def test_numpy_in_numpy_out(session: opencl.Session, dtype: torch.dtype) -> None:
    points_uv, magnified = warped(2, 5, 6, dtype), torch.ones(2, 5, 6, dtype=dtype)
    for got, wanted in zip(stretch(points_uv.numpy(), magnified.numpy()), stretch(points_uv, magnified), strict=True):
        assert isinstance(got, np.ndarray) and np.array_equal(got, wanted.numpy())


def test_refuses_other_shapes(session: opencl.Session) -> None:
    with pytest.raises(ValueError, match=r"`magnified` must be .* H = 4 as in `points_uv`, got"):
        stretch(torch.zeros(1, 4, 5, 2), torch.zeros(1, 5, 4))
    with pytest.raises(ValueError, match="`points_uv` must be"):
        stretch(torch.zeros(1, 4, 5, 3), torch.zeros(1, 4, 5))


def test_a_plane_along_the_motion_stays_whole_close_to_the_camera(
    mapped_session: opencl.Session, dtype: torch.dtype
) -> None:
    rows = torch.arange(40, 80, dtype=dtype)  # of a road below the horizon, whose inverse depth grows with the row
    magnified = 1 / (1 - rows / 100)  # up to 5, where rows come to lie up to 25 px apart
    points_uv = torch.stack([torch.zeros(40, dtype=dtype), rows * magnified], dim=1)[None, :, None]
    factor, opacity = stretch(points_uv, magnified[None, :, None])
    assert opacity[0, 1:-1].all() and (factor[0, 1:-1, 0] > 0.9 * magnified[1:-1]).all()
    points_uv[:, 31:, :, 1] += 60  # a jump: what is next to it has neighbours at one side
    opacity = stretch(points_uv, magnified[None, :, None])[1][0, 1:-1, 0]
    assert opacity.nonzero()[:, 0].tolist() == [i for i in range(38) if i not in (29, 30)]
    assert_like_reference(stretch, reference.stretch, points_uv=points_uv, magnified=magnified[None, :, None])


def test_rows_of_a_road_are_no_farther_apart_at_its_sides(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    rows, columns = torch.arange(40, 70, dtype=dtype)[:, None], torch.arange(-100, 100, dtype=dtype)
    magnified = (1 / (1 - rows / 100)).expand(30, 200)
    points_uv = torch.stack([columns * magnified, rows * magnified], dim=2)[None]  # the sides' rows move outwards
    factor, opacity = stretch(points_uv, magnified[None])
    assert opacity[0, 1:-1].all()
    torch.testing.assert_close(factor[0, 1:-1, 1:-1], magnified[1:-1, 1:-1], rtol=0.02, atol=0)
    assert_like_reference(stretch, reference.stretch, points_uv=points_uv, magnified=magnified[None].contiguous())

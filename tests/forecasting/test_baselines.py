"""vestcl.forecasting.baselines by hand, and on textures whose motion is known."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from vestcl.evaluation import metrics
from vestcl.forecasting.baselines import flow_extrapolation, repeat_last
from vestcl.scene.flow.optical_flow import backward_warp, optical_flow

CLIP = Path(__file__).resolve().parents[3] / "shared" / "data" / "kitti_clip" / "image"

HEIGHT, WIDTH = 96, 128

Points = tuple[torch.Tensor, torch.Tensor]


@pytest.fixture
def texture() -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
    """An image [1, 3, H, W] that is known at every real x, y: forty waves of 8 to 40 px for each channel."""
    angle, phase = 2 * math.pi * torch.rand(2, 3, 40, 1, 1)
    wavelength = 8 + 32 * torch.rand(3, 40, 1, 1)

    def colours_at(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        waves = (2 * math.pi / wavelength * (x * angle.cos() + y * angle.sin()) + phase).sin()
        return (0.5 + 0.05 * waves.sum(dim=1)).clamp(0, 1)[None]

    return colours_at


def pixel_centres() -> Points:
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    return x, y


def psnr_by_step(frames: torch.Tensor, truth: torch.Tensor, border: int = 12) -> torch.Tensor:
    """dB at each step, away from the border, where new objects come in that nobody can know."""
    return metrics.psnr(*(images[..., border:-border, border:-border] for images in (frames[0], truth)))


def test_repeat_last() -> None:
    frame_prev, frame_cur = torch.rand(2, 2, 3, 4, 5)
    frames = repeat_last(frame_prev, frame_cur, 3)
    assert frames.shape == (2, 3, 3, 4, 5)
    assert all(torch.equal(frames[:, k], frame_cur) for k in range(3))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_backward_warp_by_hand(dtype: torch.dtype) -> None:
    image = torch.arange(12, dtype=dtype).reshape(1, 1, 3, 4)
    flow_uv = torch.zeros(1, 2, 3, 4, dtype=dtype)
    torch.testing.assert_close(backward_warp(image, flow_uv), image)
    flow_uv[:, 0] = 1
    wanted = torch.tensor([[1.0, 2, 3, 3], [5, 6, 7, 7], [9, 10, 11, 11]], dtype=dtype)[None, None]
    torch.testing.assert_close(backward_warp(image, flow_uv), wanted)
    flow_uv[:, 0], flow_uv[:, 1] = 0, -0.5
    wanted = torch.tensor([[0.0, 1, 2, 3], [2, 3, 4, 5], [6, 7, 8, 9]], dtype=dtype)[None, None]
    torch.testing.assert_close(backward_warp(image, flow_uv), wanted)


def test_backward_warp_gradients() -> None:
    image = torch.rand(1, 2, 5, 6, dtype=torch.float64, requires_grad=True)
    flow_uv = (0.1 + 0.8 * torch.rand(1, 2, 5, 6, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(backward_warp, (image, flow_uv))


def test_optical_flow_of_a_shift(texture: Any) -> None:
    x, y = pixel_centres()
    src, dst = texture(x, y), texture(x - 2.25, y + 1.5)
    flow_uv = optical_flow(torch.cat([src, dst]), torch.cat([dst, src]))
    inner = flow_uv[..., 12:-12, 12:-12]
    wanted = torch.tensor([[2.25, -1.5], [-2.25, 1.5]])[:, :, None, None]
    assert flow_uv.shape == (2, 2, HEIGHT, WIDTH) and flow_uv.dtype == torch.float32
    assert float((inner - wanted).abs().mean()) < 0.05


def test_a_moving_texture_is_followed(texture: Any) -> None:
    x, y = pixel_centres()
    at = [texture(x - 1.7 * t, y + 0.6 * t) for t in range(-1, 5)]
    truth = torch.cat(at[2:])
    frames = flow_extrapolation(at[0], at[1], 4)
    assert frames.shape == (1, 4, 3, HEIGHT, WIDTH)
    repeated = psnr_by_step(repeat_last(at[0], at[1], 4), truth)
    assert (psnr_by_step(frames, truth) > repeated + 10).all()


def test_driving_forward_a_place_keeps_its_flow(texture: Any) -> None:
    """A zoom by the same factor every step, as in a corridor."""
    x, y = (centre - size / 2 for centre, size in zip(pixel_centres(), (WIDTH, HEIGHT), strict=True))
    at = [texture(x / 1.04**t, y / 1.04**t) for t in range(-1, 6)]
    truth = torch.cat(at[2:])
    repeated = psnr_by_step(repeat_last(at[0], at[1], 5), truth)
    assert (psnr_by_step(flow_extrapolation(at[0], at[1], 5), truth) > repeated + 6).all()


def test_a_still_scene_stays(texture: Any) -> None:
    frame = texture(*pixel_centres())
    frames = flow_extrapolation(frame, frame, 2)
    torch.testing.assert_close(frames, repeat_last(frame, frame, 2), atol=1e-4, rtol=0)


def test_batch_and_order_do_not_matter(texture: Any) -> None:
    x, y = pixel_centres()
    frame_prev, frame_cur = (torch.cat([texture(x - t, y), texture(x, y - 2 * t)]) for t in (0, 1))
    both = flow_extrapolation(frame_prev, frame_cur, 2)
    single = flow_extrapolation(frame_prev[1:], frame_cur[1:], 2)
    assert torch.equal(both[1:], single)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda i: repeat_last(i, i, 0), "`steps` must be 1 or more, got 0"),
        (lambda i: flow_extrapolation(i, i, 0), "`steps` must be 1 or more, got 0"),
        (
            lambda i: flow_extrapolation(i, i[..., :-1], 1),
            r"`frame_cur` must be \[1, 3, 16, 16\], got \[1, 3, 16, 15",
        ),
        (lambda i: optical_flow(i[..., :8], i[..., :8]), "H and W must be 12 or more for optical flow, got 16 x 8"),
        (lambda i: optical_flow(i[:, :1], i), r"`src` must be \[B, 3, H, W\], got \[1, 1, 16, 16\]"),
        (lambda i: backward_warp(i, i), r"`flow_uv` must be \[1, 2, 16, 16\], got \[1, 3, 16, 16\]"),
    ],
)
def test_refuses(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(torch.rand(1, 3, 16, 16))


@pytest.mark.skipif(not CLIP.is_dir(), reason="the KITTI clip of ../shared/data is absent")
def test_real_driving() -> None:
    files = sorted(CLIP.iterdir())[7:13]
    pixels = [np.asarray(Image.open(file).resize((416, 128), Image.Resampling.BOX)) for file in files]
    at = [torch.from_numpy(frame.copy()).permute(2, 0, 1)[None].float() / 255 for frame in pixels]
    truth = torch.cat(at[2:])
    repeated = metrics.psnr(repeat_last(at[0], at[1], 4)[0], truth)
    followed = metrics.psnr(flow_extrapolation(at[0], at[1], 4)[0], truth)
    assert (followed > repeated + 3).all()

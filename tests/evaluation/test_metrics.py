"""vestcl.evaluation.metrics by hand, against scikit-image and against plain re-computations in NumPy."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy import signal
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from vestcl import geometry
from vestcl.evaluation import metrics

#: Where float32 rounding may show against float64 oracles.
FLOAT32 = 2e-5


def image_pair(height: int = 40, width: int = 50, batch: int = 2, noise: float = 0.1) -> tuple[torch.Tensor, ...]:
    """Smooth random images in float64 and noisy ones of them."""
    coarse = torch.rand(batch, 3, 8, 8, dtype=torch.float64)
    target = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")
    return (target + noise * torch.randn_like(target)).clamp(0, 1), target


def rectangle(height: int, width: int, rows: slice, columns: slice) -> torch.Tensor:
    mask = torch.zeros(2, 1, height, width, dtype=torch.bool)
    mask[..., rows, columns] = True
    return mask


def skimage_ssim(prediction: torch.Tensor, target: torch.Tensor, **options: Any) -> Any:
    arrays = (image.permute(1, 2, 0).numpy() for image in (prediction, target))
    fixed = {"gaussian_weights": True, "sigma": 1.5, "data_range": 1.0, "channel_axis": -1}
    return structural_similarity(*arrays, **fixed, **options)


def test_quantise_rounds_to_bytes_and_clamps() -> None:
    image = torch.tensor([-0.2, 0.0, 0.4 / 255, 0.6 / 255, 0.5, 1.0, 1.7])
    assert (metrics.quantise(image) * 255).tolist() == [0, 0, 0, 1, 128, 255, 255]
    assert torch.equal(metrics.quantise(metrics.quantise(image)), metrics.quantise(image))


def test_psnr_by_hand() -> None:
    target = torch.full((2, 3, 4, 4), 0.5, dtype=torch.float64)
    prediction = target.clone()
    prediction[0] += 0.1
    prediction[1, :, 0, 0] -= 0.2  # one pixel of 16
    wanted = torch.tensor([20.0, -10 * math.log10(0.04 / 16)], dtype=torch.float64)
    torch.testing.assert_close(metrics.psnr(prediction, target), wanted)


def test_psnr_like_scikit_image() -> None:
    prediction, target = image_pair()
    for i, value in enumerate(metrics.psnr(prediction, target)):
        wanted = peak_signal_noise_ratio(target[i].numpy(), prediction[i].numpy(), data_range=1.0)
        assert float(value) == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, FLOAT32)])
def test_ssim_like_scikit_image(dtype: torch.dtype, tolerance: float) -> None:
    prediction, target = image_pair()
    values = metrics.ssim(prediction.to(dtype), target.to(dtype))
    assert values.shape == (2,) and values.dtype == dtype
    for i, value in enumerate(values):
        wanted = skimage_ssim(prediction[i], target[i], use_sample_covariance=False)
        assert float(value) == pytest.approx(wanted, abs=tolerance)


def test_ssim_by_hand_of_constant_images() -> None:
    first, second = (torch.full((1, 3, 12, 11), value, dtype=torch.float64) for value in (0.3, 0.8))
    wanted = (2 * 0.24 + metrics.C1) / (0.09 + 0.64 + metrics.C1)
    assert float(metrics.ssim(first, second)) == pytest.approx(wanted, abs=1e-12)


def ms_ssim_plainly(prediction: np.ndarray, target: np.ndarray) -> float:
    """One channel [H, W]: a two-dimensional window, covariances of centred values, level by level."""
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / 4.5)
    window /= window.sum()
    score = 1.0
    for level, weight in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        x, y = prediction, target
        mx, my, xx, yy, xy = (signal.convolve2d(v, window, mode="valid") for v in (x, y, x * x, y * y, x * y))
        contrast = (2 * (xy - mx * my) + 0.0009) / (xx - mx**2 + yy - my**2 + 0.0009)
        luminance = (2 * mx * my + 0.0001) / (mx**2 + my**2 + 0.0001)
        score *= max((contrast * luminance if level == 4 else contrast).mean(), 0) ** weight
        even = x[: x.shape[0] // 2 * 2, : x.shape[1] // 2 * 2], y[: x.shape[0] // 2 * 2, : x.shape[1] // 2 * 2]
        prediction, target = ((v[::2, ::2] + v[1::2, ::2] + v[::2, 1::2] + v[1::2, 1::2]) / 4 for v in even)
    return score


@pytest.mark.parametrize(("height", "width"), [(176, 192), (181, 203)])
def test_ms_ssim_like_a_plain_computation(height: int, width: int) -> None:
    prediction, target = image_pair(height, width)
    channels = zip(prediction.flatten(0, 1).numpy(), target.flatten(0, 1).numpy(), strict=True)
    wanted = torch.tensor([ms_ssim_plainly(*pair) for pair in channels], dtype=torch.float64).reshape(2, 3).mean(dim=1)
    torch.testing.assert_close(metrics.ms_ssim(prediction, target), wanted, atol=1e-11, rtol=0)
    single = metrics.ms_ssim(prediction.float(), target.float())
    torch.testing.assert_close(single.double(), wanted, atol=FLOAT32, rtol=0)


def test_ms_ssim_by_hand_of_constant_images() -> None:
    """Structure is 1 everywhere, so that the luminance of the coarsest level only remains."""
    first, second = (torch.full((1, 3, 176, 176), value, dtype=torch.float64) for value in (0.3, 0.8))
    luminance = (2 * 0.24 + metrics.C1) / (0.09 + 0.64 + metrics.C1)
    assert float(metrics.ms_ssim(first, second)) == pytest.approx(luminance**0.1333, abs=1e-12)


def test_ms_ssim_of_a_negative_is_zero() -> None:
    target = torch.rand(1, 3, 176, 176)
    assert metrics.ms_ssim(1 - target, target).tolist() == [0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_images_are_perfect(dtype: torch.dtype) -> None:
    image = image_pair(176, 180)[0].to(dtype)
    assert metrics.psnr(image, image).tolist() == [math.inf] * 2
    assert metrics.ssim(image, image).tolist() == [1, 1]
    assert metrics.ms_ssim(image, image).tolist() == [1, 1]


@pytest.mark.parametrize("metric", [metrics.psnr, metrics.ssim, metrics.ms_ssim])
def test_worse_with_more_noise(metric: Any) -> None:
    _, target = image_pair(176, 176)
    noise = torch.randn_like(target)
    scores = torch.stack([metric(target + strength * noise, target) for strength in (0.01, 0.03, 0.1, 0.3)])
    assert (scores.diff(dim=0) < 0).all()


@pytest.mark.parametrize("metric", [metrics.psnr, metrics.ssim])
def test_masked_is_cropped(metric: Any) -> None:
    prediction, target = image_pair()
    rows, columns = slice(5, 30), slice(12, 48)
    mask = rectangle(40, 50, rows, columns)
    wanted = metric(prediction[..., rows, columns], target[..., rows, columns])
    prediction[~mask.expand_as(prediction)] = math.nan  # what cannot be seen must not count
    for kind in (mask, mask.float()):
        torch.testing.assert_close(metric(prediction, target, kind), wanted)
    everything = torch.ones_like(mask)
    torch.testing.assert_close(metric(target + 0.1, target, everything), metric(target + 0.1, target))


def test_nothing_visible_is_nan_for_that_image_only() -> None:
    prediction, target = image_pair()
    mask = torch.ones(2, 1, 40, 50)
    mask[1] = 0
    mask[1, :, :10] = 1  # pixels, but no window
    assert metrics.ssim(prediction, target, mask).isnan().tolist() == [False, True]
    assert metrics.psnr(prediction, target, mask).isnan().tolist() == [False, False]
    mask[1] = 0
    assert metrics.psnr(prediction, target, mask).isnan().tolist() == [False, True]


def test_gradients() -> None:
    prediction, target = (image.requires_grad_() for image in image_pair(13, 12, batch=1))
    mask = rectangle(13, 12, slice(0, 12), slice(0, 12))[:1]
    assert torch.autograd.gradcheck(metrics.ssim, (prediction, target, mask), fast_mode=True)
    assert torch.autograd.gradcheck(metrics.psnr, (prediction, target, mask), fast_mode=True)


def test_ms_ssim_has_the_slope_of_its_gradient() -> None:
    prediction, target = image_pair(176, 176, batch=1)
    prediction.requires_grad_()
    (grad,) = torch.autograd.grad(metrics.ms_ssim(prediction, target).sum(), prediction)
    step = 1e-5 * torch.randn_like(target)
    with torch.no_grad():
        slope = metrics.ms_ssim(prediction + step, target) - metrics.ms_ssim(prediction - step, target)
    assert float(slope) == pytest.approx(2 * float((grad * step).sum()), rel=1e-5)


def test_running_mean() -> None:
    assert metrics.running_mean(torch.tensor([[8.0, 4, 3], [1, 1, 1]])).tolist() == [[8, 6, 5], [1, 1, 1]]


@pytest.mark.parametrize("degrees", [0.0, 1e-3, 3.0, 90.0, 179.0, 180.0])
def test_ego_motion_error_by_hand(degrees: float) -> None:
    half = math.radians(degrees) / 2
    turn = torch.tensor([[math.cos(half), 0, math.sin(half), 0]], dtype=torch.float64)
    base = torch.tensor([[0.9, 0.1, -0.3, 0.2]], dtype=torch.float64)
    truth = geometry.compose_rigid(base, torch.tensor([[0.0, 0, -2]], dtype=torch.float64))
    estimate = geometry.compose_rigid(
        geometry.quaternion_multiply(base, turn), torch.tensor([[0.3, 0, -2.4]], dtype=torch.float64)
    )
    rotation_deg, translation_percent = metrics.ego_motion_error(estimate, truth)
    assert rotation_deg.tolist() == [pytest.approx(degrees, abs=1e-6)]
    assert translation_percent.tolist() == [pytest.approx(25.0)]


def test_a_small_turn_keeps_its_digits_in_float32() -> None:
    turn = torch.tensor([[1.0, 1e-5, 0, 0]])
    estimate = geometry.compose_rigid(turn, torch.tensor([[0.0, 0, 1]]))
    error = metrics.ego_motion_error(estimate, torch.eye(4)[None])
    assert error.rotation_deg.tolist() == [pytest.approx(math.degrees(2e-5), rel=1e-4)]


def test_no_per_cent_of_a_standstill() -> None:
    truth = torch.eye(4).repeat(2, 1, 1)
    truth[1, 2, 3] = -1
    estimate = truth.clone()
    estimate[:, 0, 3] = 0.1
    rotation_deg, translation_percent = metrics.ego_motion_error(estimate, truth)
    assert rotation_deg.tolist() == [0, 0]
    assert translation_percent.isnan().tolist() == [True, False] and float(translation_percent[1]) == pytest.approx(10)


def test_end_point_error_by_hand() -> None:
    truth = torch.zeros(2, 3, 3)
    displacement_xyz = torch.tensor([[[3.0, 4, 0], [0, 0, 1], [0, 0, 0]]]).repeat(2, 1, 1)
    assert metrics.end_point_error(displacement_xyz, truth).tolist() == [2, 2]
    mask = torch.tensor([[True, False, False], [False, False, False]])
    masked = metrics.end_point_error(displacement_xyz, truth, mask)
    assert float(masked[0]) == 5 and masked[1].isnan()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: metrics.psnr(x[0], x), r"`prediction` must be \[B, 3, H, W\], got \[3, 12, 12\]"),
        (lambda x: metrics.psnr(x, x[..., :-1]), r"`target` must be \[2, 3, 12, 12\], got \[2, 3, 12, 11\]"),
        (lambda x: metrics.psnr(x, x, x[:, :1, :5]), r"`mask` must be \[2, 1, 12, 12\], got \[2, 1, 5, 12\]"),
        (lambda x: metrics.ssim(x[..., :10], x[..., :10]), "H and W must be 11 or more for a window of SSIM, got 12 x"),
        (lambda x: metrics.ms_ssim(x, x), "H and W must be 176 or more for five levels of MS-SSIM, got 12 x 12"),
        (lambda x: metrics.ssim(x.byte(), x), "`prediction` must be a floating-point tensor, got torch.uint8"),
        (lambda x: metrics.end_point_error(x[0, :, :, :3], x[0, :, :, :3], x[0, 0]), r"`mask` must be \[3, 12\], got"),
        (lambda x: metrics.ego_motion_error(x[0], x[0]), r"`dst_from_src` must be \[B, 4, 4\], got"),
    ],
)
def test_refuses(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(torch.rand(2, 3, 12, 12))

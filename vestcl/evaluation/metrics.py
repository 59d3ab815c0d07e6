"""How good a forecast is: images against the truth, ego-motion and 3D motion against the truth.

Every function answers with one number per image or sample, [B]; the mean over a data set is the caller's. Where a
number is undefined (nothing visible, a car that is static) it is NaN, so take means with `torch.nanmean`.
"""

from typing import Final, NamedTuple

import torch
from torch.nn import functional

from vestcl.shapes import check

#: Side of SSIM's window in pixels, and the standard deviation of its Gaussian (Wang et al. 2004).
WINDOW: Final = 11
SIGMA: Final = 1.5

#: SSIM's constants, (K L)^2 with K = (0.01, 0.03) and images of range L = 1: they keep flat regions from 0 / 0.
C1: Final = 0.01**2
C2: Final = 0.03**2

#: Exponents of MS-SSIM from the finest level to the coarsest (Wang et al. 2003).
LEVEL_WEIGHTS: Final = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)

#: The smallest image side that still holds a window on MS-SSIM's coarsest level.
MS_SSIM_SIDE: Final = WINDOW << (len(LEVEL_WEIGHTS) - 1)

#: A car that moves less than this between two frames (metres) is static: an error in per cent of it is undefined.
STANDSTILL: Final = 0.01


class EgoMotionError(NamedTuple):
    """What `ego_motion_error` returns, [B] each."""

    rotation_deg: torch.Tensor
    translation_percent: torch.Tensor


def quantise(image: torch.Tensor) -> torch.Tensor:
    """round(255 clamp(x, 0, 1)) / 255: the image as an 8-bit file holds it.

    Published figures are of 8-bit images; the metrics of this module don't do this themselves.

    Args:
        image: any shape.

    Returns:
        The same shape; its gradient is zero.
    """
    return (image.clamp(0, 1) * 255).round() / 255


def psnr(prediction: torch.Tensor, target: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
    """-10 log10(mean (prediction - target)^2) dB, the mean over the pixels inside the mask and their channels.

    Args:
        prediction: [B, 3, H, W] in [0, 1], RGB.
        target: [B, 3, H, W] in [0, 1], RGB.
        mask: [B, 1, H, W], bool or numbers: inside where above 0.5. None is everything.

    Returns:
        [B] dB; infinite for equal images, NaN where the mask is empty. Differentiable in both images where finite.

    Raises:
        ValueError: shapes don't fit.
    """
    sizes = check(prediction=(prediction, "B 3 H W"), target=(target, "B 3 H W"))
    squares = (prediction - target).square().mean(dim=1, keepdim=True)
    return -10 * _mean_inside(squares, _inside(mask, sizes, squares)).log10()


def ssim(
    prediction: torch.Tensor,
    target: torch.Tensor,
    mask: torch.Tensor | None = None,
) -> torch.Tensor:
    """Mean over windows and channels of (2 mx my + C1) (2 sxy + C2) / ((mx^2 + my^2 + C1) (sxx + syy + C2)).

    m and s are means and covariances under a Gaussian of 11 x 11 pixels and sigma 1.5; only windows wholly within
    the image count ("valid"). That is scikit-image's `structural_similarity` with ``gaussian_weights=True,
    sigma=1.5, use_sample_covariance=False, data_range=1``.

    Args:
        prediction: [B, 3, H, W] in [0, 1], RGB; H and W are WINDOW or more.
        target: [B, 3, H, W] in [0, 1], RGB.
        mask: [B, 1, H, W], bool or numbers: inside where above 0.5. None is everything. Windows with every pixel inside
            count, so nothing outside has an influence, and a rectangle scores as its crop does.

    Returns:
        [B], 1 for equal images; NaN where no window is inside. Differentiable in both images.

    Raises:
        ValueError: shapes don't fit, the image is smaller than a window.

    Source: Wang, Bovik, Sheikh, Simoncelli: Image Quality Assessment: From Error Visibility to Structural
    Similarity, 2004.
    """
    sizes = check(prediction=(prediction, "B 3 H W"), target=(target, "B 3 H W"))
    _require_side(sizes, WINDOW, "a window of SSIM")
    inside = _inside(mask, sizes, prediction)
    # A NaN that can't be seen must not spread through the matrix products.
    prediction, target = (torch.where(inside, image, 0) for image in (prediction, target))
    luminance, structure = _ssim_maps(prediction, target)
    values = (luminance * structure).mean(dim=1, keepdim=True)
    return _mean_inside(values, functional.max_pool2d((~inside).float(), WINDOW, stride=1) == 0)


def ms_ssim(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """prod_j max(cs_j, 0)^w_j with l cs in place of cs at the last level; mean over channels.

    l and cs are the two factors of `ssim`, each level's mean over its valid windows; the next level is the mean of
    2 x 2 pixels, an odd last row or column left out; w is LEVEL_WEIGHTS.

    Args:
        prediction: [B, 3, H, W] in [0, 1], RGB; H and W are MS_SSIM_SIDE or more.
        target: [B, 3, H, W] in [0, 1], RGB.

    Returns:
        [B], 1 for equal images. Differentiable in both images where every factor is positive.

    Raises:
        ValueError: shapes don't fit, or a side is below MS_SSIM_SIDE.

    Source: Wang, Simoncelli, Bovik: Multiscale Structural Similarity for Image Quality Assessment, 2003; SPEC
    section 10.
    """
    sizes = check(prediction=(prediction, "B 3 H W"), target=(target, "B 3 H W"))
    _require_side(sizes, MS_SSIM_SIDE, "five levels of MS-SSIM")
    score = torch.ones((), dtype=prediction.dtype, device=prediction.device)
    for level, weight in enumerate(LEVEL_WEIGHTS):
        if level:
            prediction, target = functional.avg_pool2d(prediction, 2), functional.avg_pool2d(target, 2)
        luminance, structure = _ssim_maps(prediction, target)
        is_last = level == len(LEVEL_WEIGHTS) - 1
        factor = (luminance * structure if is_last else structure).mean(dim=(2, 3))
        score = score * factor.clamp(min=0) ** weight
    return score.mean(dim=1)


def running_mean(by_horizon: torch.Tensor) -> torch.Tensor:
    """y_k = (x_1 + ... + x_k) / k: some tables give a horizon's own score, some the mean up to it.

    Args:
        by_horizon: [..., K], the scores at t+1 to t+K.

    Returns:
        [..., K]; differentiable.
    """
    steps = torch.arange(1, by_horizon.shape[-1] + 1, dtype=by_horizon.dtype, device=by_horizon.device)
    return by_horizon.cumsum(dim=-1) / steps


def ego_motion_error(dst_from_src: torch.Tensor, truth: torch.Tensor) -> EgoMotionError:
    """angle(R_truth^T R) and 100 |t - t_truth| / |t_truth|.

    Args:
        dst_from_src: [B, 4, 4], the estimate, metres.
        truth: [B, 4, 4], of the same two frames.

    Returns:
        Rotation error in degrees, 0 to 180, and translation error in per cent of the true path, NaN where that is
        shorter than STANDSTILL; [B] each.

    Raises:
        ValueError: shapes don't fit.
    """
    check(dst_from_src=(dst_from_src, "B 4 4"), truth=(truth, "B 4 4"))
    rotation = truth[:, :3, :3].mT @ dst_from_src[:, :3, :3]
    # The arc cosine of the trace by itself has no digits left near zero; the sine gives them.
    axis = torch.stack([rotation[:, i, j] - rotation[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], dim=-1)
    trace = rotation.diagonal(dim1=1, dim2=2).sum(dim=-1)
    angle = torch.atan2(torch.linalg.vector_norm(axis, dim=-1), trace - 1)
    path = torch.linalg.vector_norm(truth[:, :3, 3], dim=-1)
    miss = torch.linalg.vector_norm(dst_from_src[:, :3, 3] - truth[:, :3, 3], dim=-1)
    return EgoMotionError(torch.rad2deg(angle), torch.where(path < STANDSTILL, torch.nan, 100 * miss / path))


def end_point_error(
    displacement_xyz: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor | None = None
) -> torch.Tensor:
    """mean |u - u_truth| over the points inside the mask.

    Args:
        displacement_xyz: [B, N, 3] m, the estimate.
        truth: [B, N, 3] m.
        mask: [B, N], bool or numbers: inside where above 0.5. None is everything.

    Returns:
        [B] m; NaN where the mask is empty. Differentiable in both.

    Raises:
        ValueError: shapes don't fit.
    """
    sizes = check(displacement_xyz=(displacement_xyz, "B N 3"), truth=(truth, "B N 3"))
    if mask is not None:
        check(mask=(mask.to(truth.dtype), f"{sizes['B']} {sizes['N']}"))
    errors = torch.linalg.vector_norm(displacement_xyz - truth, dim=-1)
    return _mean_inside(errors, torch.ones_like(errors, dtype=torch.bool) if mask is None else mask > 0.5)


def _ssim_maps(prediction: torch.Tensor, target: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """SSIM's two factors, luminance and contrast-structure, [B, C, H - 10, W - 10] each."""
    products = [prediction, target, prediction.square() + target.square(), prediction * target]
    mean_x, mean_y, squares, cross = _gaussian(torch.stack(products)).unbind()
    mean_squares, mean_cross = mean_x.square() + mean_y.square(), mean_x * mean_y
    luminance = (2 * mean_cross + C1) / (mean_squares + C1)
    structure = (2 * (cross - mean_cross) + C2) / (squares - mean_squares + C2)
    return luminance, structure


def _gaussian(image: torch.Tensor) -> torch.Tensor:
    """A x B^T with A and B the filter as band matrices: [..., H, W] -> [..., H - 10, W - 10]."""
    rows, columns = (_band(size, image) for size in image.shape[-2:])
    return rows @ (image @ columns.mT)


def _band(size: int, like: torch.Tensor) -> torch.Tensor:
    """[size - 10, size]: row i has the normalised Gaussian from column i on."""
    offsets = torch.arange(WINDOW, dtype=like.dtype, device=like.device) - WINDOW // 2
    gaussian = (-offsets.square() / (2 * SIGMA**2)).exp()
    band = torch.zeros(size - WINDOW + 1, size, dtype=like.dtype, device=like.device)
    for column, weight in enumerate(gaussian / gaussian.sum()):
        band.diagonal(column).fill_(weight)
    return band


def _require_side(sizes: dict[str, int], side: int, purpose: str) -> None:
    if min(sizes["H"], sizes["W"]) < side:
        raise ValueError(f"H and W must be {side} or more for {purpose}, got {sizes['H']} x {sizes['W']}")


def _inside(mask: torch.Tensor | None, sizes: dict[str, int], like: torch.Tensor) -> torch.Tensor:
    """``mask`` as bool [B, 1, H, W]."""
    shape = sizes["B"], 1, sizes["H"], sizes["W"]
    if mask is None:
        return torch.ones(shape, dtype=torch.bool, device=like.device)
    check(mask=(mask.to(like.dtype), " ".join(map(str, shape))))
    return mask > 0.5


def _mean_inside(values: torch.Tensor, inside: torch.Tensor) -> torch.Tensor:
    """The mean over all dimensions but the first, [B]; NaN where nothing is inside."""
    return torch.where(inside, values, 0).flatten(1).sum(dim=1) / inside.flatten(1).sum(dim=1)

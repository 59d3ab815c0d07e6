"""What training minimises: the image against the truth, and how far the motion is from what is known of it.

Each term but routing's is a mean over the samples of a batch, so that processes which share a batch and average their
gradients get the gradient of the whole. Images are compared as they come, without clamping to [0, 1]: a clamp's
gradient is 0 just where it is needed, and every term is defined beyond.
"""

from collections.abc import Callable
from functools import partial
from typing import Final

import torch
from torch.nn import functional

from train.data.windows import Batch
from train.settings.config import LossConfig
from vestcl.evaluation import metrics
from vestcl.evaluation.perceptual import VggLoss, squeeze_distance
from vestcl.evaluation.trunks.trunks import load_trunk
from vestcl.models import budget_loss
from vestcl.models.forecaster import RenderedView, Step
from vestcl.shapes import check

#: (prediction, target), [B, 3, H, W] each -> [B].
Perceptual = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]

#: Nearer than this, metres, motion counts in metres and not in shares of the depth: a camera's own car begins there,
#: and depth below it is mostly wrong.
NEAREST: Final = 1.0


def build_perceptual(config: LossConfig) -> Perceptual | None:
    """The perceptual distance that ``config`` names, its classifier frozen.

    Args:
        config: the loss; ``perceptual.kind`` "vgg19" is `vestcl.evaluation.perceptual.VggLoss`, "squeeze" is
            `vestcl.evaluation.perceptual.squeeze_distance`.

    Returns:
        (prediction, target) -> [B], differentiable in both; None for kind "none" or weight 0.

    Raises:
        FileNotFoundError: no weights there; the message says how to get them.
        ValueError: a damaged file, or one that holds something else.
    """
    perceptual = config.perceptual
    if perceptual.kind == "none" or not perceptual.weight:
        return None
    assert perceptual.weights is not None  # the configuration has seen to it
    if perceptual.kind == "vgg19":
        return VggLoss.load(perceptual.weights)
    return partial(squeeze_distance, trunk=load_trunk("squeezenet1_0", perceptual.weights))


def total_loss(
    view: RenderedView | None,
    step: Step,
    batch: Batch,
    config: LossConfig,
    perceptual: Perceptual | None,
    budget: float | None = None,
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """sum_i w_i term_i, over the terms of weight above 0.

        l1               mean |image - target|
        perceptual       mean over samples of perceptual(image, target)
        ssim             `ssim_loss`
        rotation         `path_errors`, rad; weight ``pose.rotation``
        translation      `path_errors`, m; weight ``pose.translation``
        residual_motion  `residual_motion`
        routing          `vestcl.models.budget_loss`, of models that route

    Args:
        view: the forecast in the target's camera, B images; None leaves out the terms of images.
        step: the forecast's motion, to the target's time.
        batch: what was shown, and the truth.
        config: weights w.
        perceptual: from `build_perceptual` of the same configuration.
        budget: blocks of object motion that should run on average; None for models that run all.

    Returns:
        The sum, differentiable in the view's image and in the step's motion, and each term before its weight,
        detached. Terms of weight 0 are left out, but those of the motion, which cost nothing, are always given.

    Raises:
        ValueError: shapes don't fit, or ``perceptual`` is missing.
    """
    rotation, translation = path_errors(step.path_from_cur, batch.path_from_cur, batch.pose_known)
    terms = {} if view is None else image_terms(view.image, batch.target, config, perceptual)
    terms |= {
        "rotation": (config.pose.rotation, rotation),
        "translation": (config.pose.translation, translation),
        "residual_motion": (config.residual_motion, residual_motion(step, batch)),
    }
    probabilities = step.motion.objects.probabilities
    if budget is not None and probabilities is not None and view is not None:
        terms["routing"] = config.routing, budget_loss(probabilities, budget)
    counted = [weight * term for weight, term in terms.values() if weight]
    total = torch.stack(counted).sum() if counted else rotation.new_zeros(())
    return total, {name: term.detach() for name, (_, term) in terms.items()}


def ssim_loss(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """1 - sum_j v_j SSIM_j, mean over samples, with SSIM_j of both images halved j times.

    v are MS-SSIM's weights of the levels that hold a window, over their sum: five levels from 176 pixels on, four
    from 88, one below 22. A sum in place of MS-SSIM's product, whose powers have an infinite gradient where a
    factor is 0, as an untrained network's may be.

    Args:
        prediction: [B, 3, H, W], RGB; H and W `vestcl.evaluation.metrics.WINDOW` or more.
        target: [B, 3, H, W], RGB.

    Returns:
        A number, 0 for equal images; differentiable in both images.

    Raises:
        ValueError: shapes don't fit, or the image is smaller than a window.
    """
    side = min(prediction.shape[-2:])
    levels = [weight for j, weight in enumerate(metrics.LEVEL_WEIGHTS) if j == 0 or side >> j >= metrics.WINDOW]
    similarity = prediction.new_zeros(())
    for level, weight in enumerate(levels):
        if level:
            prediction, target = functional.avg_pool2d(prediction, 2), functional.avg_pool2d(target, 2)
        similarity = similarity + weight / sum(levels) * metrics.ssim(prediction, target).mean()
    return 1 - similarity


def path_errors(path: torch.Tensor, truth: torch.Tensor, known: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """`pose_errors`, means over the frame intervals that both ways have.

    Args:
        path: [B, m, 4, 4] m, from t to t + 1 ... t + m, the forecast.
        truth: [B, n, 4, 4] m.
        known: [B] bool.

    Returns:
        Radians and metres, a number each; differentiable in both ways.
    """
    steps = min(path.shape[1], truth.shape[1])
    first, second = (way[:, :steps].flatten(0, 1) for way in (path, truth))
    return pose_errors(first, second, known.repeat_interleave(steps))


def pose_errors(
    dst_from_src: torch.Tensor, truth: torch.Tensor, known: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Means over all samples, 0 where the truth is unknown, of angle(R^T R*) and of |t - t*|.

    The angle is atan2(|s|, (trace - 1) / 2) with s the axis times the sine, from the skew part: exact down to 0, where
    an arc cosine has no digits and no gradient. Both have a kink at 0, as any distance; the gradient there is 0.

    Args:
        dst_from_src: [B, 4, 4] m, rigid, the forecast.
        truth: [B, 4, 4] m, of the same two times.
        known: [B] bool. The mean is over all B, so that it is the mean of the parts' means, however a batch is split.

    Returns:
        Radians and metres, a number each; differentiable in both motions.

    Raises:
        ValueError: shapes don't fit.
    """
    check(dst_from_src=(dst_from_src, "B 4 4"), truth=(truth, "B 4 4"), known=(known.to(truth), f"{len(truth)}"))
    between = dst_from_src[:, :3, :3].mT @ truth[:, :3, :3]
    skew = between - between.mT
    twice_sine = torch.linalg.vector_norm(torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=1), dim=1)
    angle = torch.atan2(twice_sine, between.diagonal(dim1=1, dim2=2).sum(dim=1) - 1)
    distance = torch.linalg.vector_norm(dst_from_src[:, :3, 3] - truth[:, :3, 3], dim=1)
    return torch.where(known, angle, 0).mean(), torch.where(known, distance, 0).mean()


def residual_motion(step: Step, batch: Batch) -> torch.Tensor:
    """mean |U - U0| / max(D, NEAREST) over the pixels of both frames, foreground and background.

    U is the motion that is used and U0 what object motion starts from, metres: the rigid flow, and what a model that
    starts from measurements was given moving objects. D is the pixel's depth, so that the term is about the shift on
    the image in focal lengths. Its gradient where both agree, as at the start of training, is 0.

    Args:
        step: the forecast, with U and U0 [B, 6, H, W] m, the previous frame's three channels first.
        batch: whose frames have D [B, 1, H, W] m.

    Returns:
        A number; differentiable in U and U0.

    Raises:
        ValueError: shapes don't fit.
    """
    flow, start = step.motion.objects.flow, step.motion.start
    depth = torch.cat([batch.frame_prev.depth, batch.frame_cur.depth], dim=1)
    check(flow=(flow, "B 6 H W"), start=(start, "B 6 H W"), depth=(depth, "B 2 H W"))
    strays = torch.linalg.vector_norm((flow - start).unflatten(1, (2, 3)), dim=2)
    return (strays / depth.clamp(min=NEAREST)).mean()


def image_terms(
    image: torch.Tensor, target: torch.Tensor, config: LossConfig, perceptual: Perceptual | None
) -> dict[str, tuple[float, torch.Tensor]]:
    """name -> (weight, term), of those that count."""
    terms, image = {}, image.to(target.dtype)
    check(image=(image, "B 3 H W"), target=(target, "B 3 H W"))
    if config.l1:
        terms["l1"] = config.l1, (image - target).abs().mean()
    if config.perceptual.kind != "none" and config.perceptual.weight:
        if perceptual is None:
            raise ValueError("`perceptual` must be what `build_perceptual` gives for this configuration, got None")
        terms["perceptual"] = config.perceptual.weight, perceptual(image, target).mean()
    if config.ssim:
        terms["ssim"] = config.ssim, ssim_loss(image, target)
    return terms

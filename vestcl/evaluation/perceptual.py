"""Distances between images in the features of a classifier: LPIPS, ST-LPIPS, one without heads, and a training loss.

Each takes two images [B, 3, H, W] in [0, 1], RGB, and answers with [B]; 0 for equal images. All are differentiable in
both images; the classifiers' weights (vestcl.evaluation.trunks.trunks) come from files and stay as they are. As metrics
they are meant for 8-bit images: `vestcl.evaluation.metrics.quantise` them first.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import torch
from torch import nn

from vestcl.evaluation.st_lpips import INSTALLED, REMEDY, find_weights
from vestcl.evaluation.trunks.shift_tolerant import ShiftTolerantTrunk, load_shift_tolerant
from vestcl.evaluation.trunks.trunks import Normalisation, Trunk, load_trunk
from vestcl.models.weights_file import check_finite, read_state_dict
from vestcl.shapes import check

#: LPIPS's own scaling layer, after 2 x - 1: ImageNet's mean and deviation on [-1, 1], in three digits.
LPIPS_SCALING: Final = Normalisation((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450), gain=2.0, offset=-1.0)

#: The public heads, and what LPIPS calls the trunk that they were learnt on.
_HEADS: Final = {"alexnet": "alex.pth", "vgg16": "vgg.pth"}

#: LPIPS's guard against 0 / 0 where all channels are zero.
_EPSILON: Final = 1e-10

#: Weights of relu1_1 to relu5_1 in the training loss (SPEC section 7).
VGG_WEIGHTS: Final = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1.0)


class _LearntDistance(nn.Module):
    """sum_l mean_hw sum_c w_lc (f_lc / |f_l| - g_lc / |g_l|)^2: a trunk, and heads w that were learnt on it."""

    def __init__(self, trunk: Trunk | ShiftTolerantTrunk, heads: Sequence[torch.Tensor], name: str) -> None:
        super().__init__()
        if [list(head.shape) for head in heads] != [[channels] for channels in trunk.channels]:
            got = ", ".join(str(list(head.shape)) for head in heads)
            raise ValueError(f"`heads` must be of sizes {list(trunk.channels)} for {name}, got {got}")
        self.trunk = trunk
        self.heads = nn.ParameterList(head.detach().clone() for head in heads).requires_grad_(False)

    def forward(self, prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """The distance.

        Args:
            prediction: [B, 3, H, W] in [0, 1], RGB (2 x - 1 is taken here).
            target: [B, 3, H, W] in [0, 1], RGB.

        Returns:
            [B]; differentiable in both images.

        Raises:
            ValueError: shapes don't fit, or the image is too small for the trunk.
        """
        maps = _both(self.trunk, prediction, target)
        layers = [
            torch.einsum("bchw,c->bhw", squared_difference(*pair), head).mean(dim=(1, 2))
            for pair, head in zip(maps, self.heads, strict=True)
        ]
        return torch.stack(layers).sum(dim=0)


class Lpips(_LearntDistance):
    """sum_l mean_hw sum_c w_lc (f_lc / |f_l| - g_lc / |g_l|)^2 over a trunk's maps f and g of the two images.

    Args:
        trunk: "alexnet" or "vgg16", with LPIPS_SCALING.
        heads: one weight per channel, for each map: [C_l].

    Raises:
        ValueError: another trunk or normalisation, or heads of other sizes.

    Source: Zhang, Isola, Efros, Shechtman, Wang: The Unreasonable Effectiveness of Deep Features as a Perceptual
    Metric, 2018; version 0.1 of its public weights.
    """

    def __init__(self, trunk: Trunk, heads: Sequence[torch.Tensor]) -> None:
        if trunk.name not in _HEADS or trunk.normalisation != LPIPS_SCALING:
            got = f"{trunk.name} with {trunk.normalisation}"
            raise ValueError(f"`trunk` must be {' or '.join(_HEADS)} with LPIPS_SCALING, got {got}")
        super().__init__(trunk, heads, trunk.name)

    @classmethod
    def load(cls, name: str, trunk_path: Path | str, heads_path: Path | str) -> "Lpips":
        """LPIPS v0.1 from its two public files.

        Args:
            name: "alexnet", which published figures use, or "vgg16".
            trunk_path: torchvision's classifier of that name (see `load_trunk`).
            heads_path: the linear heads, lin0.model.1.weight [1, C, 1, 1] to lin4.model.1.weight.

        Raises:
            FileNotFoundError: one of the files is absent; the message says how to get it.
            ValueError: another name, or a file that holds something else.
        """
        if name not in _HEADS:
            raise ValueError(f"`name` must be {' or '.join(_HEADS)}, got {name!r}")
        trunk = load_trunk(name, trunk_path, LPIPS_SCALING)
        return cls(trunk, _read_heads(name, Path(heads_path), trunk.channels))


class StLpips(_LearntDistance):
    """ST-LPIPS: LPIPS's formula over the shift-tolerant AlexNet's maps, with weights and heads of its own.

    It hardly sees a shift of the whole image by a pixel. It is a separate metric: not LPIPS, and not comparable with
    LPIPS's figures.

    Args:
        trunk: of the five maps.
        heads: one weight per channel, for each map: [C_l].

    Raises:
        ValueError: heads of other sizes.

    Source: Ghildyal, Liu: Shift-tolerant Perceptual Similarity Metric, ECCV 2022; its public weights vST0.0.
    """

    def __init__(self, trunk: ShiftTolerantTrunk, heads: Sequence[torch.Tensor]) -> None:
        super().__init__(trunk, heads, "ST-LPIPS")

    @classmethod
    def load(cls, source: Path | str = INSTALLED) -> "StLpips":
        """ST-LPIPS with its public weights.

        Args:
            source: alex_shift_tolerant.pth, or "installed" for that file inside an installed ``stlpips-pytorch``,
                which is not imported.

        Raises:
            FileNotFoundError: no such file or package; the message says how to get it.
            ValueError: a file that is damaged or holds something else.
        """
        return cls(*load_shift_tolerant(find_weights(source), REMEDY))


def squeeze_distance(prediction: torch.Tensor, target: torch.Tensor, trunk: Trunk) -> torch.Tensor:
    """sum_l mean_hw |f_l / |f_l| - g_l / |g_l||^2 over SqueezeNet's maps fire2 to fire9: 0 to 16.

    LPIPS's formula with every head weight 1, on another trunk: no LPIPS, and not comparable with its figures.

    Args:
        prediction: [B, 3, H, W] in [0, 1], RGB.
        target: [B, 3, H, W] in [0, 1], RGB.
        trunk: "squeezenet1_0", with the normalisation of its weights (`load_trunk` sees to it).

    Returns:
        [B]; differentiable in both images.

    Raises:
        ValueError: another trunk, shapes that don't fit, or images below 21 x 21.
    """
    if trunk.name != "squeezenet1_0":
        raise ValueError(f"`trunk` must be squeezenet1_0, got {trunk.name}")
    layers = [squared_difference(*pair).sum(dim=1).mean(dim=(1, 2)) for pair in _both(trunk, prediction, target)]
    return torch.stack(layers).sum(dim=0)


class VggLoss(nn.Module):
    """sum_l w_l mean |f_l - g_l| over VGG19's relu1_1 to relu5_1, w = 1/32, 1/16, 1/8, 1/4, 1.

    Args:
        trunk: "vgg19", with the normalisation of its weights.

    Raises:
        ValueError: another trunk.

    Source: SPEC section 7; the weights are pix2pixHD's (Wang et al. 2018).
    """

    def __init__(self, trunk: Trunk) -> None:
        super().__init__()
        if trunk.name != "vgg19":
            raise ValueError(f"`trunk` must be vgg19, got {trunk.name}")
        self.trunk = trunk

    @classmethod
    def load(cls, path: Path | str) -> "VggLoss":
        """The loss on torchvision's VGG19, from a file (see `load_trunk` for what it raises)."""
        return cls(load_trunk("vgg19", path))

    def forward(self, prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """The loss.

        Args:
            prediction: [B, 3, H, W] in [0, 1], RGB; H and W 16 or more.
            target: [B, 3, H, W] in [0, 1], RGB.

        Returns:
            [B], of which training takes the mean; differentiable in both images.

        Raises:
            ValueError: shapes don't fit, or the image is too small.
        """
        pairs = zip(VGG_WEIGHTS, _both(self.trunk, prediction, target), strict=True)
        return torch.stack([weight * (f - g).abs().mean(dim=(1, 2, 3)) for weight, (f, g) in pairs]).sum(dim=0)


def _both(
    trunk: Trunk | ShiftTolerantTrunk, prediction: torch.Tensor, target: torch.Tensor
) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """The maps of both images, in pairs. One pass each: a target that needs no gradient then keeps nothing for it."""
    check(prediction=(prediction, "B 3 H W"), target=(target, "B 3 H W"))
    return list(zip(trunk(prediction), trunk(target), strict=True))


def squared_difference(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """(f / |f| - g / |g|)^2 with the norms over channels: [B, C, H, W]."""
    # vector_norm has gradient 0 at 0, where the square root of a sum of squares would give NaN.
    unit = [f / (torch.linalg.vector_norm(f, dim=1, keepdim=True) + _EPSILON) for f in (first, second)]
    return (unit[0] - unit[1]).square()


def _read_heads(name: str, path: Path, channels: Sequence[int]) -> list[torch.Tensor]:
    remedy = f"wanted are LPIPS's v0.1 linear heads, weights/v0.1/{_HEADS[name]} in the Python package `lpips`"
    if not path.is_file():
        raise FileNotFoundError(f"no LPIPS heads at {path}: {remedy}")
    state = read_state_dict(path)
    heads = []
    for layer, size in enumerate(channels):
        key = f"lin{layer}.model.1.weight"
        if key not in state or list(state[key].shape) != [1, size, 1, 1]:
            got = list(state[key].shape) if key in state else "nothing"
            raise ValueError(f"`heads_path` must hold {key} [1, {size}, 1, 1], got {got} in {path}: {remedy}")
        check_finite({key: state[key]}, path, "heads_path", f": {remedy}")
        heads.append(state[key].flatten().float())
    return heads

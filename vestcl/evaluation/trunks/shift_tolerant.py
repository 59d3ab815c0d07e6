"""The shift-tolerant AlexNet of ST-LPIPS: what `vestcl.evaluation.trunks.trunks` is to LPIPS, with anti-aliased
strides.

Against AlexNet: the first convolution has stride 1, and each of its strides of 2 is a blur and a stride (`BlurPool`);
pooling takes the maximum at every pixel. Reflected borders are as wide as the blur on either side.
"""

from pathlib import Path
from typing import Final

import torch
from torch import nn
from torch.nn import functional

from vestcl.models.weights_file import check_finite, misfit, read_state_dict
from vestcl.shapes import check

#: Channels of the five maps, each after a ReLU.
CHANNELS: Final = (64, 192, 384, 256, 256)

#: The smallest image side that leaves the blurs something to reflect.
SIDE: Final = 21

#: Layers of ``features`` whose output is a map: all ReLUs.
_TAPS: Final = (2, 6, 10, 12, 14)

#: (1, 2, 1) / 4 in both directions, and by how much borders are reflected, px.
_BLUR: Final = (0.25, 0.5, 0.25)
_REFLECTED: Final = 2

#: Layers that the public file groups: "net.slice2.5.weight" is "features.5.weight" here.
_SLICES: Final = {0: 1, 1: 1, 4: 2, 5: 2, 8: 3, 9: 3, 11: 4, 13: 5}

#: The public file's names of what images are shifted and divided by.
_SCALING: Final = {"scaling_layer.shift": "shift", "scaling_layer.scale": "scale"}


class BlurPool(nn.Module):
    """Every second pixel of the image blurred by (1, 2, 1) / 4 both ways, after reflecting 2 px at its borders.

    Source: Zhang, Making Convolutional Networks Shift-Invariant Again, 2019.
    """

    filt: torch.Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        row = torch.tensor(_BLUR)
        self.register_buffer("filt", (row[:, None] * row).expand(channels, 1, -1, -1).clone())

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[B, C, H, W] -> [B, C, floor((H + 3) / 2), floor((W + 3) / 2)]; H and W 3 or more; differentiable."""
        padded = functional.pad(features, (_REFLECTED,) * 4, mode="reflect")
        return functional.conv2d(padded, self.filt, stride=2, groups=features.shape[1])


class ShiftTolerantTrunk(nn.Module):
    """The maps that ST-LPIPS compares, relu1 to relu5, with random weights; `load_shift_tolerant` reads them.

    Source: Ghildyal, Liu, Shift-tolerant Perceptual Similarity Metric, ECCV 2022.
    """

    shift: torch.Tensor
    scale: torch.Tensor
    channels = CHANNELS

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(*_layers())
        self.register_buffer("shift", torch.zeros(1, 3, 1, 1))
        self.register_buffer("scale", torch.ones(1, 3, 1, 1))

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        """(2 x - 1 - shift) / scale, then the maps from the finest to the coarsest.

        Args:
            image: [B, 3, H, W] in [0, 1], RGB; H and W 21 or more.

        Returns:
            The maps [B, C_l, H_l, W_l]; differentiable in the image and, unless they are frozen, the weights.

        Raises:
            ValueError: another shape, or too small.
        """
        sizes = check(image=(image, "B 3 H W"))
        if min(sizes["H"], sizes["W"]) < SIDE:
            raise ValueError(f"`image` must have {SIDE} rows and columns or more, got {sizes['H']} x {sizes['W']}")
        features, maps = (2 * image - 1 - self.shift) / self.scale, []
        for index, layer in enumerate(self.features):
            features = layer(features)
            if index in _TAPS:
                maps.append(features)
        return maps


def load_shift_tolerant(path: Path, remedy: str) -> tuple[ShiftTolerantTrunk, list[torch.Tensor]]:
    """The trunk and the heads [C_l] of ST-LPIPS from their public file, frozen, in evaluation mode.

    Args:
        path: alex_shift_tolerant.pth, or the same in safetensors. Read without running any code from it.
        remedy: how to get the file, for errors.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a damaged file, weights that are missing, of another shape, or not finite.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no ST-LPIPS weights at {path}: {remedy}")
    trunk, names = ShiftTolerantTrunk(), dict(_SCALING)
    for index, group in _SLICES.items():
        names |= {f"net.slice{group}.{index}.{kind}": f"features.{index}.{kind}" for kind in ("weight", "bias", "filt")}
    state = {names.get(name, name): value for name, value in read_state_dict(path).items()}
    heads = {f"lin{layer}.model.1.weight": torch.empty(1, size, 1, 1) for layer, size in enumerate(CHANNELS)}
    if why := misfit(state, trunk.state_dict() | heads):
        raise ValueError(f"`path` must hold ST-LPIPS's AlexNet weights; {path} {why}: {remedy}")
    check_finite(state, path, remedy=f": {remedy}")
    trunk.load_state_dict({name: value for name, value in state.items() if name not in heads})
    return trunk.requires_grad_(False).eval(), [state[name].flatten().float() for name in heads]


def _layers() -> list[nn.Module]:
    return [
        *(nn.Conv2d(3, 64, 11, padding=2), BlurPool(64), nn.ReLU()),
        *(nn.MaxPool2d(3, stride=1), BlurPool(64), nn.Conv2d(64, 192, 5, padding=2), nn.ReLU()),
        *(nn.MaxPool2d(3, stride=1), BlurPool(192), nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    ]

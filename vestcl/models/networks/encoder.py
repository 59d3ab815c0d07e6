"""From an image to features: a ResNet34 without its last layer, and a decoder up to a quarter of the size."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import torch
from torch import nn
from torch.nn import functional

from vestcl.models.config import ENCODER_GROUP, EncoderConfig
from vestcl.models.networks.group_norm import Normalise, own
from vestcl.models.networks.layers import channels_last, group_norm, side_by_side, upsample
from vestcl.models.weights_file import check_finite, read_state_dict, some_of
from vestcl.shapes import check

#: Pixels of the image a cell of the features, in both directions.
STRIDE: Final = 4

#: Pixels of the image a cell of the coarsest features.
COARSEST: Final = 16

#: Mean and standard deviation of ImageNet's images (RGB in [0, 1]), which its networks expect at 0 and 1.
IMAGENET_MEAN: Final = (0.485, 0.456, 0.406)
IMAGENET_STD: Final = (0.229, 0.224, 0.225)


class Encoder(nn.Module):
    """image -> features at a quarter of its size; one network for frames and inpainted backgrounds.

    A 7x7 stem of stride 2 and a max-pool of stride 2, then residual layers at H/4, H/8 and H/16. The decoder doubles
    the last, conv, joins it with layer 2, conv; doubles that, conv, joins it with layer 1, conv; and ends in a 1x1
    conv. Its other convs are 3x3 with a bias, GroupNorm and ELU; those of the trunk have no bias, and ReLU. Names
    are ResNet34's, but for norm instead of bn.

    Source: SPEC section 3.4; 3D Moments (CVPR 2022), whose batch statistics are GroupNorm here.
    """

    def __init__(self, config: EncoderConfig | None = None) -> None:
        super().__init__()
        config = config or EncoderConfig()
        first, second, third = config.widths
        self.features = config.features
        self.conv1 = nn.Conv2d(3, first, 7, stride=2, padding=3, bias=False)
        self.norm1 = group_norm(first, ENCODER_GROUP)
        self.layer1 = _layer(first, first, config.blocks[0], stride=1)
        self.layer2 = _layer(first, second, config.blocks[1], stride=2)
        self.layer3 = _layer(second, third, config.blocks[2], stride=2)
        middle, fine = config.decoder
        self.up2 = _decoder_conv(third, middle)
        self.join2 = _decoder_conv(middle + second, middle)
        self.up1 = _decoder_conv(middle, fine)
        self.join1 = _decoder_conv(fine + first, config.features)
        self.out = nn.Conv2d(config.features, config.features, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, image: torch.Tensor, norm: Normalise = own) -> torch.Tensor:
        """Encode a batch of images.

        Args:
            image: [B, 3, H, W] RGB in [0, 1], of any size.
            norm: by which statistics it is normalised: `vestcl.models.networks.group_norm`.

        Returns:
            features [B, features, ceil(H / 4), ceil(W / 4)]; differentiable. `upsample_features` brings them to H x W.

        Raises:
            ValueError: ``image`` is not floating point [B, 3, H, W].
        """
        check(image=(image, "B 3 H W"))
        stem = functional.relu(norm(self.norm1, self.conv1(normalise(image))))
        at4 = self.layer1(functional.max_pool2d(stem, 3, stride=2, padding=1), norm)
        at8 = self.layer2(at4, norm)
        at16 = self.layer3(at8, norm)
        up = self.up2(upsample(at16, 2, *at8.shape[-2:]), norm)
        up = self.join2(side_by_side([up, at8]), norm)
        up = self.up1(upsample(up, 2, *at4.shape[-2:]), norm)
        up = self.join1(side_by_side([up, at4]), norm)
        return self.out(up)


class ResidualBlock(nn.Module):
    """ReLU(x + norm(conv(ReLU(norm(conv(x)))))), with a 1x1 conv on x where its shape changes: ResNet's basic block."""

    def __init__(self, channels_in: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels, 3, stride=stride, padding=1, bias=False)
        self.norm1 = group_norm(channels, ENCODER_GROUP)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm2 = group_norm(channels, ENCODER_GROUP)
        self.downsample: nn.Module = Chain()
        if stride != 1 or channels_in != channels:
            convolution = nn.Conv2d(channels_in, channels, 1, stride=stride, bias=False)
            self.downsample = Chain(convolution, group_norm(channels, ENCODER_GROUP))

    def forward(self, x: torch.Tensor, norm: Normalise = own) -> torch.Tensor:
        """[B, channels_in, H, W] -> [B, channels, ceil(H / stride), ceil(W / stride)]."""
        inner = functional.relu(norm(self.norm1, self.conv1(x)))
        return functional.relu(norm(self.norm2, self.conv2(inner)) + self.downsample(x, norm))


class Chain(nn.Sequential):
    """Modules one after the other, given how to normalise."""

    def forward(self, x: torch.Tensor, norm: Normalise = own) -> torch.Tensor:
        """x through all of them."""
        for module in self:
            if isinstance(module, nn.GroupNorm):
                x = norm(module, x)
            else:
                x = module(x, norm) if isinstance(module, ResidualBlock) else module(x)
        return x


def reach(config: EncoderConfig) -> int:
    """Pixels beyond a cell of the features that they may depend on, brought to the image's size.

    A 3x3 conv on cells of s pixels reaches s further, the stem's 7x7 one 3; bilinear enlarging reaches a coarse cell.
    """
    first, second, third = (2 * blocks for blocks in config.blocks)
    trunk = 3 + 2 + 4 * first + (4 + 8 * (second - 1)) + (8 + 16 * (third - 1))
    return trunk + (16 + 8 + 8) + (8 + 4 + 4) + STRIDE


def upsample_features(features: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Bilinear from the encoder's grid to the image's; cell k covers pixels 4k to 4k + 3.

    Args:
        features: [B, C, ceil(height / 4), ceil(width / 4)], or anything else on that grid.
        height: rows of the image.
        width: columns of the image.

    Returns:
        [B, C, height, width]; differentiable.

    Raises:
        ValueError: ``features`` are not on the grid of such an image.
    """
    check(features=(features, f"B C {-(-height // STRIDE)} {-(-width // STRIDE)}"))
    return upsample(features, STRIDE, height, width)


def load_resnet34(encoder: Encoder, path: Path | str) -> None:
    """Start the stem and layers 1 to 3 from a public ResNet34 that was trained on ImageNet.

    Weight and bias of each BatchNorm become those of the GroupNorm in its place. Its running statistics are ignored:
    GroupNorm takes each image's own. So this is where to train from, and not ResNet34's features. ``layer4`` and
    ``fc`` are ignored, too; the decoder stays as it is. If anything is wrong, nothing is changed.

    Args:
        encoder: with the trunk of `EncoderConfig`'s defaults.
        path: a state dict with torchvision's names (conv1.weight, bn1.weight, layer1.0.conv1.weight, ...) as
            ``torch.save`` wrote it, or in safetensors. Read without running any code from it.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is damaged, lacks weights, or has some of other shapes or some that are not finite.
    """
    state = read_state_dict(path)
    wanted = {_resnet_name(name): parameter for name, parameter in _trunk(encoder)}
    if missing := [name for name in wanted if name not in state]:
        raise ValueError(f"`path` must hold ResNet34's weights; {path} lacks {some_of(missing)}")
    shapes = {name: (list(parameter.shape), list(state[name].shape)) for name, parameter in wanted.items()}
    if wrong := [f"{name} {want}, got {got}" for name, (want, got) in shapes.items() if want != got]:
        raise ValueError(f"`path` must hold weights of the encoder's shapes; {path}: wanted {some_of(wrong)}")
    check_finite({name: state[name] for name in wanted}, path)
    with torch.no_grad():
        for name, parameter in wanted.items():
            parameter.copy_(state[name])


def normalise(image: torch.Tensor) -> torch.Tensor:
    """(image - mean) / standard deviation of ImageNet, [B, 3, H, W]."""
    mean, std = (image.new_tensor(numbers)[:, None, None] for numbers in (IMAGENET_MEAN, IMAGENET_STD))
    return channels_last((image - mean) / std)


def _layer(channels_in: int, channels: int, blocks: int, stride: int) -> Chain:
    first = ResidualBlock(channels_in, channels, stride)
    return Chain(first, *(ResidualBlock(channels, channels, 1) for _ in range(blocks - 1)))


def _decoder_conv(channels_in: int, channels: int) -> Chain:
    return Chain(nn.Conv2d(channels_in, channels, 3, padding=1), group_norm(channels, ENCODER_GROUP), nn.ELU())


def _trunk(encoder: Encoder) -> Iterator[tuple[str, nn.Parameter]]:
    parts = ("conv1.", "norm1.", "layer1.", "layer2.", "layer3.")
    return ((name, parameter) for name, parameter in encoder.named_parameters() if name.startswith(parts))


def _resnet_name(name: str) -> str:
    return name.replace("norm", "bn")

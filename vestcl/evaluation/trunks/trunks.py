"""The convolutional trunks of public ImageNet classifiers: feature maps that distances between images are taken in.

Layers and names are torchvision's (``features.0.weight``, ...), so its state dicts load as they are; torchvision is
not needed. A trunk ends at the last map that is taken and knows how images are normalised for its weights.
"""

import zipfile
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import nn

from vestcl.models.weights_file import check_finite, read_state_dict, unwrapped
from vestcl.shapes import check


class Normalisation(NamedTuple):
    """(gain x + offset - shift) / scale of an RGB image x in [0, 1]; shift and scale by channel, after the flip."""

    shift: tuple[float, float, float]
    scale: tuple[float, float, float]
    gain: float = 1.0
    offset: float = 0.0
    bgr: bool = False


#: torchvision's classifiers: mean and standard deviation of ImageNet.
IMAGENET: Final = Normalisation((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))

#: Caffe's classifiers: 0 to 255, blue first, minus the mean colour.
CAFFE: Final = Normalisation((104.0, 117.0, 123.0), (1.0, 1.0, 1.0), gain=255.0, bgr=True)


#: Channels of VGG's five blocks, and the convolutions in each as far as they are needed.
_VGG_WIDTHS: Final = (64, 128, 256, 512, 512)
_VGG_BLOCKS: Final = {"vgg16": (2, 2, 3, 3, 3), "vgg19": (2, 2, 4, 4, 1)}

#: Channels out of SqueezeNet's fire2 to fire9, within them (squeezed), and after which fires it pools.
_FIRE_WIDTHS: Final = (128, 128, 256, 256, 384, 384, 512, 512)
_FIRE_SQUEEZED: Final = (16, 16, 32, 32, 48, 48, 64, 64)
_POOLED_FIRES: Final = (4, 8)


class _Recipe(NamedTuple):
    taps: tuple[int, ...]
    """Layers of ``features`` whose output is taken."""
    channels: tuple[int, ...]
    """Channels of each map taken."""
    side: int
    """The smallest image side that leaves a pixel on the last map."""
    file: str
    """The public weights, as torchvision calls them."""


_RECIPES: Final = {
    "alexnet": _Recipe((1, 4, 7, 9, 11), (64, 192, 384, 256, 256), 31, "alexnet-owt-7be5be79.pth"),
    "vgg16": _Recipe((3, 8, 15, 22, 29), _VGG_WIDTHS, 16, "vgg16-397923af.pth"),
    "vgg19": _Recipe((1, 6, 11, 20, 29), _VGG_WIDTHS, 16, "vgg19-dcbb9e9d.pth"),
    "squeezenet1_0": _Recipe((3, 4, 5, 7, 8, 9, 10, 12), _FIRE_WIDTHS, 21, "squeezenet1_0-b66bff10.pth"),
}

#: Names in the Caffe export of SqueezeNet -> torchvision's, within a fire module.
_CAFFE_FIRE: Final = {"conv1x1_1": "squeeze", "conv1x1_2": "expand1x1", "conv3x3_2": "expand3x3"}


class Fire(nn.Module):
    """cat[relu(W1 s), relu(W3 * s)] with s = relu(W x): SqueezeNet's block, 1x1 down, then 1x1 and 3x3 up."""

    def __init__(self, channels_in: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels_in, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded // 2, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded // 2, 3, padding=1)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[B, channels_in, H, W] -> [B, expanded, H, W]; differentiable."""
        squeezed = self.squeeze(features).relu()
        return torch.cat([self.expand1x1(squeezed), self.expand3x3(squeezed)], dim=1).relu()


class Trunk(nn.Module):
    """The layers of a classifier up to the last map that is taken, with random weights; `load_trunk` reads them.

    Maps taken, all after their ReLU: "alexnet" relu1 to relu5 (64, 192, 384, 256, 256 channels); "vgg16" relu1_2,
    2_2, 3_3, 4_3, 5_3 and "vgg19" relu1_1, 2_1, 3_1, 4_1, 5_1 (64, 128, 256, 512, 512); "squeezenet1_0" fire2 to
    fire9 (128, 128, 256, 256, 384, 384, 512, 512).

    Args:
        name: one of these four.
        normalisation: what the weights expect.

    Raises:
        ValueError: another name.

    Source: Krizhevsky, One weird trick for parallelizing CNNs, 2014 (AlexNet); Simonyan, Zisserman, Very Deep
    Convolutional Networks, 2015 (VGG, configurations D and E); Iandola et al., SqueezeNet, 2016 (version 1.0).
    """

    shift: torch.Tensor
    scale: torch.Tensor

    def __init__(self, name: str, normalisation: Normalisation = IMAGENET) -> None:
        super().__init__()
        if name not in _RECIPES:
            raise ValueError(f"`name` must be one of {', '.join(_RECIPES)}, got {name!r}")
        self.name = name
        self.channels = _RECIPES[name].channels
        self.normalisation = normalisation
        self.features = _features(name)
        self.register_buffer("shift", torch.tensor(normalisation.shift)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(normalisation.scale)[:, None, None], persistent=False)

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        """Normalise, then the maps from the finest to the coarsest.

        Args:
            image: [B, 3, H, W] in [0, 1], RGB; H and W 31 or more for AlexNet, 16 for VGG, 21 for SqueezeNet.

        Returns:
            The maps [B, C_l, H_l, W_l]; differentiable in the image and, unless `load_trunk` froze them, the weights.

        Raises:
            ValueError: another shape, or too small.
        """
        sizes = check(image=(image, "B 3 H W"))
        recipe = _RECIPES[self.name]
        if min(sizes["H"], sizes["W"]) < recipe.side:
            got = f"{sizes['H']} x {sizes['W']}"
            raise ValueError(f"`image` must have {recipe.side} rows and columns or more for {self.name}, got {got}")
        features = self.normalise(image)
        maps = []
        for index, layer in enumerate(self.features):
            features = layer(features)
            if index in recipe.taps:
                maps.append(features)
        return maps

    def normalise(self, image: torch.Tensor) -> torch.Tensor:
        """The first layer's input: see `Normalisation`. [B, 3, H, W] -> the same; differentiable."""
        gain, offset = self.normalisation.gain, self.normalisation.offset
        return (gain * (image.flip(1) if self.normalisation.bgr else image) + offset - self.shift) / self.scale


def load_trunk(name: str, path: Path | str, normalisation: Normalisation | None = None) -> Trunk:
    """A trunk with the weights of a public classifier, frozen, in evaluation mode.

    Args:
        name: "alexnet", "vgg16", "vgg19" or "squeezenet1_0".
        path: torchvision's state dict as ``torch.save`` wrote it, or the same in safetensors; the classifier's own
            weights may be there and are left out. For "squeezenet1_0" also the Caffe model as ``.npz`` (conv1.weight,
            fire2.conv1x1_1.weight, ...). Read without running any code from it.
        normalisation: what the weights expect; None is CAFFE for an ``.npz`` and IMAGENET for the others.

    Returns:
        The trunk; gradients flow through it to the image only.

    Raises:
        FileNotFoundError: no such file; the message says how to make it.
        ValueError: another name, a damaged file, weights that are missing, of another shape, or not finite.
    """
    path = Path(path)
    is_caffe = path.suffix == ".npz"
    trunk = Trunk(name, normalisation or (CAFFE if is_caffe else IMAGENET))
    if not path.is_file():
        raise FileNotFoundError(f"no {name} weights at {path}: {_remedy(name)}")
    state = _read_caffe(path) if is_caffe else read_state_dict(path)
    wanted = {key: value.shape for key, value in trunk.state_dict().items()}
    if missing := [key for key in wanted if key not in state]:
        raise ValueError(f"`path` must hold {name}'s weights; {path} lacks {missing[0]}: {_remedy(name)}")
    if wrong := [key for key, shape in wanted.items() if state[key].shape != shape]:
        key, want, got = wrong[0], list(wanted[wrong[0]]), list(state[wrong[0]].shape)
        raise ValueError(f"`path` must hold {name}'s weights; in {path} {key} is {got} and not {want}: {_remedy(name)}")
    weights = {key: state[key] for key in wanted}
    check_finite(weights, path, remedy=f": {_remedy(name)}")
    trunk.load_state_dict(weights)
    return trunk.requires_grad_(False).eval()


def _remedy(name: str) -> str:
    model = f"torchvision.models.{name}(weights='IMAGENET1K_V1')"
    return (
        f"wanted is the public ImageNet model {_RECIPES[name].file}; where torchvision is installed, "
        f"`torch.save({model}.state_dict(), PATH)` writes it"
    )


def _features(name: str) -> nn.Sequential:
    if name in _VGG_BLOCKS:
        return nn.Sequential(*_vgg(_VGG_BLOCKS[name]))
    return nn.Sequential(*(_alexnet() if name == "alexnet" else _squeezenet()))


def _alexnet() -> list[nn.Module]:
    return [
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, stride=2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, stride=2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    ]


def _vgg(blocks: tuple[int, ...]) -> list[nn.Module]:
    layers: list[nn.Module] = []
    channels = 3
    for convolutions, width in zip(blocks, _VGG_WIDTHS, strict=True):
        layers += [nn.MaxPool2d(2)] if layers else []
        for _ in range(convolutions):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
    return layers


def _squeezenet() -> list[nn.Module]:
    layers: list[nn.Module] = [nn.Conv2d(3, 96, 7, stride=2), nn.ReLU(), _ceil_pool()]
    widths = pairwise((96, *_FIRE_WIDTHS))
    for number, (squeezed, (before, after)) in enumerate(zip(_FIRE_SQUEEZED, widths, strict=True), start=2):
        layers.append(Fire(before, squeezed, after))
        layers += [_ceil_pool()] if number in _POOLED_FIRES else []
    return layers


def _ceil_pool() -> nn.MaxPool2d:
    return nn.MaxPool2d(3, stride=2, ceil_mode=True)


def _read_caffe(path: Path) -> dict[str, torch.Tensor]:
    """The Caffe export of SqueezeNet under torchvision's names."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            state: dict[str, Any] = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
    except (AttributeError, EOFError, OSError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"`path` must be an .npz file of weights, got {path} ({error})") from error
    state = unwrapped(state, path)
    modules = [str(i) for i, layer in enumerate(_squeezenet()) if isinstance(layer, Fire)]
    names = {"conv1": "0"}
    for fire, index in enumerate(modules, start=2):
        names |= {f"fire{fire}.{theirs}": f"{index}.{ours}" for theirs, ours in _CAFFE_FIRE.items()}
    stems = ((name, *name.rpartition(".")[::2]) for name in state)
    return {f"features.{names[stem]}.{kind}": state[name] for name, stem, kind in stems if stem in names}

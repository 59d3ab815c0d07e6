"""vestcl.evaluation.perceptual against plain re-computations on random weights, and the real SqueezeNet where it is at
hand."""

from collections.abc import Callable
from copy import deepcopy
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import skimage.data
import torch

from vestcl.evaluation.perceptual import LPIPS_SCALING, Lpips, VggLoss, squeeze_distance
from vestcl.evaluation.trunks.trunks import IMAGENET, Normalisation, Trunk, load_trunk

SQUEEZENET = Path(__file__).resolve().parents[3] / "shared" / "data" / "squeezenet" / "squeezenet_v1.0.npz"

#: Layers of ``features`` whose outputs are compared.
TAPS = {
    "alexnet": (1, 4, 7, 9, 11),
    "vgg16": (3, 8, 15, 22, 29),
    "vgg19": (1, 6, 11, 20, 29),
    "squeezenet1_0": (3, 4, 5, 7, 8, 9, 10, 12),
}

Distance = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


@lru_cache
def random_trunk(name: str, normalisation: Normalisation = IMAGENET) -> Trunk:
    """Random weights that keep the signal alive through all layers; a copy is to be changed, not this."""
    trunk = Trunk(name, normalisation)
    for parameter in trunk.parameters():
        if parameter.ndim > 1:
            torch.nn.init.kaiming_normal_(parameter)
    return trunk.requires_grad_(False)


def random_lpips(name: str) -> Lpips:
    trunk = random_trunk(name, LPIPS_SCALING)
    return Lpips(trunk, [torch.rand(channels) for channels in trunk.channels])


def distance(name: str, dtype: torch.dtype = torch.float32) -> Distance:
    """One of the three, on random weights."""
    if name == "lpips":
        return deepcopy(random_lpips("alexnet")).to(dtype)
    trunk = deepcopy(random_trunk("vgg19" if name == "vgg_loss" else "squeezenet1_0")).to(dtype)
    return VggLoss(trunk) if name == "vgg_loss" else lambda *pair: squeeze_distance(*pair, trunk)


def image_pair(name: str) -> tuple[torch.Tensor, torch.Tensor]:
    """A little larger than the network's smallest image."""
    side = {"squeeze": 24, "lpips": 32}.get(name, 16)
    return torch.rand(2, 3, side, side + 4), torch.rand(2, 3, side, side + 4)


def features_of(trunk: Trunk, first_input: torch.Tensor) -> list[np.ndarray]:
    """The maps [B, C, h, w] of what has been normalised already."""
    outputs = []
    for layer in trunk.features:
        first_input = layer(first_input)
        outputs.append(first_input)
    return [outputs[tap].numpy().astype(np.float64) for tap in TAPS[trunk.name]]


def unit(features: np.ndarray) -> np.ndarray:
    """f / (|f| + 1e-10) over channels."""
    return features / (np.sqrt((features**2).sum(axis=1, keepdims=True)) + 1e-10)


@pytest.mark.parametrize("name", ["alexnet", "vgg16"])
def test_lpips_like_a_plain_computation(name: str) -> None:
    lpips, pair = random_lpips(name), image_pair("lpips")
    shift, scale = (torch.tensor(v)[:, None, None] for v in ([-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]))
    maps = [features_of(lpips.trunk, (2 * image - 1 - shift) / scale) for image in pair]
    wanted = sum(
        (head.numpy()[:, None, None] * (unit(f) - unit(g)) ** 2).sum(axis=1).mean(axis=(1, 2))
        for f, g, head in zip(*maps, lpips.heads, strict=True)
    )
    got = lpips(*pair)
    assert got.shape == (2,) and got.tolist() == pytest.approx(list(wanted), rel=1e-5)


def test_squeeze_distance_like_a_plain_computation() -> None:
    trunk, pair = random_trunk("squeezenet1_0"), image_pair("squeeze")
    maps = [features_of(trunk, trunk.normalise(image)) for image in pair]
    wanted = sum(((unit(f) - unit(g)) ** 2).sum(axis=1).mean(axis=(1, 2)) for f, g in zip(*maps, strict=True))
    got = squeeze_distance(*pair, trunk)
    assert got.shape == (2,) and got.tolist() == pytest.approx(list(wanted), rel=1e-5)


def test_vgg_loss_like_a_plain_computation() -> None:
    trunk, pair = random_trunk("vgg19"), image_pair("vgg_loss")
    maps = [features_of(trunk, trunk.normalise(image)) for image in pair]
    weights = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1)
    wanted = sum(w * np.abs(f - g).mean(axis=(1, 2, 3)) for w, f, g in zip(weights, *maps, strict=True))
    got = VggLoss(trunk)(*pair)
    assert got.shape == (2,) and got.tolist() == pytest.approx(list(wanted), rel=1e-5)


@pytest.mark.parametrize("name", ["lpips", "squeeze", "vgg_loss"])
def test_equal_images_symmetry_and_noise(name: str) -> None:
    measure, (image, noise) = distance(name), image_pair(name)
    assert measure(image, image).tolist() == [0, 0]
    torch.testing.assert_close(measure(image, noise), measure(noise, image))
    by_strength = torch.stack([measure(image + strength * (noise - 0.5), image) for strength in (0.01, 0.1, 0.5)])
    assert (by_strength[0] > 0).all() and (by_strength.diff(dim=0) > 0).all()


@pytest.mark.parametrize("name", ["lpips", "squeeze", "vgg_loss"])
def test_gradients_are_the_slopes(name: str) -> None:
    """In float64 and along the gradient only: gradcheck would run the networks thousands of times."""
    measure = distance(name, torch.float64)
    pair = [image.double().requires_grad_() for image in image_pair(name)]
    grads = torch.autograd.grad(measure(*pair).sum(), pair)
    steps = [1e-6 * grad / grad.norm() for grad in grads]
    with torch.no_grad():
        ahead, behind = (measure(*(i + sign * s for i, s in zip(pair, steps, strict=True))).sum() for sign in (1, -1))
    slope = 2 * sum(float((g * s).sum()) for g, s in zip(grads, steps, strict=True))
    assert float(ahead - behind) == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize("name", ["lpips", "squeeze", "vgg_loss"])
def test_no_gradient_is_lost_where_all_features_are_dead(name: str) -> None:
    measure, image = distance(name), torch.zeros(1, 3, 35, 40, requires_grad=True)
    measure(image, torch.full_like(image, 0.5)).sum().backward()
    assert image.grad is not None and image.grad.isfinite().all()


def test_lpips_loads_its_two_files(tmp_path: Path) -> None:
    wanted = random_lpips("alexnet")
    torch.save(wanted.trunk.state_dict(), tmp_path / "alexnet.pth")
    heads = {f"lin{i}.model.1.weight": head[None, :, None, None] for i, head in enumerate(wanted.heads)}
    torch.save(heads, tmp_path / "alex.pth")
    lpips = Lpips.load("alexnet", tmp_path / "alexnet.pth", tmp_path / "alex.pth")
    pair = image_pair("lpips")
    assert torch.equal(lpips(*pair), wanted(*pair))
    assert not any(parameter.requires_grad for parameter in lpips.parameters())
    torch.save(heads | {"lin3.model.1.weight": torch.ones(1, 512, 1, 1)}, tmp_path / "vgg.pth")
    with pytest.raises(ValueError, match=r"hold lin3.model.1.weight \[1, 256, 1, 1\], got \[1, 512, 1, 1\] in .*vgg"):
        Lpips.load("alexnet", tmp_path / "alexnet.pth", tmp_path / "vgg.pth")
    with pytest.raises(ValueError, match=r"`heads_path` must hold lin0.model.1.weight .*, got nothing in .*alexnet.pt"):
        Lpips.load("alexnet", tmp_path / "alexnet.pth", tmp_path / "alexnet.pth")
    with pytest.raises(FileNotFoundError, match=r"no LPIPS heads at .*none.pth: .*weights/v0.1/alex.pth .* `lpips`"):
        Lpips.load("alexnet", tmp_path / "alexnet.pth", tmp_path / "none.pth")


def test_vgg_loss_loads_its_file(tmp_path: Path) -> None:
    trunk = Trunk("vgg19").requires_grad_(False)
    for parameter in trunk.parameters():
        parameter.fill_(0.01)
    shapes = {name: value.shape for name, value in trunk.state_dict().items()}
    torch.save({name: torch.tensor(0.01).expand(shape) for name, shape in shapes.items()}, tmp_path / "vgg19.pth")
    pair = image_pair("vgg_loss")
    assert torch.equal(VggLoss.load(tmp_path / "vgg19.pth")(*pair), VggLoss(trunk)(*pair))
    with pytest.raises(FileNotFoundError, match=r"no vgg19 weights at .*: wanted is the public ImageNet model vgg19-"):
        VggLoss.load(tmp_path / "none.pth")


def test_refuses(tmp_path: Path) -> None:
    image = torch.rand(1, 3, 35, 40)
    with torch.device("meta"):
        alexnet, scaled = Trunk("alexnet"), Trunk("alexnet", LPIPS_SCALING)
    with pytest.raises(ValueError, match="`trunk` must be squeezenet1_0, got alexnet"):
        squeeze_distance(image, image, alexnet)
    with pytest.raises(ValueError, match="`trunk` must be vgg19, got alexnet"):
        VggLoss(alexnet)
    with pytest.raises(ValueError, match=r"`trunk` must be alexnet or vgg16 with LPIPS_SCALING, got alexnet with Norm"):
        Lpips(alexnet, [])
    with pytest.raises(ValueError, match=r"`heads` must be of sizes \[64, 192, 384, 256, 256\] for alexnet, got \[64"):
        Lpips(scaled, [torch.rand(64)])
    with pytest.raises(ValueError, match="`name` must be alexnet or vgg16, got 'vgg19'"):
        Lpips.load("vgg19", tmp_path, tmp_path)
    with pytest.raises(ValueError, match=r"`target` must be \[1, 3, 35, 40\], got \[1, 3, 35, 35\]"):
        squeeze_distance(image, image[..., :35], random_trunk("squeezenet1_0"))


@pytest.mark.skipif(not SQUEEZENET.is_file(), reason="the SqueezeNet weights of ../shared/data are absent")
def test_the_real_squeezenet_ranks_damage() -> None:
    """A photo shifted by a pixel is nearer to itself than blurred, and blurred nearer than another photo."""
    trunk = load_trunk("squeezenet1_0", SQUEEZENET)
    photos = [
        np.ascontiguousarray(photo[100:240, 100:260]) for photo in (skimage.data.chelsea(), skimage.data.coffee())
    ]
    cat, cup = (torch.from_numpy(photo).permute(2, 0, 1)[None].float() / 255 for photo in photos)
    small = torch.nn.functional.avg_pool2d(cat, 4)
    blurred = torch.nn.functional.interpolate(small, scale_factor=4, mode="bilinear")
    with torch.no_grad():
        itself, shifted, blur, other = (
            float(squeeze_distance(image, cat, trunk)) for image in (cat, cat.roll(1, dims=-1), blurred, cup)
        )
    assert itself == 0 < shifted < blur < other < 16

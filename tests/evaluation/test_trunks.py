"""vestcl.evaluation.trunks.trunks: shapes and names of the public networks, plain re-computations, files good and
bad."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skimage.data
import torch
from torch import nn
from torch.nn import functional

from vestcl.evaluation.trunks import trunks
from vestcl.evaluation.trunks.trunks import CAFFE, IMAGENET, Normalisation, Trunk, load_trunk

SQUEEZENET = Path(__file__).resolve().parents[3] / "shared" / "data" / "squeezenet" / "squeezenet_v1.0.npz"

NAMES = ["alexnet", "vgg16", "vgg19", "squeezenet1_0"]

#: An image a little larger than each network's smallest.
SMALL = {"alexnet": 40, "vgg16": 20, "vgg19": 20, "squeezenet1_0": 40}

#: Convolutions of VGG, as numbered in torchvision's ``features``, block by block.
VGG_CONVOLUTIONS = {
    "vgg16": ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28)),
    "vgg19": ((0, 2), (5, 7), (10, 12, 14, 16), (19, 21, 23, 25), (28,)),
}


def write_safetensors(path: Path, state: dict[str, torch.Tensor]) -> None:
    content, header = b"", {}
    for name, value in state.items():
        data = value.numpy().tobytes()
        header[name] = {"dtype": "F32", "shape": [*value.shape], "data_offsets": [len(content), len(content + data)]}
        content += data
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + content)


def public(trunk: Trunk) -> dict[str, torch.Tensor]:
    """The trunk's weights as a public file has them, with a classifier's next to them."""
    return {**trunk.state_dict(), "classifier.1.weight": torch.zeros(3, 3), "features.99.bias": torch.zeros(1)}


def caffe(state: dict[str, torch.Tensor]) -> dict[str, np.ndarray]:
    """SqueezeNet's weights under the names of the Caffe export."""
    fires = {index: fire for fire, index in enumerate((3, 4, 5, 7, 8, 9, 10, 12), start=2)}
    parts = {"squeeze": "conv1x1_1", "expand1x1": "conv1x1_2", "expand3x3": "conv3x3_2"}
    arrays = {}
    for name, value in state.items():
        _, index, *part, kind = name.split(".")
        stem = f"fire{fires[int(index)]}.{parts[part[0]]}" if part else "conv1"
        arrays[f"{stem}.{kind}"] = value.numpy()
    return arrays


@pytest.mark.parametrize(
    ("name", "parameters", "shapes"),
    [
        ("alexnet", 2_469_696, [(64, 55), (192, 27), (384, 13), (256, 13), (256, 13)]),
        ("vgg16", 14_714_688, [(64, 224), (128, 112), (256, 56), (512, 28), (512, 14)]),
        ("vgg19", 20_024_384 - 3 * 2_359_808, [(64, 224), (128, 112), (256, 56), (512, 28), (512, 14)]),
        (
            "squeezenet1_0",
            1_248_424 - 513_000,
            [(128, 54), (128, 54), (256, 54), (256, 27), (384, 27), (384, 27), (512, 27), (512, 13)],
        ),
    ],
)
def test_sizes_of_the_public_networks(name: str, parameters: int, shapes: list[tuple[int, int]]) -> None:
    with torch.device("meta"):  # shapes only
        trunk = Trunk(name)
        maps = trunk(torch.empty(2, 3, 224, 224))
    assert sum(p.numel() for p in trunk.parameters()) == parameters
    assert [tuple(m.shape) for m in maps] == [(2, channels, side, side) for channels, side in shapes]
    assert trunk.channels == tuple(channels for channels, _ in shapes)


def conv(trunk: Trunk, stem: str, features: torch.Tensor, **options: int) -> torch.Tensor:
    state = trunk.state_dict()
    return functional.conv2d(features, state[f"features.{stem}.weight"], state[f"features.{stem}.bias"], **options)


def alexnet_plainly(trunk: Trunk, x: torch.Tensor) -> list[torch.Tensor]:
    first = conv(trunk, "0", x, stride=4, padding=2).relu()
    second = conv(trunk, "3", functional.max_pool2d(first, 3, 2), padding=2).relu()
    third = conv(trunk, "6", functional.max_pool2d(second, 3, 2), padding=1).relu()
    fourth = conv(trunk, "8", third, padding=1).relu()
    return [first, second, third, fourth, conv(trunk, "10", fourth, padding=1).relu()]


def vgg_plainly(trunk: Trunk, x: torch.Tensor) -> list[torch.Tensor]:
    maps = []
    for block, numbers in enumerate(VGG_CONVOLUTIONS[trunk.name]):
        x = functional.max_pool2d(x, 2) if block else x
        outputs = []
        for number in numbers:
            x = conv(trunk, str(number), x, padding=1).relu()
            outputs.append(x)
        maps.append(outputs[-1 if trunk.name == "vgg16" else 0])
    return maps


def squeezenet_plainly(trunk: Trunk, x: torch.Tensor) -> list[torch.Tensor]:
    x = functional.max_pool2d(conv(trunk, "0", x, stride=2).relu(), 3, 2, ceil_mode=True)
    maps = []
    for index in (3, 4, 5, 7, 8, 9, 10, 12):
        x = functional.max_pool2d(x, 3, 2, ceil_mode=True) if index in (7, 12) else x
        squeezed = conv(trunk, f"{index}.squeeze", x).relu()
        wide = conv(trunk, f"{index}.expand1x1", squeezed), conv(trunk, f"{index}.expand3x3", squeezed, padding=1)
        x = torch.cat(wide, dim=1).relu()
        maps.append(x)
    return maps


@pytest.mark.parametrize("name", NAMES)
def test_maps_like_a_plain_computation(name: str) -> None:
    trunk, image = Trunk(name), torch.rand(2, 3, SMALL[name], SMALL[name] + 7)
    mean, deviation = (torch.tensor(v)[:, None, None] for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    plainly = {"alexnet": alexnet_plainly, "squeezenet1_0": squeezenet_plainly}.get(name, vgg_plainly)
    with torch.no_grad():
        wanted = plainly(trunk, (image - mean) / deviation)
        torch.testing.assert_close(trunk(image), wanted)


def test_normalisation_by_hand() -> None:
    image = torch.tensor([0.0, 0.5, 1.0])[None, :, None, None]
    assert Trunk("alexnet", CAFFE).normalise(image).flatten().tolist() == [255 - 104, 127.5 - 117, -123]
    by_hand = [-0.485 / 0.229, (0.5 - 0.456) / 0.224, (1 - 0.406) / 0.225]
    assert Trunk("alexnet", IMAGENET).normalise(image).flatten().tolist() == pytest.approx(by_hand)
    own = Normalisation((1.0, 2.0, 3.0), (1.0, 2.0, 4.0), gain=10.0, offset=1.0)
    assert Trunk("alexnet", own).normalise(image).flatten().tolist() == [0, 2, 2]


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_loads_a_public_state_dict(tmp_path: Path, suffix: str) -> None:
    source, path = Trunk("squeezenet1_0"), tmp_path / f"weights{suffix}"
    (torch.save if suffix == ".pth" else lambda state, to: write_safetensors(to, state))(public(source), path)
    trunk = load_trunk("squeezenet1_0", path)
    assert trunk.normalisation == IMAGENET and not trunk.training
    image = torch.rand(1, 3, 32, 32, requires_grad=True)
    maps = trunk(image)
    torch.testing.assert_close(maps, source(image))
    assert not any(p.requires_grad for p in trunk.parameters())
    sum(m.sum() for m in maps).backward()
    assert image.grad is not None and image.grad.abs().sum() > 0


def test_loads_the_caffe_export(tmp_path: Path) -> None:
    source = Trunk("squeezenet1_0", CAFFE)
    np.savez(tmp_path / "weights.npz", **caffe(source.state_dict()), conv_final=np.zeros(3, np.float32))
    trunk = load_trunk("squeezenet1_0", tmp_path / "weights.npz")
    image = torch.rand(1, 3, 32, 32)
    with torch.no_grad():
        torch.testing.assert_close(trunk(image), source(image))


@pytest.mark.parametrize("name", NAMES)
def test_the_smallest_image(name: str) -> None:
    side = {"alexnet": 31, "vgg16": 16, "vgg19": 16, "squeezenet1_0": 21}[name]
    with torch.device("meta"):
        trunk = Trunk(name)
        assert min(trunk(torch.empty(1, 3, side, side))[-1].shape) == 1
        with pytest.raises(ValueError, match=f"`image` must have {side} rows and columns or more for {name}, got"):
            trunk(torch.empty(1, 3, side, side - 1))
        with pytest.raises(ValueError, match=r"`image` must be \[B, 3, H, W\]"):
            trunk(torch.empty(1, 1, side, side))


@pytest.mark.parametrize("name", NAMES)
def test_a_missing_file_says_what_to_get(name: str, tmp_path: Path) -> None:
    message = rf"no {name} weights at .*absent.pth: .*{name}.*\.pth; .*torchvision.models.{name}\(weights='IMAGENET1K"
    with pytest.raises(FileNotFoundError, match=message):
        load_trunk(name, tmp_path / "absent.pth")


def test_refuses_other_weights(tmp_path: Path) -> None:
    path = tmp_path / "weights.pth"
    for other, wanted, message in [
        ("vgg16", "vgg19", "must hold vgg19's weights; .* lacks features.16.weight: wanted is .*vgg19-"),
        ("vgg19", "vgg16", "must hold vgg16's weights; .* lacks features.17.weight"),
        ("squeezenet1_0", "alexnet", "must hold alexnet's weights; .* lacks features.3.weight"),
    ]:
        with torch.device("meta"):
            names = Trunk(other).state_dict()
        torch.save({name: torch.zeros(1).expand(value.shape) for name, value in names.items()}, path)
        with pytest.raises(ValueError, match=message):
            load_trunk(wanted, path)
    state = public(Trunk("squeezenet1_0"))
    torch.save(state | {"features.0.weight": torch.zeros(64, 3, 3, 3)}, path)  # as in version 1.1
    with pytest.raises(ValueError, match=r"features.0.weight is \[64, 3, 3, 3\] and not \[96, 3, 7, 7\]: wanted is"):
        load_trunk("squeezenet1_0", path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 and then nothing", b"no weights at all"])
@pytest.mark.parametrize("suffix", [".pth", ".npz", ".safetensors"])
def test_refuses_damaged_files(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"weights{suffix}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="`path` must "):
        load_trunk("squeezenet1_0", path)


def test_runs_no_code_from_a_file(tmp_path: Path) -> None:
    torch.save(nn.Linear(2, 2), tmp_path / "module.pth")
    np.savez(tmp_path / "objects.npz", conv1=np.array([{}], dtype=object))
    for path in tmp_path.iterdir():
        with pytest.raises(ValueError, match="`path` must be"):
            load_trunk("squeezenet1_0", path)


def test_refuses_another_name() -> None:
    with pytest.raises(ValueError, match="`name` must be one of alexnet, vgg16, vgg19, squeezenet1_0, got 'resnet'"):
        Trunk("resnet")


@pytest.mark.skipif(not SQUEEZENET.is_file(), reason="the SqueezeNet weights of ../shared/data are absent")
@pytest.mark.parametrize(("picture", "classes"), [("chelsea", {281, 282, 285}), ("coffee", {504, 967, 968})])
def test_the_real_squeezenet_sees_cats_and_cups(picture: str, classes: set[int]) -> None:
    """ImageNet's tabby, tiger cat, Egyptian cat; mug, espresso, cup: trunk, names and normalisation are all right."""
    trunk = load_trunk("squeezenet1_0", SQUEEZENET)
    photo: Any = getattr(skimage.data, picture)()
    image = torch.from_numpy(photo).permute(2, 0, 1)[None].float() / 255
    image = functional.interpolate(image[..., :, 40:-40], (227, 227), mode="area")
    with np.load(SQUEEZENET) as arrays, torch.no_grad():
        weight, bias = (torch.from_numpy(arrays[f"conv_final.{kind}"]) for kind in ("weight", "bias"))
        logits = functional.conv2d(trunk(image)[-1], weight, bias).relu().mean(dim=(2, 3))
    assert int(logits.argmax()) in classes
    assert trunk.normalisation == trunks.CAFFE

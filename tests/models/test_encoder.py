"""vestcl.models.networks.encoder: its size, its shapes, and public weights that load into it."""

import json
from pathlib import Path

import pytest
import torch
from tolerances import assert_close
from torch.nn import functional

from vestcl.models import Encoder, configuration, load_resnet34, upsample_features
from vestcl.models.config import EncoderConfig
from vestcl.models.networks.encoder import normalise

SMALL = EncoderConfig(widths=(8, 12, 16), blocks=(2, 1, 1), decoder=(12, 8), features=4)


def resnet34() -> dict[str, torch.Tensor]:
    """Random weights under the public names; what must be ignored takes no memory."""
    state = {"conv1.weight": torch.randn(64, 3, 7, 7) * 0.1, **batch_norm("bn1", 64)}
    channels = 64
    for layer, (width, blocks) in enumerate([(64, 3), (128, 4), (256, 6), (512, 3)], start=1):
        for block in range(blocks):
            name = f"layer{layer}.{block}"
            convs = {"conv1": (channels, 3, "bn1"), "conv2": (width, 3, "bn2"), "downsample.0": (channels, 1, "")}
            for conv, (inputs, kernel, norm) in convs.items():
                shape = (width, inputs, kernel, kernel)
                if conv == "downsample.0" and (block or layer == 1):
                    continue
                ignored = torch.zeros(()).expand(shape) if layer == 4 else None
                scale = (2 / (inputs * kernel**2)) ** 0.5
                state[f"{name}.{conv}.weight"] = torch.randn(shape) * scale if ignored is None else ignored
                state |= batch_norm(f"{name}.{norm or 'downsample.1'}", width)
            channels = width
    return state | {"fc.weight": torch.zeros(()).expand(1000, 512), "fc.bias": torch.zeros(1000)}


def batch_norm(name: str, channels: int) -> dict[str, torch.Tensor]:
    return {
        f"{name}.weight": torch.rand(channels) + 0.5,
        f"{name}.bias": torch.randn(channels) * 0.1,
        f"{name}.running_mean": torch.full((channels,), torch.nan),
        f"{name}.running_var": torch.full((channels,), torch.nan),
        f"{name}.num_batches_tracked": torch.tensor(7),
    }


def trunk_by_name(image: torch.Tensor, state: dict[str, torch.Tensor]) -> torch.Tensor:
    """ResNet34 up to layer 3 written out on the public names, GroupNorm of 16 channels a group for BatchNorm."""

    def norm(x: torch.Tensor, name: str) -> torch.Tensor:
        return functional.group_norm(x, x.shape[1] // 16, state[f"{name}.weight"], state[f"{name}.bias"])

    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    x = (image - mean[:, None, None]) / std[:, None, None]
    x = norm(functional.conv2d(x, state["conv1.weight"], stride=2, padding=3), "bn1").relu()
    x = functional.max_pool2d(x, 3, 2, 1)
    for layer, blocks in ((1, 3), (2, 4), (3, 6)):
        for block in range(blocks):
            name, stride = f"layer{layer}.{block}", 2 if layer > 1 and block == 0 else 1
            y = functional.conv2d(x, state[f"{name}.conv1.weight"], stride=stride, padding=1)
            y = functional.conv2d(norm(y, f"{name}.bn1").relu(), state[f"{name}.conv2.weight"], padding=1)
            if stride == 2:
                down = functional.conv2d(x, state[f"{name}.downsample.0.weight"], stride=2)
                x = norm(down, f"{name}.downsample.1")
            x = (norm(y, f"{name}.bn2") + x).relu()
    return x


def write_safetensors(path: Path, state: dict[str, torch.Tensor]) -> None:
    names = {torch.float32: "F32", torch.int64: "I64"}
    header: dict[str, object] = {"__metadata__": {"format": "pt"}}
    content = b""
    for name, tensor in state.items():
        raw = tensor.contiguous().numpy().tobytes()
        span = [len(content), len(content) + len(raw)]
        header[name] = {"dtype": names[tensor.dtype], "shape": list(tensor.shape), "data_offsets": span}
        content += raw
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + content)


def test_number_of_parameters() -> None:
    assert sum(parameter.numel() for parameter in Encoder().parameters()) == 8_872_832


@pytest.mark.parametrize(("height", "width"), [(32, 48), (37, 53), (30, 42), (5, 3), (1, 1)])
def test_any_size(height: int, width: int) -> None:
    features = Encoder(SMALL)(torch.rand(2, 3, height, width))
    assert features.shape == (2, 4, -(-height // 4), -(-width // 4)) and features.isfinite().all()
    assert upsample_features(features, height, width).shape == (2, 4, height, width)


@pytest.mark.parametrize("name", ["vest-paper", "vest-s"])
def test_features_of_the_named_models(name: str) -> None:
    config = configuration(name).encoder
    assert Encoder(config)(torch.rand(1, 3, 32, 64)).shape == (1, config.features, 8, 16)


def test_images_do_not_see_each_other() -> None:
    encoder, images = Encoder(SMALL), torch.rand(3, 3, 32, 48)
    single = torch.cat([encoder(image[None]) for image in images])
    assert torch.allclose(encoder(images), single, atol=1e-5)


def test_float64() -> None:
    encoder, image = Encoder(SMALL), torch.rand(1, 3, 33, 47)
    features = encoder(image)
    exact = encoder.double()(image.double())
    assert exact.dtype == torch.float64
    assert torch.allclose(features, exact.float(), atol=1e-4)


def test_a_gradient_for_every_tensor() -> None:
    encoder, image = Encoder(SMALL).double(), torch.rand(2, 3, 40, 56, dtype=torch.float64, requires_grad=True)
    features = encoder(image)
    (features * torch.randn_like(features)).sum().backward()
    for name, tensor in [("image", image), *encoder.named_parameters()]:
        assert tensor.grad is not None and tensor.grad.abs().max() > 1e-9, name


def test_upsampling_by_hand() -> None:
    """Cells are 4 pixels wide, with their values at 2 and 6: in between a ramp by eighths at pixel centres."""
    ramp = upsample_features(torch.tensor([[[[0.0, 1.0]]]]), 3, 7)
    assert ramp[0, 0].tolist() == [[0, 0, 0.125, 0.375, 0.625, 0.875, 1]] * 3


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (torch.rand(3, 8, 8), r"`image` must be \[B, 3, H, W\], got \[3, 8, 8\]"),
        (torch.rand(1, 4, 8, 8), r"`image` must be \[B, 3, H, W\], got \[1, 4, 8, 8\]"),
        (torch.rand(1, 3, 0, 8), r"`image` must be \[B, 3, H, W\], got \[1, 3, 0, 8\]"),
        (torch.zeros(1, 3, 8, 8, dtype=torch.uint8), "`image` must be a floating-point tensor, got torch.uint8"),
        (None, "`image` must be a floating-point tensor, got NoneType"),
    ],
)
def test_refuses_images(image: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Encoder(SMALL)(image)


def test_refuses_features_of_another_grid() -> None:
    with pytest.raises(ValueError, match=r"`features` must be \[B, C, 3, 2\], got \[1, 4, 2, 2\]"):
        upsample_features(torch.rand(1, 4, 2, 2), 9, 8)


@pytest.fixture(scope="module")
def public(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, torch.Tensor], Path]:
    state, path = resnet34(), tmp_path_factory.mktemp("public") / "resnet34.pth"
    torch.save(state, path)
    return state, path


def test_public_weights_load(public: tuple[dict[str, torch.Tensor], Path]) -> None:
    """The loaded trunk computes what ResNet34 does, written out on the file's own names."""
    state, path = public
    encoder, image = Encoder(), torch.rand(1, 3, 64, 96)
    decoder = {name: tensor.clone() for name, tensor in encoder.state_dict().items() if name.startswith(("up", "join"))}
    load_resnet34(encoder, str(path))
    stem = functional.relu(encoder.norm1(encoder.conv1(normalise(image))))
    loaded = encoder.layer3(encoder.layer2(encoder.layer1(functional.max_pool2d(stem, 3, 2, 1))))
    assert torch.allclose(loaded, trunk_by_name(image, state), atol=1e-3)
    assert encoder(image).isfinite().all()
    assert all(torch.equal(encoder.state_dict()[name], tensor) for name, tensor in decoder.items())


def test_public_weights_load_from_safetensors(public: tuple[dict[str, torch.Tensor], Path], tmp_path: Path) -> None:
    state = {name: tensor for name, tensor in public[0].items() if not name.startswith(("layer4", "fc"))}
    write_safetensors(tmp_path / "resnet34.safetensors", state)
    encoder = Encoder().double()
    load_resnet34(encoder, tmp_path / "resnet34.safetensors")
    for ours, theirs in {
        "conv1.weight": "conv1.weight",
        "norm1.bias": "bn1.bias",
        "layer1.2.conv2.weight": "layer1.2.conv2.weight",
        "layer3.0.downsample.0.weight": "layer3.0.downsample.0.weight",
        "layer3.0.downsample.1.weight": "layer3.0.downsample.1.weight",
        "layer3.5.norm2.weight": "layer3.5.bn2.weight",
    }.items():
        assert_close(encoder.state_dict()[ours], state[theirs], ours)


def test_a_wrong_file_changes_nothing(public: tuple[dict[str, torch.Tensor], Path], tmp_path: Path) -> None:
    path, encoder = tmp_path / "weights.pth", Encoder()
    before = {name: tensor.clone() for name, tensor in encoder.state_dict().items()}
    gone = ("layer3.5.bn2.bias", "layer3.5.bn2.weight", "layer3.4.bn2.bias", "layer3.4.bn2.weight")
    torch.save({name: tensor for name, tensor in public[0].items() if name not in gone}, path)
    with pytest.raises(ValueError, match=r"lacks layer3.4.bn2.weight; layer3.4.bn2.bias; .*; and 1 more"):
        load_resnet34(encoder, path)
    torch.save(public[0] | {"layer2.0.conv1.weight": torch.zeros(128, 64, 1, 1)}, path)
    with pytest.raises(ValueError, match=r"wanted layer2.0.conv1.weight \[128, 64, 3, 3\], got \[128, 64, 1, 1\]$"):
        load_resnet34(encoder, path)
    assert all(torch.equal(encoder.state_dict()[name], tensor) for name, tensor in before.items())


def test_a_smaller_trunk_takes_no_public_weights(public: tuple[dict[str, torch.Tensor], Path]) -> None:
    with pytest.raises(ValueError, match=r"wanted conv1.weight \[8, 3, 7, 7\], got \[64, 3, 7, 7\]"):
        load_resnet34(Encoder(SMALL), public[1])


class _Code:
    def __reduce__(self) -> tuple[object, ...]:
        return exec, ("raise SystemExit('code of a weight file was run')",)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"state_dict": {}, "epoch": 3}, r"must hold a state dict \(name -> tensor\), got \['dict', 'int'\]"),
        ([torch.zeros(1)], r"must hold a state dict \(name -> tensor\), got list"),
        ({"conv1.weight": _Code()}, "must be a PyTorch file that holds only tensors"),
    ],
)
def test_refuses_other_files_of_torch(content: object, message: str, tmp_path: Path) -> None:
    torch.save(content, tmp_path / "weights.pth")
    with pytest.raises(ValueError, match=message):
        load_resnet34(Encoder(), tmp_path / "weights.pth")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("weights.pth", b"", "must be a PyTorch file that holds only tensors"),
        ("weights.pth", b"no weights at all", "must be a PyTorch file that holds only tensors"),
        ("weights.safetensors", b"", "must be a safetensors file of weights"),
        ("weights.safetensors", b"\x02\0\0\0\0\0\0\0[]", "must be a safetensors file of weights"),
        ("weights.safetensors", b"\xff\xff\xff\xff\0\0\0\0{}", "must be a safetensors file of weights"),
    ],
)
def test_refuses_damaged_files(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        load_resnet34(Encoder(), tmp_path / name)


@pytest.mark.parametrize("name", ["weights.pth", "weights.safetensors"])
def test_refuses_files_that_were_cut_short(name: str, tmp_path: Path) -> None:
    path, state = tmp_path / name, {"conv1.weight": torch.zeros(64, 3, 7, 7)}
    write_safetensors(path, state) if path.suffix == ".safetensors" else torch.save(state, path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="`path` must be a"):
        load_resnet34(Encoder(SMALL), path)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    for name in ("weights.pth", "weights.safetensors"):
        with pytest.raises(FileNotFoundError):
            load_resnet34(Encoder(), tmp_path / name)

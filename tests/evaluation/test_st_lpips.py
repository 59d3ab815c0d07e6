"""ST-LPIPS: its network by a plain computation, where its weights are found, and published values on a real frame."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import tyro
from data_files import real
from safetensors.torch import save_file
from st_lpips_weights import public_state
from torch.nn import functional

from vestcl.cli import main as cli
from vestcl.evaluation import st_lpips
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.scores import distance
from vestcl.evaluation.trunks.shift_tolerant import CHANNELS, SIDE, BlurPool, ShiftTolerantTrunk
from vestcl.io import read_image


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "alex_shift_tolerant.pth"
    torch.save(public_state(), path)
    return path


def plainly(state: dict[str, torch.Tensor], image: torch.Tensor) -> list[torch.Tensor]:
    """The maps, layer by layer."""

    def conv(name: str, x: torch.Tensor, padding: int) -> torch.Tensor:
        return functional.conv2d(x, state[f"{name}.weight"], state[f"{name}.bias"], padding=padding)

    def blurred(name: str, x: torch.Tensor) -> torch.Tensor:
        x = functional.pad(x, (2, 2, 2, 2), mode="reflect")
        rows = (x[..., :-2, :] + 2 * x[..., 1:-1, :] + x[..., 2:, :]) / 4
        return ((rows[..., :-2] + 2 * rows[..., 1:-1] + rows[..., 2:]) / 4)[..., ::2, ::2]

    def pooled(x: torch.Tensor) -> torch.Tensor:
        return functional.max_pool2d(x, 3, stride=1)

    x = (2 * image - 1 - state["scaling_layer.shift"]) / state["scaling_layer.scale"]
    maps = [blurred("net.slice1.1", conv("net.slice1.0", x, 2)).relu()]
    maps.append(conv("net.slice2.5", blurred("net.slice2.4", pooled(maps[-1])), 2).relu())
    maps.append(conv("net.slice3.9", blurred("net.slice3.8", pooled(maps[-1])), 1).relu())
    maps.append(conv("net.slice4.11", maps[-1], 1).relu())
    return [*maps, conv("net.slice5.13", maps[-1], 1).relu()]


def test_the_distance_by_a_plain_computation(weights: Path) -> None:
    state, (first, second) = public_state(), torch.rand(2, 2, 3, 40, 56)
    wanted = torch.zeros(2)
    for layer, (f, g) in enumerate(zip(plainly(state, first), plainly(state, second), strict=True)):
        f, g = (x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10) for x in (f, g))
        head = state[f"lin{layer}.model.1.weight"]
        wanted += (head * (f - g).square()).sum(1).mean(dim=(1, 2))
    metric = StLpips.load(weights)
    torch.testing.assert_close(metric(first, second), wanted, rtol=1e-4, atol=1e-6)
    assert (metric(first, first) == 0).all()


def test_it_is_differentiable_in_both_images_and_frozen(weights: Path) -> None:
    metric = StLpips.load(weights)
    first, second = (torch.rand(1, 3, SIDE, SIDE + 3, requires_grad=True) for _ in range(2))
    metric(first, second).sum().backward()
    for image in (first, second):
        assert image.grad is not None and image.grad.isfinite().all() and image.grad.abs().sum() > 0
    assert not any(parameter.requires_grad for parameter in metric.parameters())


def test_a_blur_by_hand() -> None:
    """A point of 16 at (1, 2). Kept are rows and columns -1, 1, 3, 5; row -1 is row 1 again, columns -2 and 6 are 2."""
    image = torch.zeros(1, 1, 5, 5)
    image[0, 0, 1, 2] = 16
    wanted = torch.tensor([2.0, 2, 0, 0])[:, None].expand(4, 4)
    got = BlurPool(1)(image)[0, 0]
    assert got.shape == (4, 4)
    torch.testing.assert_close(got, wanted)


def test_images_that_are_too_small_or_of_other_shapes() -> None:
    trunk = ShiftTolerantTrunk().eval()
    assert [m.shape[1] for m in trunk(torch.rand(1, 3, SIDE, SIDE))] == list(CHANNELS)
    with pytest.raises(ValueError, match="`image` must have 21 rows and columns or more, got 20 x 40"):
        trunk(torch.rand(1, 3, 20, 40))
    with pytest.raises(ValueError, match="`image` must be"):
        trunk(torch.rand(3, 40, 40))
    with pytest.raises(ValueError, match=r"`heads` must be of sizes .* for ST-LPIPS"):
        StLpips(trunk, [torch.rand(3)])


# ---------------------------------------------------------------- files


def test_safetensors_are_the_same(weights: Path, tmp_path: Path) -> None:
    save_file(public_state(), tmp_path / "weights.safetensors")
    pair = torch.rand(2, 1, 3, 32, 32)
    assert float(StLpips.load(weights)(*pair)) == float(StLpips.load(tmp_path / "weights.safetensors")(*pair))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.pop("lin2.model.1.weight"), "lacks lin2.model.1.weight"),
        (lambda state: state.pop("net.slice2.5.bias"), "lacks features.5.bias"),
        (lambda state: state.update({"net.slice1.0.weight": torch.zeros(64, 3, 3, 3)}), r"not \[64, 3, 11, 11\]"),
        (lambda state: state.update({"features.0.weight": torch.zeros(1)}), r"features.0.weight is \[1\]"),
        (lambda state: state["net.slice3.9.weight"].fill_(torch.nan), "must hold finite weights, got NaN"),
    ],
)
def test_files_that_hold_something_else(
    change: Callable[[dict[str, torch.Tensor]], object], message: str, tmp_path: Path
) -> None:
    state = public_state()
    change(state)
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(ValueError, match=message):
        StLpips.load(tmp_path / "w.pth")


def test_a_file_that_is_not_there() -> None:
    with pytest.raises(FileNotFoundError, match=r"no ST-LPIPS weights at nowhere.pth: `pip install .*stlpips-pytorch`"):
        StLpips.load("nowhere.pth")


class Installed(SimpleNamespace):
    """A file as importlib.metadata lists it."""

    def locate(self) -> Path:
        return self.path


def test_weights_inside_an_installed_package(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def files(package: str) -> list[Installed]:
        assert package == "stlpips-pytorch"
        return [Installed(name=name, path=weights.with_name(name)) for name in ("stlpips.py", weights.name)]

    monkeypatch.setattr("importlib.metadata.files", files)
    assert st_lpips.find_weights("installed") == weights
    pair = torch.rand(2, 1, 3, 32, 32)
    assert float(StLpips.load()(*pair)) == float(StLpips.load(weights)(*pair))
    weights.unlink()
    with pytest.raises(FileNotFoundError, match=r"is installed, but without alex_shift_tolerant\.pth"):
        StLpips.load()


def test_a_package_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(st_lpips, "PACKAGE", "no-such-package-as-this")
    with pytest.raises(FileNotFoundError, match="is not installed: `pip install"):
        StLpips.load()


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["clip"], None),
        (["clip", "--st-lpips"], "installed"),
        (["clip", "--st-lpips", "--compare"], "installed"),
        (["clip", "--st-lpips", "weights.pth"], Path("weights.pth")),
        (["--st-lpips", "weights.pth", "--out", "o", "clip"], Path("weights.pth")),
    ],
)
def test_the_option_takes_a_file_or_none(arguments: list[str], wanted: object) -> None:
    assert tyro.cli(cli.Forecast, args=arguments).st_lpips == wanted


# ---------------------------------------------------------------- real weights and frames


def test_the_real_metric_on_a_real_frame() -> None:
    """Frame 10 of kitti_clip against others and damage: the values that come with the data."""
    metric = StLpips.load(real("models/alex_shift_tolerant.pth"))
    folder = real("kitti_clip/image")
    frame = {i: torch.from_numpy(np.ascontiguousarray(read_image(folder / f"{i:06}.jpg")))[None] for i in (10, 11, 15)}
    pixels = frame[10][0].permute(1, 2, 0).numpy()
    blur = {px: torch.from_numpy(cv2.GaussianBlur(pixels, (0, 0), px)).permute(2, 0, 1)[None] for px in (1, 3)}
    noise = torch.randn(frame[10].shape, generator=torch.Generator().manual_seed(0)) * 0.05  # 0.1 of -1 ... 1
    others = {
        "itself": (frame[10], 0),
        "next": (frame[11], 0.096),
        "five on": (frame[15], 0.274),
        "blur 1": (blur[1], 0.149),
        "blur 3": (blur[3], 0.571),
        "noise": (frame[10] + noise, 0.280),
        "shift 1": (frame[10].roll(1, -1), 0.003),
        "shift 8": (frame[10].roll(8, -1), 0.071),
    }
    heads = list(metric.heads)
    with torch.no_grad():
        maps = metric.trunk(frame[10].contiguous(memory_format=torch.channels_last))
        for name, (image, value) in others.items():
            other = maps if value == 0 else metric.trunk(image.contiguous(memory_format=torch.channels_last))
            tolerance = 0.004 if name == "noise" else 0.0006
            assert float(distance(other, maps, heads)) == pytest.approx(value, abs=tolerance), name

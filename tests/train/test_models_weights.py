"""Weights from files: what is not finite is refused, wrappers' prefixes are stripped, in every file that is read."""

import functools
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from checkpoint_states import state_of
from forecaster_scenes import TINY
from safetensors.torch import save_file
from torch import nn

from train.run import checkpoint
from vestcl.cli import main as cli
from vestcl.evaluation.perceptual import Lpips, VggLoss
from vestcl.evaluation.trunks.trunks import Trunk, load_trunk
from vestcl.models.checkpoint import read_checkpoint, write_checkpoint
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.fast import accelerate
from vestcl.models.networks.encoder import Encoder, load_resnet34
from vestcl.models.weights_file import read_state_dict, unwrapped

State = dict[str, torch.Tensor]

#: What wrappers make of a name: DistributedDataParallel, torch.compile, both, of the whole and of a part.
WRAPPED: dict[str, Callable[[str], str]] = {
    "module": lambda name: f"module.{name}",
    "compiled": lambda name: f"_orig_mod.{name}",
    "module of compiled": lambda name: f"module._orig_mod.{name}",
    "compiled module": lambda name: f"_orig_mod.module.{name}",
    "twice": lambda name: f"module.module.{name}",
    "a part": lambda name: ".".join([*name.split(".")[:1], "_orig_mod", *name.split(".")[1:]]),
    "a part of the whole": lambda name: ".".join(["module", *name.split(".")[:1], "module", *name.split(".")[1:]]),
}


def forecaster() -> Forecaster:
    torch.manual_seed(0)
    return Forecaster(TINY)


def same(one: Mapping[str, torch.Tensor], other: Mapping[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


# ---------------------------------------------------------------- files of every kind, each with a way to load it


def write_npz(path: Path, state: State) -> None:
    np.savez(path, **{name: tensor.numpy() for name, tensor in state.items()})


def of_forecaster(state: State, folder: Path) -> State:
    write_checkpoint(folder / "m.safetensors", TINY, state)
    return Forecaster.from_pretrained(folder / "m.safetensors").state_dict()


def of_checkpoint(state: State, folder: Path) -> State:
    write_checkpoint(folder / "m.safetensors", TINY, state)
    return read_checkpoint(folder / "m.safetensors")[1]


def of_trunk(state: State, folder: Path) -> State:
    torch.save(state, folder / "m.pth")
    return load_trunk("squeezenet1_0", folder / "m.pth").state_dict()


def of_trunk_in_safetensors(state: State, folder: Path) -> State:
    save_file(state, folder / "m.safetensors")
    return load_trunk("squeezenet1_0", folder / "m.safetensors").state_dict()


def of_vgg_loss(state: State, folder: Path) -> State:
    torch.save(state, folder / "m.pth")
    return VggLoss.load(folder / "m.pth").trunk.state_dict()


def of_resnet(state: State, folder: Path) -> State:
    torch.save(state, folder / "m.pth")
    encoder = Encoder()
    load_resnet34(encoder, folder / "m.pth")
    return {name: tensor for name, tensor in encoder.state_dict().items() if not name.startswith(("up", "join", "out"))}


def of_heads(state: State, folder: Path) -> State:
    torch.save(constant(lambda: Trunk("alexnet")), folder / "alexnet.pth")
    torch.save(state, folder / "m.pth")
    heads = Lpips.load("alexnet", folder / "alexnet.pth", folder / "m.pth").heads
    return {f"lin{layer}.model.1.weight": head[None, :, None, None] for layer, head in enumerate(heads)}


def squeezenet() -> State:
    torch.manual_seed(0)
    return dict(Trunk("squeezenet1_0").state_dict())


def constant(make: Callable[[], nn.Module]) -> State:
    """A number for all weights of a large network: it takes no time to make or to write."""
    with torch.device("meta"):
        shapes = {name: tensor.shape for name, tensor in make().state_dict().items()}
    return {name: torch.full((1,), 0.01).expand(shape) for name, shape in shapes.items()}


def vgg19() -> State:
    return constant(lambda: Trunk("vgg19"))


@functools.cache
def resnet() -> State:
    """The encoder's names."""
    state = Encoder().state_dict()
    return {name: tensor for name, tensor in state.items() if not name.startswith(("up", "join", "out"))}


def heads() -> State:
    sizes = enumerate((64, 192, 384, 256, 256))
    return {f"lin{layer}.model.1.weight": torch.rand(1, size, 1, 1) for layer, size in sizes}


Load = Callable[[State, Path], State]
KINDS: dict[str, tuple[Callable[[], State], Load]] = {
    "forecaster": (lambda: dict(forecaster().state_dict()), of_forecaster),
    "checkpoint": (lambda: dict(forecaster().state_dict()), of_checkpoint),
    "trunk": (squeezenet, of_trunk),
    "trunk, safetensors": (squeezenet, of_trunk_in_safetensors),
    "vgg loss": (vgg19, of_vgg_loss),
    "resnet34": (resnet, of_resnet),
    "lpips heads": (heads, of_heads),
}


def as_file(kind: str, state: State) -> State:
    """ResNet34's public names."""
    return {name.replace("norm", "bn"): tensor for name, tensor in state.items()} if kind == "resnet34" else state


@pytest.mark.parametrize(
    ("kind", "wrapper"),
    [*(("forecaster", wrapper) for wrapper in WRAPPED), *((kind, "module of compiled") for kind in KINDS)],
)
def test_wrapped_names(kind: str, wrapper: str, tmp_path: Path) -> None:
    make, load = KINDS[kind]
    state = make()
    wrapped = {WRAPPED[wrapper](name): tensor for name, tensor in as_file(kind, state).items()}
    assert same(load(wrapped, tmp_path), state)


@pytest.mark.parametrize(
    ("kind", "number"),
    [*(("forecaster", number) for number in (torch.inf, -torch.inf, 1e300)), *((kind, torch.nan) for kind in KINDS)],
)
def test_weights_that_are_not_finite(kind: str, number: float, tmp_path: Path) -> None:
    """1e300 is finite only in the file, of float64."""
    make, load = KINDS[kind]
    word = "infinity" if number == number else "NaN"
    state = as_file(kind, make())
    name = list(state)[-1]
    state[name] = state[name].double().clone() if number == 1e300 else state[name].clone()
    state[name].view(-1)[-1] = number
    with pytest.raises(ValueError, match=r"path` must hold finite weights, got ") as caught:
        load(state, tmp_path)
    message = str(caught.value)
    assert f"{word} in {name} (1 of {state[name].numel()} numbers) of {tmp_path}" in message and "\n" not in message


def test_half_precision_counts_as_it_is(tmp_path: Path) -> None:
    state = {name: tensor.half() for name, tensor in forecaster().state_dict().items()}
    of_forecaster(state, tmp_path)
    state["encoder.out.bias"][1] = 1e6  # beyond half's range
    with pytest.raises(ValueError, match=r"got infinity in encoder.out.bias \(1 of 4 numbers\)"):
        of_forecaster(state, tmp_path)


def test_the_caffe_export(tmp_path: Path) -> None:
    """Of SqueezeNet, in an .npz file."""
    trunk = Trunk("squeezenet1_0").state_dict()
    indices = dict(zip(range(2, 10), (3, 4, 5, 7, 8, 9, 10, 12), strict=True))
    ours = {"conv1x1_1": "squeeze", "conv1x1_2": "expand1x1", "conv3x3_2": "expand3x3"}
    state = {f"conv1.{kind}": trunk[f"features.0.{kind}"] for kind in ("weight", "bias")}
    for (fire, index), (theirs, name), kind in itertools.product(indices.items(), ours.items(), ("weight", "bias")):
        state[f"fire{fire}.{theirs}.{kind}"] = trunk[f"features.{index}.{name}.{kind}"]
    path = tmp_path / "m.npz"
    write_npz(path, {f"module.{name}": tensor for name, tensor in state.items()})
    assert same(load_trunk("squeezenet1_0", path).state_dict(), trunk)
    write_npz(path, state | {"conv1.bias": torch.full((96,), torch.nan)})
    with pytest.raises(
        ValueError, match=r"got NaN in features.0.bias \(96 of 96 numbers\) of .*: wanted is the public"
    ):
        load_trunk("squeezenet1_0", path)


def test_what_is_left_out_may_be_anything(tmp_path: Path) -> None:
    """A classifier's own head, and statistics that nothing reads."""
    state = as_file("resnet34", resnet()) | {"fc.weight": torch.full((3,), torch.nan)}
    assert same(of_resnet(state, tmp_path), resnet())


def test_a_failed_load_changes_nothing(tmp_path: Path) -> None:
    state, encoder = as_file("resnet34", resnet()), Encoder()
    before = {name: tensor.clone() for name, tensor in encoder.state_dict().items()}
    state["layer3.5.bn2.bias"] = torch.full_like(state["layer3.5.bn2.bias"], torch.inf)
    torch.save(state, tmp_path / "m.pth")
    with pytest.raises(ValueError, match="finite weights"):
        load_resnet34(encoder, tmp_path / "m.pth")
    assert same(encoder.state_dict(), before)


def test_names_that_become_one(tmp_path: Path) -> None:
    state = {"module.a": torch.ones(1), "a": torch.zeros(1), "b": torch.ones(1)}
    with pytest.raises(ValueError, match=r"must hold each weight once, got module.a and a in here"):
        unwrapped(state, "here")
    torch.save(state, tmp_path / "m.pth")
    with pytest.raises(ValueError, match=r"must hold each weight once, got module.a and a in .*m.pth"):
        read_state_dict(tmp_path / "m.pth")
    torch.save({0: torch.ones(1)}, tmp_path / "m.pth")
    with pytest.raises(ValueError, match="must hold a state dict"):
        read_state_dict(tmp_path / "m.pth")


def test_weights_of_another_model_in_one_line(tmp_path: Path) -> None:
    state = dict(forecaster().state_dict())
    cases = {
        r"lacks encoder.out.bias$": {name: t for name, t in state.items() if name != "encoder.out.bias"},
        r"has colour$": state | {"colour": torch.ones(1)},
        r"encoder.out.bias is \[5\], not \[4\]$": state | {"encoder.out.bias": torch.ones(5)},
        r"lacks .*; .*; .*; and \d+ more$": {"colour": torch.ones(1)},
    }
    for message, content in cases.items():
        with pytest.raises(ValueError, match=f"must hold the weights of tiny, got .*, which {message}") as caught:
            of_forecaster(content, tmp_path)
        assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- where files are used


class Compiled(nn.Module):
    """`torch.compile`'s names; importing what it needs takes ten seconds."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self._orig_mod = module


def test_a_compiled_part_is_accelerated_and_saved(tmp_path: Path) -> None:
    model = forecaster().eval()
    wanted = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    model.encoder = Compiled(model.encoder)  # type: ignore[assignment]
    assert any("_orig_mod" in name for name in model.state_dict())
    assert same(accelerate(model).state_dict(), wanted)
    model.save(tmp_path / "m.safetensors")
    assert same(Forecaster.load(tmp_path / "m.safetensors").state_dict(), wanted)


def test_the_command_line_refuses_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = forecaster()
    model.refine.out.weight.data[0] = torch.nan
    model.save(tmp_path / "m.safetensors")
    asked = ["forecast", "street:", "--out", str(tmp_path / "out"), "--model", str(tmp_path / "m.safetensors")]
    assert cli.main(asked) == 2
    reported = capsys.readouterr()
    text = " ".join((reported.out + reported.err).split())
    assert "must hold finite weights, got NaN in refine.out.weight" in text and "Traceback" not in text
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


def test_a_training_checkpoint_that_is_not_finite_is_damaged(tmp_path: Path) -> None:
    """The one before it is used."""
    checkpoint.save(tmp_path, state_of(1))
    broken = state_of(2)
    assert broken.ema is not None
    broken.ema["b.weight"].fill_(torch.nan)
    checkpoint.save(tmp_path, broken)
    with pytest.warns(UserWarning, match=r"damaged checkpoint, the one before it is used: .*finite weights"):
        loaded = checkpoint.load_latest(tmp_path)
    assert loaded is not None and loaded.step == 1

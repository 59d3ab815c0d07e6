"""Accelerated networks: the same forecasts, no gradients, and the plain network unchanged."""

import copy
import ctypes
import dataclasses
import platform
from collections.abc import Callable
from typing import Any, get_args

import pytest
import torch
from forecaster_scenes import ABLATIONS, SMALL, TINY, camera, pair_of, stir, turning
from torch.nn import functional

from vestcl.evaluation import metrics
from vestcl.models import ModelConfig, ObjectMotion
from vestcl.models.config import ObjectMotionConfig
from vestcl.models.forecaster import Forecaster, Step
from vestcl.models.inference import fast
from vestcl.models.inference.fast import (
    FastForecaster,
    JointConv,
    Precision,
    SharedMotionConv,
    accelerate,
    share_frames,
)
from vestcl.models.inference.options import InferenceOptions
from vestcl.models.networks.object_motion import MotionConv

#: Of images with values from 0 to 1, as `accelerate` promises.
CLOSE = 1e-4
DECIBELS = 40

#: Blocks at three scales: two of them share the frames at full size with every block's other branch.
DEEP = ObjectMotionConfig("dmvfn", scales=(4, 2, 2, 1, 1), widths=(8, 8, 8, 8, 4), detail=4)


def trained(config: ModelConfig) -> Forecaster:
    """With motion that is no longer zero."""
    torch.manual_seed(0)
    model = Forecaster(config).eval()
    return stir(model) if config.ego_motion and config.object_motion else model


def arguments(batch: int = 1, height: int = 32, width: int = 48) -> tuple[Any, ...]:
    torch.manual_seed(1)
    return *pair_of(batch, height, width), camera(batch, height, width)


def image(step: Step) -> torch.Tensor:
    return step.views[0].image


# ---------------------------------------------------------------- the same forecasts


@pytest.mark.parametrize("name", ABLATIONS)
def test_it_forecasts_what_the_plain_model_does(name: str) -> None:
    model = trained(ABLATIONS[name])
    with torch.no_grad():
        wanted = model(*arguments(batch=2))
    got = accelerate(model)(*arguments(batch=2))
    assert (image(got) - image(wanted)).abs().max() <= CLOSE
    assert torch.allclose(got.motion.objects.flow, wanted.motion.objects.flow, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("mode", ["compose", "feedback"])
def test_longer_forecasts_from_measured_motion(mode: Any) -> None:
    model, given = trained(SMALL), arguments(1, 36, 44)
    settings = {"steps": 3, "mode": mode, "prior": turning(1, 36, 44)}
    with torch.no_grad():
        wanted = model.forecast(*given, **settings)
    got = accelerate(model).forecast(*given, **settings)
    assert len(got) == len(wanted)
    for one, other in zip(got, wanted, strict=True):
        assert (image(one) - image(other)).abs().max() <= CLOSE


def test_the_current_frame_itself() -> None:
    model, (prev, cur, K), prior = trained(SMALL), arguments(), turning(1, 32, 48)
    cameras = [(torch.eye(4)[None], K)]
    with torch.no_grad():
        wanted = model.present(prev, cur, K, cameras, prior)
    got = accelerate(model).present(prev, cur, K, cameras, prior)
    assert (got[0].image - wanted[0].image).abs().max() <= CLOSE


def test_bfloat16_is_near() -> None:
    model, given, prior = trained(SMALL), arguments(1, 64, 96), turning(1, 64, 96)
    wanted, got = (image(accelerate(model, precision)(*given, prior=prior)) for precision in get_args(Precision))
    assert metrics.psnr(got, wanted).min() >= DECIBELS
    assert got.dtype == torch.float32 and not torch.equal(got, wanted)


def test_the_shipped_network() -> None:
    model, given, prior = Forecaster.from_pretrained("vest-s"), arguments(1, 64, 96), turning(1, 64, 96)
    with torch.no_grad():
        wanted = image(model(*given, prior=prior))
    assert (image(accelerate(model)(*given, prior=prior)) - wanted).abs().max() <= CLOSE
    assert metrics.psnr(image(accelerate(model, "bfloat16")(*given, prior=prior)), wanted).min() >= DECIBELS


# ---------------------------------------------------------------- the frames looked at once


def omf_arguments(features: int, height: int = 32, width: int = 48) -> list[torch.Tensor]:
    torch.manual_seed(2)
    frames = [torch.randn(2, features, height, width) for _ in range(2)]
    depths = [torch.rand(2, 1, height, width) * 20 + 1 for _ in range(2)]
    masks = [(torch.rand(2, 1, height, width) > 0.5).float() for _ in range(2)]
    return [*frames, *depths, *masks, torch.randn(2, 6, height, width)]


def object_motion(config: ObjectMotionConfig) -> ObjectMotion:
    torch.manual_seed(3)
    network = ObjectMotion(config, features=4).eval()
    for block in network.blocks:
        for parameter in block.get_submodule("out").parameters():
            torch.nn.init.normal_(parameter, std=0.1)
    return network


@pytest.mark.parametrize("size", [(32, 48), (30, 45)])
def test_blocks_that_share_the_frames_give_the_same(size: tuple[int, int]) -> None:
    network, given = object_motion(DEEP), omf_arguments(4, *size)
    shared = copy.deepcopy(network)
    assert share_frames(shared)
    with torch.no_grad():
        for blocks in (None, 2):
            wanted, got = (one(*given, blocks=blocks).flow for one in (network, shared))
            assert (wanted - given[-1]).abs().max() > 0.01
            assert torch.allclose(got, wanted, rtol=1e-5, atol=1e-5)


def test_one_convolution_a_size_and_forecast(monkeypatch: pytest.MonkeyPatch) -> None:
    network, given = object_motion(DEEP), omf_arguments(4)
    share_frames(network)
    assert sum(isinstance(module, SharedMotionConv) for module in network.modules()) == 2 * len(DEEP.scales)
    run: list[tuple[int, ...]] = []
    original: Callable[..., torch.Tensor] = functional.conv2d

    def conv2d(x: torch.Tensor, *rest: Any) -> torch.Tensor:
        run.append(tuple(x.shape[1:]))
        return original(x, *rest)

    monkeypatch.setattr(functional, "conv2d", conv2d)
    with torch.no_grad():
        for _ in range(2):
            network(*given)
    looked = [shape for shape in run if shape[0] == 2 * (4 + 2)]
    assert sorted(looked) == sorted(2 * [(12, 32 // scale, 48 // scale) for scale in set(DEEP.scales)])


def test_new_frames_are_looked_at_again() -> None:
    convs = [MotionConv(5, channels, 2).requires_grad_(False) for channels in (3, 4)]
    joint = JointConv(convs)
    one, other, flow = torch.randn(1, 5, 8, 8), torch.randn(1, 5, 8, 8), torch.randn(1, 6, 8, 8)
    shared = [SharedMotionConv(conv, joint, start) for conv, start in zip(convs, (0, 3), strict=True)]
    for frames in (one, other, one):
        for plain, conv in zip(convs, shared, strict=True):
            assert torch.allclose(conv(frames, flow), plain(frames, flow), atol=1e-5)


def test_networks_that_it_does_not_suit_stay_as_they_are() -> None:
    for name in ("routing", "paper"):
        config = ABLATIONS[name].object_motion
        assert config is not None
        network = ObjectMotion(config, features=4)
        assert not share_frames(network)
        assert not any(isinstance(module, SharedMotionConv) for module in network.modules())


def test_weights_that_are_loaded_later_count() -> None:
    first, second = trained(TINY), trained(TINY)
    with torch.no_grad():
        for parameter in second.parameters():
            parameter.mul_(1.1)
        wanted = second(*arguments()).motion.objects.flow
    quick = accelerate(first)
    quick(*arguments())
    copied = copy.deepcopy(quick)
    for one in (quick, copied):
        one.load_state_dict(second.state_dict())
        assert torch.allclose(one(*arguments()).motion.objects.flow, wanted, rtol=1e-5, atol=1e-5)


# ---------------------------------------------------------------- a copy, for inference


def test_the_plain_model_is_untouched() -> None:
    model = trained(TINY)
    model.options = InferenceOptions(min_transmittance=0.01).without_skips()
    before = copy.deepcopy(model.state_dict())
    quick = accelerate(model, "bfloat16")
    assert quick.options == dataclasses.replace(model.options, autocast="bfloat16") and quick.config == model.config
    quick(*arguments())
    assert model.options.autocast is None and all(parameter.requires_grad for parameter in model.parameters())
    assert not any(isinstance(module, SharedMotionConv) for module in model.modules())
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())
    assert all(torch.equal(before[name], value) for name, value in quick.state_dict().items())


def test_it_is_saved_as_the_plain_model(tmp_path: Any) -> None:
    model = trained(TINY)
    accelerate(model).save(tmp_path / "model.safetensors")
    loaded = Forecaster.load(tmp_path / "model.safetensors")
    assert type(loaded) is Forecaster
    with torch.no_grad():
        assert torch.equal(image(loaded(*arguments())), image(model(*arguments())))


def test_gradients_are_refused() -> None:
    quick, (prev, cur, K) = accelerate(trained(TINY)), arguments()
    step = quick(prev, cur, K)
    assert not image(step).requires_grad and step.motion.objects.candidates == []
    learning = cur._replace(image=cur.image.clone().requires_grad_())
    with pytest.raises(ValueError, match=r"`frame_cur` must not require a gradient.*use the plain model"):
        quick(prev, learning, K)
    with pytest.raises(ValueError, match="`K` must not require a gradient"):
        quick.present(prev, cur, K.requires_grad_(), [(torch.eye(4)[None], K.detach())], None)
    with torch.no_grad():
        assert torch.equal(image(quick(prev, learning, K.detach())), image(step))
    with pytest.raises(ValueError, match=r"`mode` must be False.*can't be trained"):
        quick.train()
    with pytest.raises(ValueError, match="`requires_grad` must be False"):
        quick.requires_grad_()
    assert quick.eval() is quick and quick.requires_grad_(False) is quick


def test_mistakes_are_reported() -> None:
    model = trained(dataclasses.replace(TINY, name="slow"))
    with pytest.raises(ValueError, match="`precision` must be one of float32, bfloat16, got 'float16'"):
        accelerate(model, "float16")  # type: ignore[arg-type]
    quick = accelerate(model)
    assert isinstance(quick, FastForecaster)
    with pytest.raises(ValueError, match="`model` must be a plain Forecaster, got slow accelerated already"):
        accelerate(quick)


# ---------------------------------------------------------------- the machine


@pytest.mark.parametrize(("names", "wanted"), [({"avx512_bf16": True, "avx2": True}, True), ({"avx2": True}, False)])
def test_processors_with_bfloat16(names: dict[str, bool], wanted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: names, raising=False)
    assert fast.computes_bfloat16() is wanted
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert fast.computes_bfloat16() is False


def test_freed_memory_is_kept_with_glibc_only(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[tuple[int, int]] = []

    class Library:
        @staticmethod
        def mallopt(parameter: int, value: int) -> int:
            called.append((parameter, value))
            return 1

    monkeypatch.setattr(ctypes, "CDLL", lambda name: Library)
    for library in ("musl", "glibc"):
        monkeypatch.setattr(platform, "libc_ver", lambda library=library: (library, "2.39"))
        assert fast.keep_freed_memory() is (library == "glibc")
    assert called == [(-4, 0), (-1, 2**31 - 1)]
    assert fast.keep_freed_memory(False) and called[2:] == [(-4, 65536), (-1, 128 * 1024)]

"""train.run.trainer: one stage's updates, by hand where they can be."""

import copy
import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from forecaster_scenes import OBJECTS, SMALL, stir
from test_encoder import resnet34
from torch import nn
from train_scenes import MODELS, configured, street

from train.data.windows import Batch, loader
from train.fit import window_set
from train.run import losses, trainer
from train.run.ranks import Ranks
from train.run.trainer import Average, NotANumberError, Trainer, build_model, choose_parts, learning_rate_factor
from train.settings.config import Config, Stage
from vestcl.models import Encoder, ObjectMotion, config, load_resnet34
from vestcl.models.config import RoutingConfig
from vestcl.models.forecaster import Forecaster

PARTS = ("encoder", "ego_motion", "object_motion", "refine")


@pytest.fixture(autouse=True)
def _models(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "CONFIGS", MODELS)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return street(tmp_path_factory)


def one_stage(
    cache: Path, out: Path, *, steps: int = 20, stage: dict[str, Any] | None = None, **changes: Any
) -> Config:
    named = {"name": "all", "steps": steps, "batch": 2, "learning_rate": 2e-3, **(stage or {})}
    return configured(cache, out, stages=[named], **changes)


def batch_of(settings: Config) -> Batch:
    (batch,) = loader(window_set(settings.data), 0, 2, range(1))
    return batch


def trained(settings: Config, model: Forecaster) -> Trainer:
    return Trainer(settings, settings.stages[0], model, None, Ranks())


def stirred() -> Forecaster:
    """No last layer is zero any more."""
    model = stir(Forecaster(SMALL)).train()
    nn.init.normal_(model.refine.out.weight, std=0.05)
    return model


# ---------------------------------------------------------------- learning rate, parts, weights


def test_the_learning_rate_by_hand() -> None:
    stage = Stage("all", steps=6, warm_up=2)
    factors = [learning_rate_factor(done, stage, 0.2) for done in range(7)]
    cosine = [0.2 + 0.4 * (1 + math.cos(math.pi * share)) for share in (0, 0.25, 0.5, 0.75, 1)]
    assert factors == pytest.approx([1 / 3, 2 / 3, *cosine])
    assert learning_rate_factor(6, Stage("all", steps=6), 0.0) == pytest.approx(0)


@pytest.mark.parametrize("part", PARTS)
def test_a_stage_learns_its_parts_only(part: Any) -> None:
    model = Forecaster(SMALL)
    learning = choose_parts(model, Stage("one", steps=1, train=(part,)))
    assert {id(parameter) for parameter in learning} == {id(p) for p in getattr(model, part).parameters()}
    assert all(p.requires_grad == name.startswith(part) for name, p in model.named_parameters())


def test_parts_that_a_model_lacks_do_not_count(cache: Path, tmp_path: Path) -> None:
    model = build_model(configured(cache, tmp_path, model="small+no-omf"))
    assert model.object_motion is None
    learning = choose_parts(model, Stage("all", steps=1))
    assert len(learning) == len(list(model.parameters()))


def test_a_model_is_that_of_its_seed_or_its_file(cache: Path, tmp_path: Path) -> None:
    first, again, other = (build_model(configured(cache, tmp_path, seed=seed)) for seed in (1, 1, 2))
    pairs = list(zip(first.parameters(), again.parameters(), other.parameters(), strict=True))
    assert all(torch.equal(one, two) for one, two, _ in pairs)
    assert not all(torch.equal(one, three) for one, _, three in pairs)
    first.save(tmp_path / "first.safetensors")
    given = build_model(configured(cache, tmp_path, seed=2, init=str(tmp_path / "first.safetensors")))
    assert all(torch.equal(one, two) for one, two in zip(first.parameters(), given.parameters(), strict=True))
    assert given.training and given.options.autocast is None
    halved = configured(cache, tmp_path, run={"precision": "bfloat16"})
    assert build_model(halved).options.autocast == "bfloat16"
    with pytest.raises(ValueError, match=r"`init` must hold weights of small-painting, got .*first\.safetensors"):
        build_model(configured(cache, tmp_path, model="small-painting", init=str(tmp_path / "first.safetensors")))
    with pytest.raises(FileNotFoundError, match=r"absent\.safetensors"):
        build_model(configured(cache, tmp_path, init=str(tmp_path / "absent.safetensors")))


def test_the_running_mean_by_hand() -> None:
    """e <- 0.9 e + 0.1 w, from the first w on; a checkpoint gives it back."""
    model = Forecaster(SMALL)
    average, weight = Average(model, 0.9), model.refine.out.weight
    wanted = None
    for value in (1.0, 3.0, -2.0):
        nn.init.constant_(weight, value)
        average.update(model)
        wanted = value if wanted is None else 0.9 * wanted + 0.1 * value
    assert torch.allclose(average.model.refine.out.weight, torch.tensor(wanted)) and average.count == 3
    assert not any(parameter.requires_grad for parameter in average.model.parameters())
    again = Average(Forecaster(SMALL), 0.9)
    again.restore(average.model.state_dict(), average.count)
    for each in (average, again):
        each.update(model)
    assert again.count == average.count == 4
    assert torch.equal(again.model.refine.out.weight, average.model.refine.out.weight)


# ---------------------------------------------------------------- updates


@pytest.mark.parametrize("part", PARTS)
def test_the_loss_falls_with_each_part_only(part: str, cache: Path, tmp_path: Path) -> None:
    """L1 only, on one batch; nothing but the part moves."""
    torch.manual_seed(0)
    changes: dict[str, Any] = {"loss": {"ssim": 0.0, "pose": {}}, "optimiser": {"clip_norm": 1.0}}
    settings = one_stage(cache, tmp_path, stage={"train": [part]}, **changes)
    model, batch = stirred(), batch_of(settings)
    before, updates = copy.deepcopy(model.state_dict()), trained(settings, model)
    reported = [updates.update(batch).terms["loss"] for _ in range(20)]
    assert min(reported[-3:]) < reported[0]
    moved = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert moved == {name for name in before if name.startswith(part)}


@pytest.mark.parametrize("name", ["small", "small-painting"])
def test_every_tensor_gets_a_gradient(name: str, cache: Path, tmp_path: Path) -> None:
    """From a real batch, through splatting; the second model starts from rest, and is shown no prior."""
    settings = one_stage(cache, tmp_path, model=name, data={"horizons": [0.0, 1.0]})
    model, batch = stirred() if name == "small" else stir(Forecaster(MODELS[name])).train(), batch_of(settings)
    assert batch.horizon == 2
    update = trained(settings, model).update(batch)
    for parameter_name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), parameter_name
        assert parameter.grad.abs().max() > 0, parameter_name
    assert update.view is not None and update.view.image.shape == (2, 3, 24, 64) and not update.skipped
    assert not any(image.requires_grad for image in update.view), "it keeps the graph of the whole step in memory"
    assert set(update.terms) == {"loss", "l1", "ssim", "rotation", "translation", "residual_motion", "gradient"}


def test_an_updates_seconds_are_split(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = one_stage(cache, tmp_path)
    seconds = trained(settings, stirred()).update(batch_of(settings)).seconds
    assert set(seconds) == {"networks", "splatting"} and all(value > 0 for value in seconds.values())


def test_a_stage_without_rendering_learns_the_camera(cache: Path, tmp_path: Path) -> None:
    settings = one_stage(
        cache, tmp_path, stage={"train": ["encoder", "ego_motion"], "render": False}, loss={"pose": {"translation": 1}}
    )
    model, batch = stirred(), batch_of(settings)
    updates, painted = trained(settings, model), []
    model.refine.register_forward_hook(lambda *_: painted.append(1))
    reported = [updates.update(batch) for _ in range(20)]
    assert not painted and reported[0].view is None and "l1" not in reported[0].terms
    assert min(each.terms["translation"] for each in reported[-3:]) < reported[0].terms["translation"]


def test_the_gradient_is_cut_to_its_norm(cache: Path, tmp_path: Path) -> None:
    """Adam's first step is the same for any length of the gradient; the reported norm is the one before the cut."""
    norms, lengths = [], []
    for clip_norm in (None, 1e-3):
        torch.manual_seed(0)
        settings = one_stage(cache, tmp_path, optimiser={"clip_norm": clip_norm})
        model = stirred()
        norms.append(trained(settings, model).update(batch_of(settings)).terms["gradient"])
        grads = [parameter.grad for parameter in model.parameters() if parameter.grad is not None]
        lengths.append(torch.cat([grad.flatten() for grad in grads]).norm().item())
    assert norms[0] == pytest.approx(norms[1], rel=1e-3)
    assert lengths[0] == pytest.approx(norms[0], rel=1e-3) and lengths[1] == pytest.approx(1e-3, rel=1e-2)


@pytest.mark.parametrize("decay", [0.0, 0.1])
def test_weights_decay_with_adam(decay: float, cache: Path, tmp_path: Path) -> None:
    """AdamW: a weight without gradient shrinks by the learning rate times the decay."""
    settings = one_stage(cache, tmp_path, optimiser={"weight_decay": decay})
    model = stirred()
    updates = trained(settings, model)
    before = copy.deepcopy(model.state_dict())
    for parameter in model.parameters():
        parameter.grad = torch.zeros_like(parameter)
    updates.adam.step()
    for name, value in model.state_dict().items():
        assert torch.allclose(value, (1 - 2e-3 * decay) * before[name]), name


@pytest.mark.parametrize("on_nan", ["stop", "skip"])
def test_no_number_leaves_the_weights(
    on_nan: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = one_stage(cache, tmp_path, run={"on_nan": on_nan})

    def infinite(*arguments: Any) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        loss, terms = losses.total_loss(*arguments)
        return loss * torch.inf, terms

    model, batch = stirred(), batch_of(settings)
    updates = trained(settings, model)
    updates.update(batch)
    before = copy.deepcopy(model.state_dict())
    monkeypatch.setattr(trainer, "total_loss", infinite)
    if on_nan == "stop":
        with pytest.raises(NotANumberError, match="loss inf, l1 0"):
            updates.update(batch)
    else:
        assert updates.update(batch).skipped
        assert updates.schedule.last_epoch == 2
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


# ---------------------------------------------------------------- routing, public weights, the recording car


def test_routing_trains_with_its_budget(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With nothing else to learn from, the expected number of blocks goes to the budget."""
    objects = dataclasses.replace(OBJECTS, routing=RoutingConfig(4, budget=0.5))
    monkeypatch.setattr(config, "CONFIGS", {**MODELS, "routed": dataclasses.replace(SMALL, object_motion=objects)})
    loss, stage = {"l1": 0.0, "ssim": 0.0, "pose": {}}, {"learning_rate": 0.2}
    settings = one_stage(cache, tmp_path, steps=12, model="routed", loss=loss, stage=stage)
    model = build_model(settings)
    assert isinstance(model.object_motion, ObjectMotion) and model.object_motion.routing is not None
    nn.init.constant_(model.object_motion.routing.choose.bias, 2.0)
    nn.init.zeros_(model.object_motion.routing.choose.weight)
    updates, batch = trained(settings, model), batch_of(settings)
    found = [updates.update(batch).terms["routing"] for _ in range(12)]
    expected = 2 / (1 + math.exp(-2.0))
    assert found[0] == pytest.approx(((expected - 0.5) / 2) ** 2, rel=1e-4)
    assert found[-1] < found[0] / 3


def test_models_without_routing_have_no_such_term(cache: Path, tmp_path: Path) -> None:
    settings = one_stage(cache, tmp_path)
    assert "routing" not in trained(settings, stirred()).update(batch_of(settings)).terms


def test_the_encoder_starts_from_public_weights(cache: Path, tmp_path: Path) -> None:
    """Of `init_encoder` the stem and layers; all else as without it."""
    torch.manual_seed(1)
    torch.save(resnet34(), tmp_path / "resnet34.pth")
    plain = one_stage(cache, tmp_path, model="vest-paper")
    given = build_model(dataclasses.replace(plain, init_encoder=tmp_path / "resnet34.pth"))
    encoder, wanted = Encoder(), Encoder()
    load_resnet34(wanted, tmp_path / "resnet34.pth")
    without = build_model(plain)
    trunk = ("conv1.", "norm1.", "layer1.", "layer2.", "layer3.")
    for name in encoder.state_dict():
        source = wanted if name.startswith(trunk) else without.encoder
        assert torch.equal(given.encoder.state_dict()[name], source.state_dict()[name]), name
    assert torch.equal(given.refine.out.weight, without.refine.out.weight)


def test_public_weights_of_another_encoder_are_refused(cache: Path, tmp_path: Path) -> None:
    torch.save(resnet34(), tmp_path / "resnet34.pth")
    settings = one_stage(cache, tmp_path, model="vest-s", init_encoder=str(tmp_path / "resnet34.pth"))
    with pytest.raises(ValueError, match="`init_encoder` must hold ResNet34's weights for vest-s"):
        build_model(settings)


def test_the_network_is_given_the_recording_car(cache: Path, tmp_path: Path) -> None:
    settings, model, seen = one_stage(cache, tmp_path), stirred(), []
    model.register_forward_pre_hook(lambda _model, _inputs, named: seen.append(named["own"]), with_kwargs=True)
    batch = batch_of(settings)
    assert batch.own is not None and batch.own.shape == batch.frame_cur.mask.shape
    trained(settings, model).update(batch)
    assert seen[0] is batch.own

"""One stage's updates of the weights: forward through the splatting, loss, backward, clip, Adam, running mean."""

import math
import time
from dataclasses import dataclass, replace
from typing import Any, Final, cast

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from train.data.windows import Batch
from train.run.losses import Perceptual, total_loss
from train.run.ranks import Ranks
from train.settings.config import Config, Stage
from vestcl import opencl
from vestcl.models.config import ModelConfig, configuration
from vestcl.models.forecaster import Forecaster, RenderedView, Step
from vestcl.models.networks.encoder import load_resnet34


class NotANumberError(RuntimeError):
    """A loss or a gradient that is not finite."""


@dataclass(frozen=True, eq=False)
class Update:
    """What one update came to."""

    terms: dict[str, float]
    """The loss, its terms before their weights, and the gradient's norm; means over the processes."""
    seconds: dict[str, float]
    """Seconds of this process: "splatting" is all that OpenCL did, forward and backward, "networks" the rest."""
    view: RenderedView | None
    """Without the graph of its computation. None in stages that render nothing."""
    skipped: bool
    """Whether the weights stayed as they were, because something was not finite."""


def build_model(config: Config) -> Forecaster:
    """The model that ``config`` names: random weights by its seed, those of its ``init``, or ``init_encoder``'s trunk.

    Raises:
        FileNotFoundError: no file ``init`` or ``init_encoder``.
        ValueError: a damaged file, or weights of another model.
    """
    torch.manual_seed(config.seed)
    model = Forecaster(model_config(config))
    if config.init is not None:
        given = Forecaster.load(config.init)
        try:
            model.load_state_dict(_fitting(given, model))
        except RuntimeError as error:
            raise ValueError(f"`init` must hold weights of {config.model}, got {config.init} ({error})") from error
    if config.init_encoder is not None:
        try:
            load_resnet34(model.encoder, config.init_encoder)
        except ValueError as error:
            raise ValueError(f"`init_encoder` must hold ResNet34's weights for {config.model} ({error})") from error
    precision = config.run.precision
    model.options = replace(model.options, autocast=None if precision == "float32" else precision)
    return model.train()


#: Entries of a model's state that depend on how EMF corrects a prior.
_HEADS: Final = tuple(f"ego_motion.{name}." for name in ("shown", "swayed", "motion", "bounded"))


def _fitting(given: Forecaster, model: Forecaster) -> dict[str, torch.Tensor]:
    """The weights of ``given``; where its EMF corrects a prior in another way, EMF's last layers are ``model``'s, and
    so is refinement where one is of geometric forecasts and the other is not."""
    pair = given.config.ego_motion, model.config.ego_motion
    other: tuple[str, ...] = ()
    if None not in pair and len({getattr(each, "correction", None) for each in pair}) > 1:
        other += _HEADS
    if given.config.refine.refines != model.config.refine.refines:
        other += ("refine.",)
    kept = {name: tensor for name, tensor in given.state_dict().items() if not name.startswith(other)}
    return kept | {name: tensor for name, tensor in model.state_dict().items() if name.startswith(other)}


def model_config(config: Config) -> ModelConfig:
    """Configuration of the trained model."""
    return configuration(config.model)


class Average:
    """The EMA of the weights: e <- d e + (1 - d) w; what evaluation uses."""

    def __init__(self, model: Forecaster, decay: float) -> None:
        self._mean = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(decay))
        self._mean.requires_grad_(False)

    def update(self, model: Forecaster) -> None:
        """Take in the weights as they are now; the first time, they are the mean."""
        self._mean.update_parameters(model)

    @property
    def model(self) -> Forecaster:
        """With the mean for weights."""
        return cast(Forecaster, self._mean.module)

    @property
    def count(self) -> int:
        """Weights taken in."""
        return int(self._mean.n_averaged)

    def restore(self, weights: dict[str, torch.Tensor], count: int) -> None:
        """Go on from a checkpoint."""
        self.model.load_state_dict(weights)
        self._mean.n_averaged.fill_(count)


class Trainer:
    """Updates ``model`` by the settings of ``stage``.

    Args:
        config: of the run.
        stage: of ``config``; its parts learn, all others are frozen.
        model: in training mode.
        perceptual: from `train.run.losses.build_perceptual` of the stage's loss.
        ranks: the processes that share each batch; gradients are means over them.
    """

    def __init__(
        self, config: Config, stage: Stage, model: Forecaster, perceptual: Perceptual | None, ranks: Ranks
    ) -> None:
        self.config, self.stage, self.ranks, self._perceptual = config, stage, ranks, perceptual
        self._learning = choose_parts(model, stage)
        self.adam = _adam(config, stage, self._learning)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(self.adam, lambda done: self._rate(done))
        self._model: nn.Module = model if ranks.world == 1 else DistributedDataParallel(model)

    def update(self, batch: Batch) -> Update:
        """One step down the loss of ``batch``, this process's part of it.

        Raises:
            NotANumberError: a loss or gradient is not finite, and ``run.on_nan`` is "stop"; the weights are as before.
        """
        start, session = time.perf_counter(), opencl.current()
        splatting = session.seconds
        self.adam.zero_grad(set_to_none=True)
        step: Step = self._model(
            batch.frame_prev, batch.frame_cur, batch.K,
            [(batch.tgt_from_next, batch.target_K)] if self.stage.render else [],
            prior=batch.prior if self._starts_from_prior() else None, own=batch.own, horizon=batch.horizon,
        )  # fmt: skip
        view = step.views[0] if step.views else None
        terms_of = self.config.loss_of(self.stage), self._perceptual, self._budget()
        loss, terms = total_loss(view, step, batch, *terms_of)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self._learning, self.config.optimiser.clip_norm or math.inf)
        broken = self.ranks.any(not (math.isfinite(loss.item()) and math.isfinite(norm.item())))
        logged = {"loss": loss.item(), **{name: term.item() for name, term in terms.items()}, "gradient": norm.item()}
        if broken and self.config.run.on_nan == "stop":
            raise NotANumberError(", ".join(f"{name} {value:g}" for name, value in logged.items()))
        if not broken:
            self.adam.step()
        self.schedule.step()
        session_seconds = session.seconds - splatting
        seconds = {"networks": time.perf_counter() - start - session_seconds, "splatting": session_seconds}
        shown = None if view is None else RenderedView(*(image.detach() for image in view))
        return Update(self.ranks.mean(logged), seconds, shown, broken)

    def state(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """State of Adam and of the learning rate's schedule."""
        return self.adam.state_dict(), self.schedule.state_dict()

    def restore(self, adam: dict[str, Any], schedule: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        self.adam.load_state_dict(adam)
        self.schedule.load_state_dict(schedule)

    def _starts_from_prior(self) -> bool:
        return model_config(self.config).start == "prior"

    def _budget(self) -> float | None:
        """Blocks of object motion that routing should run on average."""
        objects = model_config(self.config).object_motion
        return None if objects is None or objects.routing is None else objects.routing.budget

    def _rate(self, done: int) -> float:
        return learning_rate_factor(done, self.stage, self.config.optimiser.final_factor)


def learning_rate_factor(done: int, stage: Stage, final: float) -> float:
    """Up in a line over the warm-up, then f + (1 - f) (1 + cos(pi s)) / 2 with s from 0 to 1 over the rest.

    Args:
        done: updates so far, of the stage.
        stage: its steps and warm-up.
        final: f.
    """
    if done < stage.warm_up:
        return (done + 1) / (stage.warm_up + 1)
    share = min((done - stage.warm_up) / max(stage.steps - stage.warm_up, 1), 1.0)
    return final + (1 - final) * (1 + math.cos(math.pi * share)) / 2


def choose_parts(model: Forecaster, stage: Stage) -> list[nn.Parameter]:
    """Freeze all but the stage's parts; the parameters that learn. Parts that the model lacks don't count."""
    model.requires_grad_(False)
    parts = [getattr(model, name) for name in stage.train if getattr(model, name) is not None]
    for part in parts:
        part.requires_grad_(True)
    return [parameter for part in parts for parameter in part.parameters()]


def _adam(config: Config, stage: Stage, learning: list[nn.Parameter]) -> torch.optim.Optimizer:
    """Adam, or with weight decay AdamW."""
    optimiser = config.optimiser
    if optimiser.weight_decay:
        decay = optimiser.weight_decay
        return torch.optim.AdamW(learning, stage.learning_rate, optimiser.betas, weight_decay=decay)
    return torch.optim.Adam(learning, stage.learning_rate, optimiser.betas)

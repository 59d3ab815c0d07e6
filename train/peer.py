"""Train the learned 2D peer: ``python -m train.peer train/configs/peer/dmvfn_street.yaml out=runs/dmvfn --resume``.

A DMVFN-shaped network (`vestcl.models.networks.voxel_flow`, all blocks, no routing) learns to forecast the source
camera's next frame from two, on the windows that `train.fit` trains on. Out come ``peer.safetensors``, the EMA weights
that `train.evaluate --peer` and `vestcl bench forecast --peer` read, ``log.jsonl``, and ``state.pt`` to resume from.
"""

import dataclasses
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, cast

import torch
import tyro
from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass
from rich.console import Console
from torch import nn
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from train.data.windows import Batch, loader
from train.fit import window_set
from train.run.losses import Perceptual, build_perceptual, image_terms
from train.run.trainer import learning_rate_factor
from train.settings.config import (
    RULES,
    CountOrNone,
    DataConfig,
    LossConfig,
    OptimiserConfig,
    RunConfig,
    Stage,
    with_stage_parts,
)
from train.settings.yaml_files import in_words, read_settings
from vestcl.io import atomic
from vestcl.models.networks.voxel_flow import MULTIPLE, VoxelFlowNetwork

#: Files of a run.
WEIGHTS: Final = "peer.safetensors"
STATE: Final = "state.pt"
LOG: Final = "log.jsonl"

#: Levels of the Laplacian pyramid, and what an earlier block's image counts against the next one's: DMVFN's.
LEVELS: Final = 5
DISCOUNT: Final = 0.8


@dataclass(frozen=True, config=RULES)
class PeerConfig:
    """A run of the peer.

    Of `Stage`, ``train`` and ``render`` have no meaning here, and of `RunConfig` ``keep`` and ``image_every``.
    """

    name: Annotated[str, Field(min_length=1)]
    out: Path
    data: DataConfig
    stages: tuple[Stage, ...]
    loss: LossConfig
    """``l1`` weighs `pyramid_loss`; ``perceptual`` and ``ssim`` are of the last block's image, as for other models."""
    seed: CountOrNone = 0
    optimiser: OptimiserConfig = OptimiserConfig()
    run: RunConfig = RunConfig()

    def __post_init__(self) -> None:
        if not self.stages:
            raise ValueError("`stages` must be one or more, got none")
        if self.run.precision != "float32":
            raise ValueError(f"`run.precision` must be float32 for flow in pixels, got {self.run.precision}")
        for stage in self.stages:
            data = self.data_of(stage)
            if data.right > 0:
                raise ValueError(f"`data.right` must be 0: images are forecast for the source camera, got {data.right}")
            if data.crop is not None and any(side % MULTIPLE for side in data.crop):
                raise ValueError(f"`crop` must be multiples of {MULTIPLE} px, got {list(data.crop)}")

    def data_of(self, stage: Stage) -> DataConfig:
        """What ``stage`` is shown."""
        data = stage.data or self.data
        return data if stage.crop is None else dataclasses.replace(data, crop=stage.crop)

    def loss_of(self, stage: Stage) -> LossConfig:
        """What ``stage`` minimises."""
        return stage.loss or self.loss


def load_config(path: Path | str, overrides: Sequence[str] = ()) -> PeerConfig:
    """As `train.settings.config.load_config`, for the peer.

    Raises:
        FileNotFoundError: no such file.
        ValueError: everything that is wrong, in one message.
    """
    try:
        return _ADAPTER.validate_python(with_stage_parts(read_settings(path, overrides)))
    except ValidationError as error:
        raise ValueError(in_words(error, PeerConfig, str(path))) from error


# ---------------------------------------------------------------- loss


def pyramid_loss(images: Sequence[torch.Tensor], target: torch.Tensor) -> torch.Tensor:
    """sum_i 0.8^(n - i) sum_l mean |L_l(image_i) - L_l(target)| over the images of n blocks and the pyramid's levels.

    L is a Laplacian pyramid of five levels: an image less its halved and doubled self, and so on; the last is the rest.

    Args:
        images: [B, 3, H, W] a block, the last one the answer.
        target: [B, 3, H, W].

    Returns:
        A number; differentiable in the images.

    Source: Hu et al., DMVFN, CVPR 2023, section 3.4.
    """
    total = target.new_zeros(())
    for age, image in enumerate(reversed(images)):
        rest = image - target  # the pyramid is linear
        for _ in range(LEVELS - 1):
            half = functional.avg_pool2d(rest, 2, ceil_mode=True)
            fine = rest - functional.interpolate(half, rest.shape[-2:], mode="bilinear", align_corners=False)
            total = total + DISCOUNT**age * fine.abs().mean()
            rest = half
        total = total + DISCOUNT**age * rest.abs().mean()
    return total


def loss_of(
    network: VoxelFlowNetwork, batch: Batch, config: LossConfig, perceptual: Perceptual | None
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The weighted sum and each term; frames beyond t+1 are forecast recursively, and the last one is compared."""
    first, second = batch.frame_prev.image, batch.frame_cur.image
    for _ in range(batch.horizon - 1):
        first, second = second, network(first, second)
    images = list(network.corrected(first, second))
    others = dataclasses.replace(config, l1=0.0)
    terms = {"pyramid": (config.l1, pyramid_loss(images, batch.target))}
    terms |= image_terms(images[-1], batch.target, others, perceptual)
    total = torch.stack([weight * term for weight, term in terms.values()]).sum()
    return total, {name: term.detach() for name, (_, term) in terms.items()}


# ---------------------------------------------------------------- run


class PeerTraining:
    """The network, its EMA weights and what is known of the run, through all stages."""

    def __init__(self, config: PeerConfig, network: VoxelFlowNetwork | None = None) -> None:
        torch.manual_seed(config.seed)
        self.config, self.console = config, Console()
        self.network = (network or VoxelFlowNetwork()).train()
        self.network.router.requires_grad_(False)
        self.average = AveragedModel(self.network, multi_avg_fn=get_ema_multi_avg_fn(config.optimiser.ema))
        self.number, self.done, self.step = 0, 0, 0
        self.restored: dict[str, Any] | None = None

    @property
    def ema(self) -> VoxelFlowNetwork:
        """With the EMA weights."""
        return cast(VoxelFlowNetwork, self.average.module)

    def go(self) -> None:
        """To the end of the last stage.

        Raises:
            ValueError: data that can't be used, or a loss that is not finite.
        """
        while self.number < len(self.config.stages):
            self._stage(self.config.stages[self.number])
            self.number, self.done, self.restored = self.number + 1, 0, None

    def restore(self) -> None:
        """Resume from the run's last state, if there is one."""
        path = self.config.out / STATE
        if path.is_file():
            state = torch.load(path, weights_only=True)
            self.network.load_state_dict(state["network"])
            self.average.load_state_dict(state["average"])
            self.number, self.done, self.step = state["number"], state["done"], state["step"]
            self.restored = state["adam"]

    def _stage(self, stage: Stage) -> None:
        config, data, loss = self.config, self.config.data_of(stage), self.config.loss_of(stage)
        perceptual, learning = build_perceptual(loss), [p for p in self.network.parameters() if p.requires_grad]
        decay = config.optimiser.weight_decay
        adam = torch.optim.AdamW(learning, stage.learning_rate, config.optimiser.betas, weight_decay=decay)
        if self.restored is not None:
            adam.load_state_dict(self.restored)
        steps = range(self.done, stage.steps)
        waiting = time.perf_counter()
        for batch in loader(window_set(data), config.seed + self.number, stage.batch, steps, workers=data.workers):
            waited, start = time.perf_counter() - waiting, time.perf_counter()
            rate = stage.learning_rate * learning_rate_factor(self.done, stage, config.optimiser.final_factor)
            adam.param_groups[0]["lr"] = rate
            adam.zero_grad(set_to_none=True)
            total, terms = loss_of(self.network, batch, loss, perceptual)
            total.backward()
            norm = nn.utils.clip_grad_norm_(learning, config.optimiser.clip_norm or math.inf)
            if math.isfinite(total.item()) and math.isfinite(norm.item()):
                adam.step()
                self.average.update_parameters(self.network)
            elif config.run.on_nan == "stop":
                raise ValueError(f"step {self.step + 1}: non-finite loss or gradient with {', '.join(batch.clips)}")
            self.done, self.step = self.done + 1, self.step + 1
            row = {
                "loss": total.item(),
                **{name: term.item() for name, term in terms.items()},
                "gradient": norm.item(),
            }
            self._log(stage, row | {"rate": rate, "s_data": waited, "s_network": time.perf_counter() - start})
            if self.step % config.run.checkpoint_every == 0 or self.done == stage.steps:
                self._save(adam)
            waiting = time.perf_counter()

    def _log(self, stage: Stage, row: dict[str, float]) -> None:
        if self.step % self.config.run.log_every == 0 or self.done == stage.steps:
            with (self.config.out / LOG).open("a", encoding="utf-8") as file:
                file.write(json.dumps({"step": self.step, "stage": stage.name, **row}) + "\n")
            shown = ", ".join(f"{name} {value:.4g}" for name, value in row.items())
            self.console.print(f"step {self.step}, {stage.name}: {shown}", highlight=False, soft_wrap=True)

    def _save(self, adam: torch.optim.Optimizer) -> None:
        self.ema.save(self.config.out / WEIGHTS)
        state = {"network": self.network.state_dict(), "average": self.average.state_dict(), "adam": adam.state_dict()}
        with atomic.replacing(self.config.out / STATE) as temporary:
            torch.save(state | {"number": self.number, "done": self.done, "step": self.step}, temporary)


@dataclasses.dataclass(frozen=True)
class PeerOptions:
    """Train the learned 2D peer as a configuration says."""

    config: tyro.conf.Positional[Path]
    """YAML file."""
    overrides: tyro.conf.Positional[tuple[str, ...]] = ()
    """key=value or key.sub=value each; values are YAML."""
    resume: bool = False
    """Resume the run from its last state, if it has one."""


def main(arguments: list[str] | None = None) -> int:
    """The command; its exit status."""
    options = tyro.cli(PeerOptions, args=arguments, description=__doc__, prog="python -m train.peer")
    try:
        train(load_config(options.config, options.overrides), resume=options.resume)
    except (ValueError, OSError) as error:
        Console(stderr=True).print(f"error: {error}", style="red", highlight=False, markup=False, soft_wrap=True)
        return 1
    return 0


def train(config: PeerConfig, *, resume: bool = False, network: VoxelFlowNetwork | None = None) -> VoxelFlowNetwork:
    """Train to the end of the last stage.

    Args:
        config: of the run.
        resume: from the last state in ``config.out``, if there is one.
        network: in place of the published one with random weights.

    Returns:
        The network with its EMA weights.

    Raises:
        ValueError: data or weights that can't be used, a run that exists already, or a non-finite loss.
        FileNotFoundError: no classifier's weights for the perceptual loss.
    """
    if not resume and (config.out / STATE).exists():
        raise ValueError(f"`out` {config.out} has a run already: --resume resumes it, or take another folder")
    config.out.mkdir(parents=True, exist_ok=True)
    if config.run.threads:
        torch.set_num_threads(config.run.threads)
    training = PeerTraining(config, network)
    if resume:
        training.restore()
    training.go()
    return training.ema.eval()


_ADAPTER: Final = TypeAdapter(PeerConfig)

if __name__ == "__main__":
    sys.exit(main())

"""Train the learned 2D peer: ``python -m train.peer train/configs/peer/dmvfn_street.yaml out=runs/dmvfn --resume``.

A DMVFN-shaped network (`vestcl.models.networks.voxel_flow`, all blocks, no routing) learns to forecast the source
camera's next frame from two, on the windows that `train.fit` trains on. Out come ``peer.safetensors``, the EMA weights
that `train.evaluate --peer` and `vestcl bench forecast --peer` read, ``log.jsonl``, and ``state.pt`` to resume from.
"""

import dataclasses
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, cast

import torch
import tyro
from pydantic import Field
from pydantic.dataclasses import dataclass
from rich.console import Console
from torch.nn import functional

from train.data.windows import Batch, loader
from train.fit import window_set
from train.run.loop import Loop, RunOptions, check_new
from train.run.losses import Perceptual, build_perceptual, image_terms
from train.settings.config import (
    RULES,
    CountOrNone,
    DataConfig,
    LossConfig,
    OptimiserConfig,
    RunConfig,
    Stage,
    StageParts,
    with_stage_parts,
)
from train.settings.yaml_files import checked, read_settings
from vestcl.models.networks.voxel_flow import MULTIPLE, VoxelFlowNetwork

#: What a run is for.
WEIGHTS: Final = "peer.safetensors"

#: Levels of the Laplacian pyramid, and what an earlier block's image counts against the next one's: DMVFN's.
LEVELS: Final = 5
DISCOUNT: Final = 0.8


@dataclass(frozen=True, config=RULES)
class PeerConfig(StageParts):
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


def load_config(path: Path | str, overrides: Sequence[str] = ()) -> PeerConfig:
    """As `train.settings.config.load_config`, for the peer.

    Raises:
        FileNotFoundError: no such file.
        ValueError: everything that is wrong, in one message.
    """
    return checked(PeerConfig, with_stage_parts(read_settings(path, overrides)), str(path))


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


class PeerTraining(Loop):
    """The network, its EMA weights and what is known of the run, through all stages."""

    name = "network"
    network: VoxelFlowNetwork

    def __init__(self, config: PeerConfig, network: VoxelFlowNetwork | None = None) -> None:
        torch.manual_seed(config.seed)
        network = (network or VoxelFlowNetwork()).train()
        network.router.requires_grad_(False)
        super().__init__(config.out, network, config.optimiser, config.run)
        self.config, self.number, self.done = config, 0, 0

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
            self.number, self.done = self.number + 1, 0

    def place(self) -> dict[str, int]:
        """Where the run is."""
        return {"number": self.number, "done": self.done, "step": self.step}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Resume from the content of the run's state."""
        super().restore(state)
        self.number, self.done = state["number"], state["done"]

    def save_weights(self) -> None:
        """Write the EMA weights."""
        self.ema.save(self.out / WEIGHTS)

    def _stage(self, stage: Stage) -> None:
        data, loss, run = self.config.data_of(stage), self.config.loss_of(stage), self.config.run
        perceptual = build_perceptual(loss)
        self.begin(stage)
        steps = range(self.done, stage.steps)
        waiting = time.perf_counter()
        for batch in loader(window_set(data), self.config.seed + self.number, stage.batch, steps, workers=data.workers):
            waited, start = time.perf_counter() - waiting, time.perf_counter()
            total, terms = loss_of(self.network, batch, loss, perceptual)
            row = self.update(total, terms, stage, self.done, batch.clips)
            self.done += 1
            row |= {"s_data": waited, "s_network": time.perf_counter() - start}
            if self.step % run.log_every == 0 or self.done == stage.steps:
                self.log(row, stage=stage.name)
            if self.step % run.checkpoint_every == 0 or self.done == stage.steps:
                self.save()
            waiting = time.perf_counter()


def main(arguments: list[str] | None = None) -> int:
    """The command; its exit status."""
    options = tyro.cli(RunOptions, args=arguments, description=__doc__, prog="python -m train.peer")
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
    check_new(config.out, resume)
    training = PeerTraining(config, network)
    training.train(resume)
    return training.ema.eval()


if __name__ == "__main__":
    sys.exit(main())

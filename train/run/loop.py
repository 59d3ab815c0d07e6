"""What runs of one network in one process share: updates, EMA weights, a line of log, and a state to resume from."""

import dataclasses
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final

import torch
import tyro
from rich.console import Console
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from train.run.trainer import learning_rate_factor
from train.settings.config import OptimiserConfig, RunConfig, Stage
from vestcl.io import atomic

#: Files of a run.
STATE: Final = "state.pt"
LOG: Final = "log.jsonl"


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """What the commands of such runs take."""

    config: tyro.conf.Positional[Path]
    """YAML file."""
    overrides: tyro.conf.Positional[tuple[str, ...]] = ()
    """key=value or key.sub=value each; values are YAML."""
    resume: bool = False
    """Resume the run from its last state, if it has one."""


def check_new(out: Path, resume: bool) -> None:
    """Refuse to begin where a run is.

    Raises:
        ValueError: ``out`` has a run, and it is not to be resumed.
    """
    if not resume and (out / STATE).exists():
        raise ValueError(f"`out` {out} has a run already: --resume resumes it, or take another folder")


class Loop(ABC):
    """A run of ``network``.

    Args:
        out: its folder.
        network: what is trained; parameters that need no gradient are left as they are.
        optimiser: of its configuration.
        run: of its configuration.
    """

    name: ClassVar[str]
    """Name of the network in the state."""

    def __init__(self, out: Path, network: nn.Module, optimiser: OptimiserConfig, run: RunConfig) -> None:
        self.out, self.network, self.optimiser, self.run = out, network, optimiser, run
        self.average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(optimiser.ema))
        self.console, self.step = Console(), 0
        self._learning = [parameter for parameter in network.parameters() if parameter.requires_grad]
        self._adam_state: dict[str, Any] | None = None

    def train(self, resume: bool) -> None:
        """To the last step, from the last state if ``resume`` and there is one.

        Raises:
            ValueError: data that can't be used, or a loss that is not finite.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        if self.run.threads:
            torch.set_num_threads(self.run.threads)
        if resume and (self.out / STATE).is_file():
            self.restore(torch.load(self.out / STATE, weights_only=True))
        self.go()

    @abstractmethod
    def go(self) -> None:
        """To the last step."""

    @abstractmethod
    def save_weights(self) -> None:
        """Write the EMA weights to the file that the run is for."""

    def place(self) -> dict[str, int]:
        """Where the run is, as the state keeps it."""
        return {"step": self.step}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Resume from the content of the run's state."""
        self.network.load_state_dict(state[self.name])
        self.average.load_state_dict(state["average"])
        self.step, self._adam_state = state["step"], state["adam"]

    def begin(self, stage: Stage) -> None:
        """Begin a stage, or resume it after `restore`."""
        decay, betas = self.optimiser.weight_decay, self.optimiser.betas
        self.adam = torch.optim.AdamW(self._learning, stage.learning_rate, betas, weight_decay=decay)
        if self._adam_state is not None:
            self.adam.load_state_dict(self._adam_state)
            self._adam_state = None

    def update(
        self, total: torch.Tensor, terms: Mapping[str, torch.Tensor], stage: Stage, done: int, clips: Sequence[str] = ()
    ) -> dict[str, float]:
        """One step down the gradient of ``total``; a row for the log.

        Args:
            total: the loss.
            terms: its parts, for the log.
            stage: that the update belongs to.
            done: updates of the stage before it.
            clips: what was shown, for the message.

        Raises:
            ValueError: a loss or gradient is not finite, and ``run.on_nan`` is "stop".
        """
        rate = stage.learning_rate * learning_rate_factor(done, stage, self.optimiser.final_factor)
        self.adam.param_groups[0]["lr"] = rate
        self.adam.zero_grad(set_to_none=True)
        total.backward()
        norm = nn.utils.clip_grad_norm_(self._learning, self.optimiser.clip_norm or math.inf)
        if math.isfinite(total.item()) and math.isfinite(norm.item()):
            self.adam.step()
            self.average.update_parameters(self.network)
        elif self.run.on_nan == "stop":
            where = f" with {', '.join(clips)}" if clips else ""
            raise ValueError(f"step {self.step + 1}: non-finite loss or gradient{where}")
        self.step += 1
        each = {name: term.item() for name, term in terms.items()}
        return {"loss": total.item(), **each, "gradient": norm.item(), "rate": rate}

    def log(self, row: Mapping[str, float], **about: str) -> None:
        """A line in the log's file and on the terminal."""
        with (self.out / LOG).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"step": self.step, **about, **row}) + "\n")
        shown = ", ".join(f"{name} {value:.4g}" for name, value in row.items())
        head = ", ".join([f"step {self.step}", *about.values()])
        self.console.print(f"{head}: {shown}", highlight=False, soft_wrap=True)

    def save(self) -> None:
        """Write the weights, and the state to resume from."""
        self.save_weights()
        state = {self.name: self.network.state_dict(), "average": self.average.state_dict()}
        with atomic.replacing(self.out / STATE) as temporary:
            torch.save(state | {"adam": self.adam.state_dict(), **self.place()}, temporary)

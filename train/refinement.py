"""Train the refinement of geometric forecasts: ``python -m train.refinement train/configs/refinement/street.yaml``.

It learns on what `train.forecasts` kept, which is what it sees at inference, and starts from changing nothing. Out come
``vest.safetensors``, a model whose refinement is the EMA weights and whose other parts are those of ``model``,
``log.jsonl``, and ``state.pt`` to resume from.
"""

import dataclasses
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, cast

import numpy as np
import torch
import tyro
from pydantic import Field
from pydantic.dataclasses import dataclass
from rich.console import Console

from train.command import ERRORS, failed
from train.data.augment import draw_colour, mean_luma
from train.forecasts import unpack
from train.run.loop import Loop, RunOptions, check_new
from train.run.losses import Perceptual, build_perceptual, image_terms
from train.settings.config import RULES, Count, CountOrNone, LossConfig, OptimiserConfig, RunConfig, Share, Stage
from train.settings.yaml_files import checked, read_settings
from vestcl import interrupt
from vestcl.models.checkpoint import read_trained_on, write_checkpoint
from vestcl.models.config import ModelConfig, RefineConfig
from vestcl.models.forecaster import Forecaster
from vestcl.models.networks.refine import Refine
from vestcl.models.shipped import find_model

#: What a run is for.
WEIGHTS: Final = "vest.safetensors"

#: Luma of RGB (ITU-R BT.601).
_LUMA: Final = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, config=RULES)
class ForecastData:
    """What is shown, and how it is varied."""

    train: tuple[str, ...]
    """Folders of a cache of `train.forecasts`, one per clip; the last part may be a pattern ("cache/street_3*")."""
    crop: tuple[Count, Count] | None = None
    """(height, width) px of a part drawn at random; null shows whole images."""
    flip: bool = True
    """Mirror every other sample."""
    colour: Share = 0.2
    """Strength of the change of brightness, contrast, gamma, saturation and hue."""
    grey: Share = 0.2
    """Probability that a sample is grey."""

    def __post_init__(self) -> None:
        if not self.train:
            raise ValueError("`train` must name a folder or more, got none")


@dataclass(frozen=True, config=RULES)
class RefinementConfig:
    """A run. Of `Stage`, steps, batch and learning rate count; of `RunConfig`, all but ``keep`` and ``image_every``."""

    name: Annotated[str, Field(min_length=1)]
    """Name of the model that is written."""
    out: Path
    data: ForecastData
    stage: Stage
    loss: LossConfig
    """The terms of images."""
    model: str = "vest-s"
    """The model whose other parts are kept, as `vestcl forecast --model` takes it."""
    init: str | None = None
    """A model, named likewise, whose refinement of geometric forecasts training starts from; null starts from that of
    ``model``, if it is of geometric forecasts, or else from one that changes nothing."""
    seed: CountOrNone = 0
    optimiser: OptimiserConfig = OptimiserConfig()
    run: RunConfig = RunConfig()


def load_config(path: Path | str, overrides: Sequence[str] = ()) -> RefinementConfig:
    """As `train.settings.config.load_config`, for a refinement.

    Raises:
        FileNotFoundError: no such file.
        ValueError: everything that is wrong, in one message.
    """
    return checked(RefinementConfig, read_settings(path, overrides), str(path))


# ---------------------------------------------------------------- data


class Samples:
    """Samples drawn from a cache: each is a function of the seed, the step and its position in the batch.

    Args:
        data: which folders.
        seed: of the run.

    Raises:
        ValueError: no windows there.
    """

    def __init__(self, data: ForecastData, seed: int) -> None:
        self.data, self.seed = data, seed
        self.files = sorted({file for pattern in data.train for file in _files(Path(pattern))})
        if not self.files:
            raise ValueError(f"`data.train` must hold windows of `train.forecasts`, got none in {list(data.train)}")

    def batch(self, step: int, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Planes [B, FORECAST_PLANES, H, W] and true images [B, 3, H, W] of an update.

        Raises:
            ValueError: a window's file is damaged, or smaller than the crop.
        """
        drawn = [self._sample(step * size + place) for place in range(size)]
        planes, targets = (torch.from_numpy(np.stack(part)) for part in zip(*drawn, strict=True))
        return planes, targets

    def _sample(self, number: int) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """Every file once per epoch, in its own order; one of its entries, varied."""
        epoch, place = divmod(number, len(self.files))
        file = self.files[np.random.default_rng([self.seed, epoch]).permutation(len(self.files))[place]]
        rng = np.random.default_rng([self.seed, 1, number])
        entry = unpack(file, lambda entries: [int(rng.integers(entries))]).entries[0]
        planes, target = self._cut(file, np.concatenate([entry.planes, entry.target]), rng)
        change = draw_colour(rng, self.data.colour, mean_luma(target))
        planes[:3], target = change(planes[:3]), change(target)
        if rng.random() < self.data.grey:
            planes[:3], target = (np.tensordot(_LUMA, image, 1)[None].repeat(3, 0) for image in (planes[:3], target))
        return planes, target

    def _cut(
        self, file: Path, both: np.ndarray[Any, Any], rng: np.random.Generator
    ) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """Planes and target of a part of the window, mirrored or not."""
        rows, columns = both.shape[1:]
        height, width = self.data.crop or (rows, columns)
        if height > rows or width > columns:
            raise ValueError(f"`data.crop` must be at most {rows}x{columns}, of {file}, got {height}x{width}")
        top, left = int(rng.integers(rows - height + 1)), int(rng.integers(columns - width + 1))
        both = both[:, top : top + height, left : left + width]
        if self.data.flip and rng.random() < 0.5:
            both = both[:, :, ::-1]
        return both[:-3].copy(), both[-3:].copy()

    def shown(self) -> dict[str, tuple[int, int]]:
        """By clip, the first and the last frame of its windows."""
        return _joined(*({clip: (0, current + ahead)} for clip, current, ahead in map(_about, self.files)))


def _about(file: Path) -> tuple[str, int, int]:
    """The clip, the frame t, and the longest horizon."""
    with np.load(file, allow_pickle=False) as arrays:
        return str(arrays["clip"]), int(arrays["current"]), int(arrays["ahead"].max())


def _files(pattern: Path) -> list[Path]:
    folders = sorted(pattern.parent.glob(pattern.name)) if "*" in pattern.name else [pattern]
    return [file for folder in folders for file in [*folder.glob("*.npz"), *folder.glob("*/*.npz")]]


# ---------------------------------------------------------------- model


def with_forecast_refinement(model: Forecaster, name: str) -> Forecaster:
    """``model`` with a refinement of geometric forecasts in place of its own, of the same sizes; it changes nothing.

    A model that has one keeps it.

    Args:
        model: any network with a base to add to.
        name: of the result.

    Raises:
        ValueError: the model predicts RGB directly.
    """
    config, state = dataclasses.replace(model.config, name=name), dict(model.state_dict())
    if not model.refine.of_forecast:
        refine = RefineConfig(**(dataclasses.asdict(config.refine) | {"refines": "forecast"}))
        config = dataclasses.replace(config, refine=refine)
        fresh = Forecaster(config).refine.state_dict()
        state = {key: value for key, value in state.items() if not key.startswith("refine.")}
        state |= {f"refine.{key}": value for key, value in fresh.items()}
    made = Forecaster(config)
    made.load_state_dict(state)
    return made


# ---------------------------------------------------------------- run


class RefinementTraining(Loop):
    """The refinement, its EMA weights and what is known of the run."""

    name = "refine"
    network: Refine

    def __init__(self, config: RefinementConfig, base: Forecaster) -> None:
        torch.manual_seed(config.seed)
        self.config, self.whole = config, with_forecast_refinement(base, config.name)
        if config.init is not None:
            self._start_from(config.init)
        super().__init__(config.out, self.whole.refine.train(), config.optimiser, config.run)
        self.samples = Samples(config.data, config.seed)
        shown = [read_trained_on(find_model(name)) or {} for name in (config.model, config.init or config.model)]
        self.trained_on = _joined(*shown, self.samples.shown())
        self.perceptual: Perceptual | None = build_perceptual(config.loss)

    def _start_from(self, name: str) -> None:
        given = Forecaster.from_pretrained(name)
        try:
            if not given.refine.of_forecast:
                raise RuntimeError("its refinement is of splatted clouds")
            self.whole.refine.load_state_dict(given.refine.state_dict())
        except RuntimeError as error:
            raise ValueError(f"`init` must have a refinement of forecasts that fits, got {name} ({error})") from error

    def go(self) -> None:
        """To the last step.

        Raises:
            ValueError: data that can't be used, or a loss that is not finite.
        """
        stage, run = self.config.stage, self.config.run
        self.begin(stage)
        for step in range(self.step, stage.steps):
            start = time.perf_counter()
            planes, target = self.samples.batch(step, stage.batch)
            read = time.perf_counter() - start
            with torch.autocast("cpu", torch.bfloat16, enabled=run.precision == "bfloat16"):
                image = self.network(planes)
            terms = image_terms(image.float(), target, self.config.loss, self.perceptual)
            total = torch.stack([weight * term for weight, term in terms.values()]).sum()
            row = self.update(total, {name: term for name, (_, term) in terms.items()}, stage, step)
            row |= {"s_data": read, "s_network": time.perf_counter() - start - read}
            if self.step % run.log_every == 0 or self.step == stage.steps:
                self.log(row | self._geometric(planes, target))
            if self.step % run.checkpoint_every == 0 or self.step == stage.steps:
                self.save()

    def _geometric(self, planes: torch.Tensor, target: torch.Tensor) -> dict[str, float]:
        """The terms of the forecasts as they are."""
        with torch.no_grad():
            terms = image_terms(planes[:, :3], target, self.config.loss, self.perceptual)
        return {f"{name}_geometric": term.item() for name, (_, term) in terms.items()}

    def model(self) -> tuple[ModelConfig, dict[str, torch.Tensor]]:
        """The whole model with the EMA weights."""
        mean = cast(Refine, self.average.module).state_dict()
        state = dict(self.whole.state_dict()) | {f"refine.{name}": value for name, value in mean.items()}
        return self.whole.config, state

    def save_weights(self) -> None:
        """Write the whole model."""
        write_checkpoint(self.out / WEIGHTS, *self.model(), self.trained_on)


def _joined(*shown: Mapping[str, tuple[int, int]]) -> dict[str, tuple[int, int]]:
    """By clip, the first and the last frame of all."""
    found: dict[str, tuple[int, int]] = {}
    for clip, (first, last) in (item for each in shown for item in each.items()):
        before = found.get(clip, (first, last))
        found[clip] = (min(first, before[0]), max(last, before[1]))
    return found


def train(config: RefinementConfig, *, resume: bool = False, base: Forecaster | None = None) -> Path:
    """Train to the last step.

    Args:
        config: of the run.
        resume: from the last state in ``config.out``, if there is one.
        base: in place of the model that ``config.model`` names.

    Returns:
        The model's file.

    Raises:
        ValueError: data or weights that can't be used, a run that exists already, or a non-finite loss.
        FileNotFoundError: no classifier's weights for the perceptual loss.
    """
    check_new(config.out, resume)
    RefinementTraining(config, base or Forecaster.from_pretrained(config.model)).train(resume)
    return config.out / WEIGHTS


@interrupt.command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command; its exit status."""
    options = tyro.cli(RunOptions, args=arguments, description=__doc__, prog="python -m train.refinement")
    try:
        file = train(load_config(options.config, options.overrides), resume=options.resume)
    except ERRORS as error:
        return failed(error)
    Console().print(str(file), highlight=False, markup=False, soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

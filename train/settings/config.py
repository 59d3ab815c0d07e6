"""All settings of a training run: frozen, checked when it is built. `load_config` reads files and overrides.

A configuration is built from plain values: strings for paths, lists for tuples. Whatever is out of range, of another
kind or unknown raises pydantic's ValidationError, a ValueError; `load_config` and `from_dict` put it into words.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

from pydantic import ConfigDict, Field, Strict, TypeAdapter
from pydantic.dataclasses import dataclass

from train.settings.yaml_files import checked, merged, read_settings
from vestcl.models import configuration

Part = Literal["encoder", "ego_motion", "object_motion", "refine"]
"""The parts of `vestcl.models.forecaster.Forecaster` that a stage may train, by the names of its attributes."""

Count = Annotated[int, Strict(), Field(ge=1)]
CountOrNone = Annotated[int, Strict(), Field(ge=0)]
Weight = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Scale = Annotated[float, Field(gt=0, le=1)]

RULES: Final = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, config=RULES)
class DegradeConfig:
    """How images are degraded as cameras do it, by random numbers of the run's seed; 0 leaves a kind out.

    Targets have the blur and the grey of the camera and the exposure of frame t, but no noise and no JPEG: see
    `train.data.degrade`.
    """

    share: Share = 0.5
    """Share of windows that are degraded; the others stay as prepared."""
    grey: Share = 0.25
    """Probability that all images of such a window are grey."""
    exposure: Weight = 0.15
    """Standard deviation, in stops, of the exposure at t - 1 against that at t."""
    white_balance: Weight = 0.03
    """Standard deviation of the logarithm of the gains of red and blue, the same."""
    blur: Share = 0.5
    """Longest time that the shutter is open, as a share of the interval. Targets from the right camera, whose depth is
    not known, make sharp windows."""
    noise: Share = 0.02
    """Highest standard deviation of noise at full signal, which falls with the root of the level."""
    jpeg: Annotated[int, Strict(), Field(ge=1, le=95)] | None = 40
    """Lowest quality; null compresses nothing."""


@dataclass(frozen=True, config=RULES)
class DataConfig:
    """What is shown, and how it is varied."""

    train: tuple[str, ...]
    """Folders that `vestcl prepare` filled; the last part may be a pattern ("streets/seed-*")."""
    weights: tuple[tuple[str, Weight], ...] = ()
    """[folder as in ``train``, weight] each: how often windows are from it. Weights are normalised to a sum of 1;
    folders that are not listed weigh 0; without any each window is shown as often."""
    crop: tuple[Count, Count] | None = None
    """(height, width) px of a window drawn at random; null shows whole images."""
    scale: tuple[Scale, Scale] = (1.0, 1.0)
    """(smallest, largest) factor that images are shrunk by before they are cropped."""
    flip: bool = True
    """Mirror every other sample."""
    colour: Share = 0.2
    """Strength of the change of brightness, contrast and saturation, the same in all frames of a sample."""
    horizons: tuple[Weight, ...] = (1.0,)
    """How often the target is t + 1, t + 2, ...: weights, normalised to a sum of 1."""
    right: Share = 0.0
    """Probability that the target is the right camera, of samples that have one."""
    frames: tuple[CountOrNone, Count] | None = None
    """(first, last) index of the frames that windows may touch, both included; null is the whole clip."""
    degrade: DegradeConfig | None = None
    """How images are degraded; null leaves them as they were prepared."""
    split: Literal["kitti-prediction", "kitti-views"] | None = None
    """Show only the drives that this split of KITTI raw trains on (`vestcl.data.readers.splits`); null shows all
    clips."""
    workers: CountOrNone = 0
    """Processes that read next to the one that trains."""

    def __post_init__(self) -> None:
        if not self.train:
            raise ValueError("`train` must name a folder or more, got none")
        if self.weights and not sum(weight for _, weight in self.weights) > 0:
            raise ValueError(f"`weights` must have a weight above 0, got {[list(entry) for entry in self.weights]}")
        if not sum(self.horizons) > 0:
            raise ValueError(f"`horizons` must have a weight above 0, got {list(self.horizons)}")
        if self.scale[0] > self.scale[1]:
            raise ValueError(f"`scale` must be the smallest factor and then the largest, got {list(self.scale)}")
        if self.frames and self.frames[1] < self.frames[0] + 2:
            raise ValueError(f"`frames` must hold three frames or more, first to last, got {list(self.frames)}")


@dataclass(frozen=True, config=RULES)
class OptimiserConfig:
    """Adam, with decoupled weight decay (AdamW) where that is above 0."""

    betas: tuple[Annotated[float, Field(ge=0, lt=1)], Annotated[float, Field(ge=0, lt=1)]] = (0.9, 0.999)
    """Decays of the running means of the gradient and of its square."""
    weight_decay: Weight = 0.0
    clip_norm: Annotated[float, Field(gt=0)] | None = 1.0
    """The gradient's norm over all parameters is cut to this; null cuts nothing."""
    ema: Annotated[float, Field(ge=0, lt=1)] = 0.999
    """Decay per step of the EMA of the weights, which evaluation uses; 0 keeps none."""
    final_factor: Share = 0.0
    """Where a stage's cosine ends, as a share of the learning rate."""


@dataclass(frozen=True, config=RULES)
class PerceptualConfig:
    """A distance between the features that a classifier has of two images."""

    kind: Literal["none", "vgg19", "squeeze"] = "vgg19"
    weights: Path | None = None
    """The classifier's file (`vestcl.evaluation.trunks.trunks.load_trunk`)."""
    weight: Weight = 1.0

    def __post_init__(self) -> None:
        if self.kind != "none" and self.weight > 0 and self.weights is None:
            raise ValueError(f'`weights` must be set for `kind` "{self.kind}": loss.perceptual.weights=FILE')


@dataclass(frozen=True, config=RULES)
class PoseConfig:
    """Weights of the ego-motion's error, where the true motion is known; 0 leaves it out."""

    rotation: Weight = 0.0
    """1 / radian."""
    translation: Weight = 0.0
    """1 / metre."""


@dataclass(frozen=True, config=RULES)
class LossConfig:
    """Weights of the loss's terms (`train.run.losses.total_loss`); 0 leaves a term out."""

    perceptual: PerceptualConfig
    l1: Weight = 1.0
    ssim: Weight = 0.0
    """1 - SSIM, over as many scales as the image holds; not in the paper."""
    pose: PoseConfig = PoseConfig()
    residual_motion: Weight = 0.0
    """Weight of the distance of object motion from the rigid flow, relative to depth."""
    routing: Weight = 1.0
    """Weight of `vestcl.models.budget_loss` for models with +routing, so that its budget of blocks runs on average."""


@dataclass(frozen=True, config=RULES)
class Stage:
    """A part of the run: what learns, how fast and how long."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][\w-]*$")]
    """A word of letters, digits, "_" and "-"; overrides may name the stage by it (``stages.all.steps=10``)."""
    steps: Count
    """Updates of the weights."""
    batch: Count = 4
    """Samples per update, over all processes."""
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 1e-4
    """After the warm-up; from there it falls along a cosine."""
    warm_up: CountOrNone = 0
    """Steps in which the learning rate rises from 0."""
    train: tuple[Part, ...] = ("encoder", "ego_motion", "object_motion", "refine")
    """The parts that learn; all others are frozen."""
    render: bool = True
    """False leaves out splatting, refinement and all of the loss but the pose's: the cheap way to a camera's motion."""
    crop: tuple[Count, Count] | None = None
    """Replaces the data's."""
    data: DataConfig | None = None
    """Replaces the run's; in files and overrides, the fields that differ."""
    loss: LossConfig | None = None
    """The same."""

    def __post_init__(self) -> None:
        if self.warm_up >= self.steps:
            raise ValueError(f"`warm_up` must be below `steps` = {self.steps}, got {self.warm_up}")
        if not self.train or len(set(self.train)) < len(self.train):
            raise ValueError(f"`train` must name one part or more, each once, got {list(self.train)}")
        if not self.render and not {"encoder", "ego_motion"} >= set(self.train):
            raise ValueError(f"`train` must be of encoder and ego_motion where `render` is off, got {list(self.train)}")


@dataclass(frozen=True, config=RULES)
class RunConfig:
    """How the run is carried out: nothing here but ``precision`` and ``on_nan`` changes the trained weights."""

    checkpoint_every: Count = 500
    """Steps."""
    keep: Annotated[int, Strict(), Field(ge=2)] = 3
    """Checkpoints kept; a damaged one must have one before it."""
    log_every: Count = 10
    """Steps between two rows of scalars."""
    image_every: CountOrNone = 500
    """Steps between two images; 0 writes none."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of encoder and refinement; motion, splatting and losses are float32."""
    on_nan: Literal["stop", "skip"] = "stop"
    """What follows a non-finite loss or gradient."""
    threads: Count | None = None
    """Threads of torch in each process; null: torch's default."""


class Position(NamedTuple):
    """Where in the run a step is."""

    number: int
    """The stage's index."""
    stage: Stage
    step: int
    """Steps of that stage that are done."""


class StageParts:
    """What stages set themselves; elsewhere the run's counts."""

    data: DataConfig
    loss: LossConfig

    def data_of(self, stage: Stage) -> DataConfig:
        """What ``stage`` is shown: its own data or else the run's, with its own crop or else theirs."""
        data = stage.data or self.data
        return data if stage.crop is None else dataclasses.replace(data, crop=stage.crop)

    def loss_of(self, stage: Stage) -> LossConfig:
        """What ``stage`` minimises: its own loss or else the run's."""
        return stage.loss or self.loss


@dataclass(frozen=True, config=RULES)
class Config(StageParts):
    """A run."""

    name: Annotated[str, Field(min_length=1)]
    out: Path
    """Folder of the run: checkpoints, scalars, images."""
    data: DataConfig
    stages: tuple[Stage, ...]
    """One after the other, each with its own optimiser."""
    loss: LossConfig
    model: str = "vest-s"
    """A name that `vestcl.models.configuration` knows, with its variants ("vest-s+no-omf")."""
    init: Path | None = None
    """A model's file to start from; null starts from random weights."""
    init_encoder: Path | None = None
    """A ResNet34's file (torchvision's names, trained on ImageNet) for the encoder's stem and layers to start from."""
    seed: Annotated[int, Strict(), Field(ge=0, lt=2**63)] = 0
    optimiser: OptimiserConfig = OptimiserConfig()
    run: RunConfig = RunConfig()

    def __post_init__(self) -> None:
        try:
            model = configuration(self.model)
        except ValueError as error:
            raise ValueError(f"`model`: {error}") from error
        if self.init is not None and self.init_encoder is not None:
            raise ValueError("`init_encoder` must be null with `init`, which holds the encoder's weights, too")
        names = [stage.name for stage in self.stages]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"`stages` must be one or more, of different names, got {names}")
        absent = {part for part in ("ego_motion", "object_motion") if getattr(model, part) is None}
        for stage in self.stages:
            if absent.issuperset(stage.train):
                raise ValueError(f"`stages.{stage.name}.train` must name a part of {self.model}, got {stage.train}")

    @property
    def steps(self) -> int:
        """Steps of all stages."""
        return sum(stage.steps for stage in self.stages)

    def position(self, step: int) -> Position:
        """The stage that the update after ``step`` updates belongs to; after the last one, the last stage's end.

        Raises:
            ValueError: ``step`` is outside [0, steps].
        """
        if not 0 <= step <= self.steps:
            raise ValueError(f"`step` must be in [0, {self.steps}], got {step}")
        index = 0
        while step >= self.stages[index].steps and index + 1 < len(self.stages):
            step -= self.stages[index].steps
            index += 1
        return Position(index, self.stages[index], step)


def load_config(path: Path | str, overrides: Sequence[str] = ()) -> Config:
    """A configuration from a YAML file, the files that it builds on, and what the command line changes.

    ``base: other.yaml`` in a file, relative to its folder, is read first: mappings are merged, everything else is
    replaced. An override ``key.sub=value`` comes last; its value is YAML, too ("1e-4", "[96, 320]", "null"). A part of
    a key that goes into a list is an index or, for stages, a name (``stages.all.steps=10``).

    Args:
        path: the file.
        overrides: ``key.sub=value`` each.

    Returns:
        The configuration.

    Raises:
        FileNotFoundError: no such file, or a base that does not exist.
        ValueError: everything that is wrong, in one message: keys that are unknown, with the nearest that is known;
            values out of range or of another kind; what the file leaves open and no override sets.
    """
    source = f"{path}{' with ' if overrides else ''}{' '.join(overrides)}"
    return checked(Config, with_stage_parts(read_settings(path, overrides)), source)


def to_dict(config: Config) -> dict[str, Any]:
    """``config`` in plain values, as a checkpoint keeps it: dicts, lists, strings, numbers, None."""
    return dict(_ADAPTER.dump_python(config, mode="json"))


def from_dict(settings: Mapping[str, Any]) -> Config:
    """What `to_dict` was given.

    Raises:
        ValueError: as in `load_config`.
    """
    return checked(Config, with_stage_parts(settings), "the configuration")


def with_stage_parts(settings: Mapping[str, Any]) -> dict[str, Any]:
    """A stage's ``data`` and ``loss`` list what differs from the run's."""
    stages = settings.get("stages")
    if not isinstance(stages, Sequence) or not all(isinstance(stage, Mapping) for stage in stages):
        return dict(settings)
    whole = {name: settings[name] for name in ("data", "loss") if isinstance(settings.get(name), Mapping)}
    full = [
        {**stage, **{name: merged(whole[name], stage[name]) for name in whole if isinstance(stage.get(name), Mapping)}}
        for stage in stages
    ]
    return {**settings, "stages": full}


_ADAPTER: Final = TypeAdapter(Config)

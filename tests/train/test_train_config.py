"""Training's configurations: files, bases, overrides, and what is refused in which words."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest

from train.settings.config import Config, DataConfig, Stage, from_dict, load_config, to_dict
from vestcl.data.readers.splits import (
    CITYSCAPES_TRAIN_SNIPPETS,
    KITTI_PREDICTION_TEST,
    KITTI_PREDICTION_TRAIN,
    KITTI_TRAINING,
    KITTI_VIEWS_TEST,
    KITTI_VIEWS_TRAIN,
    KITTI_VIEWS_VAL,
)

CONFIGS = sorted((Path(__file__).resolve().parents[2] / "train" / "configs").glob("*.yaml"))

#: What shipped files may leave open; each says in its first lines what it does.
OPEN = ("out=runs/a", "data.train=[prepared/*]", "loss.perceptual.weights=trunk.pth")

#: Frames of the left camera in KITTI raw's city drives, by day and number.
KITTI_FRAMES = {
    "09_260001": 108, "09_260002": 77, "09_260005": 154, "09_260009": 447, "09_260011": 233, "09_260013": 144,
    "09_260014": 314, "09_260017": 114, "09_260018": 270, "09_260048": 22, "09_260051": 438, "09_260056": 294,
    "09_260057": 361, "09_260059": 373, "09_260060": 78, "09_260084": 383, "09_260091": 340, "09_260093": 433,
    "09_260095": 268, "09_260096": 475, "09_260104": 312, "09_260106": 227, "09_260113": 87, "09_260117": 660,
    "09_280001": 106, "09_280002": 376, "09_290026": 158, "09_290071": 1059,
}  # fmt: skip

SMALL = """
name: small
out: runs/small
data: {train: [streets]}
loss: {perceptual: {kind: none}}
stages:
  - {name: first, steps: 10, train: [encoder, refine]}
  - {name: second, steps: 20, crop: [32, 64]}
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.yaml"
    path.write_text(SMALL)
    return path


def error_of(path: Path, *overrides: str) -> str:
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - its words are what is tested
        load_config(path, overrides)
    return str(caught.value)


def test_the_papers_epochs() -> None:
    """300 epochs at batch 4; frames of each drive as KITTI raw's release has them."""
    steps = {path.stem: load_config(path, OPEN).steps for path in CONFIGS if path.stem.startswith("vest-paper")}
    frames = {
        drive: KITTI_FRAMES[drive[5:10] + drive[17:21]] for drive in KITTI_PREDICTION_TRAIN + KITTI_PREDICTION_TEST
    }
    assert sum(frames.values()) == 8311
    for name, drives in (("kitti", KITTI_PREDICTION_TRAIN), ("kitti-views", KITTI_VIEWS_TRAIN)):
        windows = sum(frames[drive] - 2 for drive in drives)
        assert steps[f"vest-paper_{name}"] == 300 * windows // 4
    assert steps["vest-paper_cityscapes"] == 300 * CITYSCAPES_TRAIN_SNIPPETS // 4
    assert (
        CITYSCAPES_TRAIN_SNIPPETS == 2975 and "2,945" in (CONFIGS[0].parent / "vest-paper_cityscapes.yaml").read_text()
    )


def test_each_split_of_kitti_has_its_configuration() -> None:
    of = {path.stem: load_config(path, OPEN).data.split for path in CONFIGS}
    assert (of["vest-paper_kitti"], of["vest-paper_kitti-views"]) == ("kitti-prediction", "kitti-views")
    assert not set(KITTI_TRAINING["kitti-views"]) & {*KITTI_VIEWS_TEST, *KITTI_VIEWS_VAL}
    assert not set(KITTI_TRAINING["kitti-prediction"]) & set(KITTI_PREDICTION_TEST)
    assert of["vest-s_street"] is None


def test_a_file_and_its_defaults(small: Path) -> None:
    config = load_config(small)
    assert config.out == Path("runs/small") and config.data.train == ("streets",)
    assert (config.model, config.seed, config.optimiser.betas) == ("vest-s", 0, (0.9, 0.999))
    assert [stage.steps for stage in config.stages] == [10, 20] and config.steps == 30
    assert config.stages[0].train == ("encoder", "refine") and config.stages[1].crop == (32, 64)


@pytest.mark.parametrize(
    ("override", "key", "value"),
    [
        ("seed=7", "seed", 7),
        ("data.horizons=[0.5, 0.5]", "data.horizons", (0.5, 0.5)),
        ("data.frames=[0, 35]", "data.frames", (0, 35)),
        ("optimiser.weight_decay=1e-4", "optimiser.weight_decay", 1e-4),
        ("optimiser.clip_norm=null", "optimiser.clip_norm", None),
        ("run.keep=5", "run.keep", 5),
        ("init=models/vest-s=old.safetensors", "init", Path("models/vest-s=old.safetensors")),
        ("stages.1.learning_rate=2E-3", "stages.1.learning_rate", 2e-3),
        ("stages.first.batch=16", "stages.0.batch", 16),
        ("loss.pose.rotation=.5", "loss.pose.rotation", 0.5),
    ],
)
def test_overrides_are_yaml(small: Path, override: str, key: str, value: Any) -> None:
    config: Any = load_config(small, [override])
    for part in key.split("."):
        config = config[int(part)] if part.isdecimal() else getattr(config, part)
    assert config == value and type(config) is type(value)


def test_the_last_override_counts(small: Path) -> None:
    assert load_config(small, ["seed=1", "seed=2"]).seed == 2


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("data.horizon=[1]", "`data.horizon` is not a key; did you mean `data.horizons`?"),
        ("sede=1", "`sede` is not a key; did you mean `seed`?"),
        ("stages.1.learning_rat=1", "`stages.1.learning_rat` is not a key; did you mean `stages.1.learning_rate`?"),
        ("optimizer.ema=0.9", "`optimizer` is not a key; did you mean `optimiser`?"),
        ("warm_up=3", "`warm_up` is not a key; did you mean `stages.warm_up`?"),
        ("xyzzy=1", "`xyzzy` is not a key"),
        ("data.train=null", "`data.train` must be set: add data.train=..."),
        ("data.train=[]", "`data`: `train` must name a folder or more, got none"),
        ("out=null", "`out` must be set: add out=..."),
        ("stages.0.steps=0", "`stages.0.steps` must be greater than or equal to 1, got 0"),
        ("stages.0.steps=yes", "`stages.0.steps` must be a valid integer, got True"),
        ("stages.0.warm_up=10", "`stages.0`: `warm_up` must be below `steps` = 10, got 10"),
        ("stages.0.train=[decoder]", "`stages.0.train.0` must be 'encoder', 'ego_motion', 'object_motion' or 'refine'"),
        ("stages.0.name=second", "`stages` must be one or more, of different names, got ['second', 'second']"),
        ("data.right=1.5", "`data.right` must be less than or equal to 1, got 1.5"),
        ("data.horizons=[0, 0]", "`data`: `horizons` must have a weight above 0, got [0.0, 0.0]"),
        ("data.scale=[1, 0.5]", "`data`: `scale` must be the smallest factor and then the largest, got [1.0, 0.5]"),
        ("data.frames=[4, 5]", "`data`: `frames` must hold three frames or more, first to last, got [4, 5]"),
        ("loss.l1=.nan", "`loss.l1` must be a finite number, got nan"),
        ("optimiser.ema=1", "`optimiser.ema` must be less than 1, got 1"),
        ("run.precision=float16", "`run.precision` must be 'float32' or 'bfloat16', got 'float16'"),
        ("run.keep=1", "`run.keep` must be greater than or equal to 2, got 1"),
        ("loss.perceptual.kind=vgg19", "loss.perceptual.weights=FILE"),
        ("model=vest-x", "`model`: `name` must begin with one of vest-paper, vest-s, got 'vest-x'"),
        ("stages.third.steps=1", "'third' must be first, second or below 2"),
        ("name.x=1", "nothing is beneath the key before 'x', which is 'small'"),
        ("seed", "an override must be key=value or key.sub=value, got 'seed'"),
        ("seed=[1", "must be YAML"),
    ],
)
def test_what_is_wrong_is_said(small: Path, override: str, words: str) -> None:
    assert words in error_of(small, override)


def test_everything_that_is_wrong_is_in_one_message(small: Path) -> None:
    message = error_of(small, "out=null", "data.color=0.1", "stages.0.steps=-1")
    assert message.startswith(f"{small} with out=null")
    assert all(
        key in message for key in ("`out`", "`data.color` is not a key; did you mean `data.colour`?", "`stages.0")
    )
    assert len(message.splitlines()) == 4


def test_a_stage_must_train_a_part_that_the_model_has(small: Path) -> None:
    overrides = ["stages.0.train=[ego_motion]", "model=vest-s+no-emf"]
    assert "`stages.first.train` must name a part of vest-s+no-emf" in error_of(small, *overrides)
    assert load_config(small, overrides[:1]).stages[0].train == ("ego_motion",)


def test_bases_are_merged_key_by_key_and_lists_replaced(small: Path) -> None:
    (small.parent / "below").mkdir()
    upper = small.parent / "below" / "upper.yaml"
    upper.write_text("base: ../small.yaml\nseed: 3\ndata: {flip: false}\nstages: [{name: only, steps: 1}]")
    config = load_config(upper)
    assert (config.name, config.seed, len(config.stages)) == ("small", 3, 1)
    assert config.data == DataConfig(train=("streets",), flip=False)


def test_bases_that_are_absent_or_in_a_circle(small: Path) -> None:
    small.write_text("base: other.yaml")
    with pytest.raises(FileNotFoundError, match=r"other.yaml, which .*small.yaml builds on"):
        load_config(small)
    (small.parent / "other.yaml").write_text("base: small.yaml")
    assert "must not lead back" in error_of(small)
    with pytest.raises(FileNotFoundError, match="no configuration at"):
        load_config(small.parent / "none.yaml")
    small.write_text("- a list")
    assert "must hold a mapping" in error_of(small)


def test_a_stage_says_what_differs_in_its_loss(small: Path) -> None:
    config = load_config(small, ["loss.ssim=0.2", "loss.pose.rotation=3", "stages.second.loss.pose.translation=2"])
    first, second = (config.loss_of(stage) for stage in config.stages)
    assert first == config.loss and (first.pose.rotation, first.pose.translation) == (3, 0)
    assert (second.ssim, second.pose.rotation, second.pose.translation) == (0.2, 3, 2)
    assert second.perceptual == first.perceptual
    assert from_dict(to_dict(config)) == config
    assert "`stages.1.loss.sim`" in error_of(small, "stages.second.loss.sim=1")


def test_a_stage_says_what_differs_in_its_data(small: Path) -> None:
    config = load_config(small, ["data.colour=0.5", "stages.second.data.flip=false", "stages.first.data.crop=[8, 8]"])
    first, second = config.stages
    assert config.data_of(first) == dataclasses.replace(config.data, crop=(8, 8))
    assert config.data_of(second) == dataclasses.replace(config.data, flip=False, crop=(32, 64))
    assert config.data_of(second).colour == 0.5
    assert config.data_of(Stage("plain", 1)) == config.data


def test_position_walks_through_the_stages(small: Path) -> None:
    config = load_config(small)
    assert [config.position(step)[::2] for step in (0, 9, 10, 29, 30)] == [(0, 0), (0, 9), (1, 0), (1, 19), (1, 20)]
    assert config.position(12).stage.name == "second"
    for step in (-1, 31):
        with pytest.raises(ValueError, match="`step` must be in"):
            config.position(step)


def test_configurations_are_frozen(small: Path) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        load_config(small).seed = 1  # type: ignore[misc]


def test_the_shipped_ones_are_there() -> None:
    sets = {f"{model}_{data}" for model in ("vest-s", "vest-paper") for data in ("street", "kitti", "cityscapes")}
    variants = {f"{name}_{kind}" for name in sets if "paper" in name for kind in ("two-stages", "mirrored")}
    more = {"vest-paper_kitti-views", "vest-s_kitti-clip", "vest-s_road", "ablation_street"}
    assert {path.stem for path in CONFIGS} == sets | variants | more


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_shipped_one_loads_once_what_it_leaves_open_is_set(path: Path) -> None:
    config = load_config(path, OPEN)
    assert config.name == path.stem and path.stem.startswith((config.model, "ablation"))
    assert isinstance(config, Config) and from_dict(json.loads(json.dumps(to_dict(config)))) == config
    reported = "".join(line for line in path.read_text().splitlines(keepends=True) if line.startswith("#"))
    for number in range(len(OPEN)):
        key, others = OPEN[number].partition("=")[0], (*OPEN[:number], *OPEN[number + 1 :])
        if re.search(rf"(?<![\w-]){re.escape(key)}\b", reported):
            assert key in error_of(path, *others)
        else:
            assert load_config(path, others).name == path.stem


def test_what_is_tuned_on_real_streets_has_frames_and_folders_of_its_own() -> None:
    """Their base's clips of ten frames, its data and its run are not theirs."""
    configs = {path.stem: load_config(path, OPEN) for path in CONFIGS if path.stem.startswith("vest-s")}
    frames = {name: config.data.frames for name, config in configs.items()}
    assert frames == {
        "vest-s_street": (1, 9), "vest-s_kitti": None, "vest-s_cityscapes": None, "vest-s_kitti-clip": (0, 35),
        "vest-s_road": (1, 8),
    }  # fmt: skip


@pytest.mark.parametrize("path", [path for path in CONFIGS if "paper" in path.stem], ids=lambda path: path.stem)
def test_the_papers_settings(path: Path) -> None:
    config = load_config(path, OPEN)
    assert {stage.learning_rate for stage in config.stages} == {1e-4} and {s.batch for s in config.stages} == {4}
    assert config.loss.l1 == config.loss.perceptual.weight == 1 and config.loss.perceptual.kind == "vgg19"
    assert not any((config.loss.ssim, config.loss.residual_motion, *dataclasses.astuple(config.loss.pose)))
    assert config.model == "vest-paper" and len(config.stages[-1].train) == 4
    assert config.data.crop is None and config.data.scale == (1, 1) and not config.data.colour
    assert config.data.flip == path.stem.endswith("mirrored")
    stages = [stage.name for stage in config.stages]
    assert stages == (["ego", "all"] if path.stem.endswith("two-stages") else ["all"])
    windows = {"street": 400, "kitti": 6894, "kitti-views": 5949, "cityscapes": 2975}[path.stem.split("_")[1]]
    assert config.steps == 300 * windows // 4
    assert config.data.horizons == (1.0,) and not config.data.right and config.run.precision == "float32"
    assert not any(stage.warm_up for stage in config.stages) and all(stage.render for stage in config.stages)
    adam = config.optimiser
    assert adam.betas == (0.9, 0.999) and adam.clip_norm is None and not any(
        (adam.weight_decay, adam.ema, adam.final_factor)
    )  # fmt: skip


def test_the_encoders_public_weights_are_a_key() -> None:
    (path,) = [path for path in CONFIGS if path.stem == "vest-paper_street"]
    assert load_config(path, OPEN).init_encoder is None
    assert load_config(path, (*OPEN, "init_encoder=resnet34.pth")).init_encoder == Path("resnet34.pth")
    words = error_of(path, *OPEN, "init_encoder=resnet34.pth", "init=model.safetensors")
    assert "`init_encoder` must be null with `init`" in words

"""vestcl.models.config: models by name, and what they refuse to be."""

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch

from vestcl.models import (
    CONFIGS,
    VARIANTS,
    EgoMotion,
    Encoder,
    ModelConfig,
    ObjectMotion,
    Refine,
    RigidMotion,
    configuration,
)
from vestcl.models.config import (
    EgoMotionConfig,
    EncoderConfig,
    ObjectMotionConfig,
    RefineConfig,
    RenderConfig,
    RoutingConfig,
)


def test_names() -> None:
    assert list(CONFIGS) == ["vest-paper", "vest-s"]
    for name, config in CONFIGS.items():
        assert configuration(name) is config or configuration(name) == config
        assert config.name == name


def test_the_paper() -> None:
    config = configuration("vest-paper")
    assert config.encoder.features == 32
    assert config.object_motion is not None and config.object_motion.shape == "paper"
    assert config.object_motion.routing is None and config.fixed_depth is None
    assert config.render.side_channels(32) == 32 and config.render.channels(32) == 64
    assert not config.render.joint and config.refine.base == "none"
    assert config.start == "rest" and config.default_mode == "feedback" and not config.object_motion.inpainted
    assert configuration("vest-paper+colour").render.channels(32) == 74
    assert config.encoder == EncoderConfig((64, 128, 256), (3, 4, 6), (128, 64), features=32, background="own")
    assert config.ego_motion == EgoMotionConfig((64, 64, 128, 128), blocks=2, heads=4, mlp_ratio=4, path=1)
    objects = config.object_motion
    assert objects.scales == (4, 4, 4, 2, 2, 2, 1, 1, 1) and objects.widths == (160,) * 3 + (80,) * 3 + (44,) * 3
    assert objects.detail == 8 and objects.where == "everywhere"
    assert config.render == RenderConfig(
        colour=False, joint=False, rho=1.5, stretched=False, inpainted="own", previous="all", normalised=False
    )
    assert config.refine == RefineConfig(stem=32, stem_kernel=7, widths=(64, 128, 256, 512), base="none")


def test_every_variant_changes_its_own_field() -> None:
    changed: dict[str, Callable[[ModelConfig], Any]] = {
        "fixed-depth": lambda c: c.fixed_depth == 20.0 and c.object_motion.where == "everywhere",
        "no-emf": lambda c: c.ego_motion is None and c.object_motion.where == "everywhere",
        "no-omf": lambda c: c.object_motion is None,
        "colour": lambda c: c.render.side_channels(32) == 37,
        "features-only": lambda c: not c.render.colour and c.render.channels(32) == 64,
        "joint": lambda c: c.render.joint and c.render.channels(32) == c.render.side_channels(32),
        "residual": lambda c: c.refine.base == "splatted" and c.render.colour and not c.render.normalised,
        "filled": lambda c: c.refine.base == "filled" and c.render.colour and c.render.normalised,
        "painting": lambda c: c.refine.base == "none" and not c.render.normalised,
        "from-rest": lambda c: c.start == "rest",
        "from-prior": lambda c: c.start == "prior",
        "feedback": lambda c: c.default_mode == "feedback",
        "compose": lambda c: c.default_mode == "compose",
        "omf-inpainted": lambda c: c.object_motion is not None and c.object_motion.inpainted,
        "omf-paper": lambda c: c.object_motion is not None and c.object_motion.shape == "paper",
        "omf-dmvfn": lambda c: c.object_motion is not None and c.object_motion.shape == "dmvfn",
        "routing": lambda c: c.object_motion is not None and c.object_motion.routing == RoutingConfig(budget=4.5),
    }
    assert set(changed) == set(VARIANTS)
    for base in CONFIGS:
        for variant, holds in changed.items():
            config = configuration(f"{base}+{variant}")
            assert holds(config) and config.name == f"{base}+{variant}"
            different = {
                f.name for f in dataclasses.fields(config) if getattr(config, f.name) != getattr(CONFIGS[base], f.name)
            }
            if variant == "from-rest":  # and no further than the next frame
                assert different <= {"name", "start", "ego_motion"}
            elif variant == "fixed-depth":  # object motion corrects all
                assert different <= {"name", "fixed_depth", "object_motion"}
            elif variant == "no-emf":  # object motion moves all
                assert different <= {"name", "ego_motion", "object_motion"}
            elif variant in ("features-only", "residual", "filled", "painting"):  # what is rendered, what is added to
                assert different <= {"name", "render", "refine"}
            else:
                assert len(different) <= 2


def test_a_path_needs_a_prior() -> None:
    """The variant from rest forecasts the next frame only; from its prior vest-s forecasts five."""
    paths = {}
    for name in ("vest-paper", "vest-s", "vest-s+from-rest", "vest-s+from-prior", "vest-paper+from-prior"):
        ego_motion = configuration(name).ego_motion
        paths[name] = ego_motion and ego_motion.path
    assert paths == {
        "vest-paper": 1, "vest-s": 5, "vest-s+from-rest": 1, "vest-s+from-prior": 5, "vest-paper+from-prior": 1,
    }  # fmt: skip
    assert configuration("vest-s+no-emf+from-rest").ego_motion is None


def test_later_frames_are_forecast_recursively_by_models_that_start_from_rest() -> None:
    """As the paper does; from a prior motion is composed. Variants say otherwise, wherever they are in the name."""
    modes = {
        "vest-paper": "feedback", "vest-s": "compose", "vest-s+from-rest": "feedback",
        "vest-paper+from-prior": "compose", "vest-paper+compose": "compose", "vest-s+feedback": "feedback",
        "vest-s+compose+from-rest": "compose", "vest-s+from-rest+no-emf": "feedback",
    }  # fmt: skip
    assert {name: configuration(name).default_mode for name in modes} == modes
    assert ModelConfig("mine").default_mode == "feedback" and ModelConfig("mine", start="prior").mode is None


def test_the_fixed_depth_is_to_be_searched() -> None:
    for name, metres in (("vest-s+fixed-depth=35", 35.0), ("vest-paper+fixed-depth=7.5+no-omf", 7.5)):
        assert configuration(name).fixed_depth == metres and configuration(name).name == name


def test_variants_add_up() -> None:
    config = configuration("vest-s+joint+residual+no-emf+routing+omf-paper")
    assert config.render.joint and config.refine.base == "splatted" and config.ego_motion is None
    assert config.object_motion is not None
    assert config.object_motion.routing is not None and config.object_motion.shape == "paper"


@pytest.mark.parametrize("name", ["vest-s", *(f"vest-s+{variant}" for variant in VARIANTS)])
def test_the_parts_of_a_model_fit(name: str) -> None:
    config = configuration(name)
    features = Encoder(config.encoder)(torch.rand(1, 3, 16, 32))
    channels, depth, mask = config.encoder.features, torch.rand(1, 1, 4, 8) * 50, torch.ones(1, 1, 4, 8)
    assert features.shape[1] == channels
    if config.ego_motion:
        rest = RigidMotion(torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3))
        prior = None if config.start == "rest" else (rest, rest, rest)
        camera = EgoMotion(config.ego_motion, channels, config.start)
        motion = camera(features, features, depth, depth, mask, mask, prior)
        assert len(motion.later) == config.ego_motion.path - 1
    if config.object_motion:
        network = ObjectMotion(config.object_motion, channels)
        behind = [features, features, depth, depth] if config.object_motion.inpainted else []
        seen = features, features, depth, depth, mask, mask, torch.rand(1, 6, 4, 8)
        assert network(*seen, backgrounds=behind).flow.shape == (1, 6, 4, 8)
    refine = Refine(config.refine, config.render, channels)
    assert refine(torch.rand(1, config.render.channels(channels), 16, 32)).shape == (1, 3, 16, 32)


def test_frozen_and_hashable() -> None:
    config = configuration("vest-s")
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.fixed_depth = 3.0  # type: ignore[misc]
    assert len({config, configuration("vest-s"), configuration("vest-paper")}) == 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: configuration("vest-xl"), "`name` must begin with one of vest-paper, vest-s, got 'vest-xl'"),
        (lambda: configuration("vest-s+fast"), r"`name` may add \+fixed-depth, .*, \+routing, got '\+fast'"),
        (lambda: configuration("vest-s+"), r"got '\+'"),
        (lambda: configuration("vest-s+no-omf+routing"), "'vest-s' has no object motion to change"),
        (lambda: configuration("vest-s+features-only+residual"), r"needs `render.colour`"),
        (lambda: configuration("vest-paper+features-only+colour"), r"not have both \+colour, .* and \+features-only"),
        (lambda: configuration("vest-s+fixed-depth=far"), r"'\+fixed-depth=far': could not convert"),
        (lambda: configuration("vest-s+fixed-depth=nan"), r"`fixed_depth` must be in \[0.1, 1000.0\] m, got nan"),
        (lambda: configuration("vest-s+joint=3"), r"`name` may give \+fixed-depth a number, got '\+joint=3'"),
        (lambda: ModelConfig("mine", mode="dream"), '`mode` must be "feedback", "compose" or None, got \'dream\''),  # type: ignore[arg-type]
        (lambda: EgoMotionConfig(heads=3), r"`widths\[-1\]` must be a multiple of 4 `heads` = 12, got 256"),
        (lambda: EgoMotionConfig(path=0), "`path` must be 1 or more, got 0"),
        (
            lambda: ModelConfig("mine", ego_motion=EgoMotionConfig(path=2)),
            '`ego_motion.path` must be 1 with `start` "rest", got 2',
        ),
        (lambda: ObjectMotionConfig(shape="vgg"), '`shape` must be "paper" or "dmvfn", got \'vgg\''),  # type: ignore[arg-type]
        (lambda: ObjectMotionConfig(scales=(4, 2)), r"`scales` and `widths` must have equal length, got \(4, 2\)"),
        (lambda: ObjectMotionConfig(scales=(), widths=()), "`scales` and `widths` must have equal length"),
        (lambda: ObjectMotionConfig(scales=(2,), widths=(42,)), "`widths` multiples of 4"),
        (lambda: ObjectMotionConfig(scales=(0,), widths=(8,)), "`scales` must be >= 1"),
        (
            lambda: ObjectMotionConfig(routing=RoutingConfig(budget=9.0)),
            r"`routing.budget` must be in \(0, 9\), got 9.0",
        ),
        (
            lambda: ModelConfig("mine", refine=RefineConfig(base="splatted"), render=RenderConfig(colour=False)),
            r"needs `render.colour`",
        ),
        (lambda: configuration("vest-s+features-only+filled"), r"needs `render.colour`"),
        (lambda: RefineConfig(base="sky"), '`base` must be "none", "splatted" or "filled", got \'sky\''),  # type: ignore[arg-type]
        (lambda: ModelConfig("mine", refine=RefineConfig(base="filled")), '"filled" needs `render.normalised`'),
        (lambda: ModelConfig("mine", start="zero"), '`start` must be "rest" or "prior", got \'zero\''),  # type: ignore[arg-type]
        (lambda: ModelConfig("mine", fixed_depth=0.0), r"`fixed_depth` must be in \[0.1, 1000.0\] m, got 0.0"),
    ],
)
def test_refuses(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()

"""Every size and choice of the networks, frozen. `configuration` knows them by name: "vest-s+no-omf+joint".

    vest-paper              the paper's widths
    vest-s                  widths that two CPU cores train
    +fixed-depth            ablation A of the paper: every pixel at FIXED_DEPTH; +fixed-depth=35 puts it at 35 m
    +no-emf  +no-omf        ablations B and C: without ego-motion (object motion moves all), without object motion
    +colour                 colour, coverage and inverse depth are rendered, too: 37 channels per side in place of 32
    +features-only          the features and nothing else are rendered, as vest-paper does
    +joint                  both clouds splatted together in one depth-ordered pass
    +residual               refinement adds to the splatted colour instead of predicting RGB directly
    +filled                 it adds to that colour divided by coverage, holes filled from what surrounds them
    +painting               it predicts RGB directly
    +from-rest              motion starts from rest, not from measurements
    +from-prior             motion starts from measurements: see `MotionPrior`
    +feedback  +compose     how later frames are forecast by default; without them as `ModelConfig.mode` says
    +omf-paper  +omf-dmvfn  the two published shapes of object motion
    +omf-inpainted          object motion sees the inpainted layers, too
    +routing                a small network picks which blocks of object motion run

Source: SPEC sections 3 to 7.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal, get_args

from vestcl import constants
from vestcl.times import is_same

Mode = Literal["feedback", "compose"]
"""How frames after the first are forecast; see `vestcl.models.forecaster.Forecaster.forecast`."""

#: Depth goes into the networks as log(metres), clamped from below where the splatter stops drawing ...
LOG_DEPTH_NEAR: Final = constants.NEAR
#: ... and from above where, for a car's camera, everything is equally far: 1 km moves less than a pixel per frame.
LOG_DEPTH_FAR: Final = 1000.0

#: Depth of every pixel in the ablation "fixed depth", metres, where the variant gives none: about the median of a
#: street seen from a car. The paper takes the best one, so search: +fixed-depth=10, =20, =40 ...
FIXED_DEPTH: Final = 20.0

#: Channels per group of GroupNorm: encoder (of 1 to 64 that its authors tried on ImageNet, 16 were the best) ...
ENCODER_GROUP: Final = 16
#: ... and refinement (as in 3D Moments).
REFINE_GROUP: Final = 32

#: The footprint's radius in source pixels (3D Moments): for features that a network then refines.
RHO: Final = 1.5

#: A pixel that is covered by less has no depth: only one footprint's outermost tenth is on it.
LEAST_COVERAGE: Final = 0.1

#: From this coverage on a side hides what is behind it: only cracks between a surface's points let it through.
OPAQUE: Final = 0.5

#: Planes that refinement of geometric forecasts is shown: `vestcl.forecasting.network.planes`.
FORECAST_PLANES: Final = 7

#: The largest amount that it changes a colour by, of 1, where a pixel is covered; where nothing covers it, by 1.
MOST_CHANGE: Final = 0.25

#: The same as RHO where colour is shown directly, and refinement only adds to it (SPEC section 2).
RHO_DIRECT: Final = 0.95


@dataclass(frozen=True)
class EncoderConfig:
    """Residual trunk and decoder. The defaults are ResNet34 without layer4, whose public weights then fit."""

    widths: tuple[int, int, int] = (64, 128, 256)
    """Channels of layers 1 to 3; the stem has those of layer 1."""
    blocks: tuple[int, int, int] = (3, 4, 6)
    """Residual blocks of layers 1 to 3."""
    decoder: tuple[int, int] = (128, 64)
    """Channels of the decoder at H/8 and, before layer 1 joins it, at H/4."""
    features: int = 32
    """Channels out."""
    background: Literal["own", "frame"] = "own"
    """"own": the inpainted background is a separate image. "frame": it is normalised by its frame's statistics, and
    where it is the frame itself, so are its features: then it need only be encoded where they differ."""


@dataclass(frozen=True)
class EgoMotionConfig:
    """Convolutions shared over both frames, then self-attention over what they give."""

    widths: tuple[int, int, int, int] = (64, 64, 128, 128)
    """Channels of the four convolutions; a token has twice the last."""
    blocks: int = 2
    """Self-attention blocks."""
    heads: int = 4
    mlp_ratio: int = 4
    """Hidden units of a block's MLP over channels of a token."""
    path: int = 1
    """Frame intervals ahead that the camera's motion is forecast for in one go; more than one needs a prior."""
    correction: Literal["linear", "bounded"] = "linear"
    """How a prior is corrected: "linear" in the last two motions, at one frame rate; or "bounded" by what a car can do
    within the time between frames, which is an input, and gated (`vestcl.models.networks.camera_correction`)."""

    def __post_init__(self) -> None:
        if self.correction not in ("linear", "bounded"):
            raise ValueError(f'`correction` must be "linear" or "bounded", got {self.correction!r}')
        if (channels := 2 * self.widths[-1]) % (4 * self.heads):
            raise ValueError(f"2 `widths[-1]` must be a multiple of 4 `heads` = {4 * self.heads}, got {channels}")
        if self.path < 1:
            raise ValueError(f"`path` must be 1 or more, got {self.path}")


@dataclass(frozen=True)
class RoutingConfig:
    """Which blocks of object motion run for which scene (DMVFN)."""

    width: int = 32
    """Channels of the two convolutions."""
    budget: float = 4.5
    """Blocks that should run on average."""
    rule: Literal["threshold", "top"] = "threshold"
    """Blocks that run outside training: of probability 1/2 and more, or the (rounded) budget's most probable."""


@dataclass(frozen=True)
class ObjectMotionConfig:
    """A cascade of multi-scale motion-flow blocks, one for each entry of ``scales`` and ``widths``."""

    shape: Literal["paper", "dmvfn"] = "paper"
    """"paper" keeps each block's resolution (ReLU); "dmvfn" works at a quarter of it (PReLU) and costs a tenth."""
    scales: tuple[int, ...] = (4, 4, 4, 2, 2, 2, 1, 1, 1)
    """Branch A of block i sees its input shrunk by scales[i]."""
    widths: tuple[int, ...] = (160, 160, 160, 80, 80, 80, 44, 44, 44)
    """Channels of branch A; multiples of 4."""
    detail: int = 8
    """Channels of branch B, at full resolution."""
    where: Literal["everywhere", "foreground"] = "everywhere"
    """"foreground": static background by the mask keeps the motion that object motion starts from."""
    routing: RoutingConfig | None = None
    """None runs every block."""
    inpainted: bool = False
    """Blocks see the features and log depths of both frames' inpainted backgrounds, too."""

    def __post_init__(self) -> None:
        if self.shape not in ("paper", "dmvfn"):
            raise ValueError(f'`shape` must be "paper" or "dmvfn", got {self.shape!r}')
        if not self.scales or len(self.scales) != len(self.widths):
            raise ValueError(f"`scales` and `widths` must have equal length, got {self.scales} and {self.widths}")
        if min(self.scales) < 1 or any(width % 4 or width < 4 for width in self.widths):
            raise ValueError(f"`scales` must be >= 1, `widths` multiples of 4, got {self.scales} and {self.widths}")
        if self.routing and not 0 < self.routing.budget < len(self.scales):
            raise ValueError(f"`routing.budget` must be in (0, {len(self.scales)}), got {self.routing.budget}")


@dataclass(frozen=True)
class RenderConfig:
    """What the clouds carry to the new view, and how they are splatted."""

    colour: bool = True
    """Colour, coverage and inverse depth are rendered with the features; False renders only the features."""
    joint: bool = False
    """Both clouds in one depth-ordered pass; False renders each on its own, previous frame first."""
    rho: float = RHO
    """Radius in source pixels."""
    stretched: bool = False
    """Radii grow with the distance between a surface's points, and points without a surface are left out."""
    inpainted: Literal["own", "last", "inner"] = "own"
    """"own": the background behind a frame's foreground is part of that frame's cloud, at its own depth. "last": only
    the current frame's is shown, as part of the previous frame's cloud, and behind all that this one has seen. "inner":
    and where the current frame leaves a hole inside the image that is not a crack; needs ``previous`` "uncovered"."""
    previous: Literal["all", "uncovered"] = "all"
    """"uncovered": the previous frame's cloud shows only where the current one's covers less than OPAQUE."""
    normalised: bool = False
    """Features, colour and inverse depth go into refinement divided by coverage; False leaves them times coverage."""

    def __post_init__(self) -> None:
        if self.inpainted == "inner" and (self.previous != "uncovered" or self.joint):
            raise ValueError('`inpainted` may be "inner" with `previous` "uncovered" only, and not with `joint`')

    def side_channels(self, features: int) -> int:
        """Channels of one rendered image: features, and then colour 3, coverage 1, inverse depth 1 (1/m)."""
        return features + 5 if self.colour else features

    def channels(self, features: int) -> int:
        """Channels that go into refinement: both sides, or the joint one."""
        return self.side_channels(features) * (1 if self.joint else 2)


@dataclass(frozen=True)
class RefineConfig:
    """U-Net from rendered channels to the image."""

    stem: int = 32
    """Channels at full resolution."""
    stem_kernel: int = 7
    widths: tuple[int, ...] = (64, 128, 256, 512)
    """Channels at H/2, H/4, ...; the bottleneck has the last."""
    base: Literal["none", "splatted", "filled"] = "none"
    """What refinement adds to: coverage x splatted colour; or that colour divided by coverage and, where nothing
    covers, filled from what surrounds it. "none" predicts RGB directly through a sigmoid."""
    refines: Literal["clouds", "forecast"] = "clouds"
    """"clouds": the splatted clouds, features among them. "forecast": planes of a geometric forecast
    (`vestcl.forecasting.network.planes`), whose image it adds to; the network's own forecast is then its base,
    unrefined."""

    def __post_init__(self) -> None:
        if self.base not in ("none", "splatted", "filled"):
            raise ValueError(f'`base` must be "none", "splatted" or "filled", got {self.base!r}')
        if self.refines not in ("clouds", "forecast"):
            raise ValueError(f'`refines` must be "clouds" or "forecast", got {self.refines!r}')
        if self.refines == "forecast" and self.base == "none":
            raise ValueError('`base` must not be "none" with `refines` "forecast": that adds to an image')


@dataclass(frozen=True)
class ModelConfig:
    """The whole model."""

    name: str
    encoder: EncoderConfig = EncoderConfig()
    ego_motion: EgoMotionConfig | None = EgoMotionConfig()
    """None: cameras are assumed static, and object motion has to explain it all, that of inpainted points, too."""
    object_motion: ObjectMotionConfig | None = ObjectMotionConfig()
    """None: all points follow the camera's motion."""
    render: RenderConfig = RenderConfig()
    refine: RefineConfig = RefineConfig()
    fixed_depth: float | None = None
    """Metres, for every pixel, and 1 % more for the background that foreground hides. Motion is then a 2D flow: its z
    is 0. None uses the depth that comes in."""
    start: Literal["rest", "prior"] = "rest"
    """What motion networks correct: no motion, or one that was measured and extrapolated (`MotionPrior`)."""
    prior: Literal["velocity", "forecast"] = "velocity"
    """The camera's motion that a prior starts from: at constant velocity, or `vestcl.scene.motion.camera_forecast`."""
    interval_s: float = 0.1
    """Seconds from frame to frame that motion networks learned at; a prior over another interval is not corrected."""
    intervals_s: tuple[float, float] | None = None
    """The shortest and the longest of them, where a network learned at several; None is `interval_s`."""
    mode: Mode | None = None
    """How frames after the first are forecast unless a call sets it; None follows `start`: "feedback" from rest,
    as the paper does, "compose" from a prior. `default_mode` has the answer."""

    def knows(self, seconds: float) -> bool:
        """Whether motion networks learned at frames that are ``seconds`` apart, up to a fifth."""
        shortest, longest = self.intervals_s or (self.interval_s, self.interval_s)
        return shortest <= seconds <= longest or is_same(seconds, shortest) or is_same(seconds, longest)

    @property
    def learned_at(self) -> str:
        """The seconds between frames that motion networks learned at: "0.1 s", or "0.033 to 0.125 s"."""
        if self.intervals_s is None or self.intervals_s[0] == self.intervals_s[1]:
            return f"{self.interval_s:g} s"
        return "{:.3g} to {:.3g} s".format(*self.intervals_s)

    @property
    def default_mode(self) -> Mode:
        """`mode`, or what follows from `start`."""
        return self.mode or ("feedback" if self.start == "rest" else "compose")

    def __post_init__(self) -> None:
        if self.mode is not None and self.mode not in get_args(Mode):
            raise ValueError(f'`mode` must be "feedback", "compose" or None, got {self.mode!r}')
        if self.start not in ("rest", "prior"):
            raise ValueError(f'`start` must be "rest" or "prior", got {self.start!r}')
        if self.prior not in ("velocity", "forecast"):
            raise ValueError(f'`prior` must be "velocity" or "forecast", got {self.prior!r}')
        if self.start == "rest" and self.ego_motion is not None and self.ego_motion.path > 1:
            raise ValueError(f'`ego_motion.path` must be 1 with `start` "rest", got {self.ego_motion.path}')
        if not 0 < self.interval_s < float("inf"):
            raise ValueError(f"`interval_s` must be positive seconds, got {self.interval_s}")
        if self.intervals_s is not None and not 0 < self.intervals_s[0] <= self.intervals_s[1] < float("inf"):
            raise ValueError(f"`intervals_s` must be positive seconds that rise, got {self.intervals_s}")
        if self.refine.base != "none" and not self.render.colour:
            raise ValueError("`refine.base` adds to the rendered colour, so it needs `render.colour` (+colour)")
        if self.refine.base == "filled" and not self.render.normalised:
            raise ValueError('`refine.base` "filled" needs `render.normalised`')
        if self.fixed_depth is not None and not LOG_DEPTH_NEAR <= self.fixed_depth <= LOG_DEPTH_FAR:
            raise ValueError(f"`fixed_depth` must be in [{LOG_DEPTH_NEAR}, {LOG_DEPTH_FAR}] m, got {self.fixed_depth}")


VEST_PAPER: Final = ModelConfig("vest-paper", render=RenderConfig(colour=False))

VEST_S: Final = ModelConfig(
    "vest-s",
    encoder=EncoderConfig(widths=(24, 48, 96), blocks=(2, 2, 2), decoder=(48, 32), features=16, background="frame"),
    ego_motion=EgoMotionConfig(widths=(32, 32, 64, 64), path=5, correction="bounded"),
    object_motion=ObjectMotionConfig(
        "dmvfn", scales=(4, 4, 2, 2, 1, 1), widths=(64, 64, 32, 32, 16, 16), detail=8, where="foreground"
    ),
    render=RenderConfig(rho=RHO_DIRECT, stretched=True, inpainted="inner", previous="uncovered", normalised=True),
    refine=RefineConfig(stem=16, stem_kernel=3, widths=(32, 64, 96, 128), base="filled"),
    start="prior",
    prior="forecast",
)

#: The whole models, by name.
CONFIGS: Final[Mapping[str, ModelConfig]] = MappingProxyType({c.name: c for c in (VEST_PAPER, VEST_S)})


def _change_object_motion(config: ModelConfig, **fields: object) -> ModelConfig:
    if config.object_motion is None:
        raise ValueError(f"{config.name!r} has no object motion to change")
    changed = dataclasses.replace(config.object_motion, **fields)  # type: ignore[arg-type]
    return dataclasses.replace(config, object_motion=changed)


def _without_ego_motion(config: ModelConfig) -> ModelConfig:
    """Then object motion has to move everything."""
    objects = config.object_motion and dataclasses.replace(config.object_motion, where="everywhere")
    return dataclasses.replace(config, ego_motion=None, object_motion=objects)


def _from_rest(config: ModelConfig) -> ModelConfig:
    camera = config.ego_motion and dataclasses.replace(config.ego_motion, path=1, correction="linear")
    return dataclasses.replace(config, ego_motion=camera, start="rest")


def _jointly(config: ModelConfig) -> ModelConfig:
    """One pass, which can't show inpainted points in the holes that another one leaves."""
    inpainted = "last" if config.render.inpainted == "inner" else config.render.inpainted
    return dataclasses.replace(config, render=dataclasses.replace(config.render, joint=True, inpainted=inpainted))


def _with_fixed_depth(config: ModelConfig, metres: float = FIXED_DEPTH) -> ModelConfig:
    """At a wrong depth the camera's motion moves the background wrongly, too: object motion corrects all pixels."""
    objects = config.object_motion and dataclasses.replace(config.object_motion, where="everywhere")
    return dataclasses.replace(config, fixed_depth=metres, object_motion=objects)


def _render_colour(config: ModelConfig, colour: bool) -> ModelConfig:
    return dataclasses.replace(config, render=dataclasses.replace(config.render, colour=colour))


def _change_base(config: ModelConfig, base: Literal["none", "splatted", "filled"]) -> ModelConfig:
    """A base other than "none" is made of the rendered colour."""
    colour = config.render.colour or base != "none"
    render = dataclasses.replace(config.render, normalised=base == "filled", colour=colour)
    return dataclasses.replace(config, refine=dataclasses.replace(config.refine, base=base), render=render)


#: What may follow a model's name after "+": the change that it makes.
VARIANTS: Final[Mapping[str, Callable[[ModelConfig], ModelConfig]]] = MappingProxyType(
    {
        "fixed-depth": _with_fixed_depth,
        "no-emf": _without_ego_motion,
        "no-omf": lambda c: dataclasses.replace(c, object_motion=None),
        "colour": lambda c: _render_colour(c, True),
        "features-only": lambda c: _render_colour(_change_base(c, "none"), False),
        "joint": _jointly,
        "residual": lambda c: _change_base(c, "splatted"),
        "filled": lambda c: _change_base(c, "filled"),
        "painting": lambda c: _change_base(c, "none"),
        "from-rest": _from_rest,
        "from-prior": lambda c: dataclasses.replace(c, start="prior"),
        "feedback": lambda c: dataclasses.replace(c, mode="feedback"),
        "compose": lambda c: dataclasses.replace(c, mode="compose"),
        "omf-paper": lambda c: _change_object_motion(c, shape="paper"),
        "omf-dmvfn": lambda c: _change_object_motion(c, shape="dmvfn"),
        "omf-inpainted": lambda c: _change_object_motion(c, inpainted=True),
        "routing": lambda c: _change_object_motion(c, routing=RoutingConfig()),
    }
)


#: Variants that take a number after "=".
_WITH_NUMBER: Final[Mapping[str, Callable[[ModelConfig, float], ModelConfig]]] = MappingProxyType(
    {"fixed-depth": _with_fixed_depth}
)

#: Variants that need the rendered colour.
_OF_COLOUR: Final = ("colour", "residual", "filled")


def configuration(name: str) -> ModelConfig:
    """A model by name, with any variants: "vest-paper", "vest-s+no-emf", "vest-s+joint+residual".

    Args:
        name: a key of `CONFIGS`, then "+" and a key of `VARIANTS` as often as wanted; "+fixed-depth=35" sets metres.

    Returns:
        The configuration; its name is ``name``.

    Raises:
        ValueError: a part of the name is unknown, or variants that exclude each other.
    """
    base, *variants = name.split("+")
    if base not in CONFIGS:
        raise ValueError(f"`name` must begin with one of {', '.join(CONFIGS)}, got {base!r}")
    if "features-only" in variants and (of_colour := [v for v in variants if v in _OF_COLOUR]):
        raise ValueError(f"`name` must not have both +{of_colour[0]}, which needs `render.colour`, and +features-only")
    config = CONFIGS[base]
    for variant in variants:
        config = _changed(config, variant)
    return dataclasses.replace(config, name=name)


def _changed(config: ModelConfig, variant: str) -> ModelConfig:
    """``config`` with one variant, "no-emf" or "fixed-depth=35"."""
    kind, equals, number = variant.partition("=")
    if kind not in VARIANTS:
        raise ValueError(f"`name` may add {', '.join(f'+{v}' for v in VARIANTS)}, got {f'+{variant}'!r}")
    if not equals:
        return VARIANTS[kind](config)
    if kind not in _WITH_NUMBER:
        raise ValueError(f"`name` may give {', '.join(f'+{v}' for v in _WITH_NUMBER)} a number, got {f'+{variant}'!r}")
    try:
        return _WITH_NUMBER[kind](config, float(number))
    except ValueError as error:
        raise ValueError(f"`name`: {f'+{variant}'!r}: {error}") from error

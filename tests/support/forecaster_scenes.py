"""Small networks, frames and cameras that the forecaster is tested on."""

import dataclasses
from typing import Any

import torch
from torch import nn

from vestcl.models import EgoMotion, ModelConfig, ObjectMotion, RigidMotion
from vestcl.models.config import (
    FIXED_DEPTH,
    EgoMotionConfig,
    EncoderConfig,
    ObjectMotionConfig,
    RefineConfig,
    RenderConfig,
    RoutingConfig,
)  # fmt: skip
from vestcl.models.forecaster import Forecaster, Step
from vestcl.models.steps.prior import MotionPrior
from vestcl.models.steps.render import Side
from vestcl.scene.layers import LayerBatch

OBJECTS = ObjectMotionConfig("dmvfn", scales=(2, 1), widths=(8, 8), detail=4)

TINY = ModelConfig(
    "tiny",
    encoder=EncoderConfig(widths=(8, 8, 8), blocks=(1, 1, 1), decoder=(8, 8), features=4),
    ego_motion=EgoMotionConfig(widths=(8, 8, 8, 8), blocks=1, heads=2),
    object_motion=OBJECTS,
    refine=RefineConfig(stem=4, stem_kernel=3, widths=(4, 8)),
)

#: Focal length of the test camera, px.
FOCAL = 30.0


def change(**fields: Any) -> ModelConfig:
    return dataclasses.replace(TINY, **fields)


#: As vest-s in all but its sizes; TINY is as vest-paper.
SMALL = change(
    start="prior",
    ego_motion=EgoMotionConfig(widths=(8, 8, 8, 8), blocks=1, heads=2, path=3),
    render=RenderConfig(rho=0.95, normalised=True),
    refine=dataclasses.replace(TINY.refine, base="filled"),
)

#: The same, predicting RGB directly.
PAINTING = dataclasses.replace(SMALL, refine=TINY.refine)

#: Every colour shown by its own pixel only: at rest nothing blurs.
SHARP = change(render=RenderConfig(rho=0.95))

ABLATIONS = {
    "whole": TINY,
    "fixed depth": change(fixed_depth=FIXED_DEPTH),
    "no ego-motion": change(ego_motion=None),
    "no object motion": change(object_motion=None),
    "no motion": change(ego_motion=None, object_motion=None),
    "features only": change(render=RenderConfig(colour=False)),
    "joint": change(render=RenderConfig(joint=True)),
    "joint features": change(render=RenderConfig(joint=True, colour=False)),
    "residual": change(refine=dataclasses.replace(TINY.refine, base="splatted")),
    "filled": change(render=RenderConfig(normalised=True), refine=dataclasses.replace(TINY.refine, base="filled")),
    "routing": change(object_motion=dataclasses.replace(OBJECTS, routing=RoutingConfig(4, budget=1.0))),
    "inpainted": change(object_motion=dataclasses.replace(OBJECTS, inpainted=True)),
    "paper": change(object_motion=dataclasses.replace(OBJECTS, shape="paper")),
}


def frame(batch: int, height: int, width: int, foreground: bool = True) -> LayerBatch:
    """Random frames; with foreground, image b has a block of b + 2 rows of it, 4 columns wide."""
    image, depth = torch.rand(batch, 3, height, width), torch.rand(batch, 1, height, width) * 20 + 5
    mask = torch.ones_like(depth)
    if foreground:
        for b in range(batch):
            mask[b, :, 6 : 8 + b, 8:12] = 0
    return LayerBatch(image, depth, mask, image * mask, depth + 10 * (1 - mask))


def pair_of(batch: int, height: int, width: int, foreground: bool = True) -> tuple[LayerBatch, LayerBatch]:
    return frame(batch, height, width, foreground), frame(batch, height, width, foreground)


def wall(height: int, width: int, depth: float) -> LayerBatch:
    """A random image on a wall that faces the camera."""
    image, metres = torch.rand(1, 3, height, width), torch.full((1, 1, height, width), depth)
    return LayerBatch(image, metres, torch.ones_like(metres), image, metres)


def measured(
    batch: int,
    height: int,
    width: int,
    *,
    cur: tuple[float, ...] = (0, 0, 0),
    velocity: tuple[float, ...] = (0, 0, 0),
) -> MotionPrior:
    """The camera's steady translation and everything's velocity, metres per frame."""
    still = torch.tensor([1.0, 0, 0, 0]).repeat(batch, 1)
    steady = RigidMotion(still, torch.tensor(cur).float().repeat(batch, 1))
    moving = torch.tensor(velocity).float()[:, None, None].repeat(batch, 1, height, width)
    return MotionPrior(steady, steady, steady, moving, moving)


def turning(batch: int, height: int, width: int) -> MotionPrior:
    """A bend over a bump, quaternions of any length, and everything moving its own way."""
    numbers = (
        ([-1.0, -0.01, 0.03, 0.01], [0.1, 0.0, -1.0]),
        ([2.0, 0.02, -0.06, 0.01], [0.2, 0.1, -1.1]),
        ([1.0, 0.0, -0.02, 0.01], [0.2, 0.0, -1.2]),
    )
    ahead, last, before = (
        RigidMotion(torch.tensor([q]).repeat(batch, 1), torch.tensor([t]).repeat(batch, 1)) for q, t in numbers
    )
    return MotionPrior(ahead, last, before, *torch.randn(2, batch, 3, height, width))


def camera(batch: int, height: int, width: int) -> torch.Tensor:
    return torch.tensor([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1]]).repeat(batch, 1, 1)


def drive(model: Forecaster, prev: tuple[float, ...], cur: tuple[float, ...]) -> Forecaster:
    """Let the model forecast these translations, metres, whatever it sees."""
    assert isinstance(model.ego_motion, EgoMotion) and model.ego_motion.swayed is None
    rest = (1.0, 0.0, 0.0, 0.0)
    with torch.no_grad():
        model.ego_motion.motion.bias.copy_(torch.tensor([*rest, *prev, *rest, *cur]))
    return model


def stir(model: Forecaster) -> Forecaster:
    """Last layers that start at zero no longer do: a small motion, other for each object."""
    assert isinstance(model.ego_motion, EgoMotion) and isinstance(model.object_motion, ObjectMotion)
    if model.ego_motion.swayed is None:
        nn.init.normal_(model.ego_motion.motion.weight, std=0.01)
    else:  # its answers are scaled to centimetres and hundredths of a radian
        nn.init.normal_(model.ego_motion.motion.weight, std=0.1)
        nn.init.normal_(model.ego_motion.swayed.weight, std=0.02)
    for block in model.object_motion.blocks:
        for parameter in block.get_submodule("out").parameters():
            nn.init.normal_(parameter, std=0.01)
    return model


def correct(model: Forecaster, *said: list[float]) -> Forecaster:
    """Let the model correct each interval of its path by that, turn and shift as the network says them."""
    assert isinstance(model.ego_motion, EgoMotion)
    with torch.no_grad():
        model.ego_motion.motion.bias.copy_(torch.tensor(said).flatten())
    return model


def push(model: Forecaster, *displacement: float) -> Forecaster:
    """Let the objects' forecast add that displacement, metres, previous frame's xyz and then the current one's."""
    assert isinstance(model.object_motion, ObjectMotion)
    with torch.no_grad():
        model.object_motion.blocks[-1].get_parameter("out.bias").copy_(torch.tensor(displacement))
    return model


def sides_of(model: Forecaster, *arguments: Any) -> tuple[Step, list[Side]]:
    """The step, and what its clouds left on the view."""
    caught: list[list[Side]] = []
    original = model.splat

    def splat(*splatted: Any) -> list[Side]:
        caught.append(original(*splatted))
        return caught[-1]

    model.splat = splat  # type: ignore[assignment, method-assign]
    return model(*arguments), caught[0]


def plain(image: torch.Tensor, depth: torch.Tensor, mask: torch.Tensor) -> LayerBatch:
    """Layers without inpainting."""
    return LayerBatch(image, torch.where(depth > 0, depth, 10.0), mask, image, torch.where(depth > 0, depth, 10.0))

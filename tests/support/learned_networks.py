"""Small networks that correct the geometric forecast, for the tests of learned parts."""

import dataclasses

import numpy as np
import torch
from forecaster_scenes import SMALL
from torch import nn

from vestcl.models.config import EgoMotionConfig
from vestcl.models.forecaster import Forecaster

#: As SMALL, with a bounded correction of the forecast motion.
BOUNDED = dataclasses.replace(
    SMALL,
    prior="forecast",
    ego_motion=EgoMotionConfig(widths=(8, 8, 8, 8), blocks=1, heads=2, path=3, correction="bounded"),
)


def model(camera: float = 0.0, speed: float = 0.0) -> Forecaster:
    """With a yaw of ``camera`` times the limit in every interval, and ``speed`` of that of the translation."""
    torch.manual_seed(0)
    made = Forecaster(BOUNDED).eval()
    assert made.ego_motion is not None and made.ego_motion.bounded is not None
    head = made.ego_motion.bounded
    with torch.no_grad():
        head.seen.weight.zero_()
        head.swayed.weight.zero_()
        said = torch.zeros(3, 6)
        said[:, 1], said[:, 5] = np.arctanh(camera), np.arctanh(speed)
        head.seen.bias.copy_(said.flatten())
        head.gate.fill_(1.0 if camera or speed else 0.0)
    return made


def stir_all(made: Forecaster) -> Forecaster:
    """Object motion and refinement add noise."""
    assert made.object_motion is not None
    for name, parameter in made.named_parameters():
        if name.startswith(("object_motion", "refine")):
            nn.init.normal_(parameter, std=0.05)
    return made

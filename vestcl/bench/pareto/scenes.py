"""What the Pareto bench forecasts: procedural streets, known up to frame t, with the frames that really follow."""

from dataclasses import dataclass
from typing import Final

import torch
from torch.nn import functional

from vestcl import geometry
from vestcl.data import Street, street_clip
from vestcl.forecasting.geometric import Perception
from vestcl.forecasting.network.input import NetworkInput, last_motions, network_input
from vestcl.models.inference.resolution import fraction, reduced
from vestcl.models.networks.layers import mapped
from vestcl.scene.layers import LayerBatch

#: The current frame t: from t - 2 and t - 1 before it the change of the camera's motion is known.
CURRENT: Final = 2

#: Seconds into the drive: an oncoming car is near.
START: Final = 0.7

#: Rays per pixel and direction: images as a camera's, without jagged edges.
SAMPLES: Final = 2


@dataclass(frozen=True, eq=False)
class Scene:
    """One street."""

    seed: int
    given: NetworkInput
    truth: torch.Tensor
    """[steps, 3, H, W] in [0, 1]: the frames at t + 1, t + 2, ..."""

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) px."""
        return self.truth.shape[2], self.truth.shape[3]


def scene(seed: int, height: int, width: int, steps: int) -> Scene:
    """A street's frames with true depth and labels, preprocessed as by `vestcl forecast`, and the frames after them.

    Args:
        seed: of the street.
        height: rows, px.
        width: columns, px.
        steps: frames after t.
    """
    clip = street_clip(Street.generate(seed), CURRENT + 1 + steps, height, width, start=START, samples=SAMPLES)
    perception = Perception(clip)
    prev, cur = (perception.seen(index) for index in (CURRENT - 1, CURRENT))
    frames = [torch.from_numpy(clip[CURRENT + step].read_image()) for step in range(1, steps + 1)]
    return Scene(seed, network_input(prev, cur, last_motions(prev, cur)), torch.stack(frames))


def double(given: NetworkInput) -> NetworkInput:
    """The same numbers in float64."""
    return mapped(torch.Tensor.double, given)


def shrunk(given: NetworkInput, scale: float) -> NetworkInput:
    """The same scene at ``scale`` of its height and width: colours are means, all other planes are sampled."""
    height, width = given.frame_cur.image.shape[2:]
    size = fraction(height, width, scale)
    if size == (height, width):
        return given

    def sampled(plane: torch.Tensor) -> torch.Tensor:
        return functional.interpolate(plane, size, mode="nearest")

    def frame(layers: LayerBatch) -> LayerBatch:
        coloured = {name: reduced(getattr(layers, name), *size) for name in ("image", "background_image")}
        others = {name: sampled(getattr(layers, name)) for name in layers._fields if name not in coloured}
        return layers._replace(**coloured, **others)

    K = geometry.scale_intrinsics(given.K, size[1] / width, size[0] / height)
    before, now = sampled(given.prior.velocity_prev), sampled(given.prior.velocity_cur)
    prior = given.prior._replace(velocity_prev=before, velocity_cur=now)
    own = None if given.own is None else sampled(given.own)
    return NetworkInput(frame(given.frame_prev), frame(given.frame_cur), K, prior, own)

"""What is splatted: one point per pixel of the procedural street, seen from a camera further on."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from vestcl.bench.common.timing import Task
from vestcl.data import Street, intrinsics
from vestcl.ops.displace import displace
from vestcl.ops.splat import splat
from vestcl.ops.unproject import unproject

#: Channels of the features: what the encoder gives (SPEC section 3).
CHANNELS: Final = 32

#: How far the camera has moved ahead, metres: what a car drives in a tenth of a second at 29 km/h.
AHEAD: Final = 0.8

#: The names of the arguments that gradients are asked for, as in `splat`.
DIFFERENTIATED: Final = ("points_uv", "radii", "opacities", "features")


@dataclass(frozen=True, eq=False)
class Scene:
    """Arguments of `splat`, and the gradient that comes back from what the image is used for."""

    points_uv: torch.Tensor
    z: torch.Tensor
    radii: torch.Tensor
    opacities: torch.Tensor
    features: torch.Tensor
    grad_image: torch.Tensor
    """[1, C, H, W] in channels-last memory, as a convolution would return it."""

    @property
    def height(self) -> int:
        return self.grad_image.shape[2]

    @property
    def width(self) -> int:
        return self.grad_image.shape[3]

    @property
    def leaves(self) -> list[torch.Tensor]:
        """What is differentiated, in the order of `DIFFERENTIATED`."""
        return [getattr(self, name) for name in DIFFERENTIATED]

    def double(self) -> "Scene":
        """The same numbers in float64."""
        return Scene(**{name: value.double() for name, value in vars(self).items()})

    def requiring_grad(self) -> "Scene":
        """The same scene, its `leaves` recording gradients."""
        leaves = {name: getattr(self, name).detach().requires_grad_() for name in DIFFERENTIATED}
        return Scene(**{**vars(self), **leaves})

    def forward(self) -> torch.Tensor:
        """vestcl's image."""
        return splat(self.points_uv, self.z, self.radii, self.opacities, self.features, self.height, self.width)[0]


def both_passes(scene: Scene, image_of: Callable[[Scene], torch.Tensor] = Scene.forward) -> Task:
    """Forward and backward of ``image_of``, with all gradients."""
    recording = scene.requiring_grad()
    return lambda: torch.autograd.grad(image_of(recording), recording.leaves, recording.grad_image)


def street(height: int, width: int, channels: int, radius: float, seed: int = 0) -> Scene:
    """The scene of the benchmark: every number follows from the arguments.

    Args:
        height: rows of the image; there are height * width points.
        width: columns of the image.
        channels: of the features, drawn from a normal distribution, as is ``grad_image``.
        radius: of all points, px.
        seed: of the street and of everything drawn. Opacities are uniform in [0.6, 1).
    """
    town = Street.generate(seed)
    camera = intrinsics(height, width)
    depth = town.render(np.linalg.inv(town.camera_pose(0.0)), camera, height, width).depth
    K = torch.from_numpy(camera)[None].float()
    points_xyz = unproject(torch.from_numpy(depth), K)
    tgt_from_src = torch.eye(4)[None].clone()
    tgt_from_src[0, 2, 3] = -AHEAD
    points_uv, z = displace(points_xyz, torch.zeros_like(points_xyz), K, tgt_from_src)
    generator = torch.Generator().manual_seed(seed)
    return Scene(
        points_uv,
        z,
        torch.full_like(z, radius),
        0.6 + 0.4 * torch.rand(z.shape, generator=generator),
        torch.randn((*z.shape, channels), generator=generator),
        torch.randn((1, height, width, channels), generator=generator).permute(0, 3, 1, 2),
    )

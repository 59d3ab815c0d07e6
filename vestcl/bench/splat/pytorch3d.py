"""PyTorch3D as a peer, where it is installed: its rasteriser finds the nearest fragments, its compositor adds them.

Its rasteriser holds every point against every pixel on a CPU, so this peer runs on `SIZE`, not on the bench's scene.
"""

import importlib
import importlib.util
from typing import Final

import torch

from vestcl.bench.splat.scenes import Scene

#: Height and width: there its loop over pixels and points takes about a second.
SIZE: Final = (64, 208)


def is_installed() -> bool:
    """Whether there is a PyTorch3D to import."""
    return importlib.util.find_spec("pytorch3d") is not None


def splat(scene: Scene, layers: int) -> torch.Tensor:
    """The image [1, C, H, W] of ``scene``, of one cloud, exact if no pixel has more than ``layers`` fragments.

    Its normalised coordinates go left and up, 2 across the image's shorter side, 0 in the middle.
    """
    structures = importlib.import_module("pytorch3d.structures")
    rasterizer = importlib.import_module("pytorch3d.renderer.points.rasterize_points")
    compositor = importlib.import_module("pytorch3d.renderer.compositing")
    pixels_per_unit = min(scene.height, scene.width) / 2
    middle = torch.tensor([scene.width, scene.height]) / 2
    points = torch.cat([(middle - scene.points_uv) / pixels_per_unit, scene.z[..., None]], dim=-1)
    index, _, d2 = rasterizer.rasterize_points(
        structures.Pointclouds(points=points),
        (scene.height, scene.width),
        scene.radii.detach() / pixels_per_unit,
        points_per_pixel=layers,
        bin_size=0,
    )
    nearest = index.long().clamp(min=0)
    radii, opacities = scene.radii[0][nearest], scene.opacities[0][nearest]
    alphas = torch.where(index >= 0, opacities * (1 - d2 * pixels_per_unit**2 / radii**2), 0)
    by_layer = (tensor.permute(0, 3, 1, 2) for tensor in (index.long(), alphas))
    image: torch.Tensor = compositor.alpha_composite(*by_layer, scene.features[0].T)
    return image

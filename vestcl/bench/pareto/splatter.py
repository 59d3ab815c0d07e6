"""The splatter's own knobs, on the splatter alone: tile size, fragments kept a pixel, precision of stored features.

The kernels have no limit on fragments, and no float16 storage: what a limit would cost in error is computed from the
exact fragments, what it saves is timed in torch, which has a step where it counts; of float16 the error alone is known.
"""

import dataclasses
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch

from vestcl import constants
from vestcl.bench.common import timing as _timing
from vestcl.bench.common.timing import Spread
from vestcl.bench.pareto import tiles as _pareto_tiles
from vestcl.bench.pareto.front import spread
from vestcl.bench.splat.scenes import Scene, street
from vestcl.bench.splat.torch_fragments import Fragments, list_fragments
from vestcl.bench.splat.torch_peers import ENDINGS
from vestcl.models.config import RHO

#: Sides of a tile, px; the kernels pack places in a tile into five bits, which ends at 31.
SIDES: Final = (8, 12, 16, 24)

#: Fragments kept, nearest first. PyTorch3D's default is 8, 3D Moments' 32.
KEPT: Final = (1, 2, 4, 8, 16, 32)

#: Channels of the paper's features.
CHANNELS: Final = 32

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Choice:
    """One value of one of the splatter's knobs."""

    value: str
    error: float
    """Root mean square difference from the exact float64 image, over that image's root mean square."""
    seconds: Spread | None
    """None where it can't be had with these kernels."""
    default: bool


def measure(
    height: int, width: int, device: str | None, runs: int, tell: Tell = lambda _: None
) -> dict[str, list[Choice]]:
    """What each of the splatter's knobs costs and saves on a street of height x width points; knob -> its values."""
    scene = street(height, width, CHANNELS, RHO)
    tell("exact")
    exact = scene.double().forward()
    tell("float16 features")
    stored = dataclasses.replace(scene, features=scene.features.half().float())
    seconds = spread(_timing.interleave({"": scene.forward}, 0.0, runs)[""].tolist())
    precisions = [
        Choice("float32", _error(scene.forward(), exact), seconds, True),
        Choice("float16 features, computed in float32", _error(stored.forward(), exact), None, False),
    ]
    tell("fragments")
    fragments = _fragments(scene, exact, runs)
    tell("tiles")
    return {"fragments": fragments, "features": precisions, "tile": _tiles(scene, exact, device, runs)}


def _error(image: torch.Tensor, exact: torch.Tensor) -> float:
    return float((image.double() - exact).square().mean().sqrt() / exact.square().mean().sqrt())


def _tiles(scene: Scene, exact: torch.Tensor, device: str | None, runs: int) -> list[Choice]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.npz"
        names = ("points_uv", "z", "radii", "opacities", "features")
        np.savez(path, exact=exact.numpy(), **{name: getattr(scene, name).numpy() for name in names})
        found = _pareto_tiles.measure(SIDES, path, device, runs)
    return [
        Choice(str(side), error, spread(seconds), side == constants.TILE) for side, (error, seconds) in found.items()
    ]


def _fragments(scene: Scene, exact: torch.Tensor, runs: int) -> list[Choice]:
    of_scene = [tensor[0] for tensor in (scene.points_uv, scene.z, scene.radii, scene.opacities)]
    size = scene.height, scene.width
    uv, z, radii, opacities = of_scene
    single = list_fragments(size, uv, z, radii, opacities)
    double = list_fragments(size, uv.double(), z.double(), radii.double(), opacities.double())
    image, features = ENDINGS["sparse"].image, scene.features[0]
    limits = (*KEPT, None)
    tasks = {str(limit): partial(image, nearest(single, limit), features) for limit in limits}
    seconds = _timing.interleave(tasks, 0.0, runs)
    choices = []
    for limit in limits:
        kept = image(nearest(double, limit), features.double())
        shown = kept.view(1, *size, -1).permute(0, 3, 1, 2)
        name = "all" if limit is None else str(limit)
        choices.append(Choice(name, _error(shown, exact), spread(seconds[str(limit)].tolist()), limit is None))
    return choices


def nearest(fragments: Fragments, limit: int | None) -> Fragments:
    """The first ``limit`` fragments of each pixel; None keeps all."""
    if limit is None:
        return fragments
    counts = fragments.starts.diff()
    rank = torch.arange(len(fragments.points)) - fragments.starts[:-1].repeat_interleave(counts)
    kept = rank < limit
    starts = torch.cat([counts.new_zeros(1), counts.clamp(max=limit).cumsum(0)])
    of_each = {name: getattr(fragments, name)[kept] for name in ("places", "points", "alphas", "transmittances")}
    return dataclasses.replace(fragments, starts=starts, **of_each)

"""What `vestcl bench stability` computes: families of inputs, each with one knob that goes to its extreme.

Every number is one that float32 holds, so that both precisions start from the same, and all that differs is rounding.

What splat computes has two kinds of jumps, where float32 may well fall on the other side, and an error there would tell
nothing about rounding: the order of points at (nearly) equal depths, and the gradient where a pixel's centre enters a
footprint. So points are ordered by their depths in the source frame, which are input, and each radius lies in the
middle of the widest gap between the distances of pixel centres, in a range of radii about the one wanted.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import torch

from vestcl import constants
from vestcl.bench.stability.places import clear_radii, projected

Inputs = dict[str, torch.Tensor]
Program = Literal["splat", "view", "flow"]

#: Of the features: colour.
CHANNELS: Final = 3

#: Height and width of images that aren't a family's knob: several tiles, the last ones partial.
SIZE: Final = (36, 52)

#: Focal length in image widths: KITTI's cameras see 80 degrees across.
FOCAL: Final = 0.6

#: Turn of one motion about each axis, radians, and its path along each, metres, on average: 50 of them in a row leave
#: most points that are 5 to 50 m away in the image.
TURN: Final = 3e-3
PATH: Final = 0.1

#: The same where points are as near as the near plane, 0.1 m: they stay in front of it.
SHORT_PATH: Final = 0.02

#: Depths of points where they aren't the knob, metres.
NEAREST, FARTHEST = 5.0, 50.0

#: Opacity where it isn't the knob: every alpha stays clear of 1, where others lose their way.
_OPACITY: Final = 0.9

#: Alphas of one pixel together: many, and the last one still shows.
_ALPHAS: Final = 2.0

#: Points of the "radius" family, and of motions alone: as many as take a second at the largest radius, and all of
#: rigid_flow's 256 partial sums several points.
_DISCS: Final = 200
_CLOUD: Final = 2000

#: Radii, px, in the "opacity" family (SPEC section 2's oracle: alphas of 1, 5/9 and 1/9) and in views (ten fragments
#: in a pixel), and in units of the stride where points are that far apart: the discs overlap.
_ORACLE: Final = 1.5
_VIEWED: Final = 1.8
_STRIDES: Final = 0.8

#: Path of the "angle" family, metres a radian: next to nothing beside what a turn moves points.
_NEXT_TO_NOTHING: Final = 1e-3

#: Pixels of the "size" family's images from point to point along each axis: at 4096 x 2048 the lists of fragments that
#: bounds and peers walk over take some GB even so.
_STRIDE: Final = 4


@dataclass(frozen=True)
class Case:
    """Inputs of one program at one setting of a knob."""

    family: str
    knob: float
    program: Program
    inputs: Inputs
    """float64, [1, ...]; motions are [steps, ...]. Every number fits float32."""
    differentiated: tuple[str, ...]
    """Inputs whose gradients count."""
    height: int = 0
    """Of the image, pixels; 0 where there is none."""
    width: int = 0
    seed: int = 0
    """Of the random linear loss."""

    @property
    def name(self) -> str:
        return f"{self.family} {self.knob:g}"


@dataclass(frozen=True)
class Family:
    """Cases along one knob."""

    name: str
    knob: str
    """What the knob is, with its unit."""
    values: tuple[float, ...]
    quick: tuple[float, ...]
    """For a quick run; a part of ``values``, or smaller."""
    build: Callable[[float, torch.Generator], tuple[Program, Inputs, tuple[int, int]]]

    def cases(self, seed: int, quick: bool) -> list[Case]:
        """A case for each value."""
        found = []
        for knob in self.quick if quick else self.values:
            program, inputs, size = self.build(knob, torch.Generator().manual_seed(seed))
            fit = {name: value.float().double() for name, value in inputs.items()}
            found.append(Case(self.name, knob, program, fit, DIFFERENTIATED[program], *size, seed=seed + 1))
        return found


DIFFERENTIATED: Final[dict[Program, tuple[str, ...]]] = {
    "splat": ("points_uv", "radii", "opacities", "features", "backgrounds"),
    "view": ("depth", "quaternion", "translation", "radii", "opacities", "features", "backgrounds"),
    "flow": ("points_xyz", "quaternion", "translation"),
}


# ---------------------------------------------------------------- splat alone


def _layers(count: float, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    """``count`` fragments in each of 4 x 4 pixels, so faint that the last one still shows."""
    points, size = int(count), (4, 4)
    inputs = _appearance(points, generator, opacity=min(_OPACITY, _ALPHAS / count))
    inputs["points_uv"] = size[0] * _uniform(generator, 1, points, 2)
    inputs["radii"] = 2 * size[0] * (1 + _uniform(generator, 1, points))  # more than from corner to corner
    inputs["z"] = _depths(points, NEAREST, FARTHEST, generator)[None]
    return "splat", inputs, size


def _radii(radius: float, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    """Points near pixel centres where the radius is less than a pixel; the fainter, the more of them a pixel has."""
    points, (height, width) = _DISCS, SIZE
    covered = min(max(1.0, math.pi * radius**2), height * width)
    inputs = _appearance(points, generator, opacity=min(_OPACITY, _ALPHAS * height * width / (points * covered)))
    places = torch.tensor([width, height]) * _uniform(generator, 1, points, 2)
    if radius < 1:
        places = places.floor() + 0.5 + radius * (_uniform(generator, 1, points, 2) - 0.5)
    inputs["points_uv"] = places.float().double()
    inputs["radii"] = clear_radii(inputs["points_uv"][0], radius, *SIZE)[None]
    inputs["z"] = _depths(points, NEAREST, FARTHEST, generator)[None]
    return "splat", inputs, SIZE


def _opacities(missing: float, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    """Three points on each pixel's centre, opacity 1 - ``missing``: alphas of it, of 5/9 and of 1/9 of it."""
    (height, width), layers = SIZE, 3
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    centres = torch.stack([x, y], dim=-1).reshape(-1, 2).double() + 0.5
    points = layers * len(centres)
    inputs = _appearance(points, generator, opacity=1.0)
    inputs["opacities"] = torch.full((1, points), 1 - missing, dtype=torch.float64)
    inputs["points_uv"] = centres.repeat(layers, 1)[None]
    inputs["radii"] = torch.full((1, points), _ORACLE, dtype=torch.float64)
    inputs["z"] = _depths(points, NEAREST, FARTHEST, generator)[None]
    return "splat", inputs, SIZE


# ---------------------------------------------------------------- unproject, move, project, splat


def _depth(metres: float, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    """All points from ``metres`` to twice as far."""
    return _view(generator, (metres, 2 * metres), path=SHORT_PATH)


def _depth_range(farthest: float, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    """From 0.1 m to ``farthest`` in one image, as many points in every decade."""
    return _view(generator, (constants.NEAR, farthest), path=SHORT_PATH)


def _sizes(width: float, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    return _view(generator, (NEAREST, FARTHEST), size=(int(width) // 2, int(width)), stride=_STRIDE)


def _origins(metres: float, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    """Points in a frame whose origin is ``metres`` away from both cameras."""
    away = metres * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    program, inputs, size = _view(generator, (NEAREST, FARTHEST))
    inputs["translation"] = inputs["translation"] + away
    inputs["tgt_from_src"][:, :3, 3] = -away
    return program, inputs, size


def _recursion(steps: float, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    """Small motions one after the other, each rounded."""
    return _view(generator, (NEAREST, FARTHEST), steps=int(steps))


def _view(
    generator: torch.Generator,
    depths: tuple[float, float],
    size: tuple[int, int] = SIZE,
    stride: int = 1,
    steps: int = 1,
    path: float = PATH,
) -> tuple[Program, Inputs, tuple[int, int]]:
    """Points at every ``stride``-th pixel's place, seen by a camera after ``steps`` motions backwards and aside."""
    rows, columns = size[0] // stride, size[1] // stride
    inputs = _appearance(rows * columns, generator, opacity=_OPACITY)
    focal = FOCAL * size[1]
    K = torch.tensor([[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1]], dtype=torch.float64)
    inputs["K"] = K[None]
    inputs["source_K"] = (torch.tensor([1 / stride, 1 / stride, 1], dtype=torch.float64)[:, None] * K)[None]
    inputs["depth"] = _depths(rows * columns, *depths, generator).reshape(1, 1, rows, columns)
    turns = TURN * (0.5 + _uniform(generator, steps, 3)) * torch.tensor([1.0, -1.0, 1.0])
    inputs["quaternion"] = torch.cat([torch.ones(steps, 1, dtype=torch.float64), turns / 2], dim=1)
    inputs["translation"] = path * (0.5 + _uniform(generator, steps, 3))
    inputs["tgt_from_src"] = torch.eye(4, dtype=torch.float64)[None]
    seen = projected(inputs)
    inputs["radii"] = clear_radii(seen, _VIEWED if stride == 1 else _STRIDES * stride, *size)[None]
    return "view", inputs, size


# ---------------------------------------------------------------- rigid flow alone


def _quaternions(length: float, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    """A quaternion of some ``length``, of a large turn."""
    direction = torch.tensor([[0.5, -0.3, 0.7, 0.4]], dtype=torch.float64)
    return _flow(length * direction / direction.norm(), generator)


def _angles(angle: float, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    """A turn by ``angle``, and no translation beside which it would not show."""
    axis = torch.tensor([[0.48, 0.6, 0.64]], dtype=torch.float64)
    turn = torch.cat([torch.full((1, 1), math.cos(angle / 2), dtype=torch.float64), math.sin(angle / 2) * axis], dim=1)
    program, inputs, size = _flow(turn, generator)
    inputs["translation"] = _NEXT_TO_NOTHING * angle * inputs["translation"]
    return program, inputs, size


def _flow(quaternion: torch.Tensor, generator: torch.Generator) -> tuple[Program, Inputs, tuple[int, int]]:
    street = torch.tensor([40.0, 10.0, FARTHEST])
    points_xyz = street * (_uniform(generator, 1, _CLOUD, 3) - torch.tensor([0.5, 0.5, 0.0]))
    return (
        "flow",
        {"points_xyz": points_xyz, "quaternion": quaternion, "translation": _uniform(generator, 1, 3)},
        (0, 0),
    )


# ---------------------------------------------------------------- what they share


def _uniform(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def _appearance(points: int, generator: torch.Generator, opacity: float) -> Inputs:
    """Colours in [0, 1], opacities from half of ``opacity`` to all of it, and a background."""
    return {
        "features": _uniform(generator, 1, points, CHANNELS),
        "opacities": opacity * (0.5 + 0.5 * _uniform(generator, 1, points)),
        "backgrounds": _uniform(generator, 1, CHANNELS),
    }


def _depths(count: int, nearest: float, farthest: float, generator: torch.Generator) -> torch.Tensor:
    """[count] different depths, log-uniform, in random order."""
    steps = torch.randperm(count, generator=generator).double() / count
    return nearest * (farthest / nearest) ** steps


FAMILIES: Final = (
    Family("depth", "nearest depth, m (farthest: twice it)", (0.1, 1, 10, 100, 1e3, 1e4), (0.1, 1e4), _depth),
    Family("depth range", "farthest depth, m (nearest: 0.1 m)", (1, 10, 100, 1e3, 1e4), (1e4,), _depth_range),
    Family("layers", "number of fragments per pixel", (1, 10, 100, 1e3, 1e4), (1, 100), _layers),
    Family("radius", "radius, px", (1e-3, 1e-2, 0.1, 0.5, 1.5, 8, 100, 1e3, 1e4), (1e-3, 1.5, 1e4), _radii),
    Family(
        "opacity",
        "distance of opacity from 1",
        (0.5, 0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 2.0**-23, 2.0**-24, 0),
        (0.5, 2.0**-24, 0),
        _opacities,
    ),
    Family("size", "image width, px (height: half of it)", (64, 256, 1024, 4096), (64,), _sizes),
    Family("origin", "cameras' distance from the origin, m", (1, 10, 100, 1e3, 1e4), (1, 1e4), _origins),
    Family(
        "quaternion",
        "length of the quaternion",
        (1e-12, 1e-9, 1e-8, 1e-7, 1e-4, 1, 1e4, 1e12, 1e18, 1e30),
        (1e-9, 1e30),
        _quaternions,
    ),
    Family("angle", "turn, rad", (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1, math.pi), (1e-6, math.pi), _angles),
    Family("recursion", "number of motions in a row", (1, 2, 5, 10, 20, 50), (1, 5), _recursion),
)

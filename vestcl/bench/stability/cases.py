"""The inputs of `vestcl bench stability`: families of cases, each with one knob that goes to its extreme.

Every number is exact in float32, so both precisions start from the same inputs and all that differs is rounding.

splat has two kinds of discontinuities, where float32 may fall on the other side, which is not a rounding error: the
order of points at (nearly) equal depths, and the gradient where a pixel centre enters a footprint. So points are
ordered by their depths in the source frame, which are input, and each radius lies in the middle of the widest gap
between the distances of pixel centres, in a range of radii around the nominal one.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import torch

from vestcl import constants, geometry, reference

Inputs = dict[str, torch.Tensor]
Program = Literal["splat", "view", "flow"]
Built = tuple[Program, Inputs, tuple[int, int]]
"""A program, its inputs, and (height, width) of the image."""

#: Height and width of images where they are not the knob: several tiles, the last ones partial. Depths, m.
SIZE: Final = (36, 52)
DEPTHS: Final = (5.0, 50.0)

#: Focal length in image widths: KITTI's cameras see 80 degrees across.
FOCAL: Final = 0.6

#: Mean rotation of one motion about each axis, radians, and its mean translation along each, metres: after 50 of them
#: most points are still in the image. The shorter one is for points at the near plane.
ROTATION: Final = 3e-3
TRANSLATION: Final = 0.1
SHORT_TRANSLATION: Final = 0.02

#: Opacity where it is not the knob: every alpha stays clear of 1. The sum of a pixel's alphas: the last still shows.
_OPACITY: Final = 0.9
_ALPHAS: Final = 2.0

#: Points of the "radius" family, and of rigid flows: several for each of rigid_flow's 256 partial sums.
_DISCS: Final = 200
_CLOUD: Final = 2000

#: Radii, px, in the "opacity" family (SPEC section 2's oracle: alphas of 1, 5/9 and 1/9) and in views (ten fragments
#: per pixel), and in units of the stride where points are that far apart: the discs overlap.
_ORACLE: Final = 1.5
_VIEWED: Final = 1.8
_STRIDES: Final = 0.8

#: Pixels of the "size" family's images between points along each axis: at 4096 x 2048 the fragments take some GB.
_STRIDE: Final = 4

#: Radii are chosen from this range around the nominal one, and so many distances are computed at once: some 100 MB.
_SLACK: Final = (0.85, 1.15)
_CHUNK: Final = 1 << 23

#: Inputs whose gradients count.
DIFFERENTIATED: Final[dict[Program, tuple[str, ...]]] = {
    "splat": ("points_uv", "radii", "opacities", "features", "backgrounds"),
    "view": ("depth", "quaternion", "translation", "radii", "opacities", "features", "backgrounds"),
    "flow": ("points_xyz", "quaternion", "translation"),
}


@dataclass(frozen=True, eq=False)
class Case:
    """Inputs of one program at one setting of a knob."""

    family: str
    knob: float
    program: Program
    inputs: Inputs
    """float64, [1, ...]; motions are [steps, ...]. Every number fits float32."""
    height: int = 0
    """Of the image, pixels; 0 where there is none."""
    width: int = 0
    seed: int = 0
    """Of the random linear loss."""

    @property
    def name(self) -> str:
        """Family and knob."""
        return f"{self.family} {self.knob:g}"

    @property
    def differentiated(self) -> tuple[str, ...]:
        """Inputs whose gradients count."""
        return DIFFERENTIATED[self.program]


@dataclass(frozen=True)
class Family:
    """Cases along one knob."""

    name: str
    knob: str
    """What the knob is, with its unit."""
    values: tuple[float, ...]
    quick: tuple[float, ...]
    """For a quick run; a part of ``values``, or smaller."""
    build: Callable[[float, torch.Generator], Built]

    def cases(self, seed: int, quick: bool) -> list[Case]:
        """A case for each value."""
        found = []
        for knob in self.quick if quick else self.values:
            program, inputs, size = self.build(knob, torch.Generator().manual_seed(seed))
            exact = {name: value.float().double() for name, value in inputs.items()}
            found.append(Case(self.name, knob, program, exact, *size, seed=seed + 1))
        return found


def _layers(count: float, generator: torch.Generator) -> Built:
    """``count`` fragments in each of 4 x 4 pixels, so faint that the last one still shows."""
    points, size = int(count), (4, 4)
    inputs = _appearance(points, generator, opacity=min(_OPACITY, _ALPHAS / count))
    inputs["points_uv"] = size[0] * _uniform(generator, 1, points, 2)
    inputs["radii"] = 2 * size[0] * (1 + _uniform(generator, 1, points))  # more than the diagonal
    inputs["z"] = _depths(points, *DEPTHS, generator)[None]
    return "splat", inputs, size


def _radii(radius: float, generator: torch.Generator) -> Built:
    """Points near pixel centres where the radius is below a pixel; the more of them per pixel, the fainter."""
    height, width = SIZE
    covered = min(max(1.0, math.pi * radius**2), height * width)
    inputs = _appearance(_DISCS, generator, opacity=min(_OPACITY, _ALPHAS * height * width / (_DISCS * covered)))
    points_uv = torch.tensor([width, height]) * _uniform(generator, 1, _DISCS, 2)
    if radius < 1:
        points_uv = points_uv.floor() + 0.5 + radius * (_uniform(generator, 1, _DISCS, 2) - 0.5)
    inputs["points_uv"] = points_uv.float().double()
    inputs["radii"] = clear_radii(inputs["points_uv"][0], radius, *SIZE)[None]
    inputs["z"] = _depths(_DISCS, *DEPTHS, generator)[None]
    return "splat", inputs, SIZE


def _opacities(missing: float, generator: torch.Generator) -> Built:
    """Three points on each pixel's centre, opacity 1 - ``missing``: alphas of it, of 5/9 and of 1/9 of it."""
    (height, width), layers = SIZE, 3
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    centres = torch.stack([x, y], dim=-1).reshape(-1, 2).double() + 0.5
    points = layers * len(centres)
    inputs = _appearance(points, generator, opacity=1.0)
    inputs["opacities"] = torch.full((1, points), 1 - missing, dtype=torch.float64)
    inputs["points_uv"] = centres.repeat(layers, 1)[None]
    inputs["radii"] = torch.full((1, points), _ORACLE, dtype=torch.float64)
    inputs["z"] = _depths(points, *DEPTHS, generator)[None]
    return "splat", inputs, SIZE


def _origins(metres: float, generator: torch.Generator) -> Built:
    """Points in a frame whose origin is ``metres`` away from both cameras."""
    away = metres * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    program, inputs, size = _view(generator)
    inputs["translation"] = inputs["translation"] + away
    inputs["tgt_from_src"][:, :3, 3] = -away
    return program, inputs, size


def _view(
    generator: torch.Generator,
    depths: tuple[float, float] = DEPTHS,
    size: tuple[int, int] = SIZE,
    stride: int = 1,
    steps: int = 1,
    translation: float = TRANSLATION,
) -> Built:
    """Points at every ``stride``-th pixel, seen by a camera after ``steps`` motions backwards and sideways."""
    rows, columns = size[0] // stride, size[1] // stride
    inputs = _appearance(rows * columns, generator, opacity=_OPACITY)
    focal = FOCAL * size[1]
    K = torch.tensor([[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1]], dtype=torch.float64)
    inputs["K"] = K[None]
    inputs["source_K"] = (torch.tensor([1 / stride, 1 / stride, 1], dtype=torch.float64)[:, None] * K)[None]
    inputs["depth"] = _depths(rows * columns, *depths, generator).reshape(1, 1, rows, columns)
    turns = ROTATION * (0.5 + _uniform(generator, steps, 3)) * torch.tensor([1.0, -1.0, 1.0])
    inputs["quaternion"] = torch.cat([torch.ones(steps, 1, dtype=torch.float64), turns / 2], dim=1)
    inputs["translation"] = translation * (0.5 + _uniform(generator, steps, 3))
    inputs["tgt_from_src"] = torch.eye(4, dtype=torch.float64)[None]
    inputs["radii"] = clear_radii(projected(inputs), _VIEWED if stride == 1 else _STRIDES * stride, *size)[None]
    return "view", inputs, size


def projected(inputs: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """The projections of a view's points, [N, 2] px: in float64, by matrices."""
    points = reference.unproject(inputs["depth"], inputs["source_K"])
    for motion in geometry.compose_rigid(inputs["quaternion"], inputs["translation"]):
        points = geometry.transform_points(motion, points)
    return reference.displace(points, torch.zeros_like(points), inputs["K"], inputs["tgt_from_src"])[0][0]


def _quaternions(length: float, generator: torch.Generator) -> Built:
    """A quaternion of some ``length``, of a large rotation."""
    direction = torch.tensor([[0.5, -0.3, 0.7, 0.4]], dtype=torch.float64)
    return _flow(length * direction / direction.norm(), generator)


def _angles(angle: float, generator: torch.Generator) -> Built:
    """A rotation by ``angle``, and a translation so small, 1 mm per radian, that it does not hide it."""
    axis = torch.tensor([[0.48, 0.6, 0.64]], dtype=torch.float64)
    turn = torch.cat([torch.full((1, 1), math.cos(angle / 2), dtype=torch.float64), math.sin(angle / 2) * axis], dim=1)
    program, inputs, size = _flow(turn, generator)
    inputs["translation"] = 1e-3 * angle * inputs["translation"]
    return program, inputs, size


def _flow(quaternion: torch.Tensor, generator: torch.Generator) -> Built:
    extent = torch.tensor([40.0, 10.0, DEPTHS[1]])
    points_xyz = extent * (_uniform(generator, 1, _CLOUD, 3) - torch.tensor([0.5, 0.5, 0.0]))
    inputs = {"points_xyz": points_xyz, "quaternion": quaternion, "translation": _uniform(generator, 1, 3)}
    return "flow", inputs, (0, 0)


def _uniform(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def _appearance(points: int, generator: torch.Generator, opacity: float) -> Inputs:
    """Colours in [0, 1], opacities from half of ``opacity`` to all of it, and a background."""
    return {
        "features": _uniform(generator, 1, points, 3),
        "opacities": opacity * (0.5 + 0.5 * _uniform(generator, 1, points)),
        "backgrounds": _uniform(generator, 1, 3),
    }


def _depths(count: int, nearest: float, farthest: float, generator: torch.Generator) -> torch.Tensor:
    """[count] different depths, log-uniform, in random order."""
    steps = torch.randperm(count, generator=generator).double() / count
    return nearest * (farthest / nearest) ** steps


def clear_radii(points_uv: torch.Tensor, nominal: float, height: int, width: int) -> torch.Tensor:
    """Radii near the ``nominal`` one whose circles stay clear of pixel centres.

    Args:
        points_uv: [N, 2] px.
        nominal: px.
        height: of the image, px.
        width: of the image, px.

    Returns:
        [N] px: the middle of the widest gap between distances of centres, in [0.85, 1.15] of ``nominal``.
    """
    low, high = (factor * nominal for factor in _SLACK)
    reach = math.ceil(high) + 1
    if 2 * reach + 1 > min(height, width):
        rows, columns, base = torch.arange(height), torch.arange(width), torch.zeros_like(points_uv)
    else:
        rows = columns = torch.arange(-reach, reach + 1)
        base = points_uv.floor()
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    centres = torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5
    chunk = max(1, _CHUNK // len(centres))
    return torch.cat([
        _middles((start[:, None] + centres - uv[:, None]).norm(dim=-1), low, high)
        for uv, start in zip(points_uv.split(chunk), base.split(chunk), strict=True)
    ])  # fmt: skip


def _middles(distances: torch.Tensor, low: float, high: float) -> torch.Tensor:
    """[N, M] -> [N], the middle of the widest gap in [low, high]."""
    ends = distances.new_tensor([[low, high]]).expand(len(distances), 2)
    marks = torch.cat([distances.clamp(low, high), ends], dim=1).sort(dim=1).values
    widths, at = marks.diff(dim=1).max(dim=1)
    return marks.gather(1, at[:, None])[:, 0] + widths / 2


FAMILIES: Final = (
    Family("depth", "nearest depth, m (farthest: twice it)", (0.1, 1, 10, 100, 1e3, 1e4), (0.1, 1e4),
           lambda metres, generator: _view(generator, (metres, 2 * metres), translation=SHORT_TRANSLATION)),
    Family("depth range", "farthest depth, m (nearest: 0.1 m)", (1, 10, 100, 1e3, 1e4), (1e4,),
           lambda metres, generator: _view(generator, (constants.NEAR, metres), translation=SHORT_TRANSLATION)),
    Family("layers", "number of fragments per pixel", (1, 10, 100, 1e3, 1e4), (1, 100), _layers),
    Family("radius", "radius, px", (1e-3, 1e-2, 0.1, 0.5, 1.5, 8, 100, 1e3, 1e4), (1e-3, 1.5, 1e4), _radii),
    Family("opacity", "distance of opacity from 1",
           (0.5, 0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 2.0**-23, 2.0**-24, 0), (0.5, 2.0**-24, 0), _opacities),
    Family("size", "image width, px (height: half of it)", (64, 256, 1024, 4096), (64,),
           lambda width, generator: _view(generator, size=(int(width) // 2, int(width)), stride=_STRIDE)),
    Family("origin", "cameras' distance from the origin, m", (1, 10, 100, 1e3, 1e4), (1, 1e4), _origins),
    Family("quaternion", "length of the quaternion",
           (1e-12, 1e-9, 1e-8, 1e-7, 1e-4, 1, 1e4, 1e12, 1e18, 1e30), (1e-9, 1e30), _quaternions),
    Family("angle", "turn, rad", (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1, math.pi), (1e-6, math.pi), _angles),
    Family("recursion", "number of motions in a row", (1, 2, 5, 10, 20, 50), (1, 5),
           lambda steps, generator: _view(generator, steps=int(steps))),
)  # fmt: skip

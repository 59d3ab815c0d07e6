"""What a camera sees of the clouds: a splat of each, and what follows from both."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from torch.nn import functional

from vestcl import constants
from vestcl.models._clouds import Cloud, Grid, last_motion
from vestcl.models._layers import check, side_by_side
from vestcl.models.config import LEAST_COVERAGE, RenderConfig
from vestcl.models.skipping import Tally
from vestcl.ops.displace import displace
from vestcl.ops.splat import composite, rasterize
from vestcl.scene.holes import deep_holes
from vestcl.scene.layers import SKY_DEPTH

#: Pixels that were next to each other belong to one surface if the view shows them no farther apart than that, times
#: what it magnifies (as in vestcl/geometric/render.py).
_TORN: Final = 2.5

#: Metres that inpainted points go farther back in the splatter's order, where they come last: what a frame has not seen
#: never hides what it has. An inpainted point stands still 1 % behind the object that hides it, and a car that drives
#: ahead of us would soon be behind the road that it was painted over.
_BEHIND: Final = 4 * SKY_DEPTH

#: Points are picked for open pixels where no more of a view is open than that: picking takes time, too.
_OPEN: Final = 0.15

#: Limits of a footprint's radius, px: half the splatter's tile, and where a footprint can miss every pixel centre.
RADIUS: Final = (0.5, constants.TILE / 2)


class Camera(NamedTuple):
    """Where a view is taken from."""

    tgt_from_next: torch.Tensor
    """[B, 4, 4] m: from the source camera at the forecast time."""
    K: torch.Tensor
    """[B, 3, 3] px."""


class Side(NamedTuple):
    """What one cloud leaves on a view. All but coverage are multiplied by it."""

    features: torch.Tensor
    """[B, C, H, W]."""
    colour: torch.Tensor
    """[B, 3, H, W]."""
    coverage: torch.Tensor
    """[B, 1, H, W]."""
    inverse_depth: torch.Tensor
    """[B, 1, H, W] 1/m, in the view's camera."""
    background: torch.Tensor
    """[B, 1, H, W], the share of static background; no gradient."""
    inverse_motion: torch.Tensor
    """[B, 3, H, W], (x_(t+k) - x_(t+k-1)) / z_tgt: else the sky, which turns by hundreds of metres, would outvote all
    that it shines through; no gradient."""


class RenderedView(NamedTuple):
    """A future frame in one camera. Where both clouds are, the current frame's is in front."""

    image: torch.Tensor
    """[B, 3, H, W], refined."""
    colour: torch.Tensor
    """[B, 3, H, W], as splatted: times coverage."""
    coverage: torch.Tensor
    """[B, 1, H, W] in [0, 1]."""
    depth: torch.Tensor
    """[B, 1, H, W] m, the harmonic mean of what covers the pixel; 0 where that is less than LEAST_COVERAGE."""
    background: torch.Tensor
    """[B, 1, H, W], the share of static background in what covers the pixel; 1 where nothing does. No gradient."""
    motion_xyz: torch.Tensor
    """[B, 3, H, W] m, x_(t+k) - x_(t+k-1) of what the pixel shows, each in its own time's source camera, weighted by
    1 / z as the depth is; 0 where unknown. No gradient."""


def checked_camera(camera: tuple[torch.Tensor, torch.Tensor], batch: int) -> Camera:
    """``camera`` with its names, for ``batch`` images.

    Raises:
        ValueError: another shape.
    """
    tgt_from_next, K = camera
    check(tgt_from_next=(tgt_from_next, f"{batch} 4 4"), K=(K, f"{batch} 3 3"))
    return Camera(tgt_from_next, K)


def splat_cloud(
    cloud: Cloud,
    camera: Camera,
    K: torch.Tensor,
    next_from_cur: torch.Tensor,
    config: RenderConfig,
    height: int,
    width: int,
    min_transmittance: float = 0.0,
    open_: torch.Tensor | None = None,
    tally: Tally | None = None,
    deep: torch.Tensor | None = None,
) -> Side:
    """Show a cloud in ``camera``: opaque points of radius r = rho z_src / z_tgt f_tgt / f_src, clamped to RADIUS.

    With ``config.stretched`` r grows with the distance to what was beside a point, and points that nothing is beside
    any more are left out: see `_surface`.

    Args:
        cloud: of B images.
        camera: B of them.
        K: [B, 3, 3] px, of the camera that the cloud was seen by.
        next_from_cur: [B, 4, 4] m, the camera's last motion, for ``motion_xyz``.
        config: rho, the radius in source pixels.
        height: rows of the view.
        width: columns of the view.
        min_transmittance: see `vestcl.splat`.
        open_: bool [B, 1, H, W], the pixels that count: others may be left empty. None is all.
        tally: is told how many points that left out; None leaves out none.
        deep: bool [B, 1, H, W], the pixels where inpainted points count, from `inner_holes`; None is all.

    Returns:
        What is seen; differentiable in the cloud, through positions, radii and inverse depth.
    """
    points_uv, z = _project(cloud, camera)
    near = z.clamp(min=constants.NEAR)
    zoom = (camera.K[:, 0, 0] * camera.K[:, 1, 1] / (K[:, 0, 0] * K[:, 1, 1])).sqrt()
    zoom_of_point = zoom.repeat_interleave(cloud.starts.diff())
    magnified, opacities = zoom_of_point * cloud.depth / near, torch.ones_like(z)
    if config.stretched:
        stretch, opacities = _surface(points_uv.detach(), magnified.detach(), cloud.grids)
        magnified = magnified * stretch
    radii = (config.rho * magnified).clamp(*RADIUS)
    order = z.detach()
    if config.inpainted != "own":
        order = order + _BEHIND * cloud.inpainted
    starts = cloud.starts
    if deep is not None:
        opacities = opacities * (~cloud.inpainted | _found(points_uv.detach(), starts, deep))
    if open_ is not None and tally is not None:
        count = len(z)
        if open_.float().mean() <= _OPEN:
            kept = _reaching(points_uv.detach(), starts, open_)
            starts = torch.searchsorted(kept, starts)
            cloud = cloud.picked(kept, starts)
            points_uv, order, near, radii, opacities = (t[kept] for t in (points_uv, order, near, radii, opacities))
            count = len(kept)
        tally.add("covered", len(z) - count, len(z), "points")
    raster = rasterize(points_uv, order, radii, opacities, height, width, cloud_starts=starts)
    with torch.no_grad():
        known = cloud.background, last_motion(cloud, next_from_cur) / near[:, None]
    shown = [cloud.shown, near.reciprocal()[:, None]]
    separate = torch.is_grad_enabled()  # no gradient is to pass through what is known
    image, coverage = composite(raster, torch.cat(shown if separate else [*shown, *known], 1), None, min_transmittance)
    if separate:
        with torch.no_grad():
            more = composite(raster, torch.cat(known, 1), None, min_transmittance)[0]
        image = torch.cat([image, more], dim=1)
    features, colour, inverse_depth, background, inverse_motion = image.split([image.shape[1] - 8, 3, 1, 1, 3], dim=1)
    return Side(features, colour, coverage, inverse_depth, background, inverse_motion)


def inner_holes(hole: torch.Tensor) -> torch.Tensor:
    """Where foreground moved away from the background: holes [B, 1, H, W] but for cracks and what reaches the border.

    What enters the picture was never hidden by anything: what is beside it is a better guess than what was inpainted.
    """
    return torch.from_numpy(np.stack([deep_holes(image) for image in hole.numpy()]))


def _found(points_uv: torch.Tensor, starts: torch.Tensor, where: torch.Tensor, around: int = 0) -> torch.Tensor:
    """bool [P]: which points [P, 2] px come to pixels of ``where`` [B, 1, H, W].

    From up to ``around`` px outside, the nearest pixel counts; from farther away none is found.
    """
    height, width = where.shape[2:]
    column, row = points_uv.nan_to_num(-1 - around).floor().long().unbind(1)
    inside = (row >= -around) & (row < height + around) & (column >= -around) & (column < width + around)
    image = torch.arange(len(where)).repeat_interleave(starts.diff())
    place = (image * height + row.clamp(0, height - 1)) * width + column.clamp(0, width - 1)
    return inside & where.flatten()[place]


def _reaching(points_uv: torch.Tensor, starts: torch.Tensor, open_: torch.Tensor) -> torch.Tensor:
    """Indices of the points whose footprints may reach an open pixel, and some of their neighbours: of all that come to
    a tile with one or beside it, which is farther than any radius.

    Args:
        points_uv: [P, 2] px.
        starts: [B + 1].
        open_: bool [B, 1, H, W].
    """
    tiles = functional.max_pool2d(open_.to(points_uv), constants.TILE, ceil_mode=True)
    wide = functional.max_pool2d(tiles, 3, stride=1, padding=1) > 0
    return _found(points_uv / constants.TILE, starts, wide, around=1).nonzero()[:, 0]


def _surface(
    points_uv: torch.Tensor, magnified: torch.Tensor, grids: Sequence[Grid]
) -> tuple[torch.Tensor, torch.Tensor]:
    """How much farther apart than ``magnified`` a surface's points are, and which points still are of a surface.

    A surface that turns towards the camera is stretched by more than what it comes nearer by. Neighbours are together
    up to _TORN times the magnification; of those at either side the nearer counts, of both directions the wider.

    Args:
        points_uv: [P, 2] px.
        magnified: [P], size of a source pixel, px.
        grids: `Cloud.grids`.

    Returns:
        Factor [P], 1 or more; opacity [P], 0 where a point had neighbours and none is near it any more.
    """
    factor, opacity = torch.ones_like(magnified), torch.ones_like(magnified)
    for start, height, width in grids:
        own, size = slice(start, start + height * width), (height, width)
        uv, pixel = points_uv[own].unflatten(0, size), magnified[own].unflatten(0, size)
        limit, spacing = _TORN * pixel.clamp(min=1), torch.zeros_like(pixel)
        together = torch.full_like(pixel, height * width == 1, dtype=torch.bool)
        for axis, (before, after) in enumerate((((0, 0, 1, 0), (0, 0, 0, 1)), ((1, 0), (0, 1)))):
            gap = torch.linalg.vector_norm(uv.diff(dim=axis), dim=2).nan_to_num(nan=torch.inf, posinf=torch.inf)
            nearer = torch.minimum(*(functional.pad(gap, side, value=torch.inf) for side in (before, after)))
            near = nearer < limit
            spacing, together = spacing.maximum(torch.where(near, nearer, 0)), together | near
        factor[own] = (spacing / pixel.clamp(min=1e-6)).clamp(min=1).flatten()
        opacity[own] = together.flatten().to(opacity)
    return factor, opacity


def refined_channels(side: Side, colour: bool, normalised: bool) -> torch.Tensor:
    """What refinement sees of a side, [B, C, H, W]: features, and with ``colour`` colour, coverage, inverse depth.

    ``normalised`` divides all but coverage by it, or by LEAST_COVERAGE where there is less.
    """
    per_coverage = 1 / side.coverage.clamp(min=LEAST_COVERAGE) if normalised else 1
    planes = [side.features * per_coverage]
    if colour:
        planes += [side.colour * per_coverage, side.coverage, side.inverse_depth * per_coverage]
    return side_by_side(planes)


def compose_view(sides: Sequence[Side], image: torch.Tensor) -> RenderedView:
    """front + (1 - coverage) behind, the last side in front, and what follows from it.

    Args:
        sides: what each cloud left on the view, the current frame's last.
        image: [B, 3, H, W], refined.

    Returns:
        The view; differentiable in colour, coverage, depth and image.
    """
    behind, *fronts = (side_by_side(side[1:]) for side in sides)
    for front in fronts:
        behind = front + (1 - front[:, 3:4]) * behind
    colour, coverage, inverse_depth, background, inverse_motion = behind.split([3, 1, 1, 1, 3], dim=1)
    known = coverage >= LEAST_COVERAGE
    inverse_depth = torch.where(known, inverse_depth, 1)
    depth = torch.where(known, coverage, 0) / inverse_depth
    background = torch.where(known, background / coverage.detach().clamp(min=LEAST_COVERAGE), 1).detach()
    motion_xyz = torch.where(known, inverse_motion / inverse_depth, 0).detach()
    return RenderedView(image, colour, coverage, depth, background, motion_xyz)


def _project(cloud: Cloud, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """points_uv [P, 2] px and z [P] m in each image's own camera."""
    clouds = zip(cloud.points_xyz.split(cloud.sizes), cloud.displacement_xyz.split(cloud.sizes), strict=True)
    cameras = zip(camera.K[:, None], camera.tgt_from_next[:, None], strict=True)
    projected = [
        displace(points[None], displacement[None], K, tgt_from_next)
        for (points, displacement), (K, tgt_from_next) in zip(clouds, cameras, strict=True)
    ]
    return torch.cat([uv[0] for uv, _ in projected]), torch.cat([z[0] for _, z in projected])

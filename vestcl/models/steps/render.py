"""What a camera sees of the clouds: a splat of each, and what follows from both."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
import torch

from vestcl import constants
from vestcl.constants import SKY_DEPTH
from vestcl.models.config import LEAST_COVERAGE, RenderConfig
from vestcl.models.inference.skipping import Tally
from vestcl.models.networks.layers import side_by_side
from vestcl.models.steps.clouds import Cloud, PixelGrid, last_motion
from vestcl.ops.displace import displace
from vestcl.ops.splat import composite, rasterize
from vestcl.ops.stretch import stretch
from vestcl.scene.inpainting.holes import deep_holes
from vestcl.shapes import check

#: Metres that inpainted points go farther back in the splatter's order, where they come last: what a frame has not seen
#: never hides what it has. An inpainted point is static 1 % behind the object that hides it, and a car that drives
#: ahead of us would soon be behind the road that it is drawn over.
_BEHIND: Final = 4 * SKY_DEPTH

#: Points are picked for open pixels where no more of them are left than that: picking takes time, too.
_WORTH: Final = 0.7

#: From a pixel's centre to its corner are 0.71 px, and OpenCV's distances up to `RADIUS` are off by less than 0.2 px.
_INSIDE: Final = 1.0

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
    known: torch.Tensor
    """[B, 8, H, W]: what a view has in addition to its features; the properties are its parts."""
    coverage: torch.Tensor
    """[B, 1, H, W]."""

    @property
    def colour(self) -> torch.Tensor:
        """[B, 3, H, W]."""
        return self.known[:, :3]

    @property
    def inverse_depth(self) -> torch.Tensor:
        """[B, 1, H, W] 1/m, in the view's camera."""
        return self.known[:, 3:4]

    @property
    def background(self) -> torch.Tensor:
        """[B, 1, H, W], the share of static background."""
        return self.known[:, 4:5]

    @property
    def inverse_motion(self) -> torch.Tensor:
        """[B, 3, H, W], (x_(t+k) - x_(t+k-1)) / z_tgt: else the sky, which turns by hundreds of metres, would outvote
        all that it shines through."""
        return self.known[:, 5:]


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
    flat: bool = False,
) -> Side:
    """Show a cloud in ``camera``: opaque points of radius r = rho z_src / z_tgt f_tgt / f_src, clamped to RADIUS.

    Points that come so near that rho z_src / z_tgt is beyond RADIUS are left out, as `vestcl.forecasting.geometric`
    leaves them out: a ball of that size hides what it is not. A longer focal length leaves out none. With
    ``config.stretched`` r grows with the distance to a point's former neighbours, and points without neighbours are
    left out, too: see `_surface`.

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
        tally: is passed how many points reach none of them, and are left out; None leaves out none.
        deep: bool [B, 1, H, W], the pixels where inpainted points count, from `inner_holes`; None is all.
        flat: motion is a 2D flow, see `vestcl.models.steps.clouds.in_plane`.

    Returns:
        What is seen; differentiable in the cloud, through positions, radii and inverse depth.
    """
    points_uv, z = _project(cloud, camera)
    near, order = z.clamp(min=constants.NEAR), z.detach()
    zoom = (camera.K[:, 0, 0] * camera.K[:, 1, 1] / (K[:, 0, 0] * K[:, 1, 1])).sqrt()
    radii, opacities = _sizes(cloud, zoom, points_uv, near, config)
    if config.inpainted != "own":
        order = order + _BEHIND * cloud.inpainted
    starts = cloud.starts
    if deep is not None:
        hidden = cloud.inpainted.nonzero()[:, 0]
        opacities[hidden] *= _found(points_uv.detach()[hidden], torch.searchsorted(hidden, starts), deep)
    if open_ is not None and tally is not None:
        kept = _reaching(points_uv.detach(), radii.detach(), opacities, starts, open_)
        worth = len(kept) < _WORTH * len(z)
        tally.add("covered", (len(z) - len(kept)) * worth, len(z), "points")
        if worth:
            starts = torch.searchsorted(kept, starts)
            cloud = cloud.picked(kept, starts)
            points_uv, order, near, radii, opacities = (t[kept] for t in (points_uv, order, near, radii, opacities))
    raster = rasterize(points_uv, order, radii, opacities, height, width, cloud_starts=starts)
    with torch.no_grad():
        measured = cloud.background, last_motion(cloud, next_from_cur, flat) / near[:, None]
    known = torch.cat([cloud.colour, near.reciprocal()[:, None], *measured], dim=1)
    features, coverage = composite(raster, cloud.features, None, min_transmittance)
    return Side(features, composite(raster, known, None, min_transmittance)[0], coverage)


def _sizes(
    cloud: Cloud, zoom: torch.Tensor, points_uv: torch.Tensor, near: torch.Tensor, config: RenderConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """Radii [N] px and opacities [N], 1 or 0, of points at depths ``near``; ``zoom`` [B] is f_tgt / f_src."""
    magnified = zoom.repeat_interleave(cloud.starts.diff()) * cloud.depth / near
    opacities = (config.rho * (cloud.depth / near).detach() <= RADIUS[1]).to(near)
    if config.stretched:
        factor, whole = _surface(points_uv.detach(), magnified.detach(), cloud.grids)
        opacities, magnified = opacities * whole, magnified * factor
    return (config.rho * magnified).clamp(*RADIUS), opacities


def inner_holes(hole: torch.Tensor) -> torch.Tensor:
    """Where foreground moved away from the background: holes [B, 1, H, W] but for cracks and what reaches the border.

    What enters the image was never hidden by anything: what is next to it is a better guess than what was inpainted.
    """
    return torch.from_numpy(np.stack([deep_holes(image) for image in hole.numpy()]))


def _found(points_uv: torch.Tensor, starts: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    """bool [P]: which points [P, 2] px come to pixels of ``where`` [B, 1, H, W]."""
    height, width = where.shape[2:]
    inside = (points_uv >= 0).all(dim=1) & (points_uv < points_uv.new_tensor([width, height])).all(dim=1)
    return inside & where.flatten()[_pixels_of(points_uv, starts, height, width)]


def _reaching(
    points_uv: torch.Tensor, radii: torch.Tensor, opacities: torch.Tensor, starts: torch.Tensor, open_: torch.Tensor
) -> torch.Tensor:
    """Indices of the points that are not transparent and whose footprints may reach an open pixel.

    From the image's nearest pixel it is no farther to what is open than from a point outside.

    Args:
        points_uv: [P, 2] px.
        radii: [P] px.
        opacities: [P].
        starts: [B + 1].
        open_: bool [B, 1, H, W].
    """
    closed = (~open_).to(torch.uint8).numpy()
    far = np.stack([cv2.distanceTransform(image[0], cv2.DIST_L2, cv2.DIST_MASK_5) for image in closed])
    nearest = torch.from_numpy(far).flatten()[_pixels_of(points_uv, starts, *open_.shape[2:])]
    return ((nearest <= radii + _INSIDE) & (opacities > 0)).nonzero()[:, 0]


def _pixels_of(points_uv: torch.Tensor, starts: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """int32 [P]: index of the pixel of B H W that is nearest to each point [P, 2] px; 0 for what is not a number."""
    last = points_uv.new_tensor([width - 1, height - 1])
    column, row = points_uv.nan_to_num(0).minimum(last).clamp_(min=0).to(torch.int32).unbind(1)
    pixel = row * width + column
    if len(starts) > 2:
        pixel += torch.arange(len(starts) - 1, dtype=torch.int32).repeat_interleave(starts.diff()) * (height * width)
    return pixel


def _surface(
    points_uv: torch.Tensor, magnified: torch.Tensor, grids: Sequence[PixelGrid]
) -> tuple[torch.Tensor, torch.Tensor]:
    """`stretch` of each of ``grids`` among the points [P, 2] and [P]; 1 and 1 for others, which have no neighbours."""
    factor, opacity = torch.ones_like(magnified), torch.ones_like(magnified)
    for start, height, width in grids:
        own, size = slice(start, start + height * width), (1, height, width)
        found = stretch(points_uv[own].unflatten(0, size), magnified[own].unflatten(0, size))
        factor[own], opacity[own] = (plane.flatten() for plane in found)
    return factor, opacity


def refined_channels(side: Side, colour: bool, normalised: bool) -> torch.Tensor:
    """What refinement sees of a side, [B, C, H, W]: features, and with ``colour`` colour, coverage, inverse depth.

    ``normalised`` divides all but coverage by it, or by LEAST_COVERAGE where there is less.
    """
    per_coverage = _per_coverage(side) if normalised else 1
    planes = [side.features * per_coverage]
    if colour:
        looks = side.known[:, :4] * per_coverage
        planes += [looks[:, :3], side.coverage, looks[:, 3:]]
    return side_by_side(planes)


def looks_of(side: Side, normalised: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Colour [B, 3, H, W] as in `refined_channels`, and coverage [B, 1, H, W]."""
    return side.colour * (_per_coverage(side) if normalised else 1), side.coverage


def _per_coverage(side: Side) -> torch.Tensor:
    return 1 / side.coverage.clamp(min=LEAST_COVERAGE)


def compose_view(sides: Sequence[Side], image: torch.Tensor) -> RenderedView:
    """front + (1 - coverage) behind, the last side in front, and what follows from it.

    Args:
        sides: what each cloud left on the view, the current frame's last.
        image: [B, 3, H, W], refined.

    Returns:
        The view; differentiable in colour, coverage, depth and image.
    """
    known, coverage = sides[0][1:]
    for front in sides[1:]:
        through = 1 - front.coverage
        known, coverage = front.known + through * known, front.coverage + through * coverage
    colour, inverse_depth, background, inverse_motion = known.split([3, 1, 1, 3], dim=1)
    seen = coverage >= LEAST_COVERAGE
    inverse_depth = torch.where(seen, inverse_depth, 1)
    depth = torch.where(seen, coverage, 0) / inverse_depth
    background = torch.where(seen, background / coverage.detach().clamp(min=LEAST_COVERAGE), 1).detach()
    motion_xyz = torch.where(seen, inverse_motion / inverse_depth, 0).detach()
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

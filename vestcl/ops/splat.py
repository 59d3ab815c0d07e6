"""Depth-sorted alpha splatting: rasterise a geometry once, composite any number of feature sets on it."""

from dataclasses import dataclass
from typing import Any, Generic, NoReturn

import numpy as np
import torch

from vestcl import constants, opencl
from vestcl.ops._arguments import Array, as_array, check_arguments, check_starts, require_no_grad, require_ordinary
from vestcl.ops._autograd import Gradients, differentiable_once, untraced
from vestcl.ops._splat_composite import NeedsGrad, composite_backward, composite_forward
from vestcl.ops._splat_layer import Layer
from vestcl.ops._splat_lists import Geometry, TileLists, list_tiles
from vestcl.ops._splat_skipped import Skipped, count_culled

__all__ = ["Raster", "Skipped", "composite", "rasterize", "skipped", "splat"]


@dataclass(frozen=True, eq=False)
class Raster(Generic[Array]):
    """A rasterised geometry, from `rasterize`; `composite` shows features on it. Its lists live on the device."""

    points_uv: Array
    radii: Array
    opacities: Array
    packed: bool
    """Whether clouds are packed one after another (``cloud_starts`` was given)."""
    geometry: Geometry
    lists: TileLists
    grad_fns: tuple[Any, ...]
    """The arrays' nodes in autograd's graph when `rasterize` was called."""

    def __copy__(self) -> "Raster[Array]":
        return self  # it is never changed

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """What copy.deepcopy and pickle ask for."""
        raise TypeError(
            "a Raster can't be deep-copied or pickled, for its lists live on an OpenCL device: keep points_uv, z, "
            "radii and opacities, and call vestcl.rasterize again"
        )

    @property
    def height(self) -> int:
        return self.geometry.height

    @property
    def width(self) -> int:
        return self.geometry.width


@untraced
def splat(
    points_uv: Array,
    z: Array,
    radii: Array,
    opacities: Array,
    features: Array,
    height: int,
    width: int,
    backgrounds: Array | None = None,
    min_transmittance: float = 0.0,
    *,
    cloud_starts: Array | None = None,
) -> tuple[Array, Array]:
    """Composite the points of each cloud front to back onto its image.

        d2 = |p - uv_i|^2,   a_i = o_i (1 - d2 / r_i^2)   at pixel centre p, for every point with d2 < r_i^2
        T_0 = 1,   w_i = a_i T_i,   T_(i+1) = T_i (1 - a_i)   in the order (z, index)
        image = sum_i w_i f_i + T_end b,   coverage = 1 - T_end

    Exact: any number of fragments per pixel, no epsilon, no division by 1 - a in the gradient, the same bits on any
    number of cores. Points with z < 0.1 m, a radius <= 0 (or so extreme that its square is subnormal or infinite) or
    any number that is not finite (a feature counts) are skipped, and their gradients are 0; so are points of opacity 0
    unless the gradient of the opacities is asked for. `skipped` counts them.

    Clouds of different sizes cost no padding when they are packed: concatenate the points of all clouds (without the
    leading B), and give in ``cloud_starts`` where each begins. Dense clouds padded with points of radius 0 work too; a
    padded point is read once and then costs nothing.

    Args:
        points_uv: [B, N, 2] px, pixel centres at (column + 0.5, row + 0.5). Torch CPU tensor or NumPy array of
            float32 or float64, any strides; the others are of the same kind and dtype.
        z: [B, N] m, z-depth, only for the order.
        radii: [B, N] px.
        opacities: [B, N], meant to be in [0, 1]; outside, the formula is used unchanged.
        features: [B, N, C], 1 <= C <= 1024.
        height: rows of the image.
        width: columns of the image.
        backgrounds: [B, C]; None is zero.
        min_transmittance: in [0, 1): a pixel takes no more fragments once its T is below this, which changes it by
            at most min_transmittance * max |f - b|; the gradient is that of the truncated sum. 0 never stops.
        cloud_starts: int64 [B + 1]; given, cloud b owns points cloud_starts[b]:cloud_starts[b + 1] of points_uv
            [P, 2], z, radii, opacities [P] and features [P, C].

    Returns:
        image [B, C, H, W] in channels-last memory (fastest for torch convolutions on a CPU) and coverage
        [B, 1, H, W], of the kind and dtype that came in; differentiable in all but z, once: a second derivative
        raises NotImplementedError. Both may be changed in place.

    Raises:
        ValueError: an argument of another kind, dtype, shape or device, or a ``z`` that requires grad (pass
            z.detach(): the order of points has no gradient).
        DeviceError: no OpenCL device, or one without float64 where that is asked for.

    Source: SPEC section 2; the footprint is 3D Moments' (CVPR 2022), without its limit on fragments per pixel.
    """
    with opencl.current().job():
        raster = rasterize(points_uv, z, radii, opacities, height, width, cloud_starts=cloud_starts)
        return composite(raster, features, backgrounds, min_transmittance)


@untraced
def rasterize(
    points_uv: Array,
    z: Array,
    radii: Array,
    opacities: Array,
    height: int,
    width: int,
    *,
    cloud_starts: Array | None = None,
) -> Raster[Array]:
    """The geometric half of `splat`, for several feature sets on one geometry: depth-sorted lists of points per tile.

    Args and raises as in `splat`. Gradients flow through `composite` into the arguments given
    here, which must require grad already if they are to have one.

    Returns:
        A `Raster`. It holds device memory (about 24 bytes for each point and tile that it touches, in float32) and a
        copy of the numbers: changing the arguments in place afterwards does not change it. Where autograd recorded
        that change, `composite` raises ValueError, for the argument's graph is that of the new numbers.
    """
    require_no_grad("z", z)
    letters = "B N" if cloud_starts is None else "P"
    sizes = check_arguments(
        points_uv=(points_uv, f"{letters} 2"),
        z=(z, letters),
        radii=(radii, letters),
        opacities=(opacities, letters),
    )
    if cloud_starts is None:
        starts = np.arange(sizes["B"] + 1, dtype=np.int64) * sizes["N"]
    else:
        starts = check_starts("cloud_starts", cloud_starts, points_uv, sizes["P"])
    if starts[-1] >= 2**31:
        raise ValueError(f"`points_uv` must hold fewer than 2**31 points, got {starts[-1]}")
    geometry = Geometry(
        points_uv=as_array(points_uv).reshape(-1, 2),
        z=as_array(z).reshape(-1),
        radii=as_array(radii).reshape(-1),
        opacities=as_array(opacities).reshape(-1),
        cloud_starts=starts.astype(np.int32),
        height=_size("height", height),
        width=_size("width", width),
        list_transparent=_requires_grad(opacities),
    )
    lists = list_tiles(opencl.current(), geometry)
    grad_fns = tuple(_grad_fn(array) for array in (points_uv, radii, opacities))
    return Raster(points_uv, radii, opacities, cloud_starts is not None, geometry, lists, grad_fns)


@untraced
def composite(
    raster: Raster[Array], features: Array, backgrounds: Array | None = None, min_transmittance: float = 0.0
) -> tuple[Array, Array]:
    """The other half of `splat`: show ``features`` [B, N, C] (packed: [P, C]) on a rasterised geometry.

    Args, returns and raises as in `splat`.
    """
    letters = "P C" if raster.packed else "B N C"
    shapes = {"raster.points_uv": (raster.points_uv, letters.replace("C", "2")), "features": (features, letters)}
    channels = check_arguments(**shapes)["C"]
    check_arguments(**shapes, backgrounds=(backgrounds, f"{raster.geometry.batch} {channels} | None"))
    if not 1 <= channels <= constants.MAX_CHANNELS:
        raise ValueError(f"`features` must have 1 to {constants.MAX_CHANNELS} channels, got {channels}")
    if not 0 <= min_transmittance < 1:
        raise ValueError(f"`min_transmittance` must be in [0, 1), got {min_transmittance}")
    if _requires_grad(raster.opacities) and not raster.geometry.list_transparent:
        raise ValueError("`raster.opacities` must require grad when `rasterize` is called, got them requiring it since")
    _check_graph(raster)
    if not isinstance(features, torch.Tensor):
        image, coverage, _ = composite_forward(_layer(raster, features, backgrounds, min_transmittance))
        return image.transpose(0, 3, 1, 2), coverage[:, None]
    image, coverage, _ = _Composite.apply(
        raster, min_transmittance, raster.points_uv, raster.radii, raster.opacities, features, backgrounds
    )
    return image, coverage


@untraced
def skipped(raster: Raster[Array], min_transmittance: float = 0.0) -> Skipped:
    """Count what compositing on ``raster`` skips: points that no list holds, tiles without points, opaque pixels.

        a pixel is saturated where T_end = 0, or T_end < min_transmittance: nothing behind changes it

    Counted when asked, all images of the batch together; splatting itself counts nothing.

    Args:
        raster: from `rasterize`; the reasons are read from its arrays, so these should still be what they were.
        min_transmittance: as in `splat`.

    Returns:
        A `Skipped`.

    Raises:
        ValueError: ``min_transmittance`` outside [0, 1).

    Source: SPEC section 2 (which points make fragments).
    """
    if not 0 <= min_transmittance < 1:
        raise ValueError(f"`min_transmittance` must be in [0, 1), got {min_transmittance}")
    geometry, lists = raster.geometry, raster.lists
    nothing = np.zeros((geometry.points, 1), geometry.z.dtype)
    white = np.ones((geometry.batch, 1), geometry.z.dtype)
    left, _, _ = composite_forward(Layer(geometry, lists, nothing, white, min_transmittance))  # T_end
    return Skipped(
        **count_culled(geometry, lists),
        points=geometry.points,
        tiles=len(lists.tile_scratch),
        empty_tiles=int((np.diff(lists.tile_starts) == 0).sum()),
        pixels=left.size,
        saturated_pixels=int(((left == 0) | (left < min_transmittance)).sum()),
    )


class _Composite(torch.autograd.Function):
    """Image and coverage, and an empty tensor by which gradients lead back to all inputs (`differentiable_once`)."""

    @staticmethod
    def forward(
        ctx: Any,
        raster: Raster[torch.Tensor],
        min_transmittance: float,
        points_uv: torch.Tensor,
        radii: torch.Tensor,
        opacities: torch.Tensor,
        features: torch.Tensor,
        backgrounds: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        image, coverage, ctx.saved = composite_forward(_layer(raster, features, backgrounds, min_transmittance))
        ctx.raster, ctx.min_transmittance = raster, min_transmittance
        ctx.shapes = {"points_uv": points_uv.shape, "radii": radii.shape, "opacities": opacities.shape}
        origin = features.new_empty(0)
        ctx.save_for_backward(features, backgrounds, origin)
        ctx.set_materialize_grads(False)
        # Arrays are reshaped before they are tensors: torch lets no view of several outputs be changed in place.
        return torch.from_numpy(image.transpose(0, 3, 1, 2)), torch.from_numpy(coverage[:, None]), origin

    @staticmethod
    @untraced
    def backward(
        ctx: Any, grad_image: torch.Tensor | None, grad_coverage: torch.Tensor | None, _: torch.Tensor | None
    ) -> Gradients:
        require_ordinary("grad_image", grad_image)
        require_ordinary("grad_coverage", grad_coverage)
        features, backgrounds, origin = ctx.saved_tensors
        layer = _layer(ctx.raster, features, backgrounds, ctx.min_transmittance)
        size = (layer.geometry.batch, layer.channels, layer.geometry.height, layer.geometry.width)
        zero = np.broadcast_to(np.zeros((), layer.dtype), size)
        image = zero if grad_image is None else grad_image.detach().resolve_neg().numpy()
        cover = None if grad_coverage is None else as_array(grad_coverage)
        names = ("points_uv", "radii", "opacities", "features", "backgrounds")
        needs_grad = NeedsGrad(**dict(zip(names, ctx.needs_input_grad[2:], strict=True)))
        arrays = composite_backward(layer, ctx.saved, image, cover, needs_grad)
        shapes = {**ctx.shapes, "features": features.shape}
        shaped = (
            arrays[name].reshape(shapes.get(name, (-1, layer.channels))) if name in arrays else None for name in names
        )
        grads = tuple(array if array is None else torch.from_numpy(array) for array in shaped)
        return None, None, *differentiable_once("splat", (grad_image, grad_coverage, origin), grads)


def _layer(raster: Raster[Any], features: Array, backgrounds: Array | None, min_transmittance: float) -> Layer:
    rows = as_array(features).reshape(-1, features.shape[-1])
    behind = None if backgrounds is None else as_array(backgrounds)
    return Layer(raster.geometry, raster.lists, rows, behind, min_transmittance)


def _requires_grad(array: Array) -> bool:
    return isinstance(array, torch.Tensor) and array.requires_grad


def _check_graph(raster: Raster[Any]) -> None:
    """Refuse a geometry that would send its gradients to where other numbers came from."""
    for name, grad_fn in zip(("points_uv", "radii", "opacities"), raster.grad_fns, strict=True):
        if torch.is_grad_enabled() and _grad_fn(getattr(raster, name)) is not grad_fn:
            raise ValueError(f"`raster.{name}` must be what `rasterize` got, got it changed in place: rasterise again")


def _grad_fn(array: Array) -> Any:
    return array.grad_fn if isinstance(array, torch.Tensor) else None


def _size(name: str, value: int) -> int:
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
        raise ValueError(f"`{name}` must be a whole number of pixels >= 1, got {value!r}")
    return int(value)

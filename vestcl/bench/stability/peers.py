"""How others compute what vestcl does, in float32 too: splats whose backward divides, PyTorch3D, a subtracting flow.

"dividing" has no A_(i+1), the colour behind a fragment, of its own. It takes it from the finished sum,
    dL/da_i = T_i f_i.g - (sum over j behind i of w_j f_j.g) / (1 - a_i + 1e-9),
where at a_i = 1 every w_j behind is 0: the quotient is 0 and the gradient lacks -T_i A_(i+1). This is what PyTorch3D's
alpha compositor does (csrc/compositing/alpha_composite.cu, kEpsilon = 1e-9; its first CPU code even had no epsilon),
and with it what is built on it, as SynSin and 3D Moments.

"clamping" keeps alpha below 1, at most 0.99, which changes the image, and walks back with T_i = T_(i+1) / (1 - a_i)
from T_end. This is what the rasteriser of 3D Gaussian Splatting (SIGGRAPH 2023) and its many descendants do; where
those stop at T < 1e-4, and leave out what is fainter than 1/255, this one does not.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import torch
from torch.autograd.function import once_differentiable

from vestcl import geometry
from vestcl.bench.splat import pytorch3d as _pytorch3d
from vestcl.bench.splat import scenes as _scenes
from vestcl.bench.stability.cases import CHANNELS, Case
from vestcl.bench.stability.fragments import Layers, list_layers, look_behind, transmittances
from vestcl.bench.stability.programs import OPERATORS, Operators

#: What PyTorch3D adds to 1 - alpha before it divides.
EPSILON: Final = 1e-9

#: The largest alpha of "clamping".
CEILING: Final = 0.99

#: The input whose gradient is left out of a peer's errors: PyTorch3D has no background, and what clamping lets shine
#: through instead of next to nothing is no matter of precision.
LEFT_OUT: Final = {"clamping": "backgrounds", "PyTorch3D": "backgrounds"}

#: PyTorch3D's rasteriser holds every point against every pixel on a CPU: so many pairs take it some seconds.
_MOST_PAIRS: Final = 1 << 27


def peers_of(case: Case) -> dict[str, Operators]:
    """By name, those who have the operators that a case is about."""
    if case.program == "flow":
        return {"R x + t - x": Operators(OPERATORS.unproject, subtracting_flow, OPERATORS.displace, OPERATORS.splat)}
    splats: dict[str, Callable[..., Any]] = {
        "dividing": partial(_splat, _Dividing),
        "clamping": partial(_splat, _Clamping),
    }
    pairs = case.height * case.width * case.inputs["radii"].numel()
    if _pytorch3d.is_installed() and pairs <= _MOST_PAIRS:
        splats["PyTorch3D"] = pytorch3d_splat
    return {
        name: Operators(OPERATORS.unproject, OPERATORS.rigid_flow, OPERATORS.displace, splat)
        for name, splat in splats.items()
    }


def subtracting_flow(points_xyz: torch.Tensor, quaternion: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """`vestcl.rigid_flow` as R x + t - x."""
    return geometry.transform_points(geometry.compose_rigid(quaternion, translation), points_xyz) - points_xyz


# ---------------------------------------------------------------- splat by division


def _composite(
    layers: Layers, alphas: torch.Tensor, values: torch.Tensor, background: torch.Tensor, pixels: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Alphas [F], values [N, C] and a background [C] to pixels [P, C]; T of each fragment [F] and T_end [P]."""
    before, after = transmittances(layers, alphas, pixels)
    image = values.new_zeros(pixels, values.shape[1])
    for part in layers.slices:
        image[layers.pixels[part]] += (alphas[part] * before[part])[:, None] * values[layers.points[part]]
    return image + after[:, None] * background, before, after


class _Dividing(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, layers: Layers, alphas: torch.Tensor, *others: Any) -> torch.Tensor:
        image, before, after = _composite(layers, alphas, *others)
        ctx.layers = layers
        ctx.save_for_backward(alphas, *others[:2], before, after)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        alphas, values, background, before, after = ctx.saved_tensors
        points, pixels = ctx.layers.points, ctx.layers.pixels
        products, weights = (values[points] * grad[pixels]).sum(dim=1), alphas * before
        shown = weights * products
        behind = look_behind(ctx.layers, lambda part, there: there + shown[part], after * (grad @ background))
        grad_alphas = before * products - behind / (1 - alphas + EPSILON)
        grad_values = torch.zeros_like(values).index_add_(0, points, weights[:, None] * grad[pixels])
        return None, grad_alphas, grad_values, (after[:, None] * grad).sum(dim=0), None


class _Clamping(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, layers: Layers, alphas: torch.Tensor, *others: Any) -> torch.Tensor:
        alphas = alphas.clamp(max=CEILING)
        image, _, after = _composite(layers, alphas, *others)
        ctx.layers = layers
        ctx.save_for_backward(alphas, *others[:2], after)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        alphas, values, background, after = ctx.saved_tensors
        points, pixels = ctx.layers.points, ctx.layers.pixels
        products, passed = (values[points] * grad[pixels]).sum(dim=1), 1 - alphas
        before = look_behind(ctx.layers, lambda part, there: there / passed[part], after.clone()) / passed

        def step(part: slice, there: torch.Tensor) -> torch.Tensor:
            return alphas[part] * products[part] + passed[part] * there

        behind = look_behind(ctx.layers, step, torch.zeros_like(after))
        grad_alphas = before * (products - behind) - (after * (grad @ background))[pixels] / passed
        grad_values = torch.zeros_like(values).index_add_(0, points, (alphas * before)[:, None] * grad[pixels])
        return None, grad_alphas, grad_values, (after[:, None] * grad).sum(dim=0), None


def _splat(
    composite: type[torch.autograd.Function],
    points_uv: torch.Tensor,
    z: torch.Tensor,
    radii: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
    height: int,
    width: int,
    backgrounds: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """`vestcl.splat` of one cloud, [1, N, ...], by another way to composite."""
    layers = list_layers(points_uv[0], z[0], radii[0], height, width)
    alphas = opacities[0][layers.points] * layers.shapes
    behind = torch.cat([backgrounds[0], backgrounds.new_zeros(1)])
    rows = composite.apply(layers, alphas, _with_ones(features)[0], behind, height * width)
    sums = rows.T.reshape(1, -1, height, width)
    return sums[:, :CHANNELS], sums[:, CHANNELS:]


def pytorch3d_splat(
    points_uv: torch.Tensor,
    z: torch.Tensor,
    radii: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
    height: int,
    width: int,
    backgrounds: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """`vestcl.splat` of one cloud by PyTorch3D."""
    most = len(list_layers(points_uv[0], z[0], radii[0], height, width).slices)
    values = _with_ones(features)
    nothing = values.new_zeros(1, values.shape[2], height, width)
    scene = _scenes.Scene(points_uv, z, radii, opacities, values, nothing)
    sums = _pytorch3d.splat(scene, most)
    image, coverage = sums[:, :CHANNELS], sums[:, CHANNELS:]
    return image + (1 - coverage) * backgrounds[:, :, None, None], coverage


def _with_ones(features: torch.Tensor) -> torch.Tensor:
    """A channel more, whose image is the coverage."""
    return torch.cat([features, torch.ones_like(features[..., :1])], dim=-1)

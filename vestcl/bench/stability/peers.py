"""How others compute what vestcl does, in float32 too: splats whose backward divides, and a subtracting flow.

"dividing" has no colour behind a fragment, A_(i+1), of its own. It derives it from the finished sum,
    dL/da_i = T_i f_i.g - (sum over j behind i of w_j f_j.g) / (1 - a_i + 1e-9),
where at a_i = 1 every w_j behind is 0: the quotient is 0 and the gradient lacks -T_i A_(i+1). PyTorch3D's alpha
compositor does this (csrc/compositing/alpha_composite.cu, kEpsilon = 1e-9), and so does what is built on it, such as
SynSin and 3D Moments.

"clamping" keeps alpha at 0.99 at most, which changes the image, and divides by 1 - a_i without an epsilon, as the
rasteriser of 3D Gaussian Splatting (SIGGRAPH 2023) and its descendants do.
"""

from functools import partial
from typing import Final

import torch

from vestcl import geometry
from vestcl.bench.stability.cases import Case
from vestcl.bench.stability.layers import list_layers, scan
from vestcl.bench.stability.programs import Operators

#: What PyTorch3D adds to 1 - alpha before it divides.
EPSILON: Final = 1e-9

#: The largest alpha of "clamping", and the input whose gradient is left out of its errors: the background that it lets
#: through is not a matter of precision.
CEILING: Final = 0.99
LEFT_OUT: Final = {"clamping": "backgrounds"}


def peers_of(case: Case) -> dict[str, Operators]:
    """By name, the peers of the operator that a case is about."""
    if case.program == "flow":
        return {"R x + t - x": Operators(rigid_flow=subtracting_flow)}
    clamping = partial(dividing_splat, epsilon=0.0, ceiling=CEILING)
    return {"dividing": Operators(splat=dividing_splat), "clamping": Operators(splat=clamping)}


def subtracting_flow(points_xyz: torch.Tensor, quaternion: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """`vestcl.rigid_flow` as R x + t - x."""
    return geometry.transform_points(geometry.compose_rigid(quaternion, translation), points_xyz) - points_xyz


def dividing_splat(
    points_uv: torch.Tensor, z: torch.Tensor, radii: torch.Tensor, opacities: torch.Tensor, features: torch.Tensor,
    height: int, width: int, backgrounds: torch.Tensor, epsilon: float = EPSILON, ceiling: float = 1.0,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """`vestcl.splat` of one cloud, [1, N, ...]: a_i <= ceiling; dT_j/da_i = -T_j / (1 - a_i + epsilon), j behind i."""
    layers = list_layers(points_uv[0], z[0], radii[0], height, width)
    alphas = opacities[0][layers.points] * layers.shapes
    alphas = alphas - (alphas - ceiling).clamp(min=0).detach()
    passed, none = 1 - alphas.detach(), alphas.new_zeros(height * width)
    before, after = scan(layers, none + 1, passed, torch.mul)
    logs, all_logs = scan(layers, none, (alphas.detach() - alphas) / (passed + epsilon), torch.add)  # 0, with a slope
    weights, after = alphas * before * (1 + logs), after * (1 + all_logs)
    values = torch.cat([features[0], torch.ones_like(features[0, :, :1])], dim=1)  # the last channel is the coverage
    image = after[:, None] * torch.cat([backgrounds[0], none[:1]])
    image = image.index_add(0, layers.pixels, weights[:, None] * values[layers.points])
    planes = image.T.reshape(1, -1, height, width)
    return planes[:, :-1], planes[:, -1:]

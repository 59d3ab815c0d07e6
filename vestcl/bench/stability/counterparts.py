"""Counterparts: what vestcl's operators compute, with the absolute value of every term in place of the term.

They say how large what was summed up is, and so how large its rounding errors may be: vestcl.bench.stability.bounds.
Where errors of many pixels or points are summed up, the root of the squares' sum stands for the sum. Everything is of
one cloud and in float64.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from vestcl import constants
from vestcl.bench.stability.fragments import Layers, list_layers, look_behind, transmittances


def rays(depth: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """Of K^-1 (u, v, 1), [1, HW, 3]."""
    height, width = depth.shape[2:]
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    places = torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(1, -1, 3).to(K)
    return places @ torch.linalg.inv(K).abs().mT


# ---------------------------------------------------------------- rigid_flow


@dataclass(frozen=True)
class _Turn:
    """|q'| of the unit quaternion (w, x, y, z), the length before, and the counterpart of R - I [3, 3]."""

    unit: torch.Tensor
    length: float
    matrix: torch.Tensor

    @classmethod
    def of(cls, quaternion: torch.Tensor) -> "_Turn":
        length = max(quaternion.norm().item(), constants.QUATERNION_FLOOR)
        unit = (quaternion / length).abs()
        w, x, y, z = unit.tolist()
        matrix = [[y * y + z * z, x * y + w * z, x * z + w * y],
                  [x * y + w * z, x * x + z * z, y * z + w * x],
                  [x * z + w * y, y * z + w * x, x * x + y * y]]  # fmt: skip
        return cls(unit, length, 2 * quaternion.new_tensor(matrix))

    def grad_quaternion(self, grad_rotation: torch.Tensor) -> torch.Tensor:
        """[4], from that of dL/dR [3, 3]: derivatives of R's entries, then what is left across q."""
        w, x, y, z = self.unit.tolist()
        both = grad_rotation + grad_rotation.T
        yz, xz, xy = both[1, 2], both[0, 2], both[0, 1]
        xx, yy, zz = grad_rotation.diagonal()
        along = 2 * torch.stack([
            x * yz + y * xz + z * xy,
            w * yz + y * xy + z * xz + 2 * x * (yy + zz),
            w * xz + x * xy + z * yz + 2 * y * (xx + zz),
            w * xy + x * xz + y * yz + 2 * z * (xx + yy),
        ])  # fmt: skip
        return (along + self.unit * (self.unit @ along)) / self.length


def rigid_flow(points_xyz: torch.Tensor, quaternion: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """Of u = (R - I) x + t, [1, N, 3]."""
    return points_xyz.abs() @ _Turn.of(quaternion[0]).matrix.T + translation.abs()[:, None]


def rigid_flow_backward(
    points_xyz: torch.Tensor, quaternion: torch.Tensor, grad: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of the gradients of points, quaternion and translation. Sums over points: the result, and its terms' errors."""
    turn = _Turn.of(quaternion[0])
    terms = grad[0].square().T @ points_xyz[0].square()
    grad_rotation = (grad[0].T @ points_xyz[0]).abs() + terms.sqrt()
    grad_translation = grad.sum(dim=1).abs() + grad.square().sum(dim=1).sqrt()
    return grad.abs() @ turn.matrix, turn.grad_quaternion(grad_rotation)[None], grad_translation


# ---------------------------------------------------------------- displace


def displace(
    points_xyz: torch.Tensor, displacement_xyz: torch.Tensor, K: torch.Tensor, tgt_from_src: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Of points_uv [1, N, 2] and z [1, N]."""
    M = K @ tgt_from_src[:, :3]
    a, b, c = ((points_xyz + displacement_xyz) @ M[:, :, :3].mT + M[:, None, :, 3]).unbind(-1)
    size = points_xyz.abs() + displacement_xyz.abs()
    reach = size @ M[:, :, :3].abs().mT + M[:, None, :, 3].abs()
    uv = torch.stack([a, b], dim=-1) / c[..., None]
    z = size @ tgt_from_src[:, 2, :3].abs()[..., None] + tgt_from_src[:, None, 2:3, 3].abs()
    return (reach[..., :2] + uv.abs() * reach[..., 2:]) / c.abs()[..., None], z[..., 0]


def displace_backward(
    grad_points_uv: torch.Tensor,
    grad_z: torch.Tensor,
    points_xyz: torch.Tensor,
    displacement_xyz: torch.Tensor,
    K: torch.Tensor,
    tgt_from_src: torch.Tensor,
) -> torch.Tensor:
    """Of the gradient of points and displacement, [1, N, 3]."""
    M = K @ tgt_from_src[:, :3]
    abc = (points_xyz + displacement_xyz) @ M[:, :, :3].mT + M[:, None, :, 3]
    across = grad_points_uv.abs() / abc[..., 2:].abs()
    down = (across * (abc[..., :2] / abc[..., 2:]).abs()).sum(dim=-1, keepdim=True)
    by_z = grad_z.abs()[..., None] * tgt_from_src[:, None, 2, :3].abs()
    return torch.cat([across, down], dim=-1) @ M[:, :, :3].abs() + by_z


# ---------------------------------------------------------------- splat


@dataclass(frozen=True)
class SplatTerms:
    """A splatted cloud, fragment by fragment."""

    layers: Layers
    radii: torch.Tensor
    opacities: torch.Tensor
    features: torch.Tensor
    background: torch.Tensor
    size: tuple[int, int]
    alphas: torch.Tensor
    before: torch.Tensor
    """T of each fragment, [F]."""
    after: torch.Tensor
    """T_end of each pixel, [P]."""

    @classmethod
    def of(cls, inputs: Sequence[torch.Tensor], size: tuple[int, int]) -> "SplatTerms":
        """From points_uv [N, 2], z, radii, opacities, features and the background [C], and height and width."""
        points_uv, z, radii, opacities, features, background = inputs
        layers = list_layers(points_uv, z, radii, *size)
        alphas = opacities[layers.points] * layers.shapes
        seen = transmittances(layers, alphas, math.prod(size))
        return cls(layers, radii, opacities, features.abs(), background.abs(), size, alphas, *seen)

    @property
    def most_layers(self) -> int:
        """Fragments of the pixel that has most."""
        return len(self.layers.slices)

    @property
    def most_pixels(self) -> int:
        """Fragments of the point that has most."""
        return int(torch.bincount(self.layers.points, minlength=1).max())

    def outputs(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Of image [1, C, H, W] and coverage [1, 1, H, W]; alpha's errors are in units of o, not of alpha."""
        image = self.after[:, None] * self.background
        for part in self.layers.slices:
            points = self.layers.points[part]
            weights = self.opacities[points] * self.before[part]
            image[self.layers.pixels[part]] += weights[:, None] * self.features[points]
        return image.T.reshape(1, -1, *self.size), image.new_ones(1, 1, *self.size)

    def gradients(self, grad_image: torch.Tensor, grad_coverage: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Of the gradients of points_uv, z (none), radii, opacities, features and backgrounds, [1, ...]."""
        g, h = grad_image[0].flatten(1).T.abs(), grad_coverage.flatten().abs()
        grad_alphas = self._grad_alphas(g, h)
        points, offsets, shapes = self.layers.points, self.layers.offsets, self.layers.shapes
        r = self.radii[points]
        slope = 2 * self.opacities[points] / r.square() * grad_alphas
        grads = (
            self._root_by_point(slope[:, None] * offsets),
            torch.zeros_like(self.radii),
            self._root_by_point(slope * (1 - shapes) * r),
            self._root_by_point(grad_alphas * shapes),
            self._grad_features(g),
            (self.after[:, None] * g).square().sum(dim=0).sqrt(),
        )
        return tuple(grad[None] for grad in grads)

    def _grad_alphas(self, g: torch.Tensor, h: torch.Tensor) -> torch.Tensor:
        """Of T (f.g - A), [F]."""
        products = torch.empty_like(self.alphas)
        for part in self.layers.slices:
            products[part] = (self.features[self.layers.points[part]] * g[self.layers.pixels[part]]).sum(dim=1)

        def step(part: slice, there: torch.Tensor) -> torch.Tensor:
            shown = self.opacities[self.layers.points[part]] * products[part]
            return shown + (1 - self.alphas[part]) * there

        behind = look_behind(self.layers, step, g @ self.background + h)
        return self.before * (products + behind)

    def _grad_features(self, g: torch.Tensor) -> torch.Tensor:
        squares = torch.zeros_like(self.features)
        for part in self.layers.slices:
            points = self.layers.points[part]
            weights = self.opacities[points] * self.before[part]
            squares.index_add_(0, points, (weights[:, None] * g[self.layers.pixels[part]]).square())
        return squares.sqrt()

    def _root_by_point(self, values: torch.Tensor) -> torch.Tensor:
        """Root of the sum of squares over each point's fragments."""
        sums = values.new_zeros(len(self.radii), *values.shape[1:])
        return sums.index_add_(0, self.layers.points, values.square()).sqrt()

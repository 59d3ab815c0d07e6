"""The splatter of a `Forecaster` from outside: what it left out, and the torch twin in its place."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import torch

from vestcl import reference
from vestcl.models.steps import render as _render
from vestcl.ops.splat import Skipped, rasterize, skipped

#: Image and coverage; and what shows features, on a background, down to a transmittance.
Shown = tuple[torch.Tensor, torch.Tensor]
_TwinRaster = Callable[[torch.Tensor, torch.Tensor | None, float], Shown]


@contextlib.contextmanager
def by_twin() -> Iterator[None]:
    """`Forecaster` splats by `vestcl.reference.splat` meanwhile."""

    def listed(
        points_uv: torch.Tensor,
        z: torch.Tensor,
        radii: torch.Tensor,
        opacities: torch.Tensor,
        height: int,
        width: int,
        *,
        cloud_starts: torch.Tensor,
    ) -> _TwinRaster:
        def show(features: torch.Tensor, backgrounds: torch.Tensor | None, least: float) -> Shown:
            points = points_uv, z, radii, opacities
            return reference.splat(*points, features, height, width, backgrounds, least, cloud_starts=cloud_starts)

        return show

    def shown(
        raster: _TwinRaster,
        features: torch.Tensor,
        backgrounds: torch.Tensor | None = None,
        min_transmittance: float = 0.0,
    ) -> Shown:
        return raster(features, backgrounds, min_transmittance)

    with replaced("rasterize", listed), replaced("composite", shown):
        yield


@contextlib.contextmanager
def counting(min_transmittance: float) -> Iterator[list[Skipped]]:
    """What every splat of a `Forecaster` inside the ``with`` block left out, counted on the way.

    Args:
        min_transmittance: that it splats down to.
    """
    found = list[Skipped]()

    def counted(*arguments: Any, **named: Any) -> Any:
        raster = rasterize(*arguments, **named)
        found.append(skipped(raster, min_transmittance))
        return raster

    with replaced("rasterize", counted):
        yield found


@contextlib.contextmanager
def replaced(name: str, function: Callable[..., Any]) -> Iterator[None]:
    """`Forecaster` splats by another ``function`` of that name meanwhile."""
    original = getattr(_render, name)
    setattr(_render, name, function)
    try:
        yield
    finally:
        setattr(_render, name, original)

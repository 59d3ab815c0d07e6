"""The splatter of a `Forecaster` from outside: what it left out, and the torch reference in its place."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import torch

from vestcl import reference
from vestcl.models.steps import render as _render
from vestcl.ops.splat import Skipped, rasterize, skipped


@contextlib.contextmanager
def by_reference() -> Iterator[None]:
    """`Forecaster` splats by `vestcl.reference.splat` meanwhile."""

    def listed(*points_and_size: Any, cloud_starts: torch.Tensor) -> Callable[..., Any]:
        points, size = points_and_size[:4], points_and_size[4:]
        splat: Callable[..., Any] = reference.splat
        return lambda features, *rest: splat(*points, features, *size, *rest, cloud_starts=cloud_starts)

    def shown(
        raster: Callable[..., Any],
        features: torch.Tensor,
        backgrounds: torch.Tensor | None = None,
        min_transmittance: float = 0.0,
    ) -> Any:
        return raster(features, backgrounds, min_transmittance)

    with _replaced("rasterize", listed), _replaced("composite", shown):
        yield


@contextlib.contextmanager
def counting(min_transmittance: float) -> Iterator[list[Skipped]]:
    """What every splat of a `Forecaster` inside the ``with`` block left out, down to its ``min_transmittance``."""
    found = list[Skipped]()

    def counted(*arguments: Any, **named: Any) -> Any:
        raster = rasterize(*arguments, **named)
        found.append(skipped(raster, min_transmittance))
        return raster

    with _replaced("rasterize", counted):
        yield found


@contextlib.contextmanager
def _replaced(name: str, function: Callable[..., Any]) -> Iterator[None]:
    """`Forecaster` splats by another ``function`` of that name meanwhile."""
    original = getattr(_render, name)
    setattr(_render, name, function)
    try:
        yield
    finally:
        setattr(_render, name, original)

"""A feature set on a rasterised geometry: what compositing reads, and what its kernels are built with."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from vestcl import constants, opencl
from vestcl.ops._splat_lists import Array, Geometry, TileLists, splat_defines

#: Channels that a GPU's work-item keeps in registers; more are composited in groups.
CHANNEL_GROUP: Final = 32


@dataclass(frozen=True)
class Layer:
    """One feature set on a geometry: what compositing reads."""

    geometry: Geometry
    lists: TileLists
    features: Array
    """[P, C]"""
    backgrounds: Array | None
    """[B, C]; None is zero."""
    min_transmittance: float

    @property
    def channels(self) -> int:
        return int(self.features.shape[1])

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.features.dtype

    @property
    def pixels(self) -> bool:
        return self.lists.session.mapping == "pixel"

    @property
    def channel_group(self) -> int:
        return min(CHANNEL_GROUP, self.channels)

    def defines(self) -> Mapping[str, str | int]:
        truncates, builtins = self.min_transmittance > 0, self.lists.session.compiles_builtins
        if self.pixels:
            return defines_of_pixels(self.dtype, self.channels, truncates)
        return defines_of_tiles(self.dtype, self.channels, truncates, builtins)

    def backgrounds_or_zero(self) -> Array:
        zero = (self.geometry.batch, self.channels)
        return np.zeros(zero, self.dtype) if self.backgrounds is None else self.backgrounds

    def scalars(self) -> dict[str, opencl.Argument]:
        return {**self.geometry.sizes, "min_transmittance": self.dtype.type(self.min_transmittance)}


@functools.cache
def defines_of_pixels(dtype: np.dtype[Any], channels: int, truncates: bool) -> dict[str, str | int]:
    """Of splat_composite_pixels.cl, without a backward."""
    own = {"CHANNELS": channels, "TRUNCATE": int(truncates), "CHANNEL_GROUP": min(CHANNEL_GROUP, channels)}
    return splat_defines(dtype, **own)


@functools.cache
def defines_of_tiles(dtype: np.dtype[Any], channels: int, truncates: bool, builtins: bool) -> dict[str, str | int]:
    """Of splat_composite.cl, without a backward."""
    line = constants.CACHE_LINE
    own = {"CHANNELS": channels, "TRUNCATE": int(truncates), "SEGMENT": constants.SEGMENT, "BUILTINS": int(builtins)}
    own["VECTOR"] = next(n for n in (16, 8, 4, 1) if n <= channels and n * dtype.itemsize <= line)
    own["STREAM"] = int(builtins and channels * dtype.itemsize % line == 0)
    return splat_defines(dtype, **own)

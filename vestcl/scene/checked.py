"""Checks of a frame's arrays: [C, H, W], numbers, one size."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def planes(name: str, value: ArrayLike, channels: int, like: NDArray[Any] | None = None) -> NDArray[np.float32]:
    """``value`` as [channels, H, W] float32, all finite, of the height and width of ``like``.

    Raises:
        ValueError: another shape, NaN or infinity; the message calls it ``name``.
    """
    array = np.asarray(value)
    if not np.issubdtype(array.dtype, np.number):
        raise ValueError(f"`{name}` must be numbers, got {array.dtype}")
    _check_shape(name, array, channels, like)
    array = np.ascontiguousarray(array, np.float32)
    if not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite, got {int((~np.isfinite(array)).sum())} values that are not")
    return array


def depth(name: str, value: ArrayLike, like: NDArray[Any] | None = None) -> NDArray[np.float32]:
    """``value`` as [1, H, W] float32 metres; all finite, none negative, 0 = invalid, at least one valid.

    Raises:
        ValueError: another shape, NaN, infinity, a negative depth, or no valid one.
    """
    metres = planes(name, value, 1, like)
    if (metres < 0).any():
        raise ValueError(f"`{name}` must be 0 (invalid) or more, got {metres.min():g} m")
    if not (metres > 0).any():
        raise ValueError(f"`{name}` must have a valid pixel, got none above 0 m")
    return metres


def mask(name: str, value: ArrayLike, like: NDArray[Any] | None = None) -> NDArray[np.bool_]:
    """``value`` as [1, H, W] bool.

    Raises:
        ValueError: another shape or another dtype.
    """
    array = np.asarray(value)
    if array.dtype != np.bool_:
        raise ValueError(f"`{name}` must be bool, got {array.dtype}")
    _check_shape(name, array, 1, like)
    return np.ascontiguousarray(array)


def matrix(name: str, value: ArrayLike, size: int) -> NDArray[np.float64]:
    """``value`` as [size, size] float64, all finite.

    Raises:
        ValueError: another shape, NaN or infinity.
    """
    array = np.asarray(value, np.float64)
    if array.shape != (size, size):
        raise ValueError(f"`{name}` must be [{size}, {size}], got {list(array.shape)}")
    if not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite, got {array.tolist()}")
    return array


def _check_shape(name: str, array: NDArray[Any], channels: int, like: NDArray[Any] | None) -> None:
    height, width = ("H", "W") if like is None else like.shape[-2:]
    sized = like is None or array.shape[-2:] == like.shape[-2:]
    if array.ndim != 3 or len(array) != channels or not array.size or not sized:
        raise ValueError(f"`{name}` must be [{channels}, {height}, {width}], got {list(array.shape)}")


def pixels(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """[C, H, W] in [0, 1] as OpenCV needs it: [H, W, C] uint8; what is outside the range is clipped."""
    scaled = image.clip(0, 1)
    scaled *= 255
    return np.ascontiguousarray(np.rint(scaled, out=scaled).astype(np.uint8).transpose(1, 2, 0))

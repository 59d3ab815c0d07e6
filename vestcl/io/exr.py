"""OpenEXR files with named channels, and the layout of a forecast's frames.

A frame's channels: `R`, `G`, `B` colour; `Z` z-depth in metres; `A` the splatter's coverage; `motion.X`, `motion.Y`,
`motion.Z` the 3D displacement of what the pixel shows, in metres, in camera axes (x right, y down, z forward).
Colour follows OpenEXR's custom: linear light, Rec. 709 primaries. Ours is display RGB, so writing linearises and
reading undoes it. It is not multiplied by `A`.
"""

import ctypes
import errno
import functools
import io
import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import OpenEXR  # type: ignore[import-not-found,import-untyped,unused-ignore]
from numpy.typing import ArrayLike, NDArray

from vestcl.io._exr_header import check_chunks, read_parts
from vestcl.io._headers import MAX_PIXELS, check_size
from vestcl.io.atomic import read_bytes, replacing

#: Channel names of what a frame may have, plane by plane.
CHANNELS: Final = {
    "image": ("R", "G", "B"),
    "depth": ("Z",),
    "coverage": ("A",),
    "motion": ("motion.X", "motion.Y", "motion.Z"),
}

#: Numbers in all channels of the largest file that is read: 1 GB in float32.
MAX_VALUES: Final = 4 * MAX_PIXELS

_COMMENT: Final = (
    "R, G, B: linear light, Rec. 709, not multiplied by A. Z: z-depth in metres, 0 where unknown. A: coverage. "
    "motion.X, .Y, .Z: 3D displacement in metres, camera axes x right, y down, z forward."
)


#: Numbers that are linearised at once.
_BLOCK: Final = 1 << 16

#: Errors of the operating system that end a write.
_WRITE_ERRORS: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)


@dataclass(frozen=True, eq=False)
class ExrFrame:
    """One forecast frame, of any floating dtype; what is None has no channel in the file."""

    image: NDArray[np.floating] | None = None
    """[3, H, W], display RGB (sRGB) in [0, 1]."""
    depth: NDArray[np.floating] | None = None
    """[1, H, W] m."""
    coverage: NDArray[np.floating] | None = None
    """[1, H, W] in [0, 1]."""
    motion: NDArray[np.floating] | None = None
    """[3, H, W] m."""


def write_exr(path: str | Path, channels: Mapping[str, ArrayLike], comment: str = "") -> None:
    """Write named channels losslessly (ZIP) and atomically.

    Args:
        path: ends in .exr.
        channels: name -> [H, W], all of one size. float16 stays half and uint32 stays; all else becomes float32.
        comment: free text for the header.

    Raises:
        ValueError: no channel, another suffix, a channel that is not [H, W] or of another size.
        OSError: the file can't be written, the disk is full for one; the message names it.
    """
    if Path(path).suffix.lower() != ".exr":
        raise ValueError(f"{path}: must end in .exr")
    arrays = {name: np.asarray(channel) for name, channel in channels.items()}
    if not arrays:
        raise ValueError("`channels` must have at least one channel")
    shape = next(iter(arrays.values())).shape
    for name, array in arrays.items():
        if array.ndim != 2 or array.shape != shape or not array.size:
            raise ValueError(
                f"channel `{name}` must be [H, W] as the first one, {list(shape)}, got {list(array.shape)}"
            )
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "comments": comment}
    if not comment:
        del header["comments"]
    _compress_quickly()
    with replacing(path) as temporary, OpenEXR.File(header, {k: _storable(a) for k, a in arrays.items()}) as file:
        try:
            file.write(str(temporary))
        except RuntimeError as error:
            raise _os_error(error, path) from error


def read_exr(path: str | Path) -> dict[str, NDArray[np.generic]]:
    """The channels of a single-part file: name -> [H, W], float32, float16 or uint32 as stored.

    Raises:
        ValueError: no such file, no OpenEXR, damaged, of several parts, with subsampled channels, or with a data
            window that is not its display window.
    """
    if not Path(path).exists():
        raise ValueError(f"{path}: no such file")
    content = read_bytes(path)
    _check_claims(path, content)
    try:
        with _silent(), OpenEXR.File(str(path), separate_channels=True) as file:
            header = dict(file.header())
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # the library raises what its file's damage leads it to
        raise ValueError(f"{path}: is not an OpenEXR image, or a damaged one ({error})") from error
    (left, top), (right, bottom) = (np.asarray(corner).tolist() for corner in header["dataWindow"])
    if not np.array_equal(header["dataWindow"], header["displayWindow"]):
        raise ValueError(f"{path}: its data window must be its display window; write the whole image")
    for name, channel in channels.items():
        if channel.shape != (bottom - top + 1, right - left + 1):
            raise ValueError(f"{path}: channel `{name}` is subsampled or damaged, {list(channel.shape)}")
    return channels


def write_exr_frame(path: str | Path, frame: ExrFrame) -> None:
    """Write a frame's channels as float32, colour linearised, atomically.

    Raises:
        ValueError: an array of another shape than `ExrFrame` documents, sizes that differ, or nothing to write.
        OSError: as `write_exr`.
    """
    channels: dict[str, NDArray[np.float32]] = {}
    for field, names in CHANNELS.items():
        value = getattr(frame, field)
        if value is None:
            continue
        planes = np.asarray(value)
        if planes.ndim != 3 or len(planes) != len(names):
            raise ValueError(f"`{field}` must be [{len(names)}, H, W], got {list(planes.shape)}")
        planes = linear_from_srgb(planes) if field == "image" else planes
        channels |= dict(zip(names, planes.astype(np.float32, copy=False), strict=True))
    write_exr(path, channels, _COMMENT)


def read_exr_frame(path: str | Path) -> ExrFrame:
    """What `write_exr_frame` wrote, float32, colour as display RGB again.

    Raises:
        ValueError: as `read_exr`, or none of the channels is there.
    """
    channels = read_exr(path)
    found: dict[str, NDArray[np.float32]] = {}
    for field, names in CHANNELS.items():
        if all(name in channels for name in names):
            planes = np.stack([channels[name] for name in names]).astype(np.float32)
            found[field] = srgb_from_linear(planes).astype(np.float32) if field == "image" else planes
    if not found:
        raise ValueError(f"{path}: has none of a frame's channels; it has {', '.join(channels)}")
    return ExrFrame(**found)


def linear_from_srgb(srgb: ArrayLike) -> NDArray[np.floating]:
    """x / 12.92 up to 0.04045, ((x + 0.055) / 1.055)^2.4 above (IEC 61966-2-1); of float32 in float32."""
    values = np.asarray(srgb)
    flat = np.ravel(values if values.dtype == np.float32 else values.astype(np.float64))
    linear = np.empty_like(flat)
    for first in range(0, len(flat), _BLOCK):  # what fits the cache, in a third of the time
        x = flat[first : first + _BLOCK]
        linear[first : first + _BLOCK] = np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0) + 0.055) / 1.055) ** 2.4)
    return linear.reshape(values.shape)


def srgb_from_linear(linear: ArrayLike) -> NDArray[np.float64]:
    """12.92 x up to 0.0031308, 1.055 x^(1/2.4) - 0.055 above: the inverse of `linear_from_srgb`."""
    values = np.asarray(linear, np.float64)
    return np.where(values <= 0.04045 / 12.92, values * 12.92, 1.055 * np.maximum(values, 0) ** (1 / 2.4) - 0.055)


def _check_claims(path: str | Path, content: bytes) -> None:
    """Refuse what the library would allocate too much for, before it does."""
    try:
        parts = read_parts(content)
    except ValueError as error:
        raise ValueError(f"{path}: is not an OpenEXR image, or a damaged one ({error})") from error
    if len(parts) != 1:
        raise ValueError(f"{path}: must have one part, got {len(parts)}")
    (part,) = parts
    check_size(path, part.height, part.width)
    if part.height * part.width * part.channels > MAX_VALUES:
        claim = f"{part.channels} channels of {part.height} x {part.width} pixels"
        raise ValueError(f"{path}: must have at most {MAX_VALUES} numbers, got {claim}")
    try:
        check_chunks(content, part)
    except ValueError as error:
        raise ValueError(f"{path}: is not an OpenEXR image, or a damaged one ({error})") from error


@contextmanager
def _silent() -> Iterator[None]:
    """Keep what OpenEXR 3.4 prints about a damaged file out of standard output.

    Other threads let it print: two that redirect `sys.stdout` at once would restore it in the wrong order.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with redirect_stdout(io.StringIO()) as printed:
        yield
    print(printed.getvalue(), end="")  # another thread's, where no error came


def _os_error(error: RuntimeError, path: str | Path) -> OSError:
    """OpenEXR's error in words, as the operating system's error; EIO where the words are its own."""
    code = next((code for code in _WRITE_ERRORS if os.strerror(code).lower() in str(error).lower()), errno.EIO)
    return OSError(code, os.strerror(code), str(path))


@functools.cache
def _compress_quickly() -> None:
    """Lowest level of compression, where this build of OpenEXR lets its users choose.

    A 4K frame takes three quarters of the time and a sixth more bytes than at OpenEXR's default.
    """
    with suppress(AttributeError, OSError):  # not every build exports its C functions
        ctypes.CDLL(OpenEXR.__file__).exr_set_default_zip_compression_level(1)


def _storable(array: NDArray[np.generic]) -> NDArray[np.generic]:
    kept = array.dtype in (np.dtype(np.float16), np.dtype(np.uint32))
    return np.ascontiguousarray(array, None if kept else np.float32)

"""Depth maps in files: 16-bit PNG with a scale, OpenEXR, NPY, and Cityscapes disparity.

Every reader answers z-depth in metres, float32 [H, W], in which 0 means "not known": a pixel is valid iff
depth > 0. What a file marks invalid, and whatever is NaN, infinite or negative, becomes 0.
"""

import io
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.io._headers import check_size
from vestcl.io.atomic import read_bytes, write_bytes
from vestcl.io.exr import read_exr, write_exr
from vestcl.io.images import read_pixels, write_pixels

#: KITTI's depth maps are uint16 with 256 steps a metre; 0 is "no return".
KITTI_UNITS: Final = 256.0

#: Virtual KITTI's depth maps are uint16 centimetres; 65535 is the sky and all that is farther than 655.35 m.
VIRTUAL_KITTI_UNITS: Final = 100.0

#: Steps of a Cityscapes disparity map in one pixel; 0 is invalid and 1 is a disparity of zero.
DISPARITY_STEPS: Final = 256.0

_DEEPEST: Final = 65535


def read_depth(
    path: str | Path, units_per_metre: float | None = None, channel: str | None = None
) -> NDArray[np.float32]:
    """depth = value / units_per_metre, and 0 where the value is 0, negative or not finite.

    Args:
        path: .png (uint16, one channel), .exr or .npy ([H, W] or [1, H, W]).
        units_per_metre: 256 for KITTI, 100 for Virtual KITTI. A PNG needs it; the others are metres without it.
        channel: of an EXR. None takes `Z`, or the only one that there is.

    Returns:
        [H, W] float32 metres; valid iff > 0.

    Raises:
        ValueError: no such file, damaged, of another kind, or ``units_per_metre`` missing or not positive.

    Source: SPEC section 8.
    """
    suffix = Path(path).suffix.lower()
    _check_units(path, suffix, units_per_metre)
    if suffix == ".png":
        values: NDArray[np.generic] = _read_png(path)
    elif suffix == ".exr":
        values = _pick(path, read_exr(path), channel)
    elif suffix == ".npy":
        values = _read_npy(path)
    else:
        raise ValueError(f"{path}: a depth file must end in .png, .exr or .npy")
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        metres = values.astype(np.float64)
    return _known(metres / (units_per_metre or 1.0))


def read_cityscapes_disparity(path: str | Path, baseline: float, fx: float) -> NDArray[np.float32]:
    """d = (p - 1) / 256,   depth = baseline fx / d,   and 0 where p = 0 (invalid) or p = 1 (d = 0: infinitely far).

    Args:
        path: uint16 PNG, one channel.
        baseline: metres between the two cameras.
        fx: px, of the 2048 pixels wide image that the disparities were measured in.

    Returns:
        [H, W] float32 metres; valid iff > 0.

    Raises:
        ValueError: no such file, damaged, of another kind, or a camera number that is not positive.

    Source: SPEC section 8; README of the Cityscapes scripts.
    """
    if not (np.isfinite([baseline, fx]).all() and baseline > 0 and fx > 0):
        raise ValueError(f"`baseline` and `fx` must be positive, got {baseline} and {fx}")
    steps = _read_png(path).astype(np.float64) - 1
    return _known(np.divide(baseline * fx * DISPARITY_STEPS, steps, out=np.zeros_like(steps), where=steps > 0))


def write_depth(path: str | Path, depth: ArrayLike, units_per_metre: float | None = None) -> None:
    """value = depth units_per_metre, atomically; what `read_depth` calls invalid is written as 0.

    A PNG's values are rounded to 1 ... 65535: depth beyond its range is written as its farthest.

    Args:
        path: .png, .exr (channel Z, float32) or .npy (float32).
        depth: [H, W] or [1, H, W] metres.
        units_per_metre: as in `read_depth`.

    Raises:
        ValueError: another suffix or shape, or ``units_per_metre`` missing for a PNG or not positive.
    """
    metres = np.asarray(depth)
    metres = metres[0] if metres.ndim == 3 and len(metres) == 1 else metres
    if metres.ndim != 2:
        raise ValueError(f"`depth` must be [H, W] or [1, H, W], got {list(metres.shape)}")
    suffix = Path(path).suffix.lower()
    _check_units(path, suffix, units_per_metre)
    values = _known(metres.astype(np.float64)).astype(np.float64) * (units_per_metre or 1.0)
    if suffix == ".png":
        steps = np.where(values > 0, np.rint(values).clip(1, _DEEPEST), 0)
        write_pixels(path, steps.astype(np.uint16))
    elif suffix == ".exr":
        write_exr(path, {"Z": values.astype(np.float32)})
    elif suffix == ".npy":
        buffer = io.BytesIO()
        np.save(buffer, values.astype(np.float32))
        write_bytes(path, buffer.getvalue())
    else:
        raise ValueError(f"{path}: a depth file must end in .png, .exr or .npy")


def _known(metres: NDArray[np.float64]) -> NDArray[np.float32]:
    """The depth where float32 has a positive, finite one, else 0."""
    with np.errstate(over="ignore", under="ignore"):
        depth = metres.astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _check_units(path: str | Path, suffix: str, units_per_metre: float | None) -> None:
    if units_per_metre is None and suffix == ".png":
        raise ValueError(f"{path}: `units_per_metre` is missing; a depth PNG needs it (KITTI 256, Virtual KITTI 100)")
    if units_per_metre is not None and not (np.isfinite(units_per_metre) and units_per_metre > 0):
        raise ValueError(f"`units_per_metre` must be positive, got {units_per_metre}")


def _read_png(path: str | Path) -> NDArray[np.uint16]:
    values = read_pixels(path)
    if values.dtype != np.uint16 or values.ndim != 2:
        bits = 8 * values.itemsize
        raise ValueError(f"{path}: must be a 16-bit PNG of one channel, got {bits} bits, {list(values.shape)}")
    return values.astype(np.uint16, copy=False)


def _read_npy(path: str | Path) -> NDArray[np.generic]:
    content = read_bytes(path)
    try:
        shape, fortran, dtype, start = _npy_header(content)
    except Exception as error:  # NumPy evaluates the header, so that damage may raise anything
        raise ValueError(f"{path}: is not an NPY array, or a damaged one ({error})") from error
    if dtype.hasobject:
        raise ValueError(f"{path}: is not an NPY array, or a damaged one (it holds Python objects)")
    if dtype.kind not in "fui":
        raise ValueError(f"{path}: must hold one array of numbers, got {dtype}")
    if len(shape) != 2 and not (len(shape) == 3 and shape[0] == 1):
        raise ValueError(f"{path}: must be [H, W] or [1, H, W], got {list(shape)}")
    height, width = shape[-2:]
    check_size(path, height, width)
    if len(content) - start != height * width * dtype.itemsize:
        held = f"{height} x {width} {dtype} after {start} bytes of header, got {len(content)} bytes in all"
        raise ValueError(f"{path}: is not an NPY array, or a damaged one (its header states {held})")
    values = np.frombuffer(content, dtype, offset=start)
    return values.reshape((width, height)).T if fortran else values.reshape((height, width))


def _npy_header(content: bytes) -> tuple[tuple[int, ...], bool, np.dtype[np.generic], int]:
    """Shape, whether columns come first, dtype, and where the numbers begin."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    return tuple(map(int, shape)), fortran, dtype, file.tell()


def _pick(path: str | Path, channels: dict[str, NDArray[np.generic]], channel: str | None) -> NDArray[np.generic]:
    if channel is None:
        channel = "Z" if "Z" in channels or len(channels) != 1 else next(iter(channels))
    if channel not in channels:
        raise ValueError(f"{path}: has no channel `{channel}`; it has {', '.join(channels)}")
    return channels[channel]

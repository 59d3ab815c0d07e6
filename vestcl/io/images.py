"""PNG and JPEG as arrays, with 8 or 16 bits per channel."""

from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.io._headers import check_whole, checked_size
from vestcl.io.atomic import read_bytes, write_bytes

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
"""An image as files hold it: [H, W, 3] RGB or [H, W] grey."""

#: JPEG's quality where none is asked for: differences from the original stay below what an eye sees.
JPEG_QUALITY: Final = 95

_JPEG: Final = (".jpg", ".jpeg")

#: Rows of an image that are converted at once: 16 of 4K in float32 are 0.7 MB.
_ROWS: Final = 16


def read_pixels(path: str | Path, size: tuple[int, int] | None = None) -> Pixels:
    """What the file holds, as it is: uint8 or uint16, [H, W, 3] RGB or [H, W] grey. An alpha channel is dropped.

    A rotation noted in a photograph's EXIF data is not applied, so that the size is the one of `image_size`.

    Args:
        path: PNG, JPEG, or another format that OpenCV decodes to 8 or 16 bits.
        size: (height, width) that the file must have; looked at before anything is decoded.

    Raises:
        ValueError: no such file, it can't be decoded, it is damaged, of another size, or has more than 2^26 pixels.
    """
    content = read_bytes(path)
    check_whole(path, content)
    got = checked_size(path, content)
    if size not in (None, got):
        assert size is not None
        raise ValueError(f"{path}: must be {size[0]} x {size[1]} as its clip is, got {got[0]} x {got[1]}")
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.shape[:2] != got:
        raise ValueError(f"{path}: is not an image, or a damaged one")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: must have 8 or 16 bits per channel, got {pixels.dtype}")
    if pixels.ndim == 3:
        code = cv2.COLOR_BGRA2RGB if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB
        pixels = cv2.cvtColor(pixels, code)
    if pixels.dtype == np.uint16:
        return pixels.astype(np.uint16, copy=False)
    return pixels.astype(np.uint8, copy=False)


def read_image(path: str | Path, size: tuple[int, int] | None = None) -> NDArray[np.float32]:
    """[3, H, W] float32 RGB in [0, 1]; grey is repeated three times.

    Args:
        path: as for `read_pixels`.
        size: (height, width) that the file must have.

    Raises:
        ValueError: as `read_pixels`.
    """
    return to_float(read_pixels(path, size))


def image_size(path: str | Path) -> tuple[int, int]:
    """(height, width) from the file's header, without decoding it.

    Raises:
        ValueError: no such file, no image, or one of more than 2^26 pixels.
    """
    return checked_size(path, read_bytes(path))


def write_pixels(path: str | Path, pixels: Pixels, quality: int = JPEG_QUALITY) -> None:
    """Write [H, W, 3] RGB or [H, W] grey, uint8 or uint16, atomically.

    Args:
        path: ends in .png, .jpg or .jpeg.
        pixels: JPEG takes uint8 only.
        quality: of a JPEG, 1 to 100.

    Raises:
        ValueError: another suffix, dtype, shape or quality.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".png", *_JPEG):
        raise ValueError(f"{path}: must end in .png, .jpg or .jpeg")
    if pixels.dtype not in ((np.uint8,) if suffix in _JPEG else (np.uint8, np.uint16)):
        wanted = "uint8" if suffix in _JPEG else "uint8 or uint16"
        raise ValueError(f"`pixels` must be {wanted} for {suffix}, got {pixels.dtype}")
    if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)) or not pixels.size:
        raise ValueError(f"`pixels` must be [H, W, 3] or [H, W] and not empty, got {list(pixels.shape)}")
    if not 1 <= quality <= 100:
        raise ValueError(f"`quality` must be in 1 ... 100, got {quality}")
    ordered = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix in _JPEG else []
    encoded, content = cv2.imencode(suffix, ordered, parameters)
    assert encoded
    write_bytes(path, content.tobytes())


def write_image(path: str | Path, image: ArrayLike, bits: int = 8, quality: int = JPEG_QUALITY) -> None:
    """Write [3, H, W] RGB or [1, H, W] grey in [0, 1] atomically; what lies outside is clipped.

    Args:
        path: ends in .png, .jpg or .jpeg.
        image: any floating dtype, NumPy or a torch CPU tensor without grad.
        bits: 8, or 16 for PNG.
        quality: of a JPEG, 1 to 100.

    Raises:
        ValueError: another suffix, shape, number of bits or quality, or a NaN in the image.
    """
    write_pixels(path, to_pixels(image, bits), quality)


def to_float(pixels: Pixels) -> NDArray[np.float32]:
    """[H, W, 3] or [H, W] integers to [3, H, W] float32: pixels / (2^bits - 1).

    Raises:
        ValueError: another shape or dtype.
    """
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,)):
        wanted = "uint8 or uint16, [H, W, 3] or [H, W]"
        raise ValueError(f"`pixels` must be {wanted}, got {pixels.dtype} {list(pixels.shape)}")
    planes = np.broadcast_to(pixels, (3, *pixels.shape)) if pixels.ndim == 2 else pixels.transpose(2, 0, 1)
    return np.divide(planes, np.float32(np.iinfo(pixels.dtype).max), dtype=np.float32, order="C")


def to_pixels(image: ArrayLike, bits: int = 8) -> Pixels:
    """[3, H, W] or [1, H, W] in [0, 1] to [H, W, 3] or [H, W] integers: round((2^bits - 1) clip(image)).

    Raises:
        ValueError: another shape or number of bits, or a NaN.
    """
    if bits not in (8, 16):
        raise ValueError(f"`bits` must be 8 or 16, got {bits}")
    planes = np.asarray(image)
    if planes.ndim != 3 or planes.shape[0] not in (1, 3) or not np.issubdtype(planes.dtype, np.floating):
        wanted = "floating, [3, H, W] or [1, H, W]"
        raise ValueError(f"`image` must be {wanted}, got {planes.dtype} {list(planes.shape)}")
    if np.isnan(planes).any():
        raise ValueError("`image` must not have NaN")
    dtype = np.uint8 if bits == 8 else np.uint16
    most = np.float32(np.iinfo(dtype).max)
    pixels = np.empty((*planes.shape[1:], len(planes)), dtype)
    for first in range(0, pixels.shape[0] if pixels.size else 0, _ROWS):  # passes over what stays in the cache
        rows = slice(first, first + _ROWS)
        levels = np.multiply(planes[:, rows], most)
        levels = np.rint(np.clip(levels, 0, most, out=levels), out=levels).astype(dtype)
        pixels[rows] = cv2.merge(list(levels)).reshape(pixels[rows].shape)
    return pixels if len(planes) == 3 else pixels[..., 0]

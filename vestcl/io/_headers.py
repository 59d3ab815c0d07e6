"""What an image's file states before anything is decoded: its size, and whether the file is whole.

Decoders allocate what a header claims, and some of them take a truncated file without a word. So the size is compared
with `MAX_PIXELS` first, a PNG against the checksums of its chunks, and a JPEG is followed up to its last marker.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from PIL import Image, UnidentifiedImageError

#: Pixels of the largest image that is read: 8,192 x 8,192. In float32 RGB that is 0.8 GB.
MAX_PIXELS: Final = 1 << 26

#: Pixels of its longest side.
MAX_SIDE: Final = 1 << 16

#: Scans of a progressive JPEG: encoders write about ten, and each is another skip the image.
_MAX_SCANS: Final = 100

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG: Final = b"\xff\xd8"

#: JPEG's start-of-frame markers: SOF0 ... SOF15 without DHT, JPG and DAC.
_FRAMES: Final = tuple(marker for marker in range(0xC0, 0xD0) if marker not in (0xC4, 0xC8, 0xCC))

#: JPEG's markers without a segment: a stuffed 0xFF, TEM, RST0 ... RST7 and SOI.
_BARE: Final = (0x00, 0x01, *range(0xD0, 0xD9))

_END_OF_IMAGE, _START_OF_SCAN = 0xD9, 0xDA


def checked_size(path: str | Path, content: bytes) -> tuple[int, int]:
    """(height, width) by the header of a PNG, a JPEG, or what else Pillow knows.

    Args:
        path: for the message.
        content: of the file.

    Raises:
        ValueError: no such header, or more than MAX_PIXELS pixels or MAX_SIDE per side.
    """
    try:
        if content.startswith(_PNG):
            size = _png_size(content)
        elif content.startswith(_JPEG):
            size = _jpeg_size(content)
        else:
            size = _other_size(content)
    except (_DamagedError, struct.error) as error:
        raise ValueError(f"{path}: is not an image, or a damaged one") from error
    check_size(path, *size)
    return size


def check_size(path: str | Path, height: int, width: int) -> None:
    """Refuse what is empty or too large to be read.

    Raises:
        ValueError: a side below 1 px or above MAX_SIDE, or more than MAX_PIXELS pixels.
    """
    if min(height, width) < 1 or max(height, width) > MAX_SIDE or height * width > MAX_PIXELS:
        limit = f"1 to {MAX_SIDE} pixels per side and at most {MAX_PIXELS} in all"
        raise ValueError(f"{path}: must have {limit}, got {height} x {width} (height x width)")


def check_whole(path: str | Path, content: bytes) -> None:
    """Refuse a PNG or JPEG that ends too early, and a PNG with a chunk that does not match its checksum.

    Raises:
        ValueError: as described above.
    """
    try:
        if content.startswith(_PNG):
            _check_png(content)
        elif content.startswith(_JPEG):
            _check_jpeg(content)
    except (_DamagedError, struct.error) as error:
        raise ValueError(f"{path}: is not an image, or a damaged one") from error


class _DamagedError(Exception):
    """Why a file is not an image, or not all of one."""


# ---------------------------------------------------------------- PNG: chunks of length, type, data and checksum


def _png_size(content: bytes) -> tuple[int, int]:
    length, kind, width, height = struct.unpack_from(">I4sII", content, len(_PNG))
    if kind != b"IHDR" or length != 13:
        raise _DamagedError("a PNG without its header")
    return height, width


def _check_png(content: bytes) -> None:
    view, at = memoryview(content), len(_PNG)
    while True:
        if at + 12 > len(view):
            raise _DamagedError("a PNG that ends too early")
        length, kind = struct.unpack_from(">I4s", view, at)
        end = at + 8 + length
        if end + 4 > len(view):
            raise _DamagedError("a PNG that ends too early")
        if zlib.crc32(view[at + 4 : end]) != struct.unpack_from(">I", view, end)[0]:
            raise _DamagedError(f"a PNG whose chunk {kind.decode('latin-1')!r} has a wrong checksum")
        if kind == b"IEND":
            return
        at = end + 4


# ---------------------------------------------------------------- JPEG: markers, most of them with a segment


def _markers(content: bytes) -> Iterator[tuple[int, int]]:
    """Each marker but the bare ones, with the position after it; coded data between them is skipped.

    Raises:
        _DamagedError: the content ends before the end of the image.
    """
    at = len(_JPEG)
    while True:
        at = content.find(b"\xff", at)
        if at < 0 or at + 1 >= len(content):
            raise _DamagedError("a JPEG that ends too early")
        marker = content[at + 1]
        if marker == 0xFF:  # any number of them may fill up
            at += 1
            continue
        at += 2
        if marker in _BARE:
            continue
        yield marker, at
        if marker == _END_OF_IMAGE:
            return
        at += max(struct.unpack_from(">H", content, at)[0], 2)


def _jpeg_size(content: bytes) -> tuple[int, int]:
    for marker, at in _markers(content):
        if marker in _FRAMES:
            height, width = struct.unpack_from(">3xHH", content, at)
            return height, width
        if marker == _START_OF_SCAN:
            break
    raise _DamagedError("a JPEG without its header")


def _check_jpeg(content: bytes) -> None:
    scans = sum(marker == _START_OF_SCAN for marker, _ in _markers(content))
    if not 1 <= scans <= _MAX_SCANS:
        raise _DamagedError(f"a JPEG of {scans} scans")


# ---------------------------------------------------------------- all else


def _other_size(content: bytes) -> tuple[int, int]:
    if not content:
        raise _DamagedError("it is empty")
    try:
        with Image.open(io.BytesIO(content)) as image:
            return image.height, image.width
    except UnidentifiedImageError as error:
        raise _DamagedError("of no known format") from error
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise _DamagedError(str(error)) from error
    except Exception as error:  # Pillow's plugins raise what their format's damage leads them to
        raise _DamagedError(f"{type(error).__name__}: {error}") from error

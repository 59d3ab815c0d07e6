"""What an OpenEXR file's headers claim, read before the library allocates it.

After magic number and version come the attributes of each part: name, type, size and value; an empty name ends the
part, and in a file of several parts an empty part ends the list. Then comes a table of where the chunks begin; a chunk
of scan lines is its first row, its size and its data.
"""

import struct
from dataclasses import dataclass
from typing import Final

_MAGIC: Final = b"\x76\x2f\x31\x01"

#: Flags in the version: deep or other data that is not an image, and several parts.
_DEEP, _PARTS = 0x800, 0x1000

#: Bytes that a name may have.
_NAME: Final = 255

#: Scan lines of a chunk by the number of its compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB.
_LINES: Final = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)


@dataclass(frozen=True)
class ExrPart:
    """A part's claim."""

    height: int
    width: int
    top: int
    """The first row's number."""
    channels: int
    compression: int
    tiled: bool
    end: int
    """End of the header, a position in the file."""


def read_parts(content: bytes) -> list[ExrPart]:
    """The parts of a file, in order.

    Args:
        content: of the file; its headers are enough.

    Raises:
        ValueError: no OpenEXR, deep data, or headers that are damaged; the message says why.
    """
    if len(content) < 8 or not content.startswith(_MAGIC):
        raise ValueError("without OpenEXR's magic number")
    (version,) = struct.unpack_from("<I", content, 4)
    if version & _DEEP:
        raise ValueError("with deep data")
    parts: list[ExrPart] = []
    at = 8
    try:
        while True:
            attributes, at = _attributes(content, at)
            if not attributes and parts:
                return parts
            parts.append(_part(attributes, at))
            if not version & _PARTS:
                return parts
    except (struct.error, IndexError, KeyError) as error:
        raise ValueError(f"with a damaged header: {error}") from error


def check_chunks(content: bytes, part: ExrPart) -> None:
    """Refuse a file whose chunks are not all there. Tiles are left to the library.

    Args:
        content: of the file.
        part: the only one of the file.

    Raises:
        ValueError: as described above.
    """
    if part.tiled or part.compression >= len(_LINES):
        return
    lines = _LINES[part.compression]
    count = -(-part.height // lines)
    first = part.end + 8 * count
    if first > len(content):
        raise ValueError("it ends too early")
    for start in struct.unpack_from(f"<{count}Q", content, part.end):
        if not first <= start <= len(content) - 8:
            raise ValueError("it ends too early, or its table of chunks is damaged")
        row, size = struct.unpack_from("<2i", content, start)
        if (
            not 0 <= size <= len(content) - 8 - start
            or (row - part.top) % lines
            or not 0 <= row - part.top < part.height
        ):
            raise ValueError("it ends too early, or a chunk is damaged")


def _attributes(content: bytes, at: int) -> tuple[dict[bytes, bytes], int]:
    found: dict[bytes, bytes] = {}
    while content[at]:
        name, at = _word(content, at)
        _, at = _word(content, at)
        (size,) = struct.unpack_from("<i", content, at)
        if not 0 <= size <= len(content) - at - 4:
            raise ValueError(f"with a damaged header: attribute {name.decode('latin-1')!r} of {size} bytes")
        found[name] = content[at + 4 : at + 4 + size]
        at += 4 + size
    return found, at + 1


def _word(content: bytes, at: int) -> tuple[bytes, int]:
    end = content.find(b"\0", at, at + _NAME + 1)
    if end < 0:
        raise ValueError("with a damaged header: a name without an end")
    return content[at:end], end + 1


def _part(attributes: dict[bytes, bytes], end: int) -> ExrPart:
    left, top, right, bottom = struct.unpack("<4i", attributes[b"dataWindow"])
    listed, count, at = attributes[b"channels"], 0, 0
    while listed[at]:
        _, at = _word(listed, at)
        at += 16  # pixel type, flags and sampling
        count += 1
    compression = attributes[b"compression"][0]
    return ExrPart(bottom - top + 1, right - left + 1, top, count, compression, b"tiles" in attributes, end)

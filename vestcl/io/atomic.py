"""Whole files or none: what a reader of another process may see of a file that is being written."""

import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final

#: Bytes of the largest file that is read whole: 16,384 x 8,192 pixels in float64.
LARGEST: Final = 1 << 30

#: What a path may lead to in place of a file, for messages.
_KINDS: Final = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
    stat.S_IFSOCK: "a socket",
}


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary sibling to write to; it takes the place of ``path`` when the block ends, and goes when that fails.

    Args:
        path: the file wanted. Its folder is made where it does not exist.

    Yields:
        A path in the same folder, hidden, with the same suffix (writers choose the format by it).

    Raises:
        ValueError: the folder can't be made.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{path}: its folder can't be made: {error.strerror}") from error
    temporary = path.with_name(f".{path.stem}.{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Replace ``path`` by ``content`` in one step.

    Raises:
        ValueError: the folder can't be made.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def open_regular(path: str | Path) -> Iterator[BinaryIO]:
    """A regular file opened for reading; anything else is refused at once, where a FIFO would block for ever.

    Raises:
        ValueError: it can't be opened or read, or is not a regular file; the message names it.
    """
    try:
        with open(path, "rb", opener=_without_blocking) as file:
            kind = stat.S_IFMT(os.fstat(file.fileno()).st_mode)
            if kind != stat.S_IFREG:
                raise ValueError(f"{path}: must be a regular file, got {_KINDS.get(kind, 'something else')}")
            yield file
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from error


def read_bytes(path: str | Path, limit: int = LARGEST) -> bytes:
    """The content of ``path``.

    Args:
        path: a regular file.
        limit: bytes; a longer file is refused.

    Raises:
        ValueError: it can't be read, is not a regular file, or is too long; the message names it.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        content = file.read(limit + 1) if size <= limit else b""
    if max(size, len(content)) > limit:
        raise ValueError(f"{path}: must have at most {limit} bytes, got {max(size, len(content))}")
    return content


def _without_blocking(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))

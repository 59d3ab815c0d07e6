"""Whole files or none: what a reader of another process may see of a file that is being written."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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


def read_bytes(path: str | Path) -> bytes:
    """The content of ``path``.

    Raises:
        ValueError: it can't be read; the message names it.
    """
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from error

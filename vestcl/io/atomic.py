"""Whole files or none: what a reader of another process may see of a file that is being written."""

import contextlib
import fcntl
import os
import re
import secrets
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final

from vestcl import interrupt

#: Bytes of the largest file that is read whole: 16,384 x 8,192 pixels in float64.
LARGEST: Final = 1 << 30

#: What a path may lead to in place of a file, for messages.
_KINDS: Final = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
    stat.S_IFSOCK: "a socket",
}

#: A temporary file's name: hidden, the stem wanted, process and random number, the suffix wanted.
_TEMPORARY: Final = re.compile(r"\..*\.(\d+)-[0-9a-f]{8}(\.[^.]*)?", re.DOTALL)

#: Seconds after which a temporary file without a lock is a leftover, though a process has the number in its name:
#: numbers are used again, and a writer that renames a file of its own into place drops the lock.
_FORGOTTEN: Final = 3600.0

#: Temporary files of this process that are being written, and folders that were searched for leftovers.
_active: set[Path] = set()
_tidied: set[Path] = set()


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary sibling to write to; it takes the place of ``path`` when the block ends, and goes when that fails.

    What a killed process left of such files in the folder is removed. A file has the rights that the umask gives.

    Args:
        path: the file wanted. Its folder is made where it does not exist.

    Yields:
        An empty file in the same folder, hidden, with the same suffix (writers choose the format by it).

    Raises:
        ValueError: the folder can't be made.
        OSError: the file can't be written, the disk is full for one; the message names ``path``.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{path}: its folder can't be made: {error.strerror}") from error
    if (folder := path.parent.absolute()) not in _tidied:
        remove_leftovers(folder)
        _tidied.add(folder)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    with _naming(path, temporary):
        _active.add(temporary)
        try:
            with _locked(temporary):
                yield temporary
                temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
            _active.discard(temporary)
    interrupt.wrote(path)


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of `replacing` in ``folder`` whose process was killed.

    A file that a process, here or on another machine, still writes is locked, and stays.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            named = _TEMPORARY.fullmatch(entry.name)
            if named and Path(entry.path) not in _active:
                with contextlib.suppress(OSError):
                    _remove_leftover(Path(entry.path), int(named[1]))


def _remove_leftover(path: Path, process: int) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
    try:
        about = os.fstat(descriptor)
        if not stat.S_ISREG(about.st_mode):
            return
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # an OSError where its writer has the lock
        if process == os.getpid() or not _runs(process) or time.time() - about.st_mtime > _FORGOTTEN:
            path.unlink()
    finally:
        os.close(descriptor)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


@contextmanager
def _locked(temporary: Path) -> Iterator[None]:
    """The file, made and locked as long as this process lives; where a file system has no locks, only made."""
    descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def _naming(path: Path, temporary: Path) -> Iterator[None]:
    """An OSError of the block names ``path``, where it names the temporary file or none."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error


def _remove_active() -> None:
    for temporary in tuple(_active):
        temporary.unlink(missing_ok=True)


interrupt.at_stop(_remove_active)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Replace ``path`` by ``content`` in one step.

    Raises:
        ValueError: the folder can't be made.
        OSError: the file can't be written; the message names it.
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

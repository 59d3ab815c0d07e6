"""SHA-256 of files, those of checkpoints for one."""

import functools
import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

#: Bytes that are hashed at once.
_CHUNK: Final = 1 << 20


@dataclass(frozen=True)
class _File:
    """A file as it is now. Equal ones have the same content, under whatever name."""

    path: Path = field(compare=False)
    device: int
    inode: int
    size: int
    changed_ns: int


def sha256(path: Path) -> str:
    """In hex, of the file's content as it is now.

    Raises:
        OSError: it can't be read.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_CHUNK):
            digest.update(block)
    return digest.hexdigest()


def known_sha256(path: Path) -> str:
    """As `sha256`; a file that this process has read before, and that was not written since, is not read again.

    Raises:
        OSError: it can't be read.
    """
    about = path.stat()
    return _sha256_of(_File(path, about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns))


@functools.lru_cache(maxsize=256)
def _sha256_of(file: _File) -> str:
    return sha256(file.path)

"""PoCL's cache of compiled kernels: checked before PoCL is loaded, and a temporary one where it can't be used.

Without a cache that it can write, PoCL does not start (no device), fails to build, or aborts the process ("LLVM ERROR:
IO failure on output stream"). It reads the environment once, when it is loaded.
"""

import atexit
import contextlib
import errno
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from vestcl import interrupt

#: The environment variable that names PoCL's cache.
VARIABLE: Final = "POCL_CACHE_DIR"

#: Bytes that must be free: all kernels, of both precisions and mappings, with what compiling them leaves for a while.
NEEDED: Final = 32 << 20

#: Bytes that must be free for one program more.
_NEEDED_FOR_ONE: Final = 4 << 20

#: The longest path that PoCL takes, minus what it adds.
_LONGEST: Final = 800

#: Errors of a file system that can be written, but can't reserve space.
_RESERVES_NOTHING: Final = (errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)

_PREFIX: Final = "vestcl-pocl-"
_LOCK: Final = ".lock"


@dataclass(frozen=True)
class Cache:
    """Where PoCL compiles to."""

    folder: Path
    note: str = ""
    """That it is a temporary one, and why."""
    fault: str = ""
    """Why there is none, with the remedy; PoCL must not be used then."""


def wanted(environment: Mapping[str, str]) -> Path:
    """The folder that PoCL takes by itself."""
    if VARIABLE in environment:
        return Path(environment[VARIABLE])
    if environment.get("XDG_CACHE_HOME"):
        return Path(environment["XDG_CACHE_HOME"]) / "pocl" / "kcache"
    return Path(environment["HOME"]) / ".cache" / "pocl" / "kcache" if "HOME" in environment else Path("/tmp/pocl")


def wrappers_cache_fault() -> str:
    """Why pyopencl can't keep what it generates, in a database in the user's folder of caches, or nothing."""
    folder = os.environ.get("XDG_CACHE_HOME", "").strip() or os.path.expanduser("~/.cache")  # noqa: PTH111
    return fault(Path(folder) / "pytools", _NEEDED_FOR_ONE)


def fault(folder: Path, needed: int = NEEDED) -> str:
    """Why ``folder`` can't be a cache with space for ``needed`` bytes, or nothing. The folder is made."""
    if not folder.parts or len(os.fsencode(folder)) > _LONGEST:
        return "its path is too long" if folder.parts else "its path is empty"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, needed)  # free space is less than what is free under a quota
    except OSError as error:
        return "" if error.errno in _RESERVES_NOTHING else error.strerror or str(error)
    return ""


_caches: dict[Path, Cache] = {}


def ensure() -> Cache:
    """The cache of this process and its children; POCL_CACHE_DIR is set to a temporary one where its own can't be used.

    A temporary one is removed when the process ends; what a killed process left is removed by the next one.
    """
    folder = wanted(os.environ)
    if folder not in _caches:
        cache = _caches[folder] = _checked(folder)
        _caches[cache.folder] = cache
        if cache.folder != folder:
            os.environ[VARIABLE] = str(cache.folder)
    return _caches[folder]


def _checked(folder: Path) -> Cache:
    why = fault(folder)
    if not why:
        return Cache(folder)
    where = f"PoCL's cache {folder} can't be used ({why})"
    remedy = f"let {VARIABLE} name a folder that can be written, with {NEEDED >> 20} MiB free"
    try:
        _remove_leftovers()
        temporary = _temporary()
        why_not = fault(temporary)
    except OSError as error:
        return Cache(folder, fault=f"{where}, nor can a temporary one be made ({error.strerror or error}): {remedy}")
    if why_not:
        return Cache(folder, fault=f"{where}, nor a temporary one in {temporary.parent} ({why_not}): {remedy}")
    return Cache(temporary, note=f"{where}; kernels are compiled to a temporary one for this run: {remedy}")


def fault_before_build() -> str:
    """Why no further program can be compiled, or nothing: the disk may have become full since `ensure`."""
    cache = ensure()
    try:
        about = os.statvfs(cache.folder)
    except OSError as error:
        return f"PoCL's cache {cache.folder} can't be used any more ({error.strerror}): start again"
    if about.f_bavail * about.f_frsize >= _NEEDED_FOR_ONE:
        return ""
    return f"PoCL's cache {cache.folder} has no space left: free some, or let {VARIABLE} name a folder on another disk"


def _temporary() -> Path:
    """A folder that goes with this process, locked as long as it lives."""
    folder, process = Path(tempfile.mkdtemp(prefix=_PREFIX)), os.getpid()
    lock = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR, 0o600)
    with contextlib.suppress(OSError):
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def remove() -> None:
        if os.getpid() == process:  # a fork's exit is not the end
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    interrupt.at_stop(remove)
    return folder


def _remove_leftovers() -> None:
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError), _unlocked(folder / _LOCK):
            shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def _unlocked(lock: Path) -> Iterator[None]:
    """An OSError where a process holds the lock."""
    descriptor = os.open(lock, os.O_RDWR | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)

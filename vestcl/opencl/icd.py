"""How OpenCL's loader finds drivers: files *.icd that hold the path of a library each, in one folder."""

import importlib.util
import os
import shlex
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Final

from vestcl.opencl import pocl_cache

#: Where the loader looks if no environment variable names another folder.
VENDORS: Final = "/etc/OpenCL/vendors"

#: Environment variables that hide PoCL.
_HIDING: Final = ("POCL_DEVICES", "OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH")

#: Bytes of the longest .icd file that is taken for one: paths are shorter.
_LONGEST: Final = 4096

#: Seconds that `ld --version` may take.
_LINKER_PATIENCE: Final = 10.0


def vendors() -> Path:
    """The folder whose .icd files name the OpenCL drivers of this machine, or the one driver that is to be loaded."""
    return Path(os.environ.get("OCL_ICD_VENDORS") or os.environ.get("OPENCL_VENDOR_PATH") or VENDORS)


def drivers() -> list[tuple[Path, str]]:
    """Each .icd file and the library that it names; broken files are left out, `faults` lists them."""
    folder = vendors()
    if folder.is_file() and folder.suffix != ".icd":  # the loader takes it for a driver then
        return [(folder, str(folder))]
    return [(file, _library(file)) for file in _files(folder) if not _fault(file)]


def faults() -> Iterator[str]:
    """What is wrong with the .icd files, by name, each with its remedy."""
    folder = vendors()
    if not folder.exists() and str(folder) != VENDORS:
        yield f"OCL_ICD_VENDORS names {folder}, which does not exist, and so hides every driver: unset it"
    for file in _files(folder):
        if why := _fault(file):
            yield f"{file} {why}: it must be a file of one line, the path of a driver's library; move it away"


def no_device() -> str:
    """That there is no OpenCL device at all, and the remedy; the same from `doctor` and from every other command."""
    cache = pocl_cache.ensure()
    if importlib.util.find_spec("pocl_binary_distribution") is None:
        return "no OpenCL device: pip install 'pyopencl[pocl]' brings one for the CPU"
    if cache.fault:
        return f"no OpenCL device: {cache.fault}"
    hiding = [name for name in _HIDING if name in os.environ]
    remedy = f"unset {', '.join(hiding)}" if hiding else "pip install 'pyopencl[pocl]' again"
    return f"no OpenCL device, though PoCL is installed: {remedy}"


def linker_fault() -> str:
    """Why PoCL, which aborts the process where it can't link, must not be used, or nothing."""
    linker = shutil.which("ld")
    if linker is None:
        return "PoCL calls the linker `ld`, which is not on PATH, and would abort: apt install binutils"
    why = _ending([linker, "--version"])
    if not why:
        return ""
    return f"PoCL calls the linker `ld`, and would abort: {linker} does not work ({why}): apt install binutils"


def intel_notes(platforms: Sequence[str]) -> Iterator[str]:
    """How to make Intel's runtime from pip visible: its wheel's .icd files hold the path of another machine.

    Args:
        platforms: names of those that the loader found.
    """
    library = _intel_library()
    if library is None:
        return
    where = str(library.parent)
    if any(not letter.isascii() or letter.isspace() for letter in where):
        yield (
            f"Intel's runtime is installed in {where}: it fails in a folder whose path has a blank or a letter "
            "beyond ASCII; install it in an environment with a plain path"
        )
    elif not any(name.startswith("Intel(R) OpenCL") for name in platforms):
        icd = Path(sys.prefix) / "etc" / "OpenCL" / "vendors" / "intel-cpu.icd"
        write = f"echo {shlex.quote(str(library))} > {shlex.quote(str(icd))}"
        make = "" if icd.parent.is_dir() else f"mkdir -p {shlex.quote(str(icd.parent))} && "
        set_it = f"export OCL_ICD_VENDORS={shlex.quote(str(icd.parent))}"
        yield f"Intel's runtime is installed, but OpenCL's loader does not see it: {make}{write} && {set_it}"


def _files(folder: Path) -> list[Path]:
    if folder.suffix == ".icd" and not folder.is_dir():
        return [folder]
    try:
        return sorted(folder.glob("*.icd")) if folder.is_dir() else []
    except OSError:
        return []


def _fault(file: Path) -> str:
    try:
        kind = file.stat().st_mode
        if not stat.S_ISREG(kind):
            return "is a folder" if stat.S_ISDIR(kind) else "is not a regular file"
        with file.open("rb") as opened:
            content = opened.read(_LONGEST + 1)
    except OSError as error:
        return f"can't be read ({error.strerror})"
    if not content.strip():
        return "is empty"
    return "is binary" if b"\0" in content or len(content) > _LONGEST or not _is_text(content) else ""


def _is_text(content: bytes) -> bool:
    """Whether it is one line without control characters, in whatever encoding file names have."""
    return all(byte >= 0x20 or byte == 0x09 for byte in content.strip()) and b"\x7f" not in content


def _library(file: Path) -> str:
    return os.fsdecode(file.read_bytes().strip())


def _ending(command: Sequence[str]) -> str:
    """How ``command`` failed, or nothing: a status of 0 and some output."""
    try:
        done = subprocess.run(command, capture_output=True, timeout=_LINKER_PATIENCE, check=False)
    except subprocess.TimeoutExpired:
        return f"did not end within {_LINKER_PATIENCE:g} s"
    except OSError as error:
        return str(error.strerror)
    if done.returncode:
        return f"exit status {done.returncode}"
    return "" if done.stdout.strip() else "no version"


def _intel_library() -> Path | None:
    """The CPU runtime's, where pip installed one."""
    try:
        files = metadata.files("intel-opencl-rt") or []
    except metadata.PackageNotFoundError:
        return None
    found = (Path(str(file.locate())).resolve() for file in files if file.name == "libintelocl.so")
    return next(found, None)

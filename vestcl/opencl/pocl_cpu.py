"""Teach PoCL 3.0 (the one on PyPI) the name of a CPU newer than its compiler.

PoCL asks LLVM for the host CPU's name and hands it to clang as ``-target-cpu``. The LLVM 14 inside PoCL 3.0 knows
no CPU later than 2022 (Zen 4, Sapphire Rapids, ...), answers "generic", and clang refuses that name on x86:
every build fails with ``unknown target CPU 'generic'`` (pocl issue 1049). PoCL 3.1 and later fall back
to the name of the instruction set instead. We do the same from outside: find the pointer to
"generic" in PoCL's device structure and point it to that name. Nothing is touched on any other driver,
version or architecture.
"""

import ctypes
import functools
import os
import struct
from pathlib import Path

#: (instruction sets a CPU must have, the LLVM name of them), best first; the same pairs as PoCL 3.1's.
_NAMES = (
    ({"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}, b"skylake-avx512"),
    ({"avx2", "fma", "bmi1", "bmi2", "f16c"}, b"haswell"),
    ({"avx", "f16c"}, b"ivybridge"),
    ({"avx"}, b"sandybridge"),
)
_POINTER = struct.calcsize("P")
_STRUCTURE_BYTES = 1536  # PoCL 3.0's _cl_device_id: the field lies at byte 640


def is_unnamed(platform_version: str, device_version: str) -> bool:
    """Whether this is the PoCL that can't build for its own CPU: version 3.0, CPU name "generic", on x86-64."""
    return "PoCL 3.0" in platform_version and device_version.endswith("x86_64-unknown-linux-gnu-generic")


def cpu_name(flags: frozenset[str]) -> bytes | None:
    """The newest LLVM CPU name whose instruction sets are all among ``flags`` (as in /proc/cpuinfo)."""
    return next((name for needed, name in _NAMES if needed <= flags), None)


def name_cpu(device_address: int) -> str | None:
    """Replace "generic" in the PoCL device structure at ``device_address``; the name given, or None if not found."""
    name = cpu_name(_host_flags())
    if name is None:
        return None
    memory = os.open("/proc/self/mem", os.O_RDONLY)  # reads of unmapped addresses fail there instead of crashing
    try:
        offset = _find_pointer_to(memory, device_address, b"generic\0")
    finally:
        os.close(memory)
    if offset is None:
        return None
    libc = ctypes.CDLL(None)
    libc.strdup.restype = ctypes.c_void_p  # malloc'ed, for PoCL frees the field at exit
    ctypes.c_void_p.from_address(device_address + offset).value = libc.strdup(name)
    return name.decode()


def host_key() -> str:
    """A text that differs between CPUs for which `name_cpu` gives different names."""
    return (cpu_name(_host_flags()) or b"").decode()


def _find_pointer_to(memory: int, base: int, text: bytes) -> int | None:
    for offset in range(0, _STRUCTURE_BYTES, _POINTER):
        (target,) = struct.unpack("P", os.pread(memory, _POINTER, base + offset))
        if 4096 <= target < 1 << 47 and _read(memory, target, len(text)) == text:
            return offset
    return None


def _read(memory: int, address: int, size: int) -> bytes:
    try:
        return os.pread(memory, size, address)
    except OSError:
        return b""


@functools.cache
def _host_flags() -> frozenset[str]:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    return next((frozenset(line.split(":")[1].split()) for line in lines if line.startswith("flags")), frozenset())

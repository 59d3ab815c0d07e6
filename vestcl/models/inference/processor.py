"""What this processor and this C library can do for inference; imports no network."""

import ctypes
import platform
from collections.abc import Callable
from typing import Any, Final

import torch

#: Processors' names for their bfloat16 instructions, as `torch.cpu.get_capabilities` has them. Without any of these
#: oneDNN computes in float32, and bfloat16 costs conversions on top.
_BFLOAT16: Final = ("avx512_bf16", "amx_bf16", "avx_ne_convert", "bf16")

#: Settings of glibc's mallopt: no separate memory maps for large blocks, nothing given back below 2 GiB; glibc's
#: defaults.
_MALLOPT: Final = {True: ((-4, 0), (-1, 2**31 - 1)), False: ((-4, 65536), (-1, 128 * 1024))}


def computes_bfloat16() -> bool:
    """Whether this processor has instructions for bfloat16; False where torch does not report it."""
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return any(capabilities.get(name, False) for name in _BFLOAT16)


def keep_freed_memory(keep: bool = True) -> bool:
    """Let this process keep what it frees, from now on: a forecast's large tensors come and go by the dozen.

    glibc returns blocks of that size to the system, which then has to find, clear and map the pages of the next one.
    The price is that the process stays as large as it has ever been.

    Args:
        keep: False returns to glibc's defaults.

    Returns:
        Whether that was done: with other C libraries than glibc nothing is changed.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt: Callable[[int, int], int] = ctypes.CDLL(None).mallopt
    done = [mallopt(parameter, value) for parameter, value in _MALLOPT[keep]]
    return all(done)

"""Kernel files and what they are built with."""

import functools
import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from vestcl import constants
from vestcl.opencl.errors import DeviceError

Defines = Mapping[str, str | int]


@functools.cache
def kernel_folder() -> Path:
    """Where the .cl files are: vestcl/kernels in a wheel, kernels/ next to the package in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "kernels", package.parent / "kernels"):
        if (folder / "common.h").is_file():
            return folder
    raise DeviceError(f"vestcl's OpenCL kernels are missing next to {package}: install the package again")


@functools.cache
def source(name: str) -> str:
    """Kernel file ``name`` with its ``#include "..."`` lines inlined, and #line so that errors point home.

    A file that is included is next to the one that names it, or in the folder of kernels.
    """
    text = (kernel_folder() / name).read_text()
    parts = [f'#line 1 "{name}"']
    for number, line in enumerate(text.splitlines(), start=1):
        included = re.fullmatch(r'\s*#include "(.+)"\s*', line)
        parts.append(f'{source(_sibling(name, included[1]))}\n#line {number + 1} "{name}"' if included else line)
    return "\n".join(parts)


def _sibling(name: str, included: str) -> str:
    near = (PurePosixPath(name).parent / included).as_posix()
    return near if (kernel_folder() / near).is_file() else included


def defines_for(dtype: np.dtype, **more: str | int) -> dict[str, str | int]:
    """What every kernel file is built with: REAL, REAL_BITS, the constants, and ``more``."""
    double = dtype == np.float64
    return {
        "REAL": "double" if double else "float",
        "REAL_BITS": 64 if double else 32,
        "NEAR": repr(constants.NEAR),
        "TILE": constants.TILE,
        **more,
    }


def compiler_warnings(log: str) -> str:
    """The lines of a build's log that warn. Intel's compiler reports there what it did, and its options."""
    lines = (line for line in log.splitlines() if not line.startswith("Options used by backend compiler"))
    return "\n".join(line for line in lines if re.search(r"\b(warning|error)\b", line, re.IGNORECASE))

"""What compilers for GPUs make of the kernels: registers, spills and memory, without a GPU.

    python tests/support/gpu_compilers.py

prints a table for AMD's gfx1030, by Debian's clang and libclc (apt-get install clang-16 libclc-16), and for NVIDIA's
sm_80 where there is a `ptxas` (of CUDA, or of `pip install nvidia-cuda-nvcc-cu12`).
"""

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from vestcl import constants, opencl
from vestcl.ops import _splat_layer, rigid_flow
from vestcl.ops._splat_lists import splat_defines

AMD: Final = "gfx1030"
NVIDIA: Final = "sm_80"
#: Of the features; the last but one leaves a group of channels that is not full.
CHANNELS: Final = (3, 32, 33, 64)
#: Targets of clang, and libclc's library for each.
_TARGETS: Final = {
    AMD: ("amdgcn-amd-amdhsa", "amdgcn--amdhsa.bc"),
    NVIDIA: ("nvptx64-nvidia-nvcl", "nvptx64--nvidiacl.bc"),
}
_LIBRARIES: Final = Path("/usr/lib/clc")
_BACKWARD: Final[dict[str, str | int]] = {
    **{f"GRAD_{name}": 1 for name in ("FEATURES", "POINTS_UV", "RADII", "OPACITIES", "BACKGROUNDS")},
    "HAS_BACKGROUNDS": 1,
    "HAS_GRAD_COVERAGE": 1,
}


@dataclass(frozen=True)
class Resources:
    """What a kernel takes of a GPU, by its compiler."""

    kernel: str
    registers: int
    """Vector registers of AMD, registers of NVIDIA."""
    spills: int
    """Registers of AMD, bytes of NVIDIA."""
    private_bytes: int
    """Of a work-item: arrays that are not in registers, and spills."""
    local_bytes: int
    """Of a work-group."""


def clang() -> str | None:
    """The newest one whose libclc is installed; Debian's are called clang-16 and so on."""
    names = [f"clang-{version}" for version in range(22, 13, -1)]
    if not all((_LIBRARIES / library).is_file() for _, library in _TARGETS.values()):
        return None
    return next((found for name in (*names, "clang") if (found := shutil.which(name))), None)


def ptxas() -> str | None:
    return shutil.which("ptxas")


def programs(dtype: np.dtype[Any], channels: int) -> dict[str, dict[str, str | int]]:
    """The files of the mapping "pixel" and what they are built with."""
    plain = opencl.defines_for(dtype)
    limits: dict[str, str | int] = {name: str(getattr(constants, name)) for name in ("TORN", "SLANTED", "BENT")}
    return {
        "splat/splat_bin.cl": splat_defines(dtype, BUILTINS=0, TOGETHER=1),
        "splat/splat_composite_pixels.cl": {**_splat_layer.defines_of_pixels(dtype, channels, True), **_BACKWARD},
        "splat/splat_skipped.cl": splat_defines(dtype),
        "unproject.cl": plain,
        "displace.cl": plain,
        "rigid_flow.cl": dict(rigid_flow._defines(dtype)),
        "stretch.cl": plain | limits,
    }


def assembly(target: str, file: str, defines: opencl.Defines) -> str:
    """What clang makes of kernel ``file``, built with ``defines``.

    Raises:
        RuntimeError: it does not compile.
    """
    triple, library = _TARGETS[target]
    compiler = clang()
    assert compiler is not None
    command = [compiler, "-w", "-x", "cl", "-cl-std=CL1.2", "-O3", "-target", triple, "-S", "-o", "-", "-"]
    command += ["-mcpu=" + target, "-nogpulib"] if target == AMD else []
    for option in ("-finclude-default-header", "-mlink-builtin-bitcode", str(_LIBRARIES / library)):
        command += ["-Xclang", option]
    command += [f"-D{name}={value}" for name, value in defines.items()]
    return _run(command, opencl.source(file))


def amd_resources(text: str) -> list[Resources]:
    """From the metadata at the end of clang's assembly."""
    metadata = text[text.index("amdhsa.kernels:") :]
    kernels = re.split(r"\n  - (?=\.)", metadata)[1:]
    return [
        Resources(
            kernel=_value(kernel, "name"),
            registers=int(_value(kernel, "vgpr_count")),
            spills=int(_value(kernel, "vgpr_spill_count")) + int(_value(kernel, "sgpr_spill_count")),
            private_bytes=int(_value(kernel, "private_segment_fixed_size")),
            local_bytes=int(_value(kernel, "group_segment_fixed_size")),
        )
        for kernel in kernels
    ]


def nvidia_resources(text: str) -> list[Resources]:
    """From what ptxas reports of clang's PTX."""
    compiler = ptxas()
    assert compiler is not None
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "kernels.ptx"
        source.write_text(text)
        report = _run([compiler, "-v", f"-arch={NVIDIA}", str(source), "-o", str(Path(folder) / "kernels.cubin")])
    kernels = re.split(r"Compiling entry function ", report)[1:]
    return [
        Resources(
            kernel=_matched(r"'(\w+)'", kernel),
            registers=int(_matched(r"Used (\d+) registers", kernel)),
            spills=int(_matched(r"(\d+) bytes spill stores", kernel)),
            private_bytes=int(_matched(r"(\d+) bytes stack frame", kernel)),
            local_bytes=int(_matched(r"(\d+) bytes smem", kernel, "0")),
        )
        for kernel in kernels
    ]


def measured(target: str, dtype: np.dtype[Any]) -> dict[str, list[Resources]]:
    """Every kernel, by name, for each number of channels; `clang` has to be there, for NVIDIA `ptxas`, too."""
    parse = amd_resources if target == AMD else nvidia_resources
    found = dict[str, list[Resources]]()
    for channels in CHANNELS:
        for file, defines in programs(dtype, channels).items():
            if "CHANNELS" in defines or channels == CHANNELS[0]:
                for kernel in parse(assembly(target, file, defines)):
                    found.setdefault(kernel.kernel, []).append(kernel)
    return found


def _run(command: list[str], given: str = "") -> str:
    done = subprocess.run(command, input=given, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}:\n{done.stderr}")
    return done.stdout + done.stderr


def _value(kernel: str, key: str) -> str:
    return _matched(rf"\n?(?:^|\s)\.{key}: +(\w+)\n(?!\s+\.value_kind)", kernel)


def _matched(pattern: str, text: str, otherwise: str | None = None) -> str:
    found = re.search(pattern, text)
    if found is None and otherwise is not None:
        return otherwise
    assert found is not None, f"{pattern} is not in {text}"
    return found[1]


def shown(builds: list[Resources]) -> str:
    """Registers for the fewest and the most channels, and what else there is of memory."""
    low, high = (function(build.registers for build in builds) for function in (min, max))
    spills, private, local = (
        max(getattr(build, name) for build in builds) for name in ("spills", "private_bytes", "local_bytes")
    )
    parts = [str(low) if low == high else f"{low} to {high}"]
    parts += [f"{spills} spills"] if spills else []
    parts += [f"{private:,} B private"] if private else []
    parts += [f"{local:,} B local"] if local else []
    return ", ".join(parts)


def rows() -> Iterator[str]:
    """A Markdown table of all kernels, over `CHANNELS`."""
    types = [np.dtype(np.float32), np.dtype(np.float64)]
    columns = [(target, dtype) for target in (AMD, *([NVIDIA] if ptxas() else [])) for dtype in types]
    table = {column: measured(*column) for column in columns}
    yield "| kernel | " + " | ".join(f"{target}, {dtype}" for target, dtype in columns) + " |"
    yield "|---|" + "---|" * len(columns)
    for kernel in sorted(table[columns[0]]):
        yield f"| `{kernel}` | " + " | ".join(shown(table[column][kernel]) for column in columns) + " |"


def main() -> int:
    if clang() is None:
        print("clang and libclc are not installed: apt-get install clang-16 libclc-16", file=sys.stderr)
        return 2
    for row in rows():
        print(row)
    return 0


if __name__ == "__main__":
    sys.exit(main())

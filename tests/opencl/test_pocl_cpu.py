"""pocl_cpu on made-up CPUs and a made-up device structure; the real repair shows in every test that builds a kernel."""

import ctypes

import pytest

from vestcl.opencl import pocl_cpu

AVX2 = frozenset({"avx", "avx2", "fma", "bmi1", "bmi2", "f16c"})
AVX512 = AVX2 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
FIELD = 640  # where PoCL 3.0 keeps the pointer

POCL_3_0 = "OpenCL 3.0 PoCL 3.0-rc2  Linux, Release, RELOC, LLVM 14.0.6"
UNNAMED = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-generic"


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (AVX512, b"skylake-avx512"),
        (AVX512 - {"avx512vl"}, b"haswell"),
        (AVX2, b"haswell"),
        (frozenset({"avx", "f16c"}), b"ivybridge"),
        (frozenset({"avx"}), b"sandybridge"),
        (frozenset({"sse2"}), None),
        (frozenset(), None),
    ],
)
def test_cpu_name_is_the_newest_that_fits(flags: frozenset[str], name: bytes | None) -> None:
    assert pocl_cpu.cpu_name(flags) == name


@pytest.mark.parametrize(
    ("platform", "device", "unnamed"),
    [
        (POCL_3_0, UNNAMED, True),
        (POCL_3_0, UNNAMED.replace("generic", "znver3"), False),
        (POCL_3_0, UNNAMED.replace("x86_64", "aarch64"), False),
        (POCL_3_0.replace("PoCL 3.0", "PoCL 3.1"), UNNAMED, False),
        ("OpenCL 3.1 LINUX", "OpenCL 3.1 (Build 0)", False),
    ],
)
def test_only_pocl_3_0_on_x86_without_a_name_is_touched(platform: str, device: str, unnamed: bool) -> None:
    assert pocl_cpu.is_unnamed(platform, device) is unnamed


class Structure:
    """1536 bytes like PoCL's device structure: zeros, a wild pointer, and one to ``text`` at FIELD."""

    def __init__(self, text: bytes) -> None:
        self._text = ctypes.create_string_buffer(text)
        self._words = (ctypes.c_uint64 * 192)()
        self._words[1] = 0x5550_0000_0008  # mapped nowhere
        self._words[FIELD // 8] = ctypes.addressof(self._text)
        self.address = ctypes.addressof(self._words)

    @property
    def cpu(self) -> bytes | None:
        return ctypes.c_char_p(self._words[FIELD // 8]).value


def test_name_cpu_replaces_generic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pocl_cpu, "_host_flags", lambda: AVX2)
    structure = Structure(b"generic")
    assert pocl_cpu.name_cpu(structure.address) == "haswell"
    assert structure.cpu == b"haswell"
    assert pocl_cpu.name_cpu(structure.address) is None  # nothing is left to replace
    assert pocl_cpu.host_key() == "haswell"


def test_name_cpu_keeps_other_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pocl_cpu, "_host_flags", lambda: AVX2)
    structure = Structure(b"generic-rv64")
    assert pocl_cpu.name_cpu(structure.address) is None
    assert structure.cpu == b"generic-rv64"


def test_name_cpu_without_a_name_for_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pocl_cpu, "_host_flags", frozenset)
    structure = Structure(b"generic")
    assert pocl_cpu.name_cpu(structure.address) is None
    assert structure.cpu == b"generic"
    assert pocl_cpu.host_key() == ""

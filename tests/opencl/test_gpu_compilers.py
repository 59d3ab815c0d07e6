"""The kernels of the mapping "pixel" as compilers for GPUs see them: they compile, and nothing lies in slow memory."""

import gpu_compilers
import numpy as np
import pytest
from gpu_compilers import AMD, NVIDIA, Resources, amd_resources, assembly, measured, nvidia_resources, programs, shown


@pytest.fixture(autouse=True)
def _compiler() -> None:
    if gpu_compilers.clang() is None:
        pytest.skip("clang and libclc are not installed: apt-get install clang-16 libclc-16")


@pytest.fixture
def _assembler() -> None:
    if gpu_compilers.ptxas() is None:
        pytest.skip("ptxas is not on PATH: it is in CUDA and in pip's nvidia-cuda-nvcc-cu12")


def kernels(builds: dict[str, list[Resources]]) -> None:
    assert {"count_tiles", "sort_tiles_together", "composite_pixels", "sum_scratch", "unproject"} <= set(builds)
    assert [len(builds[name]) for name in ("count_tiles", "sum_scratch")] == [1, len(gpu_compilers.CHANNELS)]
    for name, each in builds.items():
        assert all(0 < build.registers <= 255 and build.local_bytes <= 32 * 1024 for build in each), name


def assert_all_in_registers(builds: dict[str, list[Resources]]) -> None:
    for name, each in builds.items():
        assert not any(build.spills for build in each), f"{name} spills registers: {shown(each)}"
        assert not any(build.private_bytes for build in each), f"{name} has an array in memory: {shown(each)}"


def test_amd() -> None:
    builds = measured(AMD, np.dtype(np.float32))
    kernels(builds)
    assert_all_in_registers(builds)


def test_amd_float64() -> None:
    kernels(measured(AMD, np.dtype(np.float64)))


@pytest.mark.usefixtures("_assembler")
def test_nvidia() -> None:
    builds = measured(NVIDIA, np.dtype(np.float32))
    kernels(builds)
    assert_all_in_registers(builds)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_nvidia_up_to_its_assembler(dtype: type[np.generic]) -> None:
    for file, defines in programs(np.dtype(dtype), 33).items():
        assert ".entry " in assembly(NVIDIA, file, defines)


# ---------------------------------------------------------------- a kernel that keeps too much

ARRAYS = """
kernel void spread(const int count, global const float* in, global float* out) {
  float sums[64];
  for (int i = 0; i < 64; i++) sums[i] = 0;
  for (int i = 0; i < count; i++) sums[(int)in[i] & 63] += in[i];
  local float shared[32];
  shared[get_local_id(0)] = sums[count & 63];
  barrier(CLK_LOCAL_MEM_FENCE);
  out[get_global_id(0)] = shared[31 - get_local_id(0)];
}
"""


@pytest.fixture
def _arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_compilers.opencl, "source", lambda _: ARRAYS)


@pytest.mark.usefixtures("_arrays")
def test_an_array_in_memory_is_found() -> None:
    (kernel,) = amd_resources(assembly(AMD, "arrays.cl", {}))
    assert kernel.kernel == "spread" and kernel.private_bytes >= 4 * 64 and kernel.local_bytes == 4 * 32
    assert f"{kernel.private_bytes:,} B private, 128 B local" in shown([kernel])
    with pytest.raises(AssertionError, match="spread has an array in memory"):
        assert_all_in_registers({"spread": [kernel]})


@pytest.mark.usefixtures("_arrays", "_assembler")
def test_an_array_in_memory_is_found_on_nvidia() -> None:
    (kernel,) = nvidia_resources(assembly(NVIDIA, "arrays.cl", {}))
    assert kernel.kernel == "spread" and kernel.private_bytes >= 4 * 64 and kernel.local_bytes == 4 * 32


def test_what_does_not_compile_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_compilers.opencl, "source", lambda _: "kernel void broken() { return 1 }")
    for target in (AMD, NVIDIA):
        with pytest.raises(RuntimeError, match="error: expected ';'"):
            assembly(target, "broken.cl", {})

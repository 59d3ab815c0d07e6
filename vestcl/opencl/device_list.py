"""OpenCL devices: which there are, and which one is meant. Importing it loads no driver."""

import functools
import os
import re
import warnings
from dataclasses import dataclass

import pyopencl as cl

from vestcl.opencl import forks, icd, pocl_cache, pocl_cpu
from vestcl.opencl.errors import DeviceError
from vestcl.opencl.forks import refuse_after_fork


@dataclass(frozen=True)
class DeviceInfo:
    """What `vestcl devices` prints about one OpenCL device."""

    index: str
    """``platform:device``, a valid value of VESTCL_DEVICE."""
    platform: str
    name: str
    kind: str
    """"CPU", "GPU" or "accelerator"."""
    compute_units: int
    memory_gib: float
    local_memory_kib: float
    float64: bool
    version: str
    driver: str


@functools.cache
def all_devices() -> tuple[tuple[DeviceInfo, cl.Device], ...]:
    """As `devices`, each with pyopencl's object; found once per process."""
    forks.opencl_runs()
    cache = pocl_cache.ensure()  # PoCL reads where it is when it is loaded
    if pocl_cache.wrappers_cache_fault():
        cl._PYOPENCL_NO_CACHE = True  # of PYOPENCL_NO_CACHE, which is read when pyopencl is imported
    try:
        platforms = cl.get_platforms()
    except cl.LogicError as error:  # the loader's way to say that there are none
        if "PLATFORM_NOT_FOUND" not in str(error):
            raise
        platforms = []
    found = []
    for p, platform in enumerate(platforms):
        try:
            devices = platform.get_devices()
        except cl.Error:  # a platform without devices (rusticl without RUSTICL_ENABLE) is not an error
            continue
        for d, device in enumerate(devices):
            if pocl_cpu.is_unnamed(platform.version, device.version):
                pocl_cpu.name_cpu(device.int_ptr)
            found.append((_describe(f"{p}:{d}", platform, device), device))
    if cache.note and any("PoCL" in info.version for info, _ in found):
        warnings.warn(cache.note, stacklevel=2)
    return tuple(found)


def _describe(index: str, platform: cl.Platform, device: cl.Device) -> DeviceInfo:
    kinds = {cl.device_type.CPU: "CPU", cl.device_type.GPU: "GPU"}
    return DeviceInfo(
        index=index,
        platform=platform.name.strip(),
        name=device.name.strip(),
        kind=next((kind for flag, kind in kinds.items() if device.type & flag), "accelerator"),
        compute_units=device.max_compute_units,
        memory_gib=device.global_mem_size / 2**30,
        local_memory_kib=device.local_mem_size / 2**10,
        float64="cl_khr_fp64" in device.extensions,
        version=device.version.strip(),
        driver=f"{platform.version.strip()} / {device.driver_version.strip()}",
    )


def devices() -> list[DeviceInfo]:
    """Every device of every OpenCL platform, in the loader's order.

    Raises:
        DeviceError: in a process that was forked after OpenCL was used.
    """
    refuse_after_fork()
    return [info for info, _ in all_devices()]


def select(selector: str | None = None) -> DeviceInfo:
    """The device that ``selector`` means.

    Args:
        selector: ``"0:1"`` (platform:device), or a part of the platform's, device's or driver's name in any case, such
            as ``"pocl"``, ``"intel"``, ``"nvidia"``. None: the environment variable VESTCL_DEVICE, and without
            it the first PoCL (pip installs one), else the first CPU, else the first device.

    Raises:
        DeviceError: no device fits, and the message lists those that there are; or as in `devices`.
    """
    name, selector = ("`device`", selector) if selector else ("VESTCL_DEVICE", os.environ.get("VESTCL_DEVICE"))
    infos = devices()
    if not infos:
        raise DeviceError(icd.no_device())
    if selector is None:
        return min(infos, key=lambda info: (info.kind != "CPU", "PoCL" not in info.version))
    if re.fullmatch(r"\d+:\d+", selector):
        chosen = [info for info in infos if info.index == selector]
    else:
        text = selector.lower()
        chosen = [i for i in infos if text in f"{i.platform} {i.name} {i.version} {i.driver}".lower()]
    if not chosen:
        known = "; ".join(f"{info.index} {info.platform} / {info.name}" for info in infos)
        raise DeviceError(f"{name} {selector!r} fits none of the OpenCL devices: {known}")
    return chosen[0]

"""Devices, programs, sessions and host memory: the only importer of pyopencl. Importing it opens no device."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # all load on first use: what needs no device is to start at once
    from vestcl.opencl.device_list import DeviceInfo, devices, select
    from vestcl.opencl.errors import DeviceError
    from vestcl.opencl.groups import GPU_GROUP, grouped
    from vestcl.opencl.programs import Defines, defines_for, kernel_folder, source
    from vestcl.opencl.selection import current, free_scratch, open_session, use
    from vestcl.opencl.session import Argument, Arguments, Buffer, Job, JobTimes, KernelTime, Launch, Session, observe

__all__ = [
    "GPU_GROUP",
    "Argument",
    "Arguments",
    "Buffer",
    "Defines",
    "DeviceError",
    "DeviceInfo",
    "Job",
    "JobTimes",
    "KernelTime",
    "Launch",
    "Session",
    "current",
    "defines_for",
    "devices",
    "free_scratch",
    "grouped",
    "kernel_folder",
    "observe",
    "open_session",
    "select",
    "source",
    "use",
]

_FILES = {
    **dict.fromkeys(("current", "free_scratch", "open_session", "use"), "selection"),
    **dict.fromkeys(("DeviceInfo", "devices", "select"), "device_list"),
    "DeviceError": "errors",
    **dict.fromkeys(("GPU_GROUP", "grouped"), "groups"),
    **dict.fromkeys(("Defines", "defines_for", "kernel_folder", "source"), "programs"),
    **dict.fromkeys(
        ("Argument", "Arguments", "Buffer", "Job", "JobTimes", "KernelTime", "Launch", "Session", "observe"), "session"
    ),
}


def __getattr__(name: str) -> Any:
    if name not in _FILES:
        raise AttributeError(f"module 'vestcl.opencl' has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(f"vestcl.opencl.{_FILES[name]}"), name)
    return value  # which is found without this function from now on

"""vestcl: differentiable point splatting in OpenCL, for forecasting driving video from novel views."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # all load on first use, for importing torch takes seconds
    from vestcl.opencl import DeviceError, DeviceInfo, devices, use
    from vestcl.opencl.host_memory import free_memory
    from vestcl.ops.displace import displace
    from vestcl.ops.rigid_flow import rigid_flow
    from vestcl.ops.splat import Raster, Skipped, composite, rasterize, skipped, splat
    from vestcl.ops.unproject import unproject

__version__ = "0.1.0"
__all__ = [
    "DeviceError",
    "DeviceInfo",
    "Raster",
    "Skipped",
    "composite",
    "devices",
    "displace",
    "free_memory",
    "rasterize",
    "rigid_flow",
    "skipped",
    "splat",
    "unproject",
    "use",
]

# others are in the file of their own name
_FILES = {
    **dict.fromkeys(("Raster", "Skipped", "composite", "rasterize", "skipped"), "ops.splat"),
    **dict.fromkeys(("DeviceError", "DeviceInfo", "devices", "use"), "opencl"),
    "free_memory": "opencl.host_memory",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'vestcl' has no attribute {name!r}")
    return getattr(importlib.import_module(f"vestcl.{_FILES.get(name, f'ops.{name}')}"), name)

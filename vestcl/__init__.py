"""vestcl: forecasts of driving video from cameras that never existed, by differentiable point splatting in OpenCL.

clip = vestcl.open("drive.mp4", fov=60)
future = vestcl.forecast(clip, steps=5, views=["source", "right"])
future["right"][3].image, future.save("out")

image, coverage = vestcl.splat(points_uv, z, features, opacities, radii, height, width)
"""

import importlib
from typing import TYPE_CHECKING, Any

from vestcl._version import __version__

if TYPE_CHECKING:  # all load on first use, for importing torch takes seconds
    from vestcl.data.sample import Clip
    from vestcl.forecasting.api import forecast, open
    from vestcl.forecasting.future import Future
    from vestcl.forecasting.live import Live, live
    from vestcl.models.forecaster import Forecaster
    from vestcl.opencl import DeviceError, DeviceInfo, devices, use
    from vestcl.opencl.host_memory import free_memory
    from vestcl.ops.displace import displace
    from vestcl.ops.rigid_flow import rigid_flow
    from vestcl.ops.splat import Raster, Skipped, composite, rasterize, skipped, splat
    from vestcl.ops.unproject import unproject

__all__ = [
    "Clip",
    "DeviceError",
    "DeviceInfo",
    "Forecaster",
    "Future",
    "Live",
    "Raster",
    "Skipped",
    "__version__",
    "composite",
    "devices",
    "displace",
    "forecast",
    "free_memory",
    "live",
    "open",
    "rasterize",
    "rigid_flow",
    "skipped",
    "splat",
    "unproject",
    "use",
]

# others are in the file of the same name
_FILES = {
    **dict.fromkeys(("Raster", "Skipped", "composite", "rasterize", "skipped"), "ops.splat"),
    **dict.fromkeys(("DeviceError", "DeviceInfo", "devices", "use"), "opencl"),
    "free_memory": "opencl.host_memory",
    **dict.fromkeys(("forecast", "open"), "forecasting.api"),
    **dict.fromkeys(("Live", "live"), "forecasting.live"),
    "Clip": "data.sample",
    "Forecaster": "models.forecaster",
    "Future": "forecasting.future",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'vestcl' has no attribute {name!r}")
    return getattr(importlib.import_module(f"vestcl.{_FILES.get(name, f'ops.{name}')}"), name)


def __dir__() -> list[str]:
    return list(__all__)

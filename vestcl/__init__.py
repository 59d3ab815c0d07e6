"""vestcl: differentiable point splatting in OpenCL, for forecasting driving video from novel views."""

from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.splat import Raster, composite, rasterize, splat
from vestcl.ops.unproject import unproject
from vestcl.runtime import DeviceError, DeviceInfo, devices, use

__version__ = "0.1.0"
__all__ = [
    "DeviceError",
    "DeviceInfo",
    "Raster",
    "composite",
    "devices",
    "displace",
    "rasterize",
    "rigid_flow",
    "splat",
    "unproject",
    "use",
]

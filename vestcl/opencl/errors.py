"""The error of OpenCL devices."""


class DeviceError(RuntimeError):
    """No OpenCL device as asked for, or one that can't do what an operator needs. The message names the remedy."""

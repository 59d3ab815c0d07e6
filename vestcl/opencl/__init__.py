"""Devices, programs, sessions and host memory: the only importer of pyopencl."""

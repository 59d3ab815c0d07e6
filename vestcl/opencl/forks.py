"""What a process may still do with OpenCL after it was forked: nothing, with an error."""

import ctypes
import os
import weakref

from vestcl.opencl.errors import DeviceError

#: Whether OpenCL's drivers were loaded: their threads run from then on.
_opencl_runs = False
#: Whether this process was forked off one where they ran. Their threads are not in it: whoever waits for them, hangs.
_forked = False
#: What holds OpenCL's objects: a child never destroys them, for that may hang, too.
_holders: "weakref.WeakSet[object]" = weakref.WeakSet()


def opencl_runs() -> None:
    """Called before drivers are loaded."""
    global _opencl_runs
    _opencl_runs = True


def hold(holder: object) -> None:
    """Never destroy ``holder`` in a child."""
    _holders.add(holder)


def was_forked() -> bool:
    """Whether this process was forked off one where OpenCL ran."""
    return _forked


def refuse_after_fork() -> None:
    """Raise DeviceError in a process that was forked after OpenCL was used."""
    if _forked:
        raise DeviceError(
            "OpenCL was used before this process was forked, and does not work after a fork: start processes with the "
            "method 'spawn' or 'forkserver' (multiprocessing.get_context('spawn'), for a DataLoader "
            "multiprocessing_context='spawn'), or use vestcl's devices only after the fork"
        )


def _after_fork() -> None:
    """In the child."""
    global _forked
    if _opencl_runs:
        _forked = True
        for holder in _holders:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(holder))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)

"""The device that operators run on now, by thread: `use` chooses it."""

import contextvars
import functools

from vestcl.opencl import icd, pocl_cache
from vestcl.opencl.device_list import DeviceInfo, all_devices, select
from vestcl.opencl.errors import DeviceError
from vestcl.opencl.forks import was_forked
from vestcl.opencl.robust_lock import WithBlock
from vestcl.opencl.session import Session, sessions

_selected: contextvars.ContextVar["use | None"] = contextvars.ContextVar("vestcl_device", default=None)


class use(WithBlock):  # noqa: N801 - reads as a verb, like contextlib.suppress
    """Run vestcl's operators on another device: from here on, or inside a ``with`` block.

    It holds for the thread that calls it; other threads start with the default device (set VESTCL_DEVICE for all).
    Gradients are computed on the device that their forward ran on.

    Args:
        selector: as in `select`.
        mapping: how work is laid out, "tile" (a work-item per tile, for CPUs) or "pixel" (a work-item per pixel, tile
            lists in local memory, for GPUs); None takes what suits the device's type.

    >>> vestcl.use("pocl")  # doctest: +SKIP
    >>> with vestcl.use("nvidia"):  # doctest: +SKIP
    ...     image, coverage = vestcl.splat(...)
    """

    def __init__(self, selector: str | None = None, mapping: str | None = None) -> None:
        if mapping not in (None, "tile", "pixel"):
            raise ValueError(f"`mapping` must be 'tile', 'pixel' or None, got {mapping!r}")
        info = select(selector)
        self.session = open_session(info, mapping or ("tile" if info.kind == "CPU" else "pixel"))
        self._permanent = False
        self._before = _use()
        if self._before is not None and self._before._permanent:
            self._before._before = None  # which a ``with`` block would go back to
        _selected.set(self)

    def __enter__(self) -> Session:
        self._enter()
        self._permanent = False
        _selected.set(self)
        return self.session

    def _leave(self, *_: object) -> None:
        _selected.set(self._before)

    def _holds(self) -> bool:
        """Not where it is for a ``with`` block that an interrupt ended."""
        if self._exit is None:  # no ``with`` statement enters it
            self._permanent = True
        return self._permanent or not self.abandoned


def _use() -> use | None:
    """The last one that holds here."""
    chosen = _selected.get()
    while chosen is not None and not chosen._holds():
        chosen = chosen._before
    return chosen


def current() -> Session:
    """The session that operators run on now; opens the default device on first use."""
    chosen = _use()
    if chosen is not None:
        return chosen.session
    info = select()
    return open_session(info, "tile" if info.kind == "CPU" else "pixel")


@functools.cache
def open_session(info: DeviceInfo, mapping: str) -> Session:
    device = next(device for known, device in all_devices() if known == info)
    if "PoCL" in info.version and (fault := icd.linker_fault() or pocl_cache.ensure().fault):
        raise DeviceError(fault)
    return Session(info, mapping, device)


def free_scratch() -> None:
    """`Session.free_scratch` of every open device; a process that was forked has none."""
    for session in () if was_forked() else tuple(sessions()):
        session.free_scratch()

"""Memory of the operators' outputs: aligned to cache lines, and recycled where it is large."""

import contextlib
import math
import weakref
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from vestcl import constants, opencl

Array = np.ndarray[Any, Any]

#: Blocks taken between two looks at how much was in use at most: some hundred training steps.
_WINDOW: Final = 1024


class _Block:
    """What an output array is a view of; it dies with the last array (or tensor) that shows it."""

    def __init__(self, memory: Array, size: int) -> None:
        self._memory = memory
        start = _to_line(memory)
        self.__array_interface__ = memory[start : start + size].__array_interface__


class _Loan(weakref.ref[_Block]):
    """Notices when a block dies, and has its memory."""

    __slots__ = ("memory",)
    memory: Array


class _HostPool:
    """Recycles large outputs. The C library returns theirs to the system, and the page faults of the next (5 ms for
    the image of a 256 x 832 frame with 32 channels) cost more than the splat. Sizes are rounded up to classes, so that
    outputs of similar sizes share memory. What is kept free grows with what was in use at once lately, so that outputs
    of any size are recycled, and a process holds at most twice what it needed.

    No lock: blocks die anywhere (the garbage collector runs in the middle of a step here), and an interrupt leaves any
    step undone. Every step is a single operation of a dict or a list, which is atomic; a block that gets lost between
    two of them goes back to the system.
    """

    def __init__(self) -> None:
        self._loans: dict[int, _Loan] = {}
        """Blocks in use, by id()."""
        self._returned: list[_Loan] = []
        """Those of them that have died since the last look."""
        self._free: dict[int, list[Array]] = {}
        """By bytes; the size that was asked for most recently is at the end."""
        self._taken = self._used = 0
        self._peaks = (0, 0)
        """Most bytes in use at once, in the last window and in this one."""

    def take(self, size: int) -> _Block:
        """A block of ``size`` bytes."""
        self._collect()
        wanted = size_class(size) + constants.CACHE_LINE
        try:
            memory = self._free[wanted].pop()
        except (KeyError, IndexError):
            memory = np.empty(wanted, np.uint8)
        self._free[wanted] = self._free.pop(wanted, [])
        block = self._lend(memory, size)
        self._note_use()
        self._trim(max(constants.HOST_POOL_BYTES, *self._peaks))
        return block

    def free(self) -> None:
        """Give all that is not in use back to the system."""
        self._collect()
        self._free.clear()
        self._peaks = (0, self._used)

    @property
    def free_bytes(self) -> int:
        """Held, but not in use."""
        self._collect()
        return sum(size * len(blocks) for size, blocks in self._free.copy().items())

    def _lend(self, memory: Array, size: int) -> _Block:
        block = _Block(memory, size)
        loan = _Loan(block, self._returned.append)  # no Python code: an interrupt in it would be lost
        loan.memory = memory
        self._loans[id(loan)] = loan
        self._used += memory.nbytes
        return block

    def _collect(self) -> None:
        """Move what has been returned to what is free."""
        for loan in self._returned[:]:
            if self._loans.pop(id(loan), None) is not None:
                self._used -= loan.memory.nbytes
                self._free.setdefault(loan.memory.nbytes, []).append(loan.memory)
            with contextlib.suppress(ValueError):  # where another thread has removed it
                self._returned.remove(loan)

    def _note_use(self) -> None:
        self._taken += 1
        last, this = self._peaks
        if self._taken % _WINDOW == 0:
            self._used = sum(loan.memory.nbytes for loan in self._loans.copy().values())
            last, this = this, 0
        self._peaks = (last, max(this, self._used))

    def _trim(self, most: int) -> None:
        """Free what was not asked for longest, until at most ``most`` bytes are free."""
        excess = self.free_bytes - most
        for size, blocks in self._free.copy().items():
            while excess > 0 and blocks:
                del blocks[:1]
                excess -= size


def size_class(size: int) -> int:
    """``size`` rounded up to the next of four steps from one power of two to the next, at most a quarter more."""
    step = 1 << max((size - 1).bit_length() - 3, 0)
    return -(-size // step) * step


_host_pool = _HostPool()


def empty(shape: Sequence[int], dtype: np.dtype[Any]) -> Array:
    """An uninitialised array for an operator's output, aligned to cache lines; large ones are recycled."""
    dtype = np.dtype(dtype)
    size = math.prod(shape) * dtype.itemsize
    if size >= constants.HOST_POOL_FROM:
        return np.asarray(_host_pool.take(size)).view(dtype).reshape(shape)
    memory = np.empty(size + constants.CACHE_LINE, np.uint8)
    start = _to_line(memory)
    return memory[start : start + size].view(dtype).reshape(shape)


def _to_line(memory: Array) -> int:
    """Bytes from the start of ``memory`` to its first cache line."""
    address: int = memory.__array_interface__["data"][0]
    return -address % constants.CACHE_LINE


def free_memory() -> None:
    """Give memory that vestcl keeps for its next calls, and that nothing uses now, back to the system.

    That is memory of large outputs (about 512 MiB, or as much as was in use at once lately) and the devices' scratch
    memory. It waits for the operators that other threads run now. The next calls are slower, for they ask for it again.
    """
    _host_pool.free()
    opencl.free_scratch()

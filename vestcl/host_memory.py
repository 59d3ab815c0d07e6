"""Memory of the operators' outputs: aligned to cache lines, and recycled where it is large."""

import collections
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np

from vestcl import constants

Array = np.ndarray[Any, Any]


class _Block:
    """Memory of an output array; it returns to the pool with the last array (or tensor) that shows it."""

    def __init__(self, pool: "_HostPool", memory: Array) -> None:
        self._pool, self._memory = pool, memory
        start = -memory.ctypes.data % constants.CACHE_LINE
        size = memory.nbytes - constants.CACHE_LINE
        self.__array_interface__ = memory[start : start + size].__array_interface__

    def __del__(self) -> None:
        self._pool.give(self._memory)


class _HostPool:
    """Recycles large outputs. The C library returns theirs to the system, and the page faults of the next (5 ms for
    the image of a 256 x 832 frame with 32 channels) cost more than the splat. What is kept free grows with what was in
    use at once, so that outputs of any size are recycled, and a process holds at most twice what it needed."""

    def __init__(self) -> None:
        self._free: collections.deque[Array] = collections.deque()
        self._lock = threading.RLock()
        self._used = self._most_used = 0

    def take(self, size: int) -> _Block:
        with self._lock:
            memory = next((free for free in self._free if free.nbytes == size + constants.CACHE_LINE), None)
            if memory is not None:
                self._free = collections.deque(free for free in self._free if free is not memory)
            self._used += size + constants.CACHE_LINE
            self._most_used = max(self._most_used, self._used)
        return _Block(self, np.empty(size + constants.CACHE_LINE, np.uint8) if memory is None else memory)

    def give(self, memory: Array) -> None:
        with self._lock:
            self._used -= memory.nbytes
            self._free.append(memory)
            while sum(free.nbytes for free in self._free) > max(constants.HOST_POOL_BYTES, self._most_used):
                self._free.popleft()


_host_pool = _HostPool()


def empty(shape: Sequence[int], dtype: np.dtype[Any]) -> Array:
    """An uninitialised array for an operator's output, aligned to cache lines; large ones are recycled."""
    dtype = np.dtype(dtype)
    size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    if size >= constants.HOST_POOL_FROM:
        return np.asarray(_host_pool.take(size)).view(dtype).reshape(shape)
    memory = np.empty(size + constants.CACHE_LINE, np.uint8)
    start = -memory.ctypes.data % constants.CACHE_LINE
    return memory[start : start + size].view(dtype).reshape(shape)

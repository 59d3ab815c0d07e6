"""Recycled memory of large outputs."""

import gc
import random
import threading
import weakref
from typing import Any

import numpy as np
import pytest

import vestcl
from vestcl import constants, opencl
from vestcl.opencl import host_memory

MIB = 1 << 20


@pytest.fixture
def pool(monkeypatch: pytest.MonkeyPatch) -> host_memory._HostPool:
    own = host_memory._HostPool()
    monkeypatch.setattr(host_memory, "_host_pool", own)
    return own


def filled(size: int, value: int) -> np.ndarray:
    array = host_memory.empty((size,), np.dtype(np.uint8))
    array.fill(value)
    return array


def test_size_classes() -> None:
    """Four from one power of two to the next."""
    assert [host_memory.size_class(size) for size in (1, 5, 8, 9, 10, 11, 16, 17, 20, 21, 1024, 1025, 1281)] == [
        1, 5, 8, 10, 10, 12, 16, 20, 20, 24, 1024, 1280, 1536,
    ]  # fmt: skip
    for size in random.Random(0).sample(range(1, 1 << 40), 1000):
        rounded = host_memory.size_class(size)
        assert size <= rounded <= 1.25 * size and host_memory.size_class(rounded) == rounded


@pytest.mark.parametrize("shape", [(3,), (0, 4), (1, 512, 512, 3)])
def test_arrays_are_aligned_and_of_the_shape(pool: host_memory._HostPool, shape: tuple[int, ...]) -> None:
    for dtype in (np.float32, np.float64):
        array = host_memory.empty(shape, np.dtype(dtype))
        assert array.shape == shape and array.dtype == dtype and array.flags.c_contiguous and array.flags.writeable
        assert array.size == 0 or array.ctypes.data % constants.CACHE_LINE == 0


def test_memory_in_use_is_nobody_elses(pool: host_memory._HostPool) -> None:
    rng, held = random.Random(0), {}
    for step in range(500):
        held[rng.randrange(12)] = filled(rng.randrange(MIB // 4, MIB), step % 251), step % 251
        assert all((array == value).all() for array, value in held.values())
    view = held[0][0][7:]
    held.clear()
    value = view[0]
    others = [filled(view.size + 7, 255) for _ in range(3)]
    assert (view == value).all() and len(others) == 3


def test_similar_sizes_are_recycled(pool: host_memory._HostPool) -> None:
    """150 sizes in a cycle, one at a time: memory for a class each, not for a size each."""
    sizes = [MIB + 7001 * i for i in range(150)]
    for _ in range(3):
        for size in sizes:
            filled(size, 1)
    assert pool.free_bytes < 8 * 2.5 * MIB
    array = filled(MIB, 1)
    address = array.ctypes.data
    del array
    assert filled(MIB - 5000, 1).ctypes.data == address


def test_what_is_kept_is_bounded_and_shrinks(pool: host_memory._HostPool, monkeypatch: pytest.MonkeyPatch) -> None:
    """By constants.HOST_POOL_BYTES, or by what was in use at once in the last 1024 to 2048 outputs."""
    monkeypatch.setattr(constants, "HOST_POOL_BYTES", 4 * MIB)
    crowd = [filled(MIB, 1) for _ in range(20)]
    crowd.clear()
    filled(MIB, 1)
    assert 19 * MIB < pool.free_bytes < 21 * MIB, "a step's outputs are there for the next step"
    for size_in_use in range(2 * MIB, 20 * MIB, 2 * MIB):
        host_memory.empty((size_in_use,), np.dtype(np.uint8))
        assert pool.free_bytes < 20 * MIB + size_in_use + MIB
    for _ in range(2100):
        host_memory.empty((MIB // 2,), np.dtype(np.uint8))
    assert pool.free_bytes <= 4.1 * MIB


def test_free_memory_gives_all_back(pool: host_memory._HostPool, session: opencl.Session) -> None:
    with session.job() as job:
        job.scratch(1 << 20, np.uint8)
    kept = filled(MIB, 3)
    filled(MIB, 4)
    assert pool.free_bytes > MIB and session.scratch_bytes >= 1 << 20
    vestcl.free_memory()
    assert pool.free_bytes == 0 and (kept == 3).all()
    assert session.scratch_bytes < 1 << 20
    del kept
    vestcl.free_memory()
    assert pool.free_bytes == 0 and not pool._loans


def test_the_collector_may_run_at_any_moment(pool: host_memory._HostPool) -> None:
    """Outputs that die in cycles, and a finaliser that asks for memory itself, while a thread does the same."""
    failed: list[BaseException] = []

    class Cycle:
        def __init__(self) -> None:
            self.me, self.array = self, filled(MIB // 4 + random.randrange(MIB // 4), 1)
            weakref.finalize(self, filled, MIB // 4, 2)

    def work() -> None:
        try:
            for step in range(400):
                Cycle()
                array = filled(MIB // 4, step % 251)
                assert (array == step % 251).all()
        except BaseException as error:
            failed.append(error)

    before = gc.get_threshold()
    gc.set_threshold(1, 1, 1)
    try:
        threads = [threading.Thread(target=work) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        gc.set_threshold(*before)
    gc.collect()
    assert not failed
    pool.free()
    assert not pool._loans


def test_an_error_in_the_middle_loses_no_memory_in_use(pool: host_memory._HostPool, monkeypatch: Any) -> None:
    """A block whose loan was not noted is not lent out twice."""
    array = filled(MIB, 5)
    monkeypatch.setattr(pool, "_note_use", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        filled(MIB, 6)
    monkeypatch.undo()
    others = [filled(MIB, 7) for _ in range(4)]
    assert (array == 5).all() and len({other.ctypes.data for other in others}) == 4

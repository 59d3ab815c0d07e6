"""Blocks that an interrupt ended, and the lock that they held."""

import threading
import time
from contextlib import ExitStack
from typing import Any

import pytest

from vestcl.opencl.robust_lock import Holder, RobustLock, WithBlock


class Block(Holder):
    def __init__(self, lock: RobustLock) -> None:
        self.lock = lock
        self.left = 0

    def __enter__(self) -> "Block":
        self._enter()
        self.lock.acquire(self)
        return self

    def _leave(self, *_: Any) -> None:
        assert not self.abandoned, "before it has left"
        self.left += 1
        self.lock.release(self)


def abandon(block: WithBlock) -> Any:
    """Enter ``block`` as a ``with`` statement does, and lose its end as an interrupt may."""
    leave = block.__exit__
    entered = block.__enter__()  # type: ignore[attr-defined]
    assert not block.abandoned
    del leave
    assert block.abandoned
    return entered


def takes(lock: RobustLock, seconds: float) -> bool:
    """Whether another thread gets the lock in that time."""

    def work() -> None:
        with Block(lock):
            got.set()

    got = threading.Event()
    threading.Thread(target=work, daemon=True).start()
    return got.wait(seconds)


def test_a_block_knows_whether_it_runs() -> None:
    block = Block(RobustLock())
    assert not block.abandoned
    with block:
        assert block.__exit__ is not None and not block.abandoned, "looking at __exit__ ends nothing"
    assert block.abandoned and block.left == 1
    for _ in range(300):  # Python specialises what it runs often
        with block:
            pass
    block.left = 1
    with pytest.raises(KeyError) as caught, block:
        {}["no such key"]
    assert caught.value.__traceback__ is not None
    assert block.abandoned and block.left == 2, "though the traceback keeps the frames"


def test_a_block_entered_by_hand_ends_by_hand() -> None:
    lock = RobustLock()
    block = Block(lock)
    block.__enter__()
    assert block.__exit__ is not None and not block.abandoned and not takes(lock, 0.2)
    block.__exit__(None, None, None)
    with ExitStack() as stack:
        assert stack.enter_context(other := Block(lock)) is other
        assert not other.abandoned and other.left == 0
    assert other.left == 1 and takes(lock, 5)


def test_one_thread_at_a_time_and_again_in_the_same_one() -> None:
    lock = RobustLock()
    with Block(lock):
        with Block(lock):
            pass
        assert not takes(lock, 0.2)
    assert takes(lock, 5)


def test_an_interrupted_holder_holds_no_more() -> None:
    lock = RobustLock()
    kept = [abandon(Block(lock)) for _ in range(3)]
    with Block(lock):
        assert not takes(lock, 0.2)
    kept.append(abandon(Block(lock)))
    assert takes(lock, 5)
    assert takes(lock, 5) and all(block.left == 0 for block in kept)


def test_a_waiting_thread_continues_when_the_holder_is_interrupted() -> None:
    lock, block = RobustLock(), Block(RobustLock())
    block.lock = lock
    leave = block.__exit__
    block.__enter__()
    got: list[float] = []

    def work() -> None:
        with Block(lock):
            got.append(time.perf_counter())

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    time.sleep(0.1)
    assert not got
    del leave
    for thread in threads:
        thread.join(5)
    assert len(got) == 3


def test_threads_take_turns() -> None:
    """No two at once, nobody left out, and a release wakes the next one at once rather than when it looks again."""
    lock, inside, seen = RobustLock(), [], []

    def work() -> None:
        for _ in range(50):
            with Block(lock):
                inside.append(1)
                seen.append(len(inside))
                time.sleep(0.0005)
                inside.pop()

    threads = [threading.Thread(target=work) for _ in range(4)]
    start = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert seen == [1] * 200
    assert time.perf_counter() - start < 200 * 0.05 / 2

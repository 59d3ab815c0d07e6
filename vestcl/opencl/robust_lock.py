"""A lock that an interrupt can't leave held, and ``with`` blocks that can check whether they still run.

Python raises what a signal handler raises (KeyboardInterrupt) between any two bytecodes: also after ``__enter__`` has
taken a lock but before the ``with`` statement is set up, and at the first bytecode of ``__exit__``, where no ``try``
helps. Like a robust mutex of POSIX, this lock therefore notices that its holder has ended, and the next one takes it.
"""

import contextlib
import functools
import queue
import threading
import weakref
from collections.abc import Callable
from types import TracebackType
from typing import Any, Final

Exit = Callable[[type[BaseException] | None, BaseException | None, TracebackType | None], None]

#: Seconds after which a waiting thread looks whether the holder has ended; a holder that releases wakes it at once.
_POLL: Final = 0.05


class _ExitOfBlock:
    """``__exit__`` of a `WithBlock`.

    A ``with`` statement gets it before it calls ``__enter__``, and holds the only reference, on the stack of its
    frame, until the block has ended in whichever way. So a weak reference to it shows whether the block still runs.
    """

    def __get__(self, block: "WithBlock | None", kind: type["WithBlock"]) -> Exit:
        if block is None:  # contextlib.ExitStack takes it from the class
            return kind._leave  # type: ignore[return-value] # and passes the block
        leave = functools.partial(block._leave)  # not the bound method: Python may unpack and drop it as it calls it
        if block._exit is None or block._exit() is None:
            block._exit = weakref.ref(leave)
        return leave


class WithBlock:
    """Base of context managers. A subclass has ``__enter__``, which calls `_enter` first, and `_leave`."""

    _exit: Callable[[], object] | None = None

    __exit__ = _ExitOfBlock()

    def _enter(self) -> None:
        if self._exit is None or self._exit() is None:  # entered without a ``with`` statement
            self._exit = _by_hand

    def _leave(self, kind: type[BaseException] | None, *_: Any) -> None:
        """What ``__exit__`` does; an interrupt may prevent it."""
        raise NotImplementedError

    @property
    def abandoned(self) -> bool:
        """Whether its ``with`` block ran and runs no more."""
        return self._exit is not None and self._exit() is None


def _by_hand() -> bool:
    return True


class Holder(WithBlock):
    """A ``with`` block that takes a `RobustLock`."""

    #: Thread of the block: threading.get_ident().
    thread = 0
    _turn: "queue.SimpleQueue[None] | None" = None


class RobustLock:
    """One thread at a time, first come first served. All steps are single operations of a list, which are atomic."""

    def __init__(self) -> None:
        self._line: list[Holder] = []
        """The holder, and those who wait; also abandoned ones, which count no more."""

    def acquire(self, holder: Holder) -> None:
        """Wait until no other thread holds the lock. A thread may take again what it holds already."""
        holder.thread = threading.get_ident()
        self._line.append(holder)
        if self._is_held_for(holder):
            return
        holder._turn = queue.SimpleQueue()
        while not self._is_held_for(holder):
            with contextlib.suppress(queue.Empty):
                holder._turn.get(timeout=_POLL)

    def release(self, holder: Holder) -> None:
        """Let the next one have it. The holder's block still runs, so that it is in the line."""
        self._line.remove(holder)
        for first in self._line[:1]:
            if first._turn is not None:
                first._turn.put(None)

    def _is_held_for(self, holder: Holder) -> bool:
        first = self._line[0]
        while first.abandoned:
            with contextlib.suppress(ValueError):  # where another thread has removed it
                self._line.remove(first)
            first = self._line[0]
        return first is holder or first.thread == holder.thread

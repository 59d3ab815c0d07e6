"""Results by frame: computed when asked for, timed, and kept while later frames need them."""

import threading
from collections.abc import Callable
from typing import Any, Final, TypeVar

from vestcl.clock import Clock

#: Results of this many frames before the last one asked for are kept; a forecast looks at three.
_KEPT: Final = 4

Result = TypeVar("Result")


class KeptResults:
    """Results of a clip's frames. Threads may share it; one computes at a time.

    ``seconds`` has the time by stage, each without the stages inside it.

    Args:
        progress: called with the stage that begins.
    """

    def __init__(self, progress: Callable[[str], None] | None = None) -> None:
        self._clock = Clock(exclusive=True)
        self.seconds = self._clock.seconds
        self._progress = progress
        self._kept: dict[tuple[str, int], Any] = {}
        self._lifetimes: dict[tuple[str, int], int] = {}
        self._lock = threading.RLock()

    def once(self, stage: str, index: int, compute: Callable[[], Result], *, lifetime: int = 0) -> Result:
        """``compute``'s result, kept with the frame's others; its time counts as the stage's.

        Args:
            stage: its name in ``seconds``.
            index: the frame.
            compute: called if the result is not there.
            lifetime: frames that the result is kept for, if more than usual.
        """
        with self._lock:
            if self._progress and (stage, index) not in self._kept:
                self._progress(stage)
            result = self._part(stage, index, compute, stage)
            self._lifetimes.setdefault((stage, index), max(lifetime, _KEPT))
            return result

    def _part(self, name: str, index: int, compute: Callable[[], Result], stage: str = "layers") -> Result:
        """As `once`, of a part of a stage."""
        key = (name, index)
        with self._lock:
            if key not in self._kept:
                with self._clock.time(stage):
                    self._kept[key] = compute()
                self._forget(index)
            result: Result = self._kept[key]
            return result

    def _untimed(self, name: str, index: int, compute: Callable[[], Result]) -> Result:
        """As `once`, of something whose time is that of the stage around it."""
        key = (name, index)
        with self._lock:
            if key not in self._kept:
                self._kept[key] = compute()
            result: Result = self._kept[key]
            return result

    def forget_all(self) -> None:
        """Drop all results; they are computed again when asked for."""
        with self._lock:
            self._kept.clear()
            self._lifetimes.clear()

    def _forget(self, index: int) -> None:
        """Drop what frame ``index`` and those after it no longer need."""
        for key in list(self._kept):
            lifetime = self._lifetimes.get(key, _KEPT)
            if not index - lifetime < key[1] <= index + lifetime:
                del self._kept[key]
                self._lifetimes.pop(key, None)

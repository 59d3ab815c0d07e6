"""The frames that were encoded last, found again by their content and under the same weights and settings."""

import threading
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import torch

from vestcl.models.steps.frames import EncodedFrame
from vestcl.scene.layers import LayerBatch

#: Frames that are kept for each thread: the next step's two inputs.
_REMEMBERED: Final = 2

#: Frames that are kept for all threads together, those that ended, too: at 256 x 832 a frame takes some 30 MB.
_MOST: Final = 8

#: Every this many rows and columns are compared before all are: of two frames a few pixels already differ.
_SOME: Final = 16


class State:
    """What features depend on besides the frame; `EncodedFrames.state` gives one object for equal weights and settings.

    Args:
        settings: compared by ``==``.
        weights: are copied.
    """

    def __init__(self, settings: object, weights: Iterable[torch.Tensor]) -> None:
        self._settings, self._weights = settings, _copies(weights)

    def equals(self, settings: object, weights: Sequence[torch.Tensor]) -> bool:
        """Whether all settings and all weights are as they were."""
        if settings != self._settings or len(weights) != len(self._weights):
            return False
        return all(map(_same_weights, self._weights, weights))


class _Remembered(NamedTuple):
    state: State
    layers: LayerBatch
    """Copies."""
    encoded: EncodedFrame
    """Its ``layers`` are ``layers``."""
    thread: int


class EncodedFrames:
    """The last frames that were encoded, for when they come again.

    Content decides: a frame is known if every number of its layers and of the weights is as it was, wherever they lie
    in memory. So all of them are copied when a frame is kept: callers may overwrite their buffers, and weights may
    change in any way. Threads share what is kept, and each has space for the two frames of its next step. A copy of a
    model (``copy.deepcopy``, pickle) begins with an empty memory.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._frames: tuple[_Remembered, ...] = ()
        self._latest: State | None = None

    def __reduce__(self) -> tuple[type["EncodedFrames"], tuple[()]]:
        return EncodedFrames, ()

    def copy(self) -> "EncodedFrames":
        """Another memory of the same frames."""
        other = EncodedFrames()
        with self._lock:
            other._frames, other._latest = self._frames, self._latest
        return other

    def state(self, settings: object, weights: Sequence[torch.Tensor]) -> State:
        """The state of the kept frames that has these settings and weights, or else a new one.

        Args:
            settings: whatever changes features apart from the weights.
            weights: parameters and buffers; compared with the copies that were made of them.
        """
        with self._lock:
            known = dict.fromkeys([self._latest, *(one.state for one in reversed(self._frames))])
            equal = (state for state in known if state is not None and state.equals(settings, weights))
            self._latest = next(equal, None) or State(settings, weights)
            return self._latest

    def find(self, state: State, layers: LayerBatch) -> EncodedFrame | None:
        """What ``layers`` were encoded to under ``state``, with the copies for its ``layers``; None if not known."""
        for one in self._frames:
            if one.state is state and all(map(_same, one.layers, layers)):
                return one.encoded
        return None

    def keep(self, state: State, layers: LayerBatch, encoded: EncodedFrame) -> None:
        """Keep a copy of ``layers`` and what they were encoded to, in place of the thread's oldest frame."""
        copies = LayerBatch(*_copies(layers))
        new = _Remembered(state, copies, encoded._replace(layers=copies), threading.get_ident())
        with self._lock:
            self._frames = _newest([*self._frames, new])


def _newest(frames: list[_Remembered]) -> tuple[_Remembered, ...]:
    """Without what is too much for the last one's thread, and for all together."""
    surplus = [one for one in frames if one.thread == frames[-1].thread][:-_REMEMBERED]
    return tuple(one for one in frames if not any(one is old for old in surplus))[-_MOST:]


def _copies(tensors: Iterable[torch.Tensor]) -> list[torch.Tensor]:
    return [tensor.detach().clone() for tensor in tensors]


def _similar(one: torch.Tensor, other: torch.Tensor) -> bool:
    return one.dtype == other.dtype and one.device == other.device and one.shape == other.shape


def _same_weights(one: torch.Tensor, other: torch.Tensor) -> bool:
    return _similar(one, other) and torch.equal(one, other)


def _same(one: torch.Tensor, other: torch.Tensor) -> bool:
    if not _similar(one, other):
        return False
    some = one[..., ::_SOME, ::_SOME], other[..., ::_SOME, ::_SOME]
    return torch.equal(*some) and torch.equal(one, other)

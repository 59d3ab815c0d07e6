"""Video files, read through FFmpeg (PyAV): any frame by its number, with its time, as it is meant to be displayed."""

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from vestcl.io.video.decoder import KEPT, Decoder
from vestcl.io.video.packets import list_frames, orientation, oriented
from vestcl.times import median_interval

#: What a forked child inherits of open videos. Its state is the parent's at any moment, so that it is not even closed.
_ABANDONED: Final[list[Decoder]] = []


class Video:
    """A video's frames by number, [H, W, 3] uint8 RGB, turned as the file's display matrix requires.

    Frames are counted by reading the file's packets, so the count is what is there, whatever the header claims. A frame
    is decoded from the key frame before it on; going forward is quick. Threads may share a video; pickled, or in a
    forked child, it opens the file for itself.
    """

    path: Path
    frames: int
    """Number of frames that are shown: without those that an edit list cuts or that precede the first key frame."""
    seconds: NDArray[np.float64]
    """[frames] presentation times since the first frame, increasing."""
    fps: float
    """1 / the median interval; of one frame, the header's rate, or 1."""
    height: int
    width: int
    pixel_aspect: float
    """Width of a pixel over its height, as displayed."""

    def __init__(self, path: str | Path) -> None:
        """Open ``path``.

        Raises:
            ValueError: no such file, not a video that FFmpeg can decode, frames of an absurd size, or turned by another
                angle than multiples of 90 degrees.
        """
        self.path = Path(path)
        listed = list_frames(self.path)
        decoder = Decoder(self.path, listed)
        self._orient(decoder)
        self._list = listed.part(decoder.readable())
        self.frames, self.seconds = len(self._list.pts), self._list.seconds
        rate = decoder.stream.average_rate or 1
        interval = median_interval(self.seconds)
        self._keeps = KEPT
        self.fps = float(rate) if interval is None else round(1 / interval, 6)
        self._open()

    def keep(self, frames: int) -> None:
        """Keep at least this many decoded frames: reading may go back that far without decoding again."""
        self._keeps = max(self._keeps, frames)
        self._decoder.keeps = self._keeps

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        """Frame ``index``, counted from 0; negative from the end.

        Raises:
            IndexError: there is no such frame.
            ValueError: the file is damaged there, or the frame has another size than the first.
        """
        if not -self.frames <= index < self.frames:
            raise IndexError(f"{self.path}: has frames 0 ... {self.frames - 1}, not {index}")
        if self._pid != os.getpid():  # forked: the parent continues reading through what it has open
            self._open()
        with self._lock:
            decoded = self._decoder.frame(index % self.frames).to_ndarray(format="rgb24", threads=1)  # none to fork
            pixels = oriented(cast("NDArray[np.uint8]", decoded), self._turned)
        if pixels.shape != (self.height, self.width, 3):
            size = f"{self.height} x {self.width}"
            raise ValueError(f"{self.path}: frame {index} is {pixels.shape[0]} x {pixels.shape[1]}, the first {size}")
        return pixels

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        for index in range(self.frames):
            yield self[index]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_decoder", "_lock", "_pid")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._open()

    def _open(self) -> None:
        if "_decoder" in vars(self):
            _ABANDONED.append(self._decoder)
        self._decoder: Decoder = Decoder(self.path, self._list)
        self._decoder.keeps = self._keeps
        self._lock, self._pid = threading.Lock(), os.getpid()

    def _orient(self, decoder: Decoder) -> None:
        """Size and shape of pixels, as displayed."""
        try:
            self._turned = orientation(decoder.first)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from None
        self.height, self.width = decoder.first.height, decoder.first.width
        self.pixel_aspect = float(decoder.stream.sample_aspect_ratio or 1)
        if self._turned[0, 0] == 0:
            self.height, self.width, self.pixel_aspect = self.width, self.height, 1 / self.pixel_aspect

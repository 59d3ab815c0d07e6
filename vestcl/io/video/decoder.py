"""One open video file: its frames by number, decoded from the key frame before them."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from vestcl.io.video.packets import Frames, explained, open_stream

#: Decoded frames that are kept: a window of context and future frames slides without decoding twice.
KEPT: Final = 16


class Decoder:
    """Decoded frames of a video, for one thread at a time."""

    stream: VideoStream
    first: VideoFrame
    """The first frame that can be decoded."""
    keeps: int
    """Decoded frames that are kept."""

    def __init__(self, path: Path, frames: Frames) -> None:
        """Open ``path`` at its beginning.

        Raises:
            ValueError: it can't be opened, or no frame of it can be decoded.
        """
        self._path, self._frames, self.keeps = path, frames, KEPT
        self._open()
        first = next(self._decoded, None)
        if first is None:
            raise ValueError(f"{path}: has no frame that FFmpeg can decode")
        self.first = first
        self._open()

    def frame(self, index: int) -> VideoFrame:
        """Frame ``index`` of the list: a kept one, or by continuing to decode, or from the key frame before it.

        Raises:
            ValueError: the file is damaged there.
        """
        if index in self._kept or (self._is_ahead(index) and self._decode_to(index)):
            return self._kept[index]
        key = self._key(index)
        found = any(self._decode_from(each, index) for each in dict.fromkeys((key, max(key - 1, 0))))
        if not found and self._began > index:  # in this file key frames are found too late
            found = self._decode_from(0, index)
        if not found:
            raise ValueError(f"{self._path}: is damaged: frame {index} can't be decoded")
        return self._kept[index]

    def readable(self) -> slice:
        """The part of the list from the first frame that can be decoded, and, if ``suspect``, to the last one."""
        start = 0 if self._frames.counted else int(np.searchsorted(self._frames.pts, self.first.pts or 0))
        stop = len(self._frames.pts)
        if self._frames.suspect:
            key = self._key(stop - 1)
            self._restart(key)
            decoded = {number for number, frame in self._numbered() if not frame.is_corrupt}
            begin = max(start, self._number(key))
            stop = next((number for number in range(begin, stop) if number not in decoded), stop)
        return slice(start, max(stop, start + 1))

    def _open(self) -> None:
        self._container, self.stream = open_stream(self._path)
        self._begin(0)

    def _begin(self, floor: int) -> None:
        """At a key frame: what is decoded with a lower number than ``floor`` refers to what was not read."""
        self._decoded = _decode(self._container, self.stream)
        self._kept: dict[int, VideoFrame] = {}
        self._floor, self._last, self._began, self._count = floor, -1, -1, 0

    def _key(self, index: int) -> int:
        """The last key frame that is shown with frame ``index`` or before it."""
        pts = self._frames.pts[index]
        return max(int(np.searchsorted(self._frames.keys[:, 0], pts, side="right")) - 1, 0)

    def _is_ahead(self, index: int) -> bool:
        """Whether continuing to decode reaches frame ``index`` sooner than going to a key frame."""
        return self._last < index and (index - self._last <= self.keeps or self._number(self._key(index)) <= self._last)

    def _number(self, key: int) -> int:
        """Number of the key frame in the list; 0 for the first."""
        return int(np.searchsorted(self._frames.pts, self._frames.keys[key, 0])) if key else 0

    def _decode_from(self, key: int, index: int) -> bool:
        """Whether ``index`` was found from the key frame on."""
        self._restart(key)
        return self._decode_to(index)

    def _restart(self, key: int) -> None:
        """Go to a key frame."""
        if key == 0:
            self._open()
            return
        with explained(self._path):
            self._container.seek(int(self._frames.keys[key, 1]), stream=self.stream)
        self._begin(self._number(key))

    def _decode_to(self, index: int) -> bool:
        """Decode on to frame ``index``; False if a later one comes, or the end."""
        for number, frame in self._numbered():
            if number > index - self.keeps:
                self._kept[number] = frame
            for old in [kept for kept in self._kept if kept <= number - self.keeps]:
                del self._kept[old]
            if number >= index:
                return number == index
        return False

    def _numbered(self) -> Iterator[tuple[int, VideoFrame]]:
        """Frames of the list from where the file is, with their numbers."""
        for frame in self._decoded:
            number = self._count if self._frames.counted else self._found(frame.pts)
            self._count += 1
            if number is not None and self._floor <= number < len(self._frames.pts):
                self._began = number if self._began < 0 else self._began
                self._last = number
                yield number, frame

    def _found(self, pts: int | None) -> int | None:
        """Number of the frame that is shown at ``pts``."""
        if pts is None:
            return None
        number = int(np.searchsorted(self._frames.pts, pts))
        return number if number < len(self._frames.pts) and self._frames.pts[number] == pts else None


def _decode(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    """Frames from where the container is on; packets that can't be decoded are skipped."""
    with contextlib.suppress(av.FFmpegError):
        for packet in container.demux(stream):
            if not packet.size:
                break
            with contextlib.suppress(av.FFmpegError):
                yield from packet.decode()
    with contextlib.suppress(av.FFmpegError, EOFError):
        yield from stream.decode(None)

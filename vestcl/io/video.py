"""Video files through OpenCV's ffmpeg, and animated GIF through Pillow."""

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vestcl.io.atomic import replacing

#: Decoded frames that a `Video` keeps: a window of context and future frames slides without decoding anew.
KEPT: Final = 16

#: OpenCV's name of the codec that every build of its wheel can write, quickly; "vp09" plays in browsers, too, is
#: better, and takes 40 times as long.
CODEC: Final = "mp4v"

#: GIF counts in hundredths of a second, and players slow down anything below two of them.
_GIF_STEP_MS: Final = 10
_GIF_SHORTEST_MS: Final = 20


class Video:
    """A video's frames by index, [H, W, 3] uint8 RGB. Going forward is quick; going far back decodes from the start.

    Frames are counted, never sought: seeking is off by some frames in many files. It can be pickled (each process
    opens the file for itself) but not shared by threads.
    """

    path: Path
    frames: int
    """As the file's header tells, or counted where it does not tell."""
    fps: float
    """Frames a second."""
    height: int
    width: int

    def __init__(self, path: str | Path) -> None:
        """Open ``path``.

        Raises:
            ValueError: no such file, or OpenCV can't decode it.
        """
        self.path = Path(path)
        self._restart()
        self.fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.frames = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"{path}: does not tell its frames a second")
        first = self._decode()
        if first is None:
            raise ValueError(f"{path}: has no frame that OpenCV can decode")
        self.height, self.width = first.shape[:2]
        if self.frames <= 0:
            self.frames = 1
            while self._capture.grab():
                self.frames += 1
            self._restart()

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        """Frame ``index``, counted from 0; negative from the end.

        Raises:
            IndexError: there is no such frame.
            ValueError: the file ends before it, although its header tells otherwise.
        """
        if not -self.frames <= index < self.frames:
            raise IndexError(f"{self.path}: has frames 0 ... {self.frames - 1}, not {index}")
        index %= self.frames
        if index not in self._kept:
            if index < self._next:
                self._restart()
            if self._next < index - KEPT:
                self._kept.clear()
            while self._next < index - KEPT and self._capture.grab():
                self._next += 1
            while self._next <= index:
                if self._decode() is None:
                    raise ValueError(f"{self.path}: ends after {self._next} frames; its header tells of {self.frames}")
        return self._kept[index].copy()

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        for index in range(self.frames):
            yield self[index]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("_capture", "_kept", "_next")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._restart()

    def _restart(self) -> None:
        if not self.path.is_file():
            raise ValueError(f"{self.path}: no such file")
        self._capture = cv2.VideoCapture(str(self.path))
        if not self._capture.isOpened():
            raise ValueError(f"{self.path}: OpenCV can't open it: no video, or a codec that this build lacks")
        self._kept: dict[int, NDArray[np.uint8]] = {}
        self._next = 0

    def _decode(self) -> NDArray[np.uint8] | None:
        decoded, frame = self._capture.read()
        if not decoded:
            return None
        rgb = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        self._kept[self._next] = rgb
        self._kept.pop(self._next - KEPT, None)
        self._next += 1
        return rgb


def write_mp4(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float, codec: str = CODEC) -> None:
    """Write an MP4, atomically. An odd width or height is made even by repeating the last column or row.

    Args:
        path: ends in .mp4.
        frames: [H, W, 3] uint8 RGB, all of one size, at least one.
        fps: frames a second.
        codec: four letters for OpenCV.

    Raises:
        ValueError: another suffix or rate, no frame or one of another shape, or a codec that OpenCV lacks.
    """
    if Path(path).suffix.lower() != ".mp4":
        raise ValueError(f"{path}: must end in .mp4")
    if len(codec) != 4:
        raise ValueError(f"`codec` must be four letters, got {codec!r}")
    first, checked = _checked(frames, fps)
    height, width = (size + size % 2 for size in first.shape[:2])
    with replacing(path) as temporary:
        fourcc = cv2.VideoWriter.fourcc(*codec)
        writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, fourcc, float(fps), (width, height))
        try:
            if not writer.isOpened():
                raise ValueError(f"{path}: this OpenCV can't write codec {codec!r} to MP4; try 'mp4v' or 'vp09'")
            for frame in checked:
                even = np.pad(frame, ((0, height - len(frame)), (0, width - frame.shape[1]), (0, 0)), "edge")
                writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))
        finally:
            writer.release()


def write_gif(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write an endlessly repeated GIF of 256 colours a frame, atomically.

    Args:
        path: ends in .gif.
        frames: [H, W, 3] uint8 RGB, all of one size, at least one.
        fps: frames a second; the time of a frame is rounded to 10 ms and at least 20 ms.

    Raises:
        ValueError: another suffix or rate, no frame or one of another shape.
    """
    if Path(path).suffix.lower() != ".gif":
        raise ValueError(f"{path}: must end in .gif")
    _, checked = _checked(frames, fps)
    duration = max(_GIF_STEP_MS * round(1000 / fps / _GIF_STEP_MS), _GIF_SHORTEST_MS)
    pictures = (Image.fromarray(frame).quantize(256) for frame in checked)
    first = next(pictures)
    with replacing(path) as temporary:
        first.save(temporary, save_all=True, append_images=pictures, duration=duration, loop=0)


def _checked(frames: Iterable[NDArray[np.uint8]], fps: float) -> tuple[NDArray[np.uint8], Iterator[NDArray[np.uint8]]]:
    """The first frame, and all of them, each held against its shape as it passes."""
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"`fps` must be positive, got {fps}")
    remaining = iter(frames)
    first = next(remaining, None)
    if first is None:
        raise ValueError("`frames` must have at least one frame")
    if first.dtype != np.uint8 or first.ndim != 3 or first.shape[2] != 3 or not first.size:
        raise ValueError(f"`frames` must be [H, W, 3] uint8, got {first.dtype} {list(first.shape)}")

    def check(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if frame.shape != first.shape or frame.dtype != first.dtype:
            raise ValueError(f"`frames` must all be {list(first.shape)} uint8, got {frame.dtype} {list(frame.shape)}")
        return frame

    return first, map(check, itertools.chain([first], remaining))

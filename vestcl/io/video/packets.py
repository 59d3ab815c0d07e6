"""Information from a video's packets, without decoding: which frames there are, when each is shown, where the keys are.

A header's count and rate are claims; packets are what is there. Reading all of them takes half a second per hour of
video, since their content is not looked at.
"""

import contextlib
import os
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, NamedTuple

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from numpy.typing import NDArray

#: Pixels of the largest frame that is decoded: 16384 x 8192. A damaged header can claim any size, and decoders allocate
#: what it claims.
MOST_PIXELS: Final = 1 << 27

#: The file itself is read, and nothing that it refers to: a playlist could name files and addresses.
_PROTOCOLS: Final = "fd"

#: Containers without presentation times: what FFmpeg makes up for reordered frames is wrong.
_WITHOUT_TIMES: Final = ("avi",)


class Frames(NamedTuple):
    """The frames of a video in the order of presentation, [n]."""

    pts: NDArray[np.int64]
    """Presentation time in units of ``time_base``, increasing; the frame's number where ``counted``."""
    seconds: NDArray[np.float64]
    """Since the first frame, increasing."""
    keys: NDArray[np.int64]
    """[k, 2] presentation time of the frames at which decoding can start, and where to seek for it; the first is where
    the video begins."""
    counted: bool
    """The file has no presentation times for its frames: they are decoded from the start and counted."""
    suspect: bool
    """The file ends early: whether its last frames can be decoded is not known."""

    def part(self, which: slice) -> "Frames":
        """Some of the frames; where decoding can start stays."""
        seconds = self.seconds[which]
        return self._replace(pts=self.pts[which], seconds=seconds - seconds[0])


@contextlib.contextmanager
def explained(path: Path) -> Iterator[None]:
    """FFmpeg's errors as ValueError with the file's name."""
    try:
        yield
    except (av.FFmpegError, OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise ValueError(f"{path}: is not a video that FFmpeg can read ({why})") from error


def open_stream(path: Path) -> tuple[InputContainer, VideoStream]:
    """The file's container and its video stream.

    Raises:
        ValueError: no such file, no video, or frames larger than MOST_PIXELS.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    with explained(path):
        descriptor = os.open(path, os.O_RDONLY)  # FFmpeg takes no names but in UTF-8, and sees options and URLs in some
        try:
            options = {"fd": str(descriptor), "protocol_whitelist": _PROTOCOLS}
            container = av.open("fd:", options=options)  # which duplicates the descriptor
        finally:
            os.close(descriptor)
        stream = container.streams.best("video")
    if not isinstance(stream, VideoStream) or stream.codec_context is None:
        raise ValueError(f"{path}: has no video stream that FFmpeg can decode")
    if stream.codec_context.width * stream.codec_context.height > MOST_PIXELS:
        size = f"{stream.codec_context.height} x {stream.codec_context.width}"
        raise ValueError(f"{path}: its header claims frames of {size} px; at most {MOST_PIXELS} pixels are decoded")
    # No threads of the decoder's own: they would not be there in a forked child, which would wait for them.
    stream.codec_context.thread_count = 1
    stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}
    return container, stream


def list_frames(path: Path) -> Frames:
    """Read all of the file's packets.

    Raises:
        ValueError: as `open_stream`, or the file has no frame.
    """
    container, stream = open_stream(path)
    with contextlib.closing(container):
        packets, suspect = _packets(container, stream)
        starts = np.flatnonzero([packet.key for packet in packets])
        packets = packets[starts[0] :] if len(starts) else packets  # what comes before can't be decoded
        if stream.codec_context.name == "h264":
            packets = _without_leading(packets)
        if not any(packet.shown for packet in packets):
            raise ValueError(f"{path}: has no frame")
        time_base = stream.time_base or Fraction(1, 1)
        reordered = container.format.name in _WITHOUT_TIMES and stream.codec_context.has_b_frames
        if reordered or any(packet.pts is None for packet in packets):
            return _counted(packets, time_base, stream.average_rate or stream.guessed_rate, suspect)
        return _timed(packets, time_base, suspect)


class _Packet(NamedTuple):
    pts: int | None
    dts: int | None
    key: bool
    shown: bool
    """Not one that an edit list cuts away: it is only there so that others can be decoded."""


def _packets(container: InputContainer, stream: VideoStream) -> tuple[list[_Packet], bool]:
    """Those with content, in the file's order, and whether the file is cut off or damaged."""
    packets, broken = list[_Packet](), False
    try:
        for packet in container.demux(stream):
            if packet.size:
                broken |= packet.is_corrupt
                packets.append(_Packet(packet.pts, packet.dts, packet.is_keyframe, not packet.is_discard))
    except av.FFmpegError:  # what was read until here is there
        broken = True
    return packets, broken or len(packets) < stream.frames


def _without_leading(packets: list[_Packet]) -> list[_Packet]:
    """Without those shown before the first key frame: in H.264 they refer to frames before it."""
    start = packets[0].pts if packets else None
    return [packet for packet in packets if start is None or packet.pts is None or packet.pts >= start]


def _timed(packets: list[_Packet], time_base: Fraction, suspect: bool) -> Frames:
    pts = np.unique(np.array([packet.pts for packet in packets if packet.shown], np.int64))
    found = sorted((packet.pts, packet.pts if packet.dts is None else packet.dts) for packet in packets if packet.key)
    keys = found or [(int(pts[0]), int(pts[0]))]
    seconds = (pts - pts[0]).astype(np.float64) * float(time_base)
    return Frames(pts, seconds, np.array(keys, np.int64), counted=False, suspect=suspect)


def _counted(packets: list[_Packet], time_base: Fraction, rate: Fraction | None, suspect: bool) -> Frames:
    """Decoding times are those of presentation but for a constant delay, once in order."""
    count = sum(packet.shown for packet in packets)
    numbers = np.arange(count, dtype=np.int64)
    times = [packet.dts for packet in packets if packet.shown and packet.dts is not None]
    if len(set(times)) == count:
        ticks = np.sort(np.array(times, np.int64))
        seconds = (ticks - ticks[0]).astype(np.float64) * float(time_base)
    else:
        seconds = numbers / float(rate or 1)
    return Frames(numbers, seconds, np.zeros((1, 2), np.int64), counted=True, suspect=suspect)


def orientation(frame: VideoFrame) -> NDArray[np.int64]:
    """[2, 2]: where the display matrix takes a step to the right and one down; identity where there is none.

    Raises:
        ValueError: it turns by something else than multiples of 90 degrees.
    """
    side_data: Any = frame.side_data
    data = next((one for one in side_data if one.type.name == "DISPLAYMATRIX"), None)
    if data is None:
        return np.eye(2, dtype=np.int64)
    matrix = np.frombuffer(bytes(data), np.int32)[:9].reshape(3, 3)[:2, :2] / 65536
    turned = matrix.round().astype(np.int64)
    if np.abs(matrix - turned).max() > 0.01 or abs(round(np.linalg.det(turned))) != 1 or np.abs(turned).sum() != 2:
        raise ValueError(f"is displayed through the matrix {matrix.round(3).tolist()}; only quarter turns are read")
    return turned


def oriented(pixels: NDArray[np.uint8], turned: NDArray[np.int64]) -> NDArray[np.uint8]:
    """[H, W, 3] as it is displayed: a step to the right in ``pixels`` is one by turned[0] = (right, down) there."""
    if turned[0, 0] == 0:
        pixels, turned = pixels.transpose(1, 0, 2), turned[::-1]
    return np.ascontiguousarray(pixels[:: int(turned[1, 1]), :: int(turned[0, 0])])

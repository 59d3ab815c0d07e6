"""Videos written: MP4 with H.264 through FFmpeg (PyAV), and animated GIF through Pillow."""

import errno
import functools
import itertools
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Final

import av
import numpy as np
from av.codec.codec import UnknownCodecError
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream
from numpy.typing import NDArray
from PIL import Image

from vestcl.io.atomic import replacing
from vestcl.io.video.reading import Video

#: FFmpeg's encoders, best first, with their options. The first two write H.264, which browsers play; every build of
#: FFmpeg has the last one. CRF 18 is visually lossless.
ENCODERS: Final[dict[str, dict[str, str]]] = {
    "libx264": {"preset": "veryfast", "crf": "18"},
    "libopenh264": {"rc_mode": "quality", "qmin": "10", "qmax": "24"},
    "mpeg4": {"qscale": "3"},
}

#: What FFmpeg calls the format that all players know.
_PIXELS: Final = "yuv420p"

#: The index comes before the frames, so that a browser plays while it loads.
_FASTSTART: Final = {"movflags": "+faststart"}

#: The largest denominator of a rate: 24000/1001 is kept as it is.
_RATE: Final = 1001

#: The largest denominator of a pixel's aspect.
_ASPECT: Final = 100

#: BT.601 with limited range, which FFmpeg converts RGB to; without the tag, players take BT.709 for large frames.
_COLOUR: Final = (int(Colorspace.ITU601), int(ColorRange.MPEG))

#: GIF counts in hundredths of a second, and players slow down anything below two of them.
_GIF_STEP_MS: Final = 10
_GIF_SHORTEST_MS: Final = 20


@functools.cache
def encoder() -> str:
    """The first of ENCODERS that this FFmpeg has.

    Raises:
        ValueError: it has none of them.
    """
    for name in ENCODERS:
        try:
            av.Codec(name, "w")
        except UnknownCodecError:
            continue
        return name
    raise ValueError(f"this FFmpeg has no encoder for MP4: none of {', '.join(ENCODERS)}")


def encoder_note() -> str | None:
    """A line for the user where videos are not H.264, and so do not play in browsers; else None."""
    if encoder() != "mpeg4":
        return None
    return "videos are MPEG-4 Part 2, which browsers do not play: this PyAV has no H.264 encoder (libx264, libopenh264)"


def write_mp4(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float, *, pixel_aspect: float = 1.0) -> None:
    """Write an MP4, atomically: H.264 (yuv420p, index first) where `encoder` has it.

    An odd width or height is made even by repeating the last column or row. What was written is read again and counted
    before it takes the place of ``path``.

    Args:
        path: ends in .mp4.
        frames: [H, W, 3] uint8 RGB, all of one size, at least one.
        fps: frames per second.
        pixel_aspect: width of a pixel over its height, by which players stretch the frames.

    Raises:
        ValueError: another suffix or rate, no frame or one of another shape, or no encoder.
        OSError: it can't be written, because the disk is full; nothing is left of it.
    """
    if Path(path).suffix.lower() != ".mp4":
        raise ValueError(f"{path}: must end in .mp4")
    first, checked = _checked(frames, fps)
    height, width = (size + size % 2 for size in first.shape[:2])
    with replacing(path) as temporary, _explained(Path(path)):
        with _in_utf8(temporary) as name:
            count = _encode(name, checked, (height, width), fps, pixel_aspect)
        _check_written(temporary, count, height, width)


def _encode(
    name: str, frames: Iterator[NDArray[np.uint8]], size: tuple[int, int], fps: float, pixel_aspect: float
) -> int:
    """Write the file; returns how many frames."""
    count, (height, width) = 0, size
    with av.open(name, "w", format="mp4", options=_FASTSTART) as container:
        stream = container.add_stream(encoder(), Fraction(fps).limit_denominator(_RATE), ENCODERS[encoder()])
        assert isinstance(stream, VideoStream)
        stream.height, stream.width, stream.pix_fmt = height, width, _PIXELS
        stream.codec_context.sample_aspect_ratio = Fraction(pixel_aspect).limit_denominator(_ASPECT)
        stream.codec_context.colorspace, stream.codec_context.color_range = _COLOUR
        for frame in frames:
            even = np.pad(frame, ((0, height - len(frame)), (0, width - frame.shape[1]), (0, 0)), "edge")
            container.mux(stream.encode(VideoFrame.from_ndarray(even, format="rgb24")))
            count += 1
        container.mux(stream.encode(None))
    return count


def _check_written(path: Path, count: int, height: int, width: int) -> None:
    """FFmpeg does not report every failed write."""
    try:
        written = Video(path)
    except ValueError as error:
        raise OSError(errno.EIO, f"what was written can't be read ({error})") from error
    got = len(written), written.height, written.width
    if got != (count, height, width):
        raise OSError(
            errno.EIO, f"{count} frames of {height} x {width} were written, {got[0]} of {got[1]} x {got[2]} read"
        )


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """FFmpeg's errors of the disk as OSError with the file's name, others as ValueError."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, f"can't be written: {os.strerror(error.errno or errno.EIO)}", str(path)) from error
    except av.FFmpegError as error:
        raise ValueError(f"{path}: can't be encoded ({error})") from error


@contextmanager
def _in_utf8(path: Path) -> Iterator[str]:
    """A name of ``path`` that FFmpeg takes, which must be UTF-8: in other folders by the folder's descriptor."""
    try:
        str(path).encode("utf-8")
        yield f"file:{path}"
        return
    except UnicodeEncodeError:
        pass
    folder = os.open(path.parent, os.O_RDONLY)
    plain = f"/proc/self/fd/{folder}/.{os.getpid()}-{id(path)}{path.suffix}"
    try:
        yield f"file:{plain}"
        Path(plain).replace(path)
    finally:
        Path(plain).unlink(missing_ok=True)
        os.close(folder)


def write_gif(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write an endlessly repeated GIF of 256 colours per frame, atomically.

    Args:
        path: ends in .gif.
        frames: [H, W, 3] uint8 RGB, all of one size, at least one.
        fps: frames per second; the time per frame is rounded to 10 ms and at least 20 ms.

    Raises:
        ValueError: another suffix or rate, no frame or one of another shape.
    """
    if Path(path).suffix.lower() != ".gif":
        raise ValueError(f"{path}: must end in .gif")
    _, checked = _checked(frames, fps)
    duration = max(_GIF_STEP_MS * round(1000 / fps / _GIF_STEP_MS), _GIF_SHORTEST_MS)
    images = (Image.fromarray(frame).quantize(256) for frame in checked)
    first = next(images)
    with replacing(path) as temporary:
        first.save(temporary, save_all=True, append_images=images, duration=duration, loop=0)


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

"""Videos as recorders and cutters leave them: uneven times, B frames, edit lists, rotation, oblong pixels."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

#: Ticks per second of presentation times.
TICKS = 1000

#: Three B frames in a row, and groups of images whose first frames refer to the group before.
REORDERED = {"bf": "3", "x264-params": "open-gop=1:b-pyramid=normal:b-adapt=0:scenecut=0"}


def flat(count: int, height: int = 32, width: int = 48) -> list[np.ndarray]:
    """Flat frames, each of a colour that differs from its neighbours' after lossy coding."""
    return [np.full((height, width, 3), (40 + 8 * i, 200 - 6 * i, 90), np.uint8) for i in range(count)]


def index_of(frame: np.ndarray) -> int:
    """Which of `flat` it is."""
    return round((float(frame[..., 0].mean()) - 40) / 8)


def write_video(
    path: Path,
    frames: Sequence[np.ndarray],
    seconds: Sequence[float] | None = None,
    *,
    codec: str = "libx264",
    gop: int = 12,
    aspect: Fraction | None = None,
    degrees: int = 0,
    hflip: bool = False,
    options: dict[str, str] | None = None,
) -> Path:
    """A video by PyAV.

    Args:
        path: its suffix is the container.
        frames: [H, W, 3] uint8 RGB.
        seconds: presentation time of each; evenly at 10 Hz where there are none.
        codec: FFmpeg's name of the encoder.
        gop: frames from a key frame to the next.
        aspect: of a pixel, width over height.
        degrees: counter-clockwise turn for display.
        hflip: mirrored for display.
        options: of the encoder.
    """
    times = [i / 10 for i in range(len(frames))] if seconds is None else seconds
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, TICKS, {"bf": "0"} | (options or {}))
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.gop_size = "yuv420p", gop
        stream.codec_context.time_base = Fraction(1, TICKS)
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if degrees or hflip:
            stream.set_display_rotation(degrees, hflip=hflip)
        for pixels, time in zip(frames, times, strict=True):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = round(time * TICKS), Fraction(1, TICKS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def cut(src: Path, dst: Path, seconds: float, from_key: bool = True) -> Path:
    """Copy from ``seconds`` on without decoding, as `ffmpeg -ss SECONDS -i SRC -c copy DST` does.

    Args:
        src: to be cut.
        dst: its suffix is the container; MP4 gets an edit list.
        seconds: where it starts.
        from_key: with the packets from the key frame before on; else from the first packet at the time, which refers
            to what is not there.
    """
    with av.open(str(src)) as source, av.open(str(dst), "w") as target:
        stream = source.streams.video[0]
        copied = target.add_stream_from_template(stream)
        start = round(seconds / stream.time_base)
        packets = [packet for packet in source.demux(stream) if packet.size]
        keys = [i for i, packet in enumerate(packets) if packet.is_keyframe and packet.pts <= start]
        first = keys[-1] if from_key else next(i for i, packet in enumerate(packets) if packet.pts >= start)
        for packet in packets[first:]:
            packet.pts, packet.dts = packet.pts - start, packet.dts - start
            packet.stream = copied
            target.mux(packet)
    return dst

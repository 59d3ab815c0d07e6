"""Which frames of which clips are forecast, and how fast the video shows them."""

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from vestcl.data.sample import Clip
from vestcl.data.sources import VideoFrame
from vestcl.forecasting.files import CONTEXT, FPS

#: Frames per second that a video has at least, by repeated frames: players are slow to start and to seek below.
_SLOWEST: Final = 5.0

#: Seconds that a frame before a gap in time is shown for, where its own share of the drive is not longer.
_LONGEST: Final = 2.0

#: Frames before t that a forecast reads.
_READ_BEFORE: Final = 8

#: Decoded frames that are kept at most: 3 MB each at 1080 x 1920.
_MOST_DECODED: Final = 100

#: Letters of a clip's name in its folder's.
_NAME_LENGTH: Final = 60


@dataclass(frozen=True, eq=False)
class Drive:
    """The frames of one clip that are forecast."""

    clip: Clip
    text: str
    """The input that was opened."""
    folder: str
    """Name of its folder in OUT/frames."""
    indices: tuple[int, ...]
    """Of the frames t, rising."""
    steps: int
    """Frames to forecast from each."""
    every: int

    @property
    def interval(self) -> float:
        """Seconds from frame to frame of the clip; one without timestamps has KITTI's."""
        return self.clip.interval or 1 / FPS

    @property
    def period(self) -> float:
        """Seconds from one t to the next, without gaps."""
        return self.every * self.interval


def drive(clip: Clip, text: str, number: int, steps: int, every: int, first: int | None = None) -> Drive:
    """The frames t = first, first + every, ... that have a true frame at each of ``steps`` intervals after them.

    Args:
        clip: a clip.
        text: the input that it is from.
        number: of the clip in the run, from 1.
        steps: frames to forecast, 1 or more.
        every: 1 or more.
        first: the first t, 1 or more; None is the CONTEXT-th frame, or an earlier one of a clip that is shorter.

    Returns:
        The frames; none where the clip is too short.

    Raises:
        ValueError: ``first`` has no frame before it.
    """
    if first is not None and first < 1:
        raise ValueError(f"`frame` must be 1 or more, to have a frame before it, got {first}")
    whole = [index for index in range(1, len(clip)) if len(clip.after(index, steps)) == steps]
    start = first if first is not None else min(CONTEXT - 1, whole[-1] if whole else 1)
    wanted = set(range(start, len(clip), every))
    name = re.sub(r"[^\w.-]+", "_", clip.name).strip("._")[:_NAME_LENGTH] or "clip"
    indices = tuple(index for index in whole if index in wanted)
    return Drive(clip, text, f"{number:03}_{name}", indices, steps, every)


def keep_decoded(drive: Drive) -> None:
    """Let a video keep the frames from the first that a forecast reads to its last true one: no frame is decoded twice.

    Args:
        drive: of a clip of any kind.
    """
    source = drive.clip[0].image
    if isinstance(source, VideoFrame):
        source.video.keep(min(_READ_BEFORE + drive.steps + drive.every, _MOST_DECODED))


def video_rate(drives: Sequence[Drive]) -> float:
    """Frames per second of a video of all: that of the clip with the shortest period, times a whole number."""
    rate = 1 / min(each.period for each in drives)
    return rate * max(1, math.ceil(_SLOWEST / rate - 1e-9))


def repeats(one: Drive, rate: float) -> Iterator[int]:
    """How often the video shows each frame of a drive, so that it plays at natural speed.

    A frame is shown until the next one's time, before a gap for `_LONGEST` seconds at most, and the last one for the
    drive's period.

    Args:
        one: the drive.
        rate: frames per second of the video.
    """
    places = one.clip.positions[list(one.indices)] * one.interval
    longest = max(_LONGEST, one.period)
    lengths = [min(float(after - at), longest) for at, after in itertools.pairwise(places)]
    end, shown = 0.0, 0
    for length in [*lengths, one.period]:
        end += length
        count = max(1, round(end * rate) - shown)
        shown += count
        yield count

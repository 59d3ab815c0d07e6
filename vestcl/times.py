"""When frames were taken: the interval of a clip, and where each frame is in intervals."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

#: Intervals count as equal up to this share, and this many seconds: clocks jitter, and containers round times to 1 ms.
_JITTER: Final = 0.02
_ROUNDED: Final = 0.0011

#: A frame represents a time from which it is at most this many intervals away.
NEAR: Final = 0.25

#: A network's interval and a clip's are the same up to this share.
_SAME: Final = 0.2


def check_increasing(seconds: Sequence[float], names: Sequence[str], where: str) -> None:
    """Refuse times of consecutive frames that do not increase.

    Args:
        seconds: of each frame.
        names: what each is called in the message.
        where: what the message begins with.

    Raises:
        ValueError: a time that is not finite, or not after the one before; the message names both.
    """
    for index, second in enumerate(seconds):
        if not np.isfinite(second):
            raise ValueError(f"{where}: the time of {names[index]} must be finite, got {second}")
        if index and second <= seconds[index - 1]:
            why = "repeats" if second == seconds[index - 1] else "steps back from"
            raise ValueError(
                f"{where}: the time of {names[index]}, {second:.6g} s, {why} that of {names[index - 1]}, "
                f"{seconds[index - 1]:.6g} s; times must increase"
            )


def median_interval(seconds: Sequence[float] | NDArray[np.float64]) -> float | None:
    """The median of the intervals between increasing times; of those that only rounding separates from it, the mean.

    Args:
        seconds: of consecutive frames.

    Returns:
        Seconds; None of less than two frames.
    """
    gaps = np.diff(np.asarray(seconds, np.float64))
    if not len(gaps):
        return None
    median = float(np.median(gaps))
    close = gaps[_is_close(gaps, median)]
    return float(close.mean()) if len(close) else median


def positions(seconds: Sequence[float] | NDArray[np.float64], interval: float) -> NDArray[np.float64]:
    """Where each frame is, in intervals since the first: 0, 1, 2 ... exactly where frames are evenly spaced.

    Args:
        seconds: increasing.
        interval: seconds.

    Returns:
        As many as times.
    """
    gaps = np.diff(np.asarray(seconds, np.float64))
    counted = np.where(_is_close(gaps, interval), 1.0, gaps / interval)
    return np.concatenate([[0.0], np.cumsum(counted).round(6)])


def frames_after(places: NDArray[np.float64], index: int, steps: int) -> list[int]:
    """The frames at t + 1, t + 2, ... intervals.

    Args:
        places: of `positions`.
        index: of the frame t.
        steps: how many.

    Returns:
        Their indices, each the nearest to its time; they end before the first time that has no frame within NEAR.
    """
    found = list[int]()
    for step in range(1, steps + 1):
        wanted = places[index] + step
        nearest = int(np.abs(places - wanted).argmin())
        if abs(places[nearest] - wanted) > NEAR:
            break
        found.append(nearest)
    return found


def steps_ahead(seconds: float, interval: float | None, where: str) -> int:
    """The whole number of intervals that is nearest to a time ahead.

    Args:
        seconds: positive.
        interval: of the clip, seconds; None is not known.
        where: what a message begins with.

    Returns:
        1 or more.

    Raises:
        ValueError: no positive time, less than half an interval, or a clip without timestamps.
    """
    if not (np.isfinite(seconds) and seconds > 0):
        raise ValueError(f"`seconds` must be positive, got {seconds}")
    if interval is None:
        raise ValueError(f"{where}: has no times, so that `seconds` can't be counted in frames; give `steps`")
    steps = round(seconds / interval + 1e-9)
    if steps < 1:
        raise ValueError(
            f"{where}: has a frame every {interval:.3g} s; `seconds` must be half of it or more, got {seconds:g}"
        )
    return steps


def is_same(interval: float, other: float) -> bool:
    """Whether a network that learned at one interval may be used at the other: they differ by 20 % at most."""
    return abs(interval / other - 1) <= _SAME


def _is_close(gaps: NDArray[np.float64], interval: float) -> NDArray[np.bool_]:
    return np.asarray(np.abs(gaps - interval) <= _JITTER * interval + min(_ROUNDED, interval / 8))

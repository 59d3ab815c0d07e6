"""Points of time against loss: the Pareto front, and the knee of a curve."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from vestcl.bench.common.timing import Spread

#: dB of PSNR that half the time may cost at a knee: a difference that is hard to see in a direct comparison.
PRICE: Final = 0.25


@dataclass(frozen=True)
class Point:
    """One setting, measured."""

    value: str
    """Of the knob, or a description of several."""
    setting: dict[str, Any]
    """What differs from the defaults."""
    seconds: Spread
    """Of one forecast step, mean over the streets."""
    rms: Spread
    """Over streets: root of the mean squared difference from the float64, nothing-skipped image, of 1."""
    psnr: Spread
    """Over streets, dB, against the frame that really follows."""
    ms_ssim: Spread
    """The same; NaN in images too small for it."""
    loss: float
    """Mean over streets of the default's PSNR less this one's, dB."""
    worst: float
    """The largest of these."""


def front(points: Sequence[Point]) -> list[Point]:
    """The Pareto front of time and loss, fastest last."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.loss, p.seconds.median)):
        if not best or point.seconds.median < best[-1].seconds.median:
            best.append(point)
    return best


def knee(points: Sequence[Point]) -> Point:
    """argmin loss + PRICE log2(seconds): where the curve's tangent is PRICE dB for half the time.

    Args:
        points: one or more, the default first; others count if they are faster than it beyond the noise: if quartiles
            of the times don't overlap.

    Raises:
        ValueError: no points.
    """
    if not points:
        raise ValueError("`points` must be one or more, got none")
    default, *others = points
    points = [default, *(point for point in others if point.seconds.high < default.seconds.low)]
    return min(points, key=lambda point: point.loss + PRICE * math.log2(point.seconds.median))

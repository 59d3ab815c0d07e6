"""Conditional computation: the regions that a scene needs, and counts of what was skipped."""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import cv2
import torch
from torch.nn import functional

#: Two boxes become one if that adds fewer pixels: a pass through a network costs about as much as this many of them.
_PASS: Final = 16384

#: From this share of an image on boxes are not worth while.
_WHOLE: Final = 0.6


class Count(NamedTuple):
    """Counts of one switch."""

    skipped: int
    of: int
    unit: str


@dataclass
class Tally:
    """What was skipped, by switch, summed up over the forecasts of a `count_skips` block."""

    counts: dict[str, Count] = field(default_factory=dict)
    outer: "Tally | None" = field(default=None, repr=False, compare=False)
    """The tally of the ``with`` block around this one's: it counts as well."""

    def add(self, switch: str, skipped: int, of: int, unit: str) -> None:
        """``skipped`` of ``of`` more, here and in all outer tallies."""
        before = self.counts.get(switch, Count(0, 0, unit))
        self.counts[switch] = Count(before.skipped + int(skipped), before.of + int(of), unit)
        if self.outer is not None:
            self.outer.add(switch, skipped, of, unit)


_tally: ContextVar[Tally | None] = ContextVar("vestcl_tally", default=None)


@contextlib.contextmanager
def count_skips() -> Iterator[Tally]:
    """Count what the forecasts skip that this thread makes inside the ``with`` block; other threads do not count.

    Returns:
        The tally, as the ``with`` block's variable.
    """
    tally = Tally(outer=_tally.get())
    token = _tally.set(tally)
    try:
        yield tally
    finally:
        _tally.reset(token)


def current_tally() -> Tally:
    """The tally of the thread's `count_skips`; outside of one, a tally that is not read."""
    return _tally.get() or Tally()


class Box(NamedTuple):
    """Rows top ... bottom - 1 and columns left ... right - 1."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def pixels(self) -> int:
        return (self.bottom - self.top) * (self.right - self.left)

    def around(self, other: "Box") -> "Box":
        """The smallest box that holds this one and ``other``."""
        return Box(
            min(self.top, other.top), max(self.bottom, other.bottom),
            min(self.left, other.left), max(self.right, other.right),
        )  # fmt: skip

    def touches(self, other: "Box") -> bool:
        """Whether they have a pixel in common, or an edge."""
        rows = self.top <= other.bottom and other.top <= self.bottom
        return rows and self.left <= other.right and other.left <= self.right

    def cut(self, image: torch.Tensor, cell: int = 1) -> torch.Tensor:
        """The part of ``image`` [..., H / cell, W / cell], of cells of ``cell`` pixels; a view."""
        top, bottom, left, right = (-(-edge // cell) for edge in self)
        return image[..., top:bottom, left:right]


def boxes(wanted: torch.Tensor, margin: int, align: int) -> list[Box]:
    """Boxes that together hold all of ``wanted`` with ``margin`` around it; they don't touch.

    Regions of cells that touch get a box each; boxes that touch, or that one pass is cheaper for, become one; boxes
    that hold most of the image become all of it.

    Args:
        wanted: bool [H, W].
        margin: px, cut off at the image's edges.
        align: px, a cell's side; edges are multiples of it, or the image's.

    Returns:
        By their left edges; none where nothing is wanted.
    """
    height, width = wanted.shape
    cells = functional.max_pool2d(wanted[None, None].float(), align, ceil_mode=True)[0, 0].byte().numpy()
    stats = cv2.connectedComponentsWithStats(cells, connectivity=8)[2]
    found = list[Box]()
    for left, top, columns, rows, _ in stats[1:].tolist():
        part = wanted[top * align : (top + rows) * align, left * align : (left + columns) * align]
        sides = [
            _aligned(start * align + along.nonzero()[:, 0], size, margin, align)
            for start, along, size in ((top, part.any(dim=1), height), (left, part.any(dim=0), width))
        ]
        found.append(Box(*sides[0], *sides[1]))
    found, whole = _joined(found), Box(0, height, 0, width)
    if sum(box.pixels for box in found) > _WHOLE * whole.pixels:
        return [whole]
    return sorted(found, key=lambda box: (box.left, box.top))


def _joined(found: list[Box]) -> list[Box]:
    """Until no two of them touch or would cost more than one around both."""
    done = list[Box]()
    while found:
        box = found.pop()
        for other in done:
            both = box.around(other)
            if box.touches(other) or both.pixels < box.pixels + other.pixels + _PASS:
                done.remove(other)
                found.append(both)
                break
        else:
            done.append(box)
    return done


def _aligned(places: torch.Tensor, size: int, margin: int, align: int) -> tuple[int, int]:
    """Start and end of all ``places``, in order, with ``margin`` around them."""
    start, end = int(places[0]) - margin, int(places[-1]) + 1 + margin
    return max(0, start // align * align), min(size, -(-end // align) * align)

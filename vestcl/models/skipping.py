"""What a scene does not need, and so is not computed: the switches, and what they saved."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import torch


@dataclass(frozen=True)
class Skip:
    """Switches. With ``margin`` None each of them changes nothing but rounding."""

    seen: bool = True
    """A frame that was encoded by the step before is not encoded again. (Where gradients are recorded, it is.)"""
    background: bool = True
    """The background is encoded around what foreground hides, and not at all where there is none."""
    objects: bool = True
    """Object motion is forecast around the foreground, and not at all where there is none."""
    covered: bool = True
    """Of the previous frame's points those are splatted that come to where the current frame leaves something open."""
    views: bool = True
    """A camera that is asked for twice is shown once."""
    margin: int | None = None
    """Pixels around the foreground that both are computed with; None is as far as the networks' convolutions reach."""

    def __post_init__(self) -> None:
        if self.margin is not None and self.margin < 0:
            raise ValueError(f"`margin` must be 0 px or more, or None, got {self.margin}")


#: Everything is computed.
NOTHING: Final = Skip(seen=False, background=False, objects=False, covered=False, views=False)


class Count(NamedTuple):
    """Of one switch."""

    skipped: int
    of: int
    unit: str


@dataclass
class Tally:
    """What was skipped, by switch, summed up over the forecasts of a model."""

    counts: dict[str, Count] = field(default_factory=dict)

    def add(self, switch: str, skipped: int, of: int, unit: str) -> None:
        """``skipped`` of ``of`` more."""
        before = self.counts.get(switch, Count(0, 0, unit))
        self.counts[switch] = Count(before.skipped + int(skipped), before.of + int(of), unit)


class Box(NamedTuple):
    """Rows top ... bottom - 1 and columns left ... right - 1."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def pixels(self) -> int:
        return (self.bottom - self.top) * (self.right - self.left)

    def around(self, others: "Iterable[Box]") -> "Box":
        """The smallest box that holds this one and ``others``."""
        every = [self, *others]
        return Box(
            min(b.top for b in every),
            max(b.bottom for b in every),
            min(b.left for b in every),
            max(b.right for b in every),
        )

    def cut(self, image: torch.Tensor, cell: int = 1) -> torch.Tensor:
        """The part of ``image`` [..., H / cell, W / cell], of cells of ``cell`` pixels; a view."""
        top, bottom, left, right = (-(-edge // cell) for edge in self)
        return image[..., top:bottom, left:right]


def boxes(wanted: torch.Tensor, margin: int, align: int) -> list[Box]:
    """Boxes that together hold all of ``wanted`` with ``margin`` around it; they don't touch.

    Args:
        wanted: bool [H, W].
        margin: px, cut off at the picture's edges.
        align: edges are multiples of it, or the picture's.

    Returns:
        From left to right; none where nothing is wanted.
    """
    height, width = wanted.shape
    found: list[tuple[int, int]] = []
    for column in wanted.any(dim=0).nonzero()[:, 0].tolist():
        left, right = _aligned(column, column + 1, width, margin, align)
        if found and left <= found[-1][1]:
            left, right = found.pop()[0], right
        found.append((left, right))
    result = []
    for left, right in found:
        rows = wanted[:, left:right].any(dim=1).nonzero()[:, 0]
        top, bottom = _aligned(int(rows[0]), int(rows[-1]) + 1, height, margin, align)
        result.append(Box(top, bottom, left, right))
    return result


def _aligned(start: int, end: int, size: int, margin: int, align: int) -> tuple[int, int]:
    return max(0, (start - margin) // align * align), min(size, -(-(end + margin) // align) * align)

"""What moves on the street, where it is at any time, and how far it gets between two.

The cars of the camera's own lane drive as it does, each LEAD seconds before the one behind it: they close up when they
slow down, and none is ever nearer to the camera than its slot allows. All others keep their speed; on a `RoadDrive`
oncoming cars follow each other at equal intervals of time, each a driver who slows for the same bends.
"""

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vestcl.data.street import layout
from vestcl.data.street.driving.drive import Drive
from vestcl.data.street.driving.road import RoadDrive
from vestcl.data.street.layout import PAVEMENT_HEIGHT, File, Layout
from vestcl.data.street.objects import Vector
from vestcl.data.street.raycast import Solids

#: Seconds between a car of the camera's lane and the one behind it, a driver's usual headway ...
LEAD: Final = 1.3

#: ... beyond these metres at standstill, which with the slots' spread leave 2 m from bumper to bumper.
QUEUE_SPACING: Final = 14.0

#: How fast oncoming cars are, as a share of the camera's mean speed.
ONCOMING_SHARE: Final = 0.9

#: Metres between cars in a crowd, which with the slots' spread leave none inside another, ...
CROWD_SPACING: Final = 9.0

#: ... and how many times as many people walk.
CROWD_WALKERS: Final = 3.0

#: A slot's number fits this many bits of an instance, its file's tag comes above: 8 million slots to either side.
SLOT_BITS: Final = 24


@dataclass(frozen=True, eq=False)
class Mover:
    """A car or a pedestrian on its way."""

    solids: Solids
    """From where it stands on the road, z = 0."""
    instance: int
    """Positive, the same at all times, of no other mover."""
    position: Vector
    """Where it stands, metres in the world's axes; z is along the street where that is bent."""
    file: File
    slot: int
    rest: float
    """z in metres of where it would be, had its file not moved."""


@dataclass(frozen=True)
class Traffic:
    """Everything that moves on a street."""

    plan: Layout
    lane: float
    """Width of each of the two lanes, metres."""
    drive: Drive
    """The camera's."""
    crowded: bool = False
    """As many cars in both lanes as fit, and more people."""

    def movers(self, t: float, low: float, high: float) -> Iterator[Mover]:
        """Those between z = ``low`` and ``high`` metres at ``t`` seconds."""
        for file in self._files():
            if self._is_timed(file):
                yield from self._timed(file, t, low, high)
                continue
            start = float(self._travelled(file, np.zeros(()), t))
            first, last = (int(np.floor((z - start) / file.spacing)) for z in (low, high))
            if file.gap is not None:  # slots ahead have got further than `start`, slots behind less far
                first, last = min(first, file.gap), max(last, file.gap)
            slots = np.arange(first, last + 1)
            for slot, travelled in zip(slots.tolist(), self._travelled(file, slots, t).tolist(), strict=True):
                if slot == file.gap:
                    continue
                solids, offset = layout.member(self.plan, file, slot)
                rest = slot * file.spacing + offset
                at = self._place(file, rest + travelled)
                if low <= at[2] <= high:
                    yield Mover(solids, file.tag << SLOT_BITS | slot & (1 << SLOT_BITS) - 1, at, file, slot, rest)

    def position(self, mover: Mover, t: float) -> Vector:
        """Where ``mover`` stands at ``t`` seconds, metres in the world's axes."""
        if self._is_timed(mover.file):
            return self._place(mover.file, self._timed_at(mover.file, mover.slot, mover.rest, t))
        return self._place(mover.file, mover.rest + float(self._travelled(mover.file, np.asarray(mover.slot), t)))

    def _is_timed(self, file: File) -> bool:
        """Whether the file's cars are on the same way at other times: z = -w(t - slot interval - rest / speed)."""
        return file.kind == "car" and file.gap is None and isinstance(self.drive, RoadDrive)

    def _timed_at(self, file: File, slot: int, rest: float, t: float) -> float:
        return -float(self._oncoming.travelled(t + (slot * file.spacing + rest) / file.speed))

    def _timed(self, file: File, t: float, low: float, high: float) -> Iterator[Mover]:
        """Those of a file of equal intervals; ``rest`` is how far from the slot's middle."""
        first, last = ((self._oncoming.time_at(-z) - t) * file.speed / file.spacing for z in (low, high))
        for slot in range(int(np.floor(first)), int(np.ceil(last)) + 1):
            solids, offset = layout.member(self.plan, file, slot)
            at = self._place(file, self._timed_at(file, slot, offset, t))
            if low <= at[2] <= high:
                yield Mover(solids, file.tag << SLOT_BITS | slot & (1 << SLOT_BITS) - 1, at, file, slot, offset)

    @functools.cached_property
    def _oncoming(self) -> RoadDrive:
        """A free driver on the same course the other way."""
        drive = self.drive
        assert isinstance(drive, RoadDrive)
        speed = ONCOMING_SHARE * drive.speed
        return dataclasses.replace(drive, speed=speed, seed=drive.seed + 1, direction=-1.0, stops=False)

    def _place(self, file: File, z: float) -> Vector:
        side_street = file.kind == "pedestrian" and layout.is_crossing(self.plan.seed, z)
        return 0.0, PAVEMENT_HEIGHT if side_street else 0.0, z

    def _travelled(self, file: File, slots: NDArray[Any], t: float) -> NDArray[np.float64]:
        """Metres along the road that ``slots`` of ``file`` have gone."""
        ours = file.gap is not None
        return self.drive.travelled(t + LEAD * slots) if ours else np.full(slots.shape, file.speed * t)

    def _files(self) -> tuple[File, ...]:
        walk = self.plan.kerb + self.plan.pavement
        queue, oncoming = (CROWD_SPACING, CROWD_SPACING) if self.crowded else (QUEUE_SPACING, 31.0)
        closer = CROWD_WALKERS if self.crowded else 1.0
        return (
            File(1, "car", self.lane / 2, self.drive.speed, queue, gap=0),
            File(2, "car", -self.lane / 2, -ONCOMING_SHARE * self.drive.speed, oncoming),
            File(3, "pedestrian", walk - 0.8, 1.3, 17.0 / closer),
            File(4, "pedestrian", walk - 1.6, -1.2, 23.0 / closer),
            File(5, "pedestrian", 0.8 - walk, -1.35, 19.0 / closer),
            File(6, "pedestrian", 1.6 - walk, 1.25, 29.0 / closer),
        )

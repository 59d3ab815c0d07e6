"""Three streets that need more and more, and a scene that needs everything, as windows that a forecast slides over.

    empty road      nothing but the static world
    traffic         the street as it is generated
    jam             slow, both lanes full
    everything      no street: foreground scattered all over two walls, all of it moving, every frame another one, seen
                    from the side, so that nothing can be skipped but points that the newer frame covers

Depth and masks are given, everything else is measured as in use: the camera's motion and objects' velocities by
`Perception`, outside of all timing.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from vestcl.data import Street, street_clip
from vestcl.data.street.driving.drive import MAX_CHANGE, Sway
from vestcl.forecasting.network.input import NetworkInput, last_motions, network_input
from vestcl.models.steps.prior import nothing_moves
from vestcl.scene.layers import LayerBatch
from vestcl.scene.perceived import PerceivedFrame
from vestcl.scene.perception import Perception

EMPTY: Final = "empty road"
TRAFFIC: Final = "traffic"
JAM: Final = "jam"
EVERYTHING: Final = "everything"

#: The streets, from little to much.
STREETS: Final = (EMPTY, TRAFFIC, JAM)

#: Of two windows: each looks at t - 1 and t, and has its truth at t + 1.
LEAST_FRAMES: Final = 4

#: Of a jam, m/s: walking pace.
_JAM_SPEED: Final = 1.5

#: Metres an interval along each axis that all of it moves: more than what `InferenceOptions.still` takes to stand.
_MOVED: Final = 0.1

#: The scene "everything": m to the wall and to what is scattered before it ...
_WALL: Final = 10.0
_SCATTERED: Final = 5.0
#: ... in dots of so many px, one every so many: a footprint reaches from one's edge to the next's.
_DOT: Final = 3
_EVERY: Final = 8
#: ... m that the view is to the side of the camera: dots then leave holes as wide as they are, everywhere.
_ASIDE: Final = 0.54


@dataclass(frozen=True)
class Window:
    """What one forecast step is given."""

    given: NetworkInput
    tgt_from_next: torch.Tensor
    """[1, 4, 4] m, of the view that is asked for; its K is the source camera's."""
    truth: torch.Tensor | None
    """[1, 3, H, W], the next frame as it will be; None where there is none."""

    @property
    def frames(self) -> tuple[LayerBatch, LayerBatch]:
        """Layers at t - 1 and t."""
        return self.given.frame_prev, self.given.frame_cur


@dataclass(frozen=True)
class Drive:
    """A scene."""

    name: str
    windows: list[Window]
    """In the order of time; a street's share a frame with the next one, but no memory."""
    foreground: float
    """Share of the pixels, over all frames at t."""
    warm: int
    """Windows that begin the drive, before which no frame is known: 1 where windows share frames, or else 0."""


def drive(name: str, height: int, width: int, frames: int, seed: int) -> Drive:
    """One of STREETS or EVERYTHING, with at least LEAST_FRAMES ``frames`` of ``height`` x ``width`` px, float32, B = 1.

    Raises:
        ValueError: another name, or too few frames.
    """
    if name not in (*STREETS, EVERYTHING):
        raise ValueError(f"`name` must be one of {', '.join((*STREETS, EVERYTHING))}, got {name!r}")
    if frames < LEAST_FRAMES:
        raise ValueError(f"`frames` must be {LEAST_FRAMES} or more, got {frames}")
    prepared = list(_prepared(name, height, width, frames, seed))
    windows = list(_scattered(prepared) if name == EVERYTHING else _slid(prepared))
    share = float(np.mean([1 - window.given.frame_cur.mask.mean().item() for window in windows]))
    return Drive(name, windows, share, 0 if name == EVERYTHING else 1)


def street(name: str, seed: int) -> Street:
    """The street of one of STREETS."""
    usual = Street.generate(seed)
    if name != JAM:
        return usual
    return dataclasses.replace(usual, crowded=True, drive=Sway(_JAM_SPEED, float(seed), _JAM_SPEED / MAX_CHANGE))


def _prepared(name: str, height: int, width: int, frames: int, seed: int) -> Iterator[PerceivedFrame]:
    clip = street_clip(street(name, seed), frames, height, width, foreground=name != EMPTY)
    perception = Perception(clip)
    return (perception.seen(index) for index in range(frames))


def _slid(frames: list[PerceivedFrame]) -> Iterator[Window]:
    for prev, cur, after in zip(frames, frames[1:], frames[2:], strict=False):
        given = network_input(prev, cur, last_motions(prev, cur))
        yield Window(given, torch.eye(4)[None], torch.from_numpy(after.layers.image.copy())[None])


def _scattered(frames: list[PerceivedFrame]) -> Iterator[Window]:
    """Two windows without a common frame, so that none was seen in the step before."""
    K, aside = torch.from_numpy(frames[0].K[None]).float(), torch.eye(4)[None]
    aside[:, 0, 3] = -_ASIDE
    images = [torch.from_numpy(frame.layers.image.copy())[None] for frame in frames[:2]]
    images += [image.flip(3) for image in images]
    for prev, cur in (images[:2], images[2:]):
        moving = torch.full_like(cur, _MOVED)
        prior = nothing_moves(cur)._replace(velocity_prev=moving, velocity_cur=moving)
        given = NetworkInput(_dotted(prev), _dotted(cur), K, prior)
        yield Window(given, aside, None)


def _dotted(image: torch.Tensor) -> LayerBatch:
    """``image`` [1, 3, H, W] on a wall, negative on the dots in front of it."""
    rows, columns = (torch.arange(size) % _EVERY < _DOT for size in image.shape[2:])
    dots = (rows[:, None] & columns)[None, None]
    wall = torch.full_like(image[:, :1], _WALL)
    depth = torch.where(dots, _SCATTERED, wall)
    return LayerBatch(torch.where(dots, 1 - image, image), depth, (~dots).float(), image, wall)

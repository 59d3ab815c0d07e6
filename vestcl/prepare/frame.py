"""One frame as perception saw it, with its camera's motion: what is computed once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vestcl.scene.layers import Layers
from vestcl.scene.perception import Perception


@dataclass(frozen=True, eq=False)
class Prepared:
    """One frame, understood."""

    name: str
    K: NDArray[np.float64]
    """[3, 3] px."""
    layers: Layers
    velocity: NDArray[np.float32]
    """[3, H, W] m per interval of the clip, in the camera's axes at t, of what moves beside the camera; else 0."""
    own: NDArray[np.bool_]
    """[1, H, W], True where the recording car itself is in the picture; it moves with the camera."""
    prev_from_cur: NDArray[np.float64] | None
    """[4, 4] m, the camera's motion to the frame before; None for a clip's first frame."""
    elapsed: float = 1.0
    """Intervals of the clip since the frame before; 1 for a clip's first frame."""


def prepare_frame(perception: Perception, index: int) -> Prepared:
    """What perception sees in a frame, with its camera's motion.

    Args:
        perception: of a clip at the size wanted.
        index: of the frame, from 0.

    Raises:
        ValueError: as `Perception.seen`: a file missing or damaged, no depth to be had.
    """
    seen, sample = perception.seen(index), perception.clip[index]
    motion = perception.prev_from_cur(index) if index > 0 else None
    elapsed = perception.clip.elapsed(index)
    return Prepared(sample.name, sample.K, seen.layers, seen.velocity, seen.own, motion, elapsed)

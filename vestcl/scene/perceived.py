"""What is known of one frame: its surface, its objects, and both with the background and the camera's motion."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vestcl.scene.layers import Layers


@dataclass(frozen=True, eq=False)
class Surface:
    """What a frame shows, without what is behind its foreground: `PerceivedFrame` is computed from it."""

    image: NDArray[np.float32]
    """[3, H, W] RGB in [0, 1]."""
    depth: NDArray[np.float32]
    """[1, H, W] m, above 0 everywhere."""
    mask: NDArray[np.bool_]
    """M [1, H, W], True = static background."""
    own: NDArray[np.bool_]
    """[1, H, W], True where the recording car itself is in the image."""


@dataclass(frozen=True, eq=False)
class Moving:
    """The objects of a frame."""

    instances: NDArray[np.int32]
    """[H, W], 0 = background, else the object."""
    velocity: NDArray[np.float32]
    """As of `PerceivedFrame`."""


@dataclass(frozen=True, eq=False)
class PerceivedFrame:
    """One frame, preprocessed: computed by `vestcl.scene.perception.Perception`, or read by `vestcl.prepare`."""

    name: str
    K: NDArray[np.float64]
    """[3, 3] px."""
    layers: Layers
    velocity: NDArray[np.float32]
    """[3, H, W] m per interval of the clip, in the camera's axes at t, of each pixel; 0 where it is static."""
    own: NDArray[np.bool_]
    """[1, H, W], True where the recording car itself is in the image; it moves with the camera."""
    prev_from_cur: NDArray[np.float64] | None
    """[4, 4] m, the camera's motion to the frame before; None for a clip's first frame."""
    elapsed: float = 1.0
    """Intervals of the clip since the frame before; 1 for a clip's first frame."""

"""A frame's two layers: what it shows, and the static background behind its foreground (SPEC section 3)."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

#: Depth of the sky, metres: so far that driving 5 m on shifts it by less than half a pixel of a 1242 pixels wide
#: picture, so that in effect it only turns (SPEC section 3.5).
SKY_DEPTH: Final = 10_000.0


@dataclass(frozen=True, eq=False)
class Layers:
    """One frame, complete: no depth is missing. Everything is at one size."""

    image: NDArray[np.float32]
    """[3, H, W] RGB in [0, 1]."""
    depth: NDArray[np.float32]
    """[1, H, W] m, above 0 everywhere, SKY_DEPTH in the sky."""
    mask: NDArray[np.bool_]
    """M [1, H, W], True = static background."""
    background_image: NDArray[np.float32]
    """[3, H, W]; equals ``image`` away from the foreground."""
    background_depth: NDArray[np.float32]
    """[1, H, W] m; equals ``depth`` away from the foreground, and is nowhere nearer."""

"""What any forecast gives, whoever makes it: images of future frames from the cameras that were asked for."""

import functools
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vestcl.data.resize import resize_labels
from vestcl.forecasting.full_size import Lookup, enlarged
from vestcl.io.images import to_pixels


@dataclass(frozen=True, eq=False)
class View:
    """A camera relative to the forecast one."""

    name: str
    tgt_from_next: NDArray[np.float64]
    """[4, 4] m: from the source camera as it is at the forecast time."""
    K: NDArray[np.float64] | None = None
    """[3, 3] px; None is the source camera's."""

    def resized(self, size: tuple[int, int], new: tuple[int, int]) -> "View":
        """The same camera for images of another (height, width): diag(sx, sy, 1) K, where it has a K of its own."""
        factors = new[1] / size[1], new[0] / size[0], 1.0
        return self if self.K is None else replace(self, K=np.diag(factors) @ self.K)


@dataclass(frozen=True, eq=False)
class Rendered:
    """One future frame from one view."""

    image: NDArray[np.float32]
    """[3, H, W] RGB in [0, 1], holes filled."""
    depth: NDArray[np.float32]
    """[1, H, W] m; 0 where unknown."""
    coverage: NDArray[np.float32]
    """[1, H, W] in [0, 1], before holes were filled."""
    motion_xyz: NDArray[np.float32]
    """[3, H, W] m: by how much what the pixel shows moved over the last frame interval, x_(t+k) - x_(t+k-1), each in
    its own time's source camera; 0 where unknown."""
    lookups: tuple[Lookup, ...] = ()
    """At a working size: where colours were recorded; see `at_size`."""

    @functools.cached_property
    def pixels(self) -> NDArray[np.uint8]:
        """[H, W, 3] RGB, ``image`` with 8 bit, as files show it.

        Raises:
            ValueError: NaN in the image.
        """
        return to_pixels(self.image).astype(np.uint8, copy=False)

    def at_size(self, height: int, width: int) -> "Rendered":
        """The view at the clip's own size: colours of the recorded images, all else of the nearest pixel.

        Args:
            height: px.
            width: px.
        """
        if self.image.shape[1:] == (height, width):
            return self
        planes = self.depth, self.coverage, self.motion_xyz
        depth, coverage, motion = (resize_labels(each, height, width) for each in planes)
        return Rendered(enlarged(self.image, self.lookups, height, width), depth, coverage, motion)


class SkippedWork(NamedTuple):
    """What a network did not compute, because the scene did not need it."""

    skipped: int
    of: int
    unit: str
    saved_seconds: float | None
    """Estimated: as long as what was computed of the same took in the same forecast; None where nothing was, or where
    time does not go with it."""

    @property
    def share(self) -> float:
        """skipped / of."""
        return self.skipped / self.of if self.of else 0.0

    def __str__(self) -> str:
        """ "73 % of 425,984 px, about 0.05 s"."""
        saved = "" if self.saved_seconds is None else f", about {self.saved_seconds:.2f} s"
        return f"{100 * self.share:.0f} % of {self.of:,} {self.unit}{saved}"


class LearnedPart(NamedTuple):
    """Whether a forecast has a learned part of a network, and why."""

    used: bool
    why: str
    """ "29.31 dB at frame 0000000012 with it, 29.02 dB without"."""
    psnr: float | None = None
    """PSNR of the tested frame, forecast with the part, dB; None where it was not tested."""
    psnr_without: float | None = None
    """The same without it."""


@dataclass(frozen=True, eq=False)
class Forecast:
    """The frames at t+1, t+2, ... from every view."""

    method: str
    future_from_cur: list[NDArray[np.float64]]
    """Per step k, [4, 4] m: from the camera at t to the camera at t+k."""
    frames: list[dict[str, Rendered]]
    """Per step, by the view's name."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time by stage."""
    profile: dict[str, float] = field(default_factory=dict)
    """A network's seconds by stage; they are in ``seconds``, too, as one number."""
    skipped: dict[str, SkippedWork] = field(default_factory=dict)
    """By switch of `vestcl.models.inference.options.InferenceOptions`."""
    notes: tuple[str, ...] = ()
    """Lines for the user: what was left out, and why."""
    mode: str | None = None
    """How a network made the steps after the first, "compose" or "feedback"; None of others."""
    learned: dict[str, LearnedPart] = field(default_factory=dict)
    """By part of a network that was to be tested (`vestcl.forecasting.network.backtest`): "camera", "objects",
    "refinement"."""

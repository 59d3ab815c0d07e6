"""A drive down the procedural street as a `Clip`, so that whatever reads a recording reads a street, too."""

import functools
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl.data import calibration
from vestcl.data.resize import check_size
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.street.camera import check_samples, intrinsics
from vestcl.data.street.raycast import Frame
from vestcl.data.street.street import Street

#: Rendered frames that are kept, over all clips: a window of four frames, left and right.
KEPT_FRAMES: Final = 8


@dataclass(frozen=True)
class Shot:
    """An image of the street to be taken. Equal shots share one rendering."""

    street: Street
    t: float
    """Seconds."""
    aside: float
    """Metres to the right of the street's camera."""
    size: tuple[int, int]
    """(height, width), px."""
    samples: int
    foreground: bool

    def take(self) -> Frame:
        """The frame, B = 1; not to be written to."""
        return _rendered(self)


@functools.lru_cache(maxsize=KEPT_FRAMES)
def _rendered(shot: Shot) -> Frame:
    camera_from_world = calibration.translation((-shot.aside, 0, 0)) @ calibration.invert(
        shot.street.camera_pose(shot.t)
    )
    height, width = shot.size
    K = intrinsics(height, width)
    return shot.street.render(
        camera_from_world, K, height, width, shot.t, samples=shot.samples, foreground=shot.foreground
    )


@dataclass(frozen=True)
class StreetImage:
    """What a shot shows."""

    shot: Shot

    @property
    def height(self) -> int:
        """Px."""
        return self.shot.size[0]

    @property
    def width(self) -> int:
        """Px."""
        return self.shot.size[1]

    def read(self) -> NDArray[np.float32]:
        """[3, H, W] RGB in [0, 1]."""
        return self.shot.take().colour[0].copy()


@dataclass(frozen=True)
class StreetDepth:
    """A shot's depth."""

    shot: Shot

    def read(self) -> NDArray[np.float32]:
        """[1, H, W] m, all valid; the street's SKY_DEPTH where there is sky."""
        return self.shot.take().depth[0].copy()


@dataclass(frozen=True)
class StreetLabels:
    """A shot's classes."""

    shot: Shot

    def read(self) -> NDArray[np.uint8]:
        """[1, H, W] Cityscapes train ids."""
        return self.shot.take().labels[0].copy()


def street_clip(
    street: Street,
    frames: int,
    height: int,
    width: int,
    *,
    start: float = 0.0,
    fps: float = 10.0,
    baseline: float = 0.54,
    samples: int = 1,
    foreground: bool = True,
) -> Clip:
    """``frames`` frames of a stereo camera that drives down ``street``.

    Frame i is at t = start + i / fps, its pose is street.camera_pose(t), its K is intrinsics(height, width); it has
    image, depth, labels, and a right camera with the same K. Nothing is rendered before it is read; image, depth and
    labels share one rendering.

    Args:
        street: where.
        frames: how many, 1 or more.
        height: of the images, px.
        width: likewise.
        start: seconds.
        fps: frames per second.
        baseline: metres from the left camera to the right one.
        samples: rays per pixel for colour, see `Street.render`.
        foreground: False leaves out the foreground and its shadows, see `Street.render`.

    Raises:
        ValueError: a number that is not positive, or not finite; the message names it.
    """
    check_size(height, width)
    check_samples(samples)
    if not isinstance(frames, int | np.integer) or frames < 1:
        raise ValueError(f"`frames` must be a positive integer, got {frames!r}")
    for name, value in (("fps", fps), ("baseline", baseline)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"`{name}` must be positive and finite, got {value!r}")
    if not np.isfinite(start):
        raise ValueError(f"`start` must be finite, got {start!r}")
    first = Shot(street, float(start), 0.0, (int(height), int(width)), int(samples), bool(foreground))
    taken = [_sample(replace(first, t=start + i / fps), i, baseline) for i in range(frames)]
    return Clip(f"street {street.seed}", "procedural street", tuple(taken))


def _sample(shot: Shot, index: int, baseline: float) -> Sample:
    K = intrinsics(*shot.size)
    right_from_left = calibration.translation((-baseline, 0, 0))
    return Sample(
        f"{index:010d}",
        StreetImage(shot),
        K,
        timestamp=shot.t,
        world_from_cam=shot.street.camera_pose(shot.t),
        depth=StreetDepth(shot),
        labels=StreetLabels(shot),
        right=RightCamera(StreetImage(replace(shot, aside=baseline)), K, right_from_left),
    )

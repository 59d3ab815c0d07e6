"""Prepared clips in place of recorded ones: their frames as a clip, and what was computed of them as a perception."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.prepare.prepared import PreparedClip
from vestcl.scene.inpainting.inpainters import Inpainter
from vestcl.scene.motion import objects
from vestcl.scene.perceived import Moving, PerceivedFrame, Surface
from vestcl.scene.perception import Perception

Element = TypeVar("Element", np.float32, np.bool_)


@dataclass(frozen=True, eq=False)
class PreparedImage:
    """A prepared frame's image, or that of its right camera."""

    clip: PreparedClip
    index: int
    height: int
    width: int
    is_right: bool = False

    def read(self) -> NDArray[np.float32]:
        """[3, H, W] RGB in [0, 1], 8 bits.

        Raises:
            ValueError: the frame's file is missing or damaged.
        """
        if not self.is_right:
            return self.clip.image(self.index)
        camera = self.clip.right(self.index)
        assert camera is not None
        return camera[0]


@dataclass(frozen=True, eq=False)
class _Part(Generic[Element]):
    """A part of a prepared frame: a DepthSource or a RegionSource."""

    clip: PreparedClip
    index: int
    take: Callable[[PerceivedFrame], NDArray[Element]]

    def read(self) -> NDArray[Element]:
        """[1, H, W]."""
        return self.take(self.clip.frame(self.index))


@dataclass(frozen=True, eq=False)
class PreparedSequence(Clip):
    """A prepared clip's images, depth, cameras, poses and times as a clip; it has no labels."""

    prepared: PreparedClip | None = None
    """What it was made of."""


def as_clip(prepared: PreparedClip) -> PreparedSequence:
    """The frames, at the size that they were prepared at.

    Args:
        prepared: of `vestcl prepare`.

    Raises:
        ValueError: a frame's file is missing or damaged.
    """
    samples = tuple(_sample(prepared, index) for index in range(len(prepared)))
    return PreparedSequence(prepared.name, prepared.kind, samples, prepared)


def _sample(prepared: PreparedClip, index: int) -> Sample:
    interval = prepared.interval
    return Sample(
        prepared.frame_name(index),
        PreparedImage(prepared, index, *prepared.size),
        prepared.K(index),
        timestamp=None if interval is None else float(prepared.positions[index]) * interval,
        world_from_cam=prepared.world_from_cam(index),
        depth=_Part(prepared, index, lambda frame: frame.layers.depth),
        ego_vehicle=_Part(prepared, index, lambda frame: frame.own),
        right=_right(prepared, index),
    )


def _right(prepared: PreparedClip, index: int) -> RightCamera | None:
    camera = prepared.right_camera(index)
    if camera is None:
        return None
    K, right_from_left, size = camera
    return RightCamera(PreparedImage(prepared, index, *size, is_right=True), K, right_from_left)


class PreparedPerception(Perception):
    """What `vestcl prepare` computed of a clip; flow, and each point's velocity from it, are computed here.

    Its clip has no right camera: whatever is computed from its frames, by `vestcl.forecasting.peer` for one, has their
    depth.

    Args:
        clip: of `as_clip`, at its own size.
        inpaint: see `Perception`; of frames that are computed from this one's.
    """

    def __init__(self, clip: PreparedSequence, *, inpaint: Inpainter | None = None) -> None:
        bare = tuple(dataclasses.replace(sample, right=None) for sample in clip)
        super().__init__(dataclasses.replace(clip, samples=bare), inpaint=inpaint)
        assert clip.prepared is not None
        self._prepared = clip.prepared

    def raw_depth(self, index: int) -> NDArray[np.float32]:
        """[1, H, W] m, complete."""
        return self.seen(index).layers.depth

    def prev_from_cur(self, index: int) -> NDArray[np.float64]:
        """[4, 4] m: the camera's motion from frame ``index`` to the one before."""
        motion = self.seen(index).prev_from_cur
        if motion is None:
            raise ValueError(f"`index` must be 1 or more, a frame of {self.clip.name} with one before, got {index}")
        return motion

    def mask(self, index: int) -> NDArray[np.bool_]:
        """M [1, H, W], True = static background."""
        return self.seen(index).layers.mask

    def seen(self, index: int) -> PerceivedFrame:
        """The frame as it is in the cache."""
        return self.once("prepared frame", index, lambda: self._prepared.frame(index))

    def surface(self, index: int) -> Surface:
        """What the frame shows."""
        frame = self.seen(index)
        return Surface(frame.layers.image, frame.layers.depth, frame.layers.mask, frame.own)

    def moving(self, index: int) -> Moving:
        """The frame's objects."""
        return self.once("layers", index, lambda: self._moving(index))

    def _moving(self, index: int) -> Moving:
        frame = self.seen(index)
        return Moving(objects.segment(frame.layers.mask, frame.layers.depth), frame.velocity)

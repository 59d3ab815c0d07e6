"""Perception of a clip's frames without a network: masks, layers and objects from measurements."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl.data.sample import Clip
from vestcl.io.labels import background
from vestcl.scene.depth.foreground import foreground_depth
from vestcl.scene.flow.correspondence import Correspondence
from vestcl.scene.flow.parallax import OtherFrame, refine_depth
from vestcl.scene.inpainting.inpaint import DEFAULT, inpaint_background
from vestcl.scene.inpainting.inpainters import Inpainter, inpainter
from vestcl.scene.layers import Layers, without_gaps
from vestcl.scene.measurements import Measurements
from vestcl.scene.motion import backtest, objects
from vestcl.scene.motion.mask import motion_mask, rigid_pixels
from vestcl.scene.motion.observable import on_the_road
from vestcl.scene.motion.outline import whole_objects
from vestcl.scene.motion.photometric import Pair, confirmed, search
from vestcl.scene.perceived import Moving, PerceivedFrame, Surface

#: A bonnet is no farther than that, metres: the road never covers it.
_BONNET: Final = 1.5


class Perception(Measurements):
    """Results for the frames of a clip: computed when asked for, kept while later frames need them.

    What the clip's sources give is copied, so they may fill one buffer again and again. Threads may share a
    `Perception`; one computes at a time.

    ``seconds`` holds the time by stage. Depth comes from the clip (scans are densified), else from its stereo pair,
    else from motion; a network's depth of a clip without a stereo pair is combined with motion's (`combine_depth`). A
    depth map without a valid pixel is treated as missing, and logged. Masks are from labels where every frame has
    them, else all from motion: frames t - 1 and t must have theirs from one source, and Cityscapes labels one frame of
    30. Across a gap in time that is too long to match the frames on both sides of it, the camera moves on at the
    velocity before, and depth from motion is that of a level road; see `is_lost`.

    Args:
        clip: at its own size.
        progress: called with the stage that begins.
        inpaint: how the background behind the foreground is filled, as
            `vestcl.scene.inpainting.inpaint.inpaint_background` takes it; None is its default.
        work_width: px, the largest width that is worked at; None is the clip's own.

    Raises:
        ValueError: no such method of inpainting, or a width that is too small.
    """

    def __init__(
        self,
        clip: Clip,
        progress: Callable[[str], None] | None = None,
        *,
        inpaint: str | Inpainter | None = None,
        work_width: int | None = None,
    ) -> None:
        super().__init__(clip, progress, work_width=work_width)
        self.inpaint = inpainter(DEFAULT if inpaint is None else inpaint)

    def mask(self, index: int) -> NDArray[np.bool_]:
        """M [1, H, W], True = static background."""
        return self.once("mask", index, lambda: self._mask(index))

    def surface(self, index: int) -> Surface:
        """What the frame shows: `seen` without the background behind the foreground and without objects' velocities.

        Frames before the last two need nothing else.
        """
        return self._part("surface", index, lambda: self._find_surface(index))

    def moving(self, index: int) -> Moving:
        """The frame's objects and their velocities."""
        return self._part("moving", index, lambda: self._find_moving(index))

    def seen(self, index: int) -> PerceivedFrame:
        """The frame's layers, velocities and camera motion.

        Raises:
            ValueError: a file missing or damaged, or no source of depth.
        """
        return self.once("layers", index, lambda: self._see(index))

    def frame(self, index: int) -> backtest.BacktestFrame:
        """The frame in the form for candidate motions of its points; at frame 0 there is no earlier frame."""
        surface, K, image = self.surface(index), self.clip[index].K, self.image(index)
        asked = image, surface.depth, self.moving(index).velocity
        if index == 0:
            return backtest.BacktestFrame(*asked, np.zeros_like(image[:2]), np.eye(4), K)
        motion = self._flow(index).flow_uv, self.prev_from_cur(index)
        return backtest.BacktestFrame(*asked, *motion, K, self.clip.elapsed(index))

    def _flow(self, index: int) -> Correspondence:
        """From frame ``index`` to the one before; on the road only what the image can show."""
        return self._part("flow on the road", index, lambda: self._find_flow(index))

    def _find_flow(self, index: int) -> Correspondence:
        surface, found = self.surface(index), self.correspondence(index)
        shown = surface.image, surface.depth, surface.mask
        motion = self.prev_from_cur(index), self.clip[index].K
        return found._replace(flow_uv=on_the_road(found.flow_uv, *shown, *motion))

    def _mask(self, index: int) -> NDArray[np.bool_]:
        sample = self.clip[index]
        if self.has_labels:
            return background(sample.read_labels())
        if index == 0:
            return np.ones((1, sample.height, sample.width), bool)
        measured = self.correspondence(index), self.prev_from_cur(index), sample.K
        mask = motion_mask(self.raw_depth(index), *measured)
        if self.is_monocular(index):  # else depth outlines objects
            rigid = rigid_pixels(self.raw_depth(index), sample.K, self.prev_from_cur(index))
            pair = self.image(index), self.image(index - 1), self.correspondence(index)
            mask = ~whole_objects(~mask[0], *pair, rigid)[None]
        return mask | self.own(index) | self._measured_sky(index)

    def _measured_sky(self, index: int) -> NDArray[np.bool_]:
        """`_sky` by the depth as it was measured."""
        return self._part("sky", index, lambda: self._sky(index, self.raw_depth(index)), "mask")

    def _find_surface(self, index: int) -> Surface:
        image, mask, own = self.image(index), self.mask(index), self.own(index)
        depth = self._complete_depth(index)
        if self.clip[index].ego_vehicle is None and own.any():
            depth = np.where(own, depth.clip(max=_BONNET), depth)
        return Surface(image, depth, mask, own)

    def _complete_depth(self, index: int) -> NDArray[np.float32]:
        """[1, H, W] m, refined by motion, that of the recording car as it is measured."""
        return self._part("complete depth", index, lambda: self._complete(index))

    def _complete(self, index: int) -> NDArray[np.float32]:
        mask, depth, own = self.mask(index), self.raw_depth(index), self.own(index)
        if index > 0 and not self.is_monocular(index):
            view = OtherFrame(self.correspondence(index), self.prev_from_cur(index))
            depth = refine_depth(depth, self.inverse_std(index), self.clip[index].K, [view], mask & ~own)
        matched = self._is_matched(index)
        sky = self._measured_sky(index) if matched or depth is self.raw_depth(index) else self._sky(index, depth)
        complete = without_gaps(self.image(index), depth, sky)
        return foreground_depth(complete, ~mask & ~own, self._pair(index)) if matched else complete

    def _find_moving(self, index: int) -> Moving:
        surface, K = self.surface(index), self.clip[index].K
        instances = objects.segment(surface.mask, surface.depth)
        if index == 0:
            return Moving(instances, np.zeros_like(surface.image))
        depth = self._object_depth(index)
        # Two depths whose scales may differ by more than an object moves are not used.
        scaled = self.is_monocular(index) or self.is_monocular(index - 1)
        measured = depth, np.zeros_like(depth) if scaled else self._object_depth(index - 1), self.inverse_std(index)
        motion = self.correspondence(index), self.prev_from_cur(index), K
        pair = Pair(surface.image, self.image(index - 1), self.prev_from_cur(index), K)
        by_instance = search(instances, objects.velocities(instances, *measured, *motion), depth, pair)
        velocity = by_instance.astype(np.float32)[instances].transpose(2, 0, 1)
        by_flow = objects.follow_flow(velocity, surface.image, surface.depth, self._flow(index), *motion[1:])
        velocity = confirmed(by_flow, velocity, surface.depth, pair)
        return Moving(instances, velocity / np.float32(self.clip.elapsed(index)))

    def _object_depth(self, index: int) -> NDArray[np.float32]:
        """[1, H, W] m, of a stereo pair with what `foreground_depth` mends; 0 = invalid."""
        depth = self.raw_depth(index)
        return self._complete_depth(index) if self._is_matched(index) else depth

    def _see(self, index: int) -> PerceivedFrame:
        surface, complete = self.surface(index), self._complete_depth(index)
        behind_image, behind_depth = inpaint_background(surface.image, complete, surface.mask, method=self.inpaint)
        if self.clip[index].ego_vehicle is None and surface.own.any():
            behind_depth = np.where(surface.own, behind_depth.clip(max=_BONNET), behind_depth)
        layers = Layers(surface.image, surface.depth, surface.mask, behind_image, behind_depth)
        velocity, sample, elapsed = self.moving(index).velocity, self.clip[index], self.clip.elapsed(index)
        motion = self.prev_from_cur(index) if index > 0 else None
        return PerceivedFrame(sample.name, sample.K, layers, velocity, surface.own, motion, elapsed)

"""What can be known of a clip's frames without a network: depth, own motion, masks, layers, things. Kept by frame."""

import logging
import math
import threading
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from vestcl.clock import Clock
from vestcl.data.calibration import power
from vestcl.data.sample import Clip
from vestcl.io.labels import SKY, background
from vestcl.scene.depth import CombinedDepth, combine_depth
from vestcl.scene.depth.from_motion import MotionDepth, motion_depth
from vestcl.scene.depth.lidar import densify
from vestcl.scene.depth.stereo import stereo_depth
from vestcl.scene.estimators.sources import EstimatedFrame
from vestcl.scene.flow.correspondence import Correspondence, correspond
from vestcl.scene.flow.parallax import OtherFrame, refine_depth
from vestcl.scene.inpainting.inpaint import DEFAULT, inpaint_background
from vestcl.scene.inpainting.inpainters import Inpainter, inpainter
from vestcl.scene.layers import Layers, without_gaps
from vestcl.scene.motion import backtest, objects
from vestcl.scene.motion.ego_motion import ego_motion
from vestcl.scene.motion.mask import motion_mask, rigid_pixels
from vestcl.scene.motion.observable import on_the_road
from vestcl.scene.motion.outline import whole_objects
from vestcl.scene.motion.photometric import Pair, confirmed, search
from vestcl.scene.own_car import own_car
from vestcl.scene.perceived import Moving, PerceivedFrame, Surface
from vestcl.scene.sky import sky_mask

#: Standard deviation of a stereo pair's disparity, px, and the nearest depth that is searched for, m.
_DISPARITY_STD, _NEAREST = 0.35, 2.0

#: Standard deviation of any other depth's inverse, 1/m: 2 % at 10 m.
_INVERSE_STD: Final = 0.002

#: Depth maps with a smaller share of valid pixels are scans, to be densified.
_DENSE: Final = 0.3

#: From so many intervals on there is a gap between two frames. It is too long if flow is believed (its error forth and
#: back, px) at less than that share of the pixels that it is believed at between the two frames before.
_GAP, _BELIEVED, _LOST = 1.5, 1.0, 0.6

#: A bonnet is looked for in so many last images, and is no farther than that, metres: the road never covers it.
_COMPARED, _BONNET = 4, 1.5

#: Results of so many frames before the last one asked for are kept; a forecast looks at three.
_KEPT: Final = 4

_LOG: Final = logging.getLogger(__name__)

Result = TypeVar("Result")


class Perception:
    """Results for the frames of a clip: computed when asked for, kept while later frames need them.

    What the clip's sources give is copied, so they may fill one buffer again and again. Threads may share a
    `Perception`; one computes at a time.

    ``seconds`` tells the time by stage. Depth comes from the clip (scans are densified), else from its stereo pair,
    else from motion; a network's depth of a clip without a stereo pair is combined with motion's (`combine_depth`). A
    depth map without a valid pixel is as a missing one, and is logged. Masks are from labels where every frame has
    them, else all from motion: frames t - 1 and t must have theirs from one source, and Cityscapes labels one frame of
    30. Across a gap in time that is too long to match the frames on both sides of it, the camera moves on at the
    velocity before, and depth from motion is that of a level road; see `is_lost`.

    Args:
        clip: at its own size.
        progress: called with the stage that begins.
        inpaint: how the background behind the foreground is filled, as
            `vestcl.scene.inpainting.inpaint.inpaint_background` takes it; None is its default.

    Raises:
        ValueError: no such method of inpainting.
    """

    def __init__(
        self,
        clip: Clip,
        progress: Callable[[str], None] | None = None,
        *,
        inpaint: str | Inpainter | None = None,
    ) -> None:
        self.clip = clip
        self.inpaint = inpainter(DEFAULT if inpaint is None else inpaint)
        self.has_labels = all(sample.labels is not None for sample in clip)
        self._clock = Clock()
        self.seconds = self._clock.seconds
        self._progress = progress
        self._kept: dict[tuple[str, int], Any] = {}
        self._lifetimes: dict[tuple[str, int], int] = {}
        self._lock = threading.RLock()
        self._empty: set[int] = set()

    def image(self, index: int) -> NDArray[np.float32]:
        """[3, H, W]."""
        return self.once("read", index, lambda: self.clip[index].read_image().copy())

    def correspondence(self, index: int) -> Correspondence:
        """From frame ``index`` to the one before."""
        if not 1 <= index < len(self.clip):
            raise ValueError(f"`index` must be 1 ... {len(self.clip) - 1}, a frame with one before, got {index}")
        return self.once("flow", index, lambda: correspond(self.image(index), self.image(index - 1)))

    def raw_depth(self, index: int) -> NDArray[np.float32]:
        """[1, H, W] m as it was measured, 0 = invalid."""
        return self.once("depth", index, lambda: self._depth(index))

    def prev_from_cur(self, index: int) -> NDArray[np.float64]:
        """[4, 4] m: the camera's motion from frame ``index`` to the one before."""
        return self.once("ego-motion", index, lambda: self._ego_motion(index))

    def motions(self, indices: Sequence[int]) -> list[NDArray[np.float64]]:
        """`prev_from_cur` of consecutive frames, all in the scale of the last one where depth comes from motion.

        There each frame's road gives it a scale of its own; parallax over three images gives the ratio of their speeds.
        Where it does not, as in the first moment of a drive, the motion before is taken to be as fast.

        Args:
            indices: of the frames, rising by one.
        """
        motions = [self.prev_from_cur(i).copy() for i in indices]
        for motion, before, index in zip(motions[:0:-1], motions[-2::-1], list(indices)[:0:-1], strict=True):
            if not self._is_from_motion(index) or not motion[:3, 3].any():
                continue
            length, length_before = (float(np.linalg.norm(each[:3, 3])) for each in (motion, before))
            ratio = self._from_motion(index).speed_before
            if not ratio:
                before[:3, 3] = motion[:3, 3]
            elif length_before:
                before[:3, 3] *= ratio * length / length_before
        return motions

    def scale_before(self, index: int) -> float:
        """What lengths in the scale of frame ``index`` - 1 are multiplied with to be in that of frame ``index``."""
        if index < 2 or not self._is_from_motion(index):
            return 1.0
        now, before = (float(np.linalg.norm(self.prev_from_cur(i)[:3, 3])) for i in (index, index - 1))
        scaled = self._from_motion(index).speed_before * now
        return scaled / before if scaled and before else 1.0

    def is_lost(self, index: int) -> bool:
        """Whether the frame before is too far away in time to be matched, and there is a motion before that."""
        if index < 2 or self.clip.elapsed(index) < _GAP or self.is_lost(index - 1):
            return False
        now, before = ((self.correspondence(i).error < _BELIEVED).mean() for i in (index, index - 1))
        return bool(now < _LOST * before)

    def own(self, index: int) -> NDArray[np.bool_]:
        """[1, H, W], True where the recording car itself is in the image: by the clip's own files; found in a video of
        one camera, which may be a dashboard's."""
        key, sample = ("own car", index), self.clip[index]
        with self._lock:
            if key not in self._kept:
                if sample.ego_vehicle is not None or not self.is_monocular(index):
                    self._kept[key] = sample.read_ego_vehicle().copy()
                else:
                    since = range(index, max(index - _COMPARED, -1), -1)
                    first = next((i for i in since if self.is_lost(i)), 0)
                    self._kept[key] = own_car([self.image(i) for i in since if i >= first])
            return self._kept[key]

    def mask(self, index: int) -> NDArray[np.bool_]:
        """M [1, H, W], True = static background."""
        return self.once("mask", index, lambda: self._mask(index))

    def surface(self, index: int) -> Surface:
        """What the frame shows: `seen` without the background behind the foreground and without objects' velocities.

        Frames before the last two are needed for no more.
        """
        return self._part("surface", index, lambda: self._find_surface(index))

    def moving(self, index: int) -> Moving:
        """The frame's objects and their velocities."""
        return self._part("moving", index, lambda: self._find_moving(index))

    def seen(self, index: int) -> PerceivedFrame:
        """The frame's layers, velocities and camera motion.

        Raises:
            ValueError: a file missing or damaged, or no depth to be had.
        """
        return self.once("layers", index, lambda: self._see(index))

    def frame(self, index: int) -> backtest.BacktestFrame:
        """The frame as candidate motions of its points are made and tested; at frame 0 nothing came from anywhere."""
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

    def inverse_std(self, index: int) -> float:
        """Standard deviation of 1 / depth, 1/m."""
        sample = self.clip[index]
        if sample.right is None or self._given_depth(index) is not None:
            return _INVERSE_STD
        return _DISPARITY_STD / -float(sample.K[0, 0] * sample.right.right_from_left[0, 3])

    def once(self, stage: str, index: int, compute: Callable[[], Result], *, lifetime: int = 0) -> Result:
        """``compute``'s result, kept with the frame's others; its time counts as the stage's.

        Args:
            stage: its name in ``seconds``.
            index: the frame.
            compute: called if the result is not there.
            lifetime: frames that the result is kept for, if more than usual.
        """
        key = (stage, index)
        with self._lock:
            if key not in self._kept:
                if self._progress:
                    self._progress(stage)
                with self._clock.stage(stage):
                    self._kept[key] = compute()
                self._lifetimes[key] = max(lifetime, _KEPT)
                self._forget(index)
            return self._kept[key]

    def _part(self, name: str, index: int, compute: Callable[[], Result], stage: str = "layers") -> Result:
        """As `once`, of a part of a stage."""
        key = (name, index)
        with self._lock:
            if key not in self._kept:
                with self._clock.stage(stage):
                    self._kept[key] = compute()
                self._forget(index)
            return self._kept[key]

    def _forget(self, index: int) -> None:
        """Drop what frame ``index`` and those after it no longer need."""
        for key in list(self._kept):
            lifetime = self._lifetimes.get(key, _KEPT)
            if not index - lifetime < key[1] <= index + lifetime:
                del self._kept[key]
                self._lifetimes.pop(key, None)

    def _depth(self, index: int) -> NDArray[np.float32]:
        sample, depth = self.clip[index], self._given_depth(index)
        if self._is_estimated(index):
            return self._combined(index).depth
        if depth is not None:
            return depth if (depth > 0).mean() >= _DENSE else densify(depth, self.image(index), sky=self._sky(index))
        if sample.right is None:
            return self._from_motion(index).depth
        focal = -float(sample.K[0, 0] * sample.right.right_from_left[0, 3])
        searched = min(math.ceil(focal / _NEAREST), sample.width // 2)
        pair = self.image(index), sample.right.read_as(sample.K, sample.height, sample.width)
        rig = sample.right.right_from_left
        return stereo_depth(*pair, sample.K, rig, max_disparity=searched, fill=False)

    def _given_depth(self, index: int) -> NDArray[np.float32] | None:
        """The clip's own depth [1, H, W] m, 0 = invalid; None where it has none, or a map without a valid pixel."""
        key = ("given depth", index)
        with self._lock:
            if key not in self._kept:
                self._kept[key] = self._read_depth(index)
            return self._kept[key]

    def _read_depth(self, index: int) -> NDArray[np.float32] | None:
        sample = self.clip[index]
        if sample.depth is None:
            return None
        depth = sample.read_depth()
        if (depth > 0).any():
            return depth.copy()
        if index not in self._empty:
            self._empty.add(index)
            file = getattr(sample.depth, "path", None) or "its depth"
            instead = "motion" if sample.right is None else "the stereo pair"
            _LOG.warning(
                "%s: frame %s: %s has no valid depth; it comes from %s", self.clip.name, sample.name, file, instead
            )
        return None

    def is_monocular(self, index: int) -> bool:
        """Whether depth comes, wholly or in part, from the motion of one camera."""
        return self._is_estimated(index) or self._is_from_motion(index)

    def _is_from_motion(self, index: int) -> bool:
        return self.clip[index].right is None and self._given_depth(index) is None

    def _is_estimated(self, index: int) -> bool:
        """Whether depth is a network's, to be combined with motion's: without a stereo pair, or without a unit."""
        sample = self.clip[index]
        if not isinstance(sample.depth, EstimatedFrame) or self._given_depth(index) is None:
            return False
        return sample.right is None or not sample.depth.metric

    def _combined(self, index: int) -> CombinedDepth:
        return self.once("combined depth", index, lambda: self._combine(index))

    def _combine(self, index: int) -> CombinedDepth:
        sample, estimate = self.clip[index], self._given_depth(index)
        assert estimate is not None and isinstance(sample.depth, EstimatedFrame)
        static = ~self.own(index)
        if sample.labels is not None:
            static &= sample.read_mask()
        if len(self.clip) == 1 or self.is_lost(index):
            frames = [index]
        elif index == 0:
            frames = [1, 0]
        else:
            frames = list(range(index - 1 if self.is_lost(index - 1) else max(index - 2, 0), index + 1))
        known = self.correspondence(index) if len(frames) > 1 and index > 0 else None
        images = [self.image(i) for i in frames]
        metric = sample.depth.metric
        return combine_depth(estimate, images, sample.K, metric=metric, static=static, correspondence=known)

    def _from_motion(self, index: int) -> MotionDepth:
        if len(self.clip) < 2:
            raise ValueError(f"{self.clip.name}: needs two frames, a right camera or depth, got one frame alone")
        if index == 0:  # nothing is before it, so what comes after has to do
            return self.once("motion depth", 0, lambda: motion_depth([self.image(1), self.image(0)], self.clip[0].K))
        if self.is_lost(index):
            alone = [self.image(index)] * 2
            return self.once("motion depth", index, lambda: motion_depth(alone, self.clip[index].K))
        first = index - 1 if self.is_lost(index - 1) else max(index - 2, 0)
        images = [self.image(i) for i in range(first, index + 1)]
        known = self.correspondence(index)
        return self.once("motion depth", index, lambda: motion_depth(images, self.clip[index].K, correspondence=known))

    def _ego_motion(self, index: int) -> NDArray[np.float64]:
        if self.is_lost(index):
            return power(self.prev_from_cur(index - 1), self.clip.elapsed(index) / self.clip.elapsed(index - 1))
        if self._is_estimated(index):
            return self._combined(index).prev_from_cur
        if self.is_monocular(index):
            return self._from_motion(index).prev_from_cur
        sample = self.clip[index]
        static = ~self.own(index)
        if self.has_labels:
            static &= sample.read_mask()
        found = ego_motion(self.raw_depth(index), static, self.correspondence(index), sample.K)
        return found.dst_from_src

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

    def _sky(self, index: int, depth: NDArray[np.float32] | None = None) -> NDArray[np.bool_]:
        sample = self.clip[index]
        if self.has_labels:
            return sample.read_labels() == SKY
        if depth is not None and sample.right is not None and self._given_depth(index) is None:
            return sky_mask(self.image(index), self.raw_depth(index), matched=True)
        return sky_mask(self.image(index), depth)

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
        same = depth is self.raw_depth(index) or (
            self.clip[index].right is not None and self._given_depth(index) is None
        )
        sky = self._measured_sky(index) if same else self._sky(index, depth)
        return without_gaps(self.image(index), depth, sky)

    def _find_moving(self, index: int) -> Moving:
        surface, K = self.surface(index), self.clip[index].K
        things = objects.segment(surface.mask, surface.depth)
        if index == 0:
            return Moving(things, np.zeros_like(surface.image))
        depth = self.raw_depth(index)
        # Two depths whose scales may differ by more than an object moves say nothing.
        scaled = self.is_monocular(index) or self.is_monocular(index - 1)
        before = np.zeros_like(depth) if scaled else self.raw_depth(index - 1)
        measured = depth, before, self.inverse_std(index)
        motion = self.correspondence(index), self.prev_from_cur(index), K
        pair = Pair(surface.image, self.image(index - 1), self.prev_from_cur(index), K)
        by_thing = search(things, objects.velocities(things, *measured, *motion), depth, pair)
        velocity = by_thing.astype(np.float32)[things].transpose(2, 0, 1)
        by_flow = objects.follow_flow(velocity, surface.image, surface.depth, self._flow(index), *motion[1:])
        velocity = confirmed(by_flow, velocity, surface.depth, pair)
        return Moving(things, velocity / np.float32(self.clip.elapsed(index)))

    def _see(self, index: int) -> PerceivedFrame:
        surface, complete = self.surface(index), self._complete_depth(index)
        behind_image, behind_depth = inpaint_background(surface.image, complete, surface.mask, method=self.inpaint)
        if self.clip[index].ego_vehicle is None and surface.own.any():
            behind_depth = np.where(surface.own, behind_depth.clip(max=_BONNET), behind_depth)
        layers = Layers(surface.image, surface.depth, surface.mask, behind_image, behind_depth)
        velocity, sample, elapsed = self.moving(index).velocity, self.clip[index], self.clip.elapsed(index)
        motion = self.prev_from_cur(index) if index > 0 else None
        return PerceivedFrame(sample.name, sample.K, layers, velocity, surface.own, motion, elapsed)

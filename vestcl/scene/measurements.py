"""Measurements of a clip's frames without a network: images, optical flow, depth, camera motion. Kept by frame."""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl.data.calibration import power
from vestcl.data.sample import Clip, Sample
from vestcl.io.labels import SKY
from vestcl.scene.depth import CombinedDepth, combine_depth
from vestcl.scene.depth.foreground import StereoPair
from vestcl.scene.depth.from_motion import MotionDepth, motion_depth
from vestcl.scene.depth.lidar import densify
from vestcl.scene.depth.stereo import stereo_depth
from vestcl.scene.estimators.sources import EstimatedFrame
from vestcl.scene.flow.correspondence import Correspondence, correspond
from vestcl.scene.flow.optical_flow import FLOW_SIDE
from vestcl.scene.kept_results import KeptResults
from vestcl.scene.motion.ego_motion import ego_motion
from vestcl.scene.own_car import own_car
from vestcl.scene.sky import sky_mask
from vestcl.shapes import is_whole

#: Standard deviation of a stereo pair's disparity, px, and the nearest depth that is searched for, m.
_DISPARITY_STD, _NEAREST = 0.35, 2.0

#: Standard deviation of any other depth's inverse, 1/m: 2 % at 10 m.
_INVERSE_STD: Final = 0.002

#: Depth maps with a smaller share of valid pixels are scans, to be densified.
_DENSE: Final = 0.3

#: From this many intervals on there is a gap between two frames. It is too long if flow is trusted (its error forth
#: and back, px) at less than that share of the pixels that it is trusted at between the two frames before.
_GAP, _BELIEVED, _LOST = 1.5, 1.0, 0.6

#: A bonnet is looked for in this many of the last images.
_COMPARED: Final = 4

#: The least width, px, that frames are measured at.
LEAST_WIDTH: Final = 64

_LOG: Final = logging.getLogger(__name__)


def check_work_width(width: int | None) -> None:
    """Refuse what is no working width.

    Raises:
        ValueError: no whole number, or a width below `LEAST_WIDTH`.
    """
    if width is None:
        return
    if not is_whole(width):
        raise ValueError(f"`work_width` must be a whole number of px, or None, got {width!r}")
    if width < LEAST_WIDTH:
        raise ValueError(f"`work_width` must be {LEAST_WIDTH} px or more, got {width}")


def at_work_width(clip: Clip, width: int | None) -> Clip:
    """``clip`` at no more than ``width`` px, in proportion; None is its own.

    Raises:
        ValueError: no whole number, a width below `LEAST_WIDTH`, or one at which the clip is lower than `FLOW_SIDE`.
    """
    check_work_width(width)
    if width is None or clip[0].width <= width:
        return clip
    fitted = clip.fitted(None, int(width))
    if fitted[0].height < FLOW_SIDE <= clip[0].height:
        least = math.ceil(FLOW_SIDE * clip[0].width / clip[0].height)
        size = f"images of {clip[0].height} x {clip[0].width} px"
        raise ValueError(f"`work_width` must be {least} px or more for {size}, {FLOW_SIDE} px high, got {width}")
    return fitted


class _Gone:
    """The image of a frame that was dropped."""

    def __init__(self, height: int, width: int) -> None:
        self.height, self.width = height, width

    def read(self) -> NDArray[np.float32]:
        raise ValueError("the frame was dropped: only the last ones are kept")


def _forgotten(clip: Clip, index: int) -> Clip:
    """``clip`` without what frame ``index`` holds, if there is such a frame."""
    if index < 0:
        return clip
    sample = clip[index]
    gone = replace(sample, image=_Gone(sample.image.height, sample.image.width), depth=None, labels=None, right=None)
    return replace(clip, samples=(*clip.samples[:index], gone, *clip.samples[index + 1 :]))


class Measurements(KeptResults):
    """Measurements of the frames of a clip; `vestcl.scene.perception.Perception` lists where depth comes from.

    ``recorded`` is the clip as it came, ``clip`` the same at the working size, which everything measured has.

    Args:
        clip: at its own size.
        progress: called with the stage that begins.
        work_width: px, the largest width that is worked at; None is the clip's own.

    Raises:
        ValueError: as `at_work_width`; later also for a frame of another size than the first.
    """

    def __init__(
        self, clip: Clip, progress: Callable[[str], None] | None = None, *, work_width: int | None = None
    ) -> None:
        super().__init__(progress)
        self.recorded, self.clip = clip, at_work_width(clip, work_width)
        self.has_labels = all(sample.labels is not None for sample in clip)
        self._empty: set[int] = set()
        self._first = clip.samples[0]

    def append(self, sample: Sample, *, keep: int) -> None:
        """Take one more frame, the clip's next; what was found of earlier ones stays.

        Args:
            sample: of the clip's own size, after its last frame in time.
            keep: how many of the last frames stay readable; those before lose their images, so that memory is bounded.

        Raises:
            ValueError: a time that does not rise.
        """
        recorded = replace(self.recorded, samples=(*self.recorded.samples, sample))
        recorded.elapsed(len(recorded) - 1)
        same = self.recorded is self.clip
        working = sample if same else sample.resized(self.clip[0].height, self.clip[0].width)
        clip = recorded if same else replace(self.clip, samples=(*self.clip.samples, working))
        self.recorded, self.clip = (_forgotten(each, len(each) - 1 - keep) for each in (recorded, clip))
        if same:
            self.clip = self.recorded

    @contextmanager
    def appended(self, sample: Sample, *, keep: int) -> Iterator[Clip]:
        """`append` for a ``with`` block; if that fails, the frame is taken back.

        Yields:
            The clip with the frame.
        """
        before = self.recorded, self.clip
        try:
            self.append(sample, keep=keep)
            yield self.recorded
        except BaseException:
            self.recorded, self.clip = before
            self.forget_all()  # the frame before may have been measured by this one
            raise

    def image(self, index: int) -> NDArray[np.float32]:
        """[3, H, W]."""
        return self.once("read", index, lambda: self._read(index))

    def _read(self, index: int) -> NDArray[np.float32]:
        sample, first = self.recorded[index], self._first
        if (sample.height, sample.width) != (first.height, first.width):
            wanted, got = f"{first.height} x {first.width}", f"{sample.height} x {sample.width}"
            name = self.clip.name
            raise ValueError(
                f"{name}: frames must have one size, {wanted} px as the first, got {got} of frame {sample.name}"
            )
        return self.clip[index].read_image().copy()

    def full_image(self, index: int) -> NDArray[np.float32] | None:
        """[3, H', W'], the image as it was recorded; None where it has the working size."""
        if self.recorded is self.clip:
            return None
        return self._part("full image", index, lambda: self.recorded[index].read_image().copy(), "read")

    def correspondence(self, index: int) -> Correspondence:
        """From frame ``index`` to the one before."""
        if not 1 <= index < len(self.clip):
            raise ValueError(f"`index` must be 1 ... {len(self.clip) - 1}, a frame with one before, got {index}")
        return self.once("flow", index, lambda: correspond(self.image(index), self.image(index - 1)))

    def raw_depth(self, index: int) -> NDArray[np.float32]:
        """[1, H, W] m as measured, 0 = invalid."""
        return self.once("depth", index, lambda: self._depth(index))

    def prev_from_cur(self, index: int) -> NDArray[np.float64]:
        """[4, 4] m: the camera's motion from frame ``index`` to the one before."""
        return self.once("ego-motion", index, lambda: self._ego_motion(index))

    def motions(self, indices: Sequence[int]) -> list[NDArray[np.float64]]:
        """`prev_from_cur` of consecutive frames, all in the scale of the last one where depth comes from motion.

        There each frame's road gives it its own scale; parallax over three images gives the ratio of their speeds.
        Where it does not, as in the first moment of a drive, the same speed is assumed for the motion before.

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
        """Factor of lengths in the scale of frame ``index`` - 1 to that of frame ``index``."""
        if index < 2 or not self._is_from_motion(index):
            return 1.0
        now, before = (float(np.linalg.norm(self.prev_from_cur(i)[:3, 3])) for i in (index, index - 1))
        scaled = self._from_motion(index).speed_before * now
        return scaled / before if scaled and before else 1.0

    def is_lost(self, index: int) -> bool:
        """Whether the frame before is too far away in time to be matched, and there is a motion before that."""
        if index < 2 or self.clip.elapsed(index) < _GAP:
            return False
        now, before = ((self.correspondence(i).error < _BELIEVED).mean() for i in (index, index - 1))
        return bool(now < _LOST * before) and not self.is_lost(index - 1)  # in this order few frames are looked at

    def own(self, index: int) -> NDArray[np.bool_]:
        """[1, H, W], True where the recording car itself is in the image: by the clip's own files; found in a video of
        one camera, which may be a dashboard's."""
        return self._untimed("own car", index, lambda: self._find_own(index))

    def inverse_std(self, index: int) -> float:
        """Standard deviation of 1 / depth, 1/m."""
        sample = self.clip[index]
        if sample.right is None or self._given_depth(index) is not None:
            return _INVERSE_STD
        return _DISPARITY_STD / -float(sample.K[0, 0] * sample.right.right_from_left[0, 3])

    def is_monocular(self, index: int) -> bool:
        """Whether depth comes, wholly or in part, from the motion of one camera."""
        return self._is_estimated(index) or self._is_from_motion(index)

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

    def _find_own(self, index: int) -> NDArray[np.bool_]:
        sample = self.clip[index]
        if sample.ego_vehicle is not None or not self.is_monocular(index):
            return sample.read_ego_vehicle().copy()
        since = range(index, max(index - _COMPARED, -1), -1)
        first = next((i for i in since if self.is_lost(i)), 0)
        return own_car([self.image(i) for i in since if i >= first])

    def _sky(self, index: int, depth: NDArray[np.float32] | None = None) -> NDArray[np.bool_]:
        sample = self.clip[index]
        if self.has_labels:
            return sample.read_labels() == SKY
        if depth is not None and self._is_matched(index):
            return sky_mask(self.image(index), self.raw_depth(index), matched=True)
        return sky_mask(self.image(index), depth)

    def _depth(self, index: int) -> NDArray[np.float32]:
        sample, depth = self.clip[index], self._given_depth(index)
        if self._is_estimated(index):
            return self._combined(index).depth
        if depth is not None:
            return depth if (depth > 0).mean() >= _DENSE else densify(depth, self.image(index), sky=self._sky(index))
        if sample.right is None:
            return self._from_motion(index).depth
        pair, rig = self._pair(index), sample.right.right_from_left
        searched = min(math.ceil(pair.focal / _NEAREST), sample.width // 2)
        return stereo_depth(pair.left, pair.right, sample.K, rig, max_disparity=searched, fill=False)

    def _pair(self, index: int) -> StereoPair:
        return self._untimed("pair", index, lambda: self._read_pair(index))

    def _read_pair(self, index: int) -> StereoPair:
        sample = self.clip[index]
        assert sample.right is not None
        focal = -float(sample.K[0, 0] * sample.right.right_from_left[0, 3])
        return StereoPair(self.image(index), sample.right.read_as(sample.K, sample.height, sample.width), focal)

    def _is_matched(self, index: int) -> bool:
        """Whether depth comes from the stereo pair."""
        return self.clip[index].right is not None and self._given_depth(index) is None

    def _given_depth(self, index: int) -> NDArray[np.float32] | None:
        """The clip's own depth [1, H, W] m, 0 = invalid; None where it has none, or a map without a valid pixel."""
        return self._untimed("given depth", index, lambda: self._read_depth(index))

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
            raise ValueError(f"{self.clip.name}: needs two frames, a right camera or depth, got only one frame")
        if index == 0:  # nothing is before it, so what comes after has to do
            return self.once("motion depth", 0, lambda: motion_depth([self.image(1), self.image(0)], self.clip[0].K))
        if self.is_lost(index):
            still = [self.image(index)] * 2
            return self.once("motion depth", index, lambda: motion_depth(still, self.clip[index].K))
        first = index - 1 if self.is_lost(index - 1) else max(index - 2, 0)
        images = [self.image(i) for i in range(first, index + 1)]
        known = self.correspondence(index)
        return self.once("motion depth", index, lambda: motion_depth(images, self.clip[index].K, correspondence=known))

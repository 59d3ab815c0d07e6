"""Estimated depth and classes as a clip's own: computed when a sample is read, and kept for a while."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from vestcl.data.sample import Clip
from vestcl.data.sources import ImageSource
from vestcl.io.labels import LAST_TRAIN_ID, VOID
from vestcl.scene import checked

#: Frames whose estimates are kept, by clip and kind. A forecast reads two frames, each more than once (depth for the
#: layers, classes for the mask and for the sky); eight leave memory for earlier frames, at 2 MB of depth per KITTI
#: frame.
KEPT: Final = 8

Element = TypeVar("Element", np.float32, np.uint8)


class _Kept(Generic[Element]):
    """The last estimates, by frame; the least recently used goes first."""

    def __init__(self, estimate: Callable[[NDArray[np.float32]], NDArray[Element]]) -> None:
        self._estimate: Callable[[NDArray[np.float32]], NDArray[Element]] = estimate
        self._by_frame: OrderedDict[int, NDArray[Element]] = OrderedDict()

    def read(self, frame: int, image: ImageSource) -> NDArray[Element]:
        found = self._by_frame.pop(frame, None)  # one step: another thread may read as well
        if found is None:
            found = self._estimate(image.read()).copy()  # an estimator may fill one array again and again
        self._by_frame[frame] = found
        if len(self._by_frame) > KEPT:
            self._by_frame.popitem(last=False)
        return found.copy()  # what is kept stays as it is, whatever a reader does to its own


@dataclass(frozen=True, eq=False)
class EstimatedFrame(Generic[Element]):
    """One frame's estimate: a DepthSource or a LabelSource."""

    image: ImageSource
    frame: int
    kept: _Kept[Element]
    metric: bool = True
    """Whether depth is in metres."""

    def read(self) -> NDArray[Element]:
        """[1, H, W] at the image's own size: metres, or train ids."""
        return self.kept.read(self.frame, self.image)


@dataclass(frozen=True)
class CheckedDepth:
    """An estimator of depth that is refused if it answers with what can't be.

    Args:
        estimate: [3, H, W] RGB in [0, 1] -> [1, H, W] m, 0 = unknown.
    """

    estimate: Callable[[NDArray[np.float32]], NDArray[np.float32]]

    def __call__(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        return checked.depth("depth", self.estimate(image), image)


@dataclass(frozen=True)
class CheckedClasses:
    """The same of classes.

    Args:
        estimate: [3, H, W] RGB in [0, 1] -> [1, H, W] uint8 train ids, 255 = void.
    """

    estimate: Callable[[NDArray[np.float32]], NDArray[np.uint8]]

    def __call__(self, image: NDArray[np.float32]) -> NDArray[np.uint8]:
        ids = np.asarray(self.estimate(image))
        if ids.dtype != np.uint8 or ids.shape != (1, *image.shape[1:]):
            wanted = f"[1, {image.shape[1]}, {image.shape[2]}] uint8"
            raise ValueError(f"`segmentation` must give {wanted}, got {list(ids.shape)} {ids.dtype}")
        strange = ids[(ids > LAST_TRAIN_ID) & (ids != VOID)]
        if strange.size:
            raise ValueError(f"`segmentation` must give train ids (0 ... {LAST_TRAIN_ID}, {VOID}), got {strange[0]}")
        return ids


def with_estimates(
    clip: Clip,
    depth: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None = None,
    segmentation: Callable[[NDArray[np.float32]], NDArray[np.uint8]] | None = None,
) -> Clip:
    """The clip with estimated depth, estimated classes, or both, in place of its own.

    Nothing is computed here. A sample's `read_depth` estimates from the image at its own size, however small the
    sample is to be, and brings that to the sample's size. The estimates of the last KEPT frames are kept.

    Args:
        clip: of any reader, resized or not.
        depth: [3, H, W] RGB in [0, 1] -> [1, H, W] m, 0 = unknown: a `DepthEstimator` or any function; None leaves
            the clip's own. An attribute ``metric`` that is False means that it has no unit, as `OnnxDepth.metric`.
        segmentation: [3, H, W] -> [1, H, W] uint8 train ids, 255 = void: a `SegmentationEstimator` or any function;
            None leaves the clip's own.

    Returns:
        A clip of the same frames. Its `read_depth` and `read_labels` raise a ValueError where an estimator answers
        with another shape or with depths or classes that can't be.
    """
    depths = None if depth is None else _Kept(CheckedDepth(depth))
    metric = bool(getattr(depth, "metric", True))
    classes = None if segmentation is None else _Kept(CheckedClasses(segmentation))
    samples = tuple(
        replace(
            sample,
            depth=sample.depth if depths is None else EstimatedFrame(sample.image, frame, depths, metric),
            labels=sample.labels if classes is None else EstimatedFrame(sample.image, frame, classes),
        )
        for frame, sample in enumerate(clip)
    )
    return replace(clip, samples=samples)

"""Forecasts as frames come in: what was perceived of earlier frames is kept, so that each new one costs its own work.

for future in vestcl.live("drive.mp4", fov=60, steps=5): ...        # each frame of a clip, one after the other

camera = vestcl.Live(K, fps=10, steps=5, views=["source", "right"], right_from_left=rig, right_K=K)
future = camera.push(left, right=right)                             # None for the first frame
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.constants import Quality
from vestcl.data import calibration
from vestcl.data.sample import Clip, RightCamera, Sample, image_planes
from vestcl.data.sources import ImageArray
from vestcl.forecasting.api import WorkWidth, check_steps, chosen_views, forecaster, open, width_of
from vestcl.forecasting.future import Future
from vestcl.forecasting.result import View
from vestcl.scene.flow.optical_flow import FLOW_SIDE
from vestcl.scene.measurements import check_work_width
from vestcl.scene.perception import Perception
from vestcl.shapes import is_real, is_whole

if TYPE_CHECKING:
    from vestcl.models.forecaster import Forecaster

#: Images of this many frames are kept: a forecast looks at eight, and one of them may be skipped.
_KEPT: Final = 12


def live(
    clip: Clip | str | Path,
    *,
    steps: int = 5,
    views: str | Iterable[str | View] = ("source",),
    model: "str | Path | Forecaster | None" = None,
    quality: Quality = "balanced",
    every: int = 1,
    work_width: WorkWidth = "preset",
    **options: Any,
) -> Iterator[Future]:
    """Forecast from each frame of a clip that has one before it, in order; later frames are not looked at.

    Args:
        clip: what `vestcl.open` gave, or anything that it opens, with ``options``.
        steps: see `vestcl.forecast`.
        views: likewise.
        model: likewise.
        quality: likewise.
        every: from every how many-th frame.
        work_width: px, the largest width that scenes are perceived at; None is the clip's own, "preset" that of
            ``quality``.
        **options: of `vestcl.open`, where ``clip`` is to be opened.

    Yields:
        The future from each frame, made when it is asked for.

    Raises:
        ValueError: as `vestcl.forecast`, at once; or ``every`` below 1.
    """
    if isinstance(clip, Clip):
        if options:
            raise ValueError(f"`clip` is open: it takes no {', '.join(options)}")
    else:
        clip = open(clip, **options)
    if not is_whole(every) or every < 1:
        raise ValueError(f"`every` must be 1 frame or more, a whole number, got {every!r}")
    check_steps(steps)
    if len(clip) < 2:
        raise ValueError(f"`clip` must have 2 frames or more, got {len(clip)}")
    cameras, make = chosen_views(views, clip, 1), forecaster(model, quality)
    perception = Perception(clip, work_width=width_of(work_width, quality))
    return (
        Future(clip, index, tuple(cameras), make(perception, index, steps, cameras))
        for index in range(1, len(clip), every)
    )


class Live:
    """Frames in, forecasts out.

    Memory is bounded: images of the last twelve frames stay, and what was perceived of the last few. One thread at a
    time may push.

    Args:
        K: [3, 3] px, of all images, pixel centres at +0.5.
        fps: frames per second, for frames that are pushed without a timestamp.
        steps: frames to forecast.
        views: cameras, as `vestcl.forecast` takes them.
        model: likewise.
        quality: likewise.
        right_from_left: [4, 4] m, of a stereo rig; frames are then pushed with their right image.
        right_K: [3, 3] px, of the right camera; None is ``K``.
        work_width: px, the largest width that scenes are perceived at; None is the clip's own, "preset" that of
            ``quality``.

    Raises:
        ValueError: matrices that are no camera or no rig, a rate that is not positive, no steps, or no such model.
    """

    def __init__(
        self,
        K: ArrayLike,
        *,
        fps: float = 10.0,
        steps: int = 5,
        views: str | Iterable[str | View] = ("source",),
        model: "str | Path | Forecaster | None" = None,
        quality: Quality = "balanced",
        right_from_left: ArrayLike | None = None,
        right_K: ArrayLike | None = None,
        work_width: WorkWidth = "preset",
    ) -> None:
        if not (is_real(fps) and 0 < fps < np.inf):
            raise ValueError(f"`fps` must be above 0 Hz, got {fps!r}")
        check_steps(steps)
        width = width_of(work_width, quality)
        check_work_width(width)
        if right_K is not None and right_from_left is None:
            raise ValueError("`right_K` is of a stereo rig; it needs `right_from_left`")
        self.K, self.fps, self.steps, self.work_width = _matrix("K", K), fps, steps, width
        several = isinstance(views, Iterable) and not isinstance(views, str)
        self.views: str | tuple[str | View, ...] = tuple(views) if several else views  # type: ignore[assignment]
        self._rig = None if right_from_left is None else _matrix("right_from_left", right_from_left)
        self._right_K = self.K if right_K is None else _matrix("right_K", right_K)
        calibration.check_intrinsics(self.K, "K")
        if self._rig is not None:
            calibration.check_rigid(self._rig, "right_from_left")
            calibration.check_intrinsics(self._right_K, "right_K")
            if not self._rig[0, 3] < 0:
                wanted = "t_x < 0 (the right camera is to the right)"
                raise ValueError(f"`right_from_left` must have {wanted}, got {self._rig[0, 3]}")
        self._make = forecaster(model, quality)
        self._perception: Perception | None = None

    def push(
        self,
        image: ArrayLike,
        *,
        right: ArrayLike | None = None,
        depth: ArrayLike | None = None,
        timestamp: float | None = None,
    ) -> Future | None:
        """Take the next frame, and forecast from it.

        Args:
            image: [3, H, W] RGB in [0, 1].
            right: [3, H, W] of the right camera, of a stereo rig.
            depth: [1, H, W] m, valid iff > 0, if something measures it.
            timestamp: seconds, rising; None counts by ``fps``.

        Returns:
            The future; None for the first frame, from which nothing is known to move.

        Raises:
            ValueError: an image of another shape or size than the first one's or outside [0, 1], depth of other
                proportions, a right image without a rig or none with one, or a time that does not rise. The frame is
                then as if it had not come; likewise where the forecast fails.
        """
        sample = self._sample(image, right, depth, timestamp)
        if self._perception is None:
            clip = Clip("live", "live", (sample,))
            chosen_views(self.views, clip, 0)
            self._perception = Perception(clip, work_width=self.work_width)
            return None
        with self._perception.appended(sample, keep=_KEPT) as clip:
            index, cameras = len(clip) - 1, chosen_views(self.views, clip, len(clip) - 1)
            return Future(clip, index, tuple(cameras), self._make(self._perception, index, self.steps, cameras))

    def _sample(
        self, image: ArrayLike, right: ArrayLike | None, depth: ArrayLike | None, timestamp: float | None
    ) -> Sample:
        if (right is None) != (self._rig is None):
            raise ValueError(
                "`right` must be given: the rig has a right camera"
                if right is None
                else "`right` needs a rig: give `right_from_left`"
            )
        before = None if self._perception is None else self._perception.recorded[-1]
        number = 0 if self._perception is None else len(self._perception.recorded)
        if timestamp is None:
            timestamp = 0.0 if before is None or before.timestamp is None else before.timestamp + 1 / self.fps
        elif not (is_real(timestamp) and np.isfinite(timestamp)):
            raise ValueError(f"`timestamp` must be a finite number of seconds, got {timestamp!r}")
        sample = Sample.from_arrays(f"{number:06}", image, self.K, depth=depth, timestamp=timestamp)
        if right is not None and self._rig is not None:
            there = ImageArray(image_planes("right", right))
            sample = replace(sample, right=RightCamera(there, self._right_K, self._rig))
        if min(sample.height, sample.width) < FLOW_SIDE:
            got = f"{sample.height} x {sample.width}"
            raise ValueError(f"`image` must be {FLOW_SIDE} x {FLOW_SIDE} px or larger, got {got}")
        if sample.depth is not None:
            sample.read_depth()  # refuses other proportions
        if before is not None:
            _check_follows(sample, before)
        return sample


def _matrix(name: str, value: ArrayLike) -> NDArray[np.float64]:
    try:
        matrix = np.asarray(value)
        if np.iscomplexobj(matrix):
            raise TypeError(f"an array of {matrix.dtype}")
        return np.array(matrix, np.float64)
    except (ValueError, TypeError, RuntimeError) as error:  # the last one of a tensor that needs its gradient
        raise ValueError(f"`{name}` must be a matrix of numbers: {error}") from error


def _check_follows(sample: Sample, before: Sample) -> None:
    size, wanted = f"{sample.height} x {sample.width}", f"{before.height} x {before.width}"
    if size != wanted:
        raise ValueError(f"`image` must be {wanted} px as the frames before, got {size}")
    if (sample.depth is None) != (before.depth is None):
        raise ValueError("`depth` must be given with every frame, or with none")
    now, then = sample.timestamp, before.timestamp
    assert now is not None and then is not None
    if not now > then:
        raise ValueError(f"`timestamp` must be after {then:g} s, of the frame before, got {now:g}")

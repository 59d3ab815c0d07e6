"""What every reader gives: a clip of samples, one per frame, all with the same types and units.

A sample holds no pixels: it knows where they are and reads them when asked, at the sample's own size. So a drive of
thousands of frames opens at once, and `Sample.resized` costs nothing but a K.
"""

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, overload

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from vestcl import geometry, times
from vestcl.data import calibration, fit, resize
from vestcl.data.sources import (
    DepthArray,
    DepthSource,
    ImageArray,
    ImageSource,
    LabelArray,
    LabelSource,
    RegionSource,
)
from vestcl.io.labels import background

#: Values of an image may lie outside [0, 1] by this much, as interpolation leaves them.
_OVERSHOOT: Final = 0.1


class _CameraImage:
    """An image and its camera, read at any size: what `Sample` and `RightCamera` share."""

    image: ImageSource
    K: NDArray[np.float64]
    size: tuple[int, int] | None

    @property
    def height(self) -> int:
        """Px, of whatever is read."""
        return self.size[0] if self.size else self.image.height

    @property
    def width(self) -> int:
        """Px, of whatever is read."""
        return self.size[1] if self.size else self.image.width

    def read_image(self) -> NDArray[np.float32]:
        """[3, height, width] RGB in [0, 1]: mean over area where it shrinks, bilinear where it grows.

        Raises:
            ValueError: the file is missing, damaged or of another size than its clip.
        """
        return resize.resize_image(self.image.read(), self.height, self.width)

    def resized_intrinsics(self, height: int, width: int) -> NDArray[np.float64]:
        """diag(sx, sy, 1) K of the image at another size, [3, 3] px."""
        sx, sy = width / self.width, height / self.height
        return geometry.scale_intrinsics(torch.from_numpy(self.K), sx, sy).numpy()


@dataclass(frozen=True, eq=False)
class RightCamera(_CameraImage):
    """The second camera of a stereo rig, at the same time."""

    image: ImageSource
    K: NDArray[np.float64]
    """[3, 3] px, of an image of ``size``."""
    right_from_left: NDArray[np.float64]
    """[4, 4] m; t_x is minus the baseline."""
    size: tuple[int, int] | None = None
    """(height, width) to read at; None is the image's own."""

    def __post_init__(self) -> None:
        calibration.check_intrinsics(self.K, "right camera")
        calibration.check_rigid(self.right_from_left, "right camera: right_from_left")

    def read_as(self, K: NDArray[np.float64], height: int, width: int) -> NDArray[np.float32]:
        """[3, height, width] RGB in [0, 1] as the same camera with another K would see it; black outside its image.

        Args:
            K: [3, 3] px, of an image of ``height`` x ``width``: the left camera's, for rows that correspond.
            height: px.
            width: px.

        Raises:
            ValueError: as `read_image`.
        """
        camera = self.resized(height, width)
        image = camera.read_image()
        if np.allclose(camera.K, K, rtol=1e-6):
            return image
        columns = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0] * camera.K[0, 0] + camera.K[0, 2] - 0.5
        rows = (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1] * camera.K[1, 1] + camera.K[1, 2] - 0.5
        return resize.sample_grid(image, rows, columns)

    def resized(self, height: int, width: int) -> "RightCamera":
        """The same camera at another size, with diag(sx, sy, 1) K."""
        return replace(self, K=self.resized_intrinsics(height, width), size=(height, width))


@dataclass(frozen=True, eq=False)
class Sample(_CameraImage):
    """One frame and what is known about it. Everything is over the same field of view, at ``height`` x ``width``."""

    name: str
    """Name of the frame in its clip, "0000000012"."""
    image: ImageSource
    K: NDArray[np.float64]
    """[3, 3] px, continuous coordinates (pixel centres at +0.5), of an image of ``size``."""
    size: tuple[int, int] | None = None
    """(height, width) to read at; None is the image's own."""
    timestamp: float | None = None
    """Seconds, from an arbitrary start."""
    world_from_cam: NDArray[np.float64] | None = None
    """[4, 4] m."""
    depth: DepthSource | None = None
    labels: LabelSource | None = None
    """Where the background mask M comes from."""
    ego_vehicle: RegionSource | None = None
    """The recording car's own bonnet, where it is in the image and known."""
    right: RightCamera | None = None

    def __post_init__(self) -> None:
        calibration.check_intrinsics(self.K, f"sample {self.name}")
        if self.world_from_cam is not None:
            calibration.check_rigid(self.world_from_cam, f"sample {self.name}: world_from_cam")

    @classmethod
    def from_arrays(
        cls,
        name: str,
        image: ArrayLike,
        K: ArrayLike,
        *,
        depth: ArrayLike | None = None,
        train_ids: ArrayLike | None = None,
        world_from_cam: ArrayLike | None = None,
        timestamp: float | None = None,
    ) -> "Sample":
        """A sample of arrays at hand, which are copied.

        Args:
            name: of the frame.
            image: [3, H, W] RGB in [0, 1].
            K: [3, 3] px, pixel centres at +0.5.
            depth: [1, H, W] m, valid iff > 0 and finite.
            train_ids: [1, H, W] Cityscapes train ids.
            world_from_cam: [4, 4] m.
            timestamp: seconds.

        Raises:
            ValueError: an array of another shape, an image of whole numbers, with NaN or outside [0, 1], or matrices
                that are no camera or no motion.
        """
        picture = image_planes("image", image)
        metres = None if depth is None else _planes("depth", depth, np.float32, 1)
        if metres is not None:
            metres = np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0))
        return cls(
            name,
            ImageArray(picture),
            np.array(K, np.float64),
            timestamp=timestamp,
            world_from_cam=None if world_from_cam is None else np.array(world_from_cam, np.float64),
            depth=None if metres is None else DepthArray(metres),
            labels=None if train_ids is None else LabelArray(_planes("train_ids", train_ids, np.uint8, 1)),
        )

    def read_depth(self) -> NDArray[np.float32]:
        """[1, height, width] m, valid iff > 0: nearest valid source pixel, see `resize.resize_depth`.

        Raises:
            ValueError: the sample has no depth, or its file is missing, damaged or of other proportions.
        """
        return self._read(self.depth, "depth", resize.resize_depth)

    def read_labels(self) -> NDArray[np.uint8]:
        """[1, height, width] Cityscapes train ids, 255 = void, 10 = sky: nearest source pixel.

        Raises:
            ValueError: the sample has no labels, or their file is missing, damaged or of other proportions.
        """
        return self._read(self.labels, "labels", resize.resize_labels)

    def read_mask(self) -> NDArray[np.bool_]:
        """M [1, height, width], True = static background (SPEC section 3.2), from the labels.

        Raises:
            ValueError: as `read_labels`.
        """
        return background(self.read_labels())

    def read_ego_vehicle(self) -> NDArray[np.bool_]:
        """[1, height, width], True where the recording car itself is in the image; nowhere if that is not known.

        Raises:
            ValueError: the file is missing, damaged or of other proportions.
        """
        if self.ego_vehicle is None:
            return np.zeros((1, self.height, self.width), bool)
        return self._read(self.ego_vehicle, "ego_vehicle", resize.resize_labels)

    def resized(self, height: int, width: int) -> "Sample":
        """The same frame at another size, anisotropic if need be: diag(sx, sy, 1) K, and everything read at it.

        Args:
            height: px.
            width: px.

        Raises:
            ValueError: a size that is not a positive integer.
        """
        resize.check_size(height, width)
        right = None if self.right is None else self.right.resized(height, width)
        return replace(self, K=self.resized_intrinsics(height, width), size=(height, width), right=right)

    def _read(self, source: Any, name: str, resized: Callable[[Any, int, int], Any]) -> Any:
        if source is None:
            raise ValueError(f"sample {self.name} has no {name}; its clip comes without")
        planes = source.read()
        height, width = planes.shape[1:]
        rounded = abs(height * self.image.width / width - self.image.height) < 1  # by a resize, less than a pixel
        if not (rounded or fit.same_proportions((height, width), (self.image.height, self.image.width))):
            where = getattr(source, "path", f"sample {self.name}: {name}")
            wanted = f"{self.image.height} x {self.image.width}"
            raise ValueError(f"{where}: must have the proportions of the image, {wanted}, got {height} x {width}")
        return resized(planes, self.height, self.width)


@dataclass(frozen=True, eq=False)
class Clip(Sequence[Sample]):
    """Consecutive frames of one camera.

    Motion is per second: `positions` has each frame's time in intervals of the clip, by which forecasts extrapolate. A
    clip without timestamps is evenly spaced.
    """

    name: str
    kind: str
    """The reader it comes from, "KITTI raw"."""
    samples: tuple[Sample, ...]

    def __post_init__(self) -> None:
        if not self.samples:
            raise ValueError(f"{self.name}: has no frames")

    def __len__(self) -> int:
        return len(self.samples)

    def __repr__(self) -> str:
        first, rate = self.samples[0], "" if self.fps is None else f" at {self.fps:g} Hz"
        return f"Clip({self.name}, {self.kind}, {len(self)} frames of {first.height} x {first.width} px{rate})"

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> "Clip": ...
    def __getitem__(self, index: int | slice) -> "Sample | Clip":
        """A frame, or the clip of a slice (which must have a frame)."""
        return replace(self, samples=self.samples[index]) if isinstance(index, slice) else self.samples[index]

    def __iter__(self) -> Iterator[Sample]:
        return iter(self.samples)

    @functools.cached_property
    def fps(self) -> float | None:
        """1 / `interval`; None if that is not known."""
        return None if self.interval is None else round(1 / self.interval, 6)  # 25, not 24.999999999999996

    @functools.cached_property
    def interval(self) -> float | None:
        """Seconds, the median from frame to frame (`vestcl.times.median_interval`); None without timestamps.

        Raises:
            ValueError: timestamps that do not increase; the message names the frames.
        """
        return None if self._seconds is None else times.median_interval(self._seconds)

    @functools.cached_property
    def positions(self) -> NDArray[np.float64]:
        """[frames] times in intervals since the first frame; 0, 1, 2 ... where they are evenly spaced, or not known.

        Raises:
            ValueError: timestamps that do not increase; the message names the frames.
        """
        if self._seconds is None or self.interval is None:
            return np.arange(len(self), dtype=np.float64)
        return times.positions(self._seconds, self.interval)

    def elapsed(self, index: int) -> float:
        """Intervals from the frame before ``index`` to ``index``; 1 for the first frame.

        Raises:
            ValueError: timestamps that do not increase; the message names the frames.
        """
        return float(self.positions[index] - self.positions[index - 1]) if index else 1.0

    def after(self, index: int, steps: int) -> list[int]:
        """The frames at t + 1, t + 2, ... intervals, see `vestcl.times.frames_after`.

        Args:
            index: of the frame t.
            steps: how many.
        """
        return times.frames_after(self.positions, index, steps)

    def is_whole(self, index: int, steps: int) -> bool:
        """Whether frames t + 1 ... t + steps follow frame t = ``index`` without a gap: they are each other's next."""
        return self.after(index, steps) == list(range(index + 1, index + steps + 1))

    @functools.cached_property
    def _seconds(self) -> list[float] | None:
        """Timestamps, increasing."""
        known = [sample.timestamp for sample in self if sample.timestamp is not None]
        if not known:
            return None
        if len(known) < len(self):
            missing = next(sample.name for sample in self if sample.timestamp is None)
            raise ValueError(f"{self.name}: frame {missing} must have a timestamp, as others do; got none")
        times.check_increasing(known, [f"frame {sample.name}" for sample in self], self.name)
        return known

    def resized(self, height: int, width: int) -> "Clip":
        """All samples at another size, see `Sample.resized`."""
        return self._mapped(sample.resized(height, width) for sample in self)

    def fitted(self, height: int | None, width: int | None) -> "Clip":
        """At a height, a width or both; the other side follows in proportion. Without either the clip itself."""
        if height is None and width is None:
            return self
        sample = self.samples[0]
        if height is None and width is not None:
            height = max(1, round(sample.height * width / sample.width))
        elif width is None and height is not None:
            width = max(1, round(sample.width * height / sample.height))
        assert height is not None and width is not None
        return self.resized(height, width)

    def from_first_pose(self) -> "Clip":
        """The same clip with the first camera as world: first_from_world world_from_cam; without poses, itself."""
        first = self.samples[0].world_from_cam
        if first is None:
            return self
        poses = [None if s.world_from_cam is None else calibration.invert(first) @ s.world_from_cam for s in self]
        return self._mapped(replace(s, world_from_cam=pose) for s, pose in zip(self, poses, strict=True))

    def _mapped(self, samples: Iterable[Sample]) -> "Clip":
        return replace(self, samples=tuple(samples))


def image_planes(name: str, value: ArrayLike) -> NDArray[np.float32]:
    """A copy of an image, [3, H, W] RGB in [0, 1].

    Args:
        name: of the argument, for messages.
        value: the image.

    Raises:
        ValueError: another shape, whole numbers, NaN, or values outside [0, 1] by more than `_OVERSHOOT`.
    """
    planes = _planes(name, value, np.float32, 3)
    low, high = float(planes.min()), float(planes.max())
    if np.isnan(low):
        raise ValueError(f"`{name}` must not have NaN")
    kind = getattr(value, "dtype", None)
    whole = isinstance(kind, np.dtype) and np.issubdtype(kind, np.integer)
    if whole or low < -_OVERSHOOT or high > 1 + _OVERSHOOT:
        got = f"{kind} of {low:g} ... {high:g}" if whole else f"{low:g} ... {high:g}"
        raise ValueError(f"`{name}` must be RGB in [0, 1], floating-point, got {got}; divide 8-bit values by 255")
    return planes


def _planes(name: str, value: ArrayLike, dtype: type[np.generic], channels: int) -> NDArray[Any]:
    try:
        given = np.asarray(value)
        if np.iscomplexobj(given):
            raise TypeError(f"an array of {given.dtype}")
        planes = given.astype(dtype)  # a copy, also of the same dtype
    except (ValueError, TypeError, RuntimeError) as error:  # the last one of a tensor that needs its gradient
        raise ValueError(f"`{name}` must be an array [{channels}, H, W] of numbers: {error}") from error
    if planes.ndim != 3 or len(planes) != channels or not planes.size:
        raise ValueError(f"`{name}` must be [{channels}, H, W], got {list(planes.shape)}")
    return planes

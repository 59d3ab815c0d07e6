"""Where a sample's images come from: files that are read when they are asked for, or arrays at hand."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vestcl.io import depth as depth_io
from vestcl.io import labels as labels_io
from vestcl.io.images import read_image, to_float
from vestcl.io.video.reading import Video


class ImageSource(Protocol):
    """An image of known size."""

    @property
    def height(self) -> int:
        """Px."""

    @property
    def width(self) -> int:
        """Px."""

    def read(self) -> NDArray[np.float32]:
        """[3, H, W] RGB in [0, 1]."""


class DepthSource(Protocol):
    """A depth map over the image's whole field of view, of any size."""

    def read(self) -> NDArray[np.float32]:
        """[1, H, W] m, valid iff > 0."""


class LabelSource(Protocol):
    """Classes over the image's whole field of view, of any size."""

    def read(self) -> NDArray[np.uint8]:
        """[1, H, W] Cityscapes train ids, 255 = void."""


class RegionSource(Protocol):
    """A part of the image's field of view, of any size."""

    def read(self) -> NDArray[np.bool_]:
        """[1, H, W]."""


@dataclass(frozen=True)
class ImageFile:
    """A PNG or JPEG, whose calibration is for ``height`` x ``width``."""

    path: Path
    height: int
    width: int

    def read(self) -> NDArray[np.float32]:
        """[3, H, W] RGB in [0, 1].

        Raises:
            ValueError: no such file, damaged, or of another size.
        """
        return read_image(self.path, (self.height, self.width))


@dataclass(frozen=True)
class VideoFrame:
    """Frame ``index`` of a video, shared by all the samples of its clip."""

    video: Video
    index: int

    @property
    def height(self) -> int:
        """Px."""
        return self.video.height

    @property
    def width(self) -> int:
        """Px."""
        return self.video.width

    def read(self) -> NDArray[np.float32]:
        """[3, H, W] RGB in [0, 1].

        Raises:
            ValueError: the file ends before the frame.
        """
        return to_float(self.video[self.index])


@dataclass(frozen=True, eq=False)
class ImageArray:
    """An image at hand."""

    image: NDArray[np.float32]
    """[3, H, W] RGB in [0, 1]."""

    @property
    def height(self) -> int:
        """Px."""
        return self.image.shape[1]

    @property
    def width(self) -> int:
        """Px."""
        return self.image.shape[2]

    def read(self) -> NDArray[np.float32]:
        """A copy of the image."""
        return self.image.copy()


@dataclass(frozen=True)
class DepthFile:
    """A depth map that `vestcl.io.depth.read_depth` reads."""

    path: Path
    units_per_metre: float | None = None
    """None is metres, for EXR and NPY."""

    def read(self) -> NDArray[np.float32]:
        """[1, H, W] m, valid iff > 0.

        Raises:
            ValueError: no such file, damaged, or of another kind.
        """
        return depth_io.read_depth(self.path, self.units_per_metre)[None]


@dataclass(frozen=True)
class DisparityFile:
    """A Cityscapes disparity map."""

    path: Path
    baseline: float
    """Metres."""
    fx: float
    """Px of the 2048 pixels wide image."""

    def read(self) -> NDArray[np.float32]:
        """[1, H, W] m, valid iff > 0.

        Raises:
            ValueError: no such file, damaged, or of another kind.
        """
        return depth_io.read_cityscapes_disparity(self.path, self.baseline, self.fx)[None]


@dataclass(frozen=True, eq=False)
class DepthArray:
    """A depth map at hand."""

    depth: NDArray[np.float32]
    """[1, H, W] m, valid iff > 0."""

    def read(self) -> NDArray[np.float32]:
        """A copy of the depth map."""
        return self.depth.copy()


@dataclass(frozen=True)
class LabelFile:
    """A PNG of classes."""

    path: Path
    kind: labels_io.LabelKind

    def read(self) -> NDArray[np.uint8]:
        """[1, H, W] train ids, 255 = void.

        Raises:
            ValueError: no such file, damaged, or of another kind.
        """
        return labels_io.read_train_ids(self.path, self.kind)[None]


@dataclass(frozen=True, eq=False)
class LabelArray:
    """Classes at hand."""

    train_ids: NDArray[np.uint8]
    """[1, H, W] Cityscapes train ids, 255 = void."""

    def read(self) -> NDArray[np.uint8]:
        """A copy of the classes."""
        return self.train_ids.copy()


@dataclass(frozen=True)
class EgoVehicleFile:
    """The recording car's bonnet in a Cityscapes labelIds PNG."""

    path: Path

    def read(self) -> NDArray[np.bool_]:
        """[1, H, W].

        Raises:
            ValueError: no such file, damaged, or of another kind.
        """
        return labels_io.read_ego_vehicle(self.path)[None]

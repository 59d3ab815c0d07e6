"""Lens distortion, undone on reading: what comes out is a pinhole image of the same K and size.

The pixel at (u, v) shows what the recorded image has at (fx x_d + cx, fy y_d + cy), where x = (u - cx) / fx,
y = (v - cy) / fy, r^2 = x^2 + y^2 and, as in OpenCV,

    opencv   x_d = x q + 2 p1 x y + p2 (r^2 + 2 x^2),   y_d = y q + p1 (r^2 + 2 y^2) + 2 p2 x y,
             q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
    fisheye  (x_d, y_d) = (x, y) a / r,   a = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8),   t = atan r

Pixels that the recorded image does not show are black, without depth and void; they count as moving with the camera.
"""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.data import calibration, fit
from vestcl.data.sources import DepthSource, ImageFile, ImageSource, LabelSource
from vestcl.io.labels import VOID

#: Radii at which a distortion is compared with growing with the radius.
_RADII: Final = 2048

#: The largest share of pixels that a recorded image may not show.
_MOST_OUTSIDE: Final = 0.5

#: OpenCV's remapping counts pixels in 16 bits with a sign.
_LONGEST: Final = 32_766


@dataclass(frozen=True)
class Distortion:
    """A model and its coefficients."""

    fisheye: bool
    coefficients: tuple[float, ...]
    """opencv: k1, k2, p1, p2, k3, k4, k5, k6; fisheye: k1, k2, k3, k4."""

    def radius(self, r: NDArray[np.float64]) -> NDArray[np.float64]:
        """The distorted radius without the tangential part, of r = tan of the angle to the optical axis."""
        k = self.coefficients
        if self.fisheye:
            t = np.arctan(r)
            return t * (1 + k[0] * t**2 + k[1] * t**4 + k[2] * t**6 + k[3] * t**8)
        s = r**2
        return r * (1 + k[0] * s + k[1] * s**2 + k[4] * s**3) / (1 + k[5] * s + k[6] * s**2 + k[7] * s**3)

    def reach(self, largest: float) -> float:
        """The radius up to which the distorted one grows; beyond, the lens would show a direction twice."""
        radii = np.linspace(0, largest, _RADII)
        with np.errstate(all="ignore"):
            grows = np.diff(self.radius(radii)) > 0
        return largest if grows.all() else float(radii[grows.argmin()])


@dataclass(frozen=True)
class Lens:
    """The camera of a recorded image."""

    K: tuple[float, float, float, float]
    """fx, fy, cx, cy in px, pixel centres at +0.5."""
    height: int
    width: int
    distortion: Distortion

    @classmethod
    def of(cls, K: calibration.Matrix, size: fit.Size, distortion: Distortion, where: str) -> "Lens":
        """The lens of images of ``size``.

        Raises:
            ValueError: the distortion leaves less than half of the image, or the image is too large.
        """
        if max(size) > _LONGEST:
            raise ValueError(
                f"{where}: images with distortion must have at most {_LONGEST} px per side, got {max(size)}"
            )
        lens = cls(_numbers(K), *size, distortion)
        share = float(lens.at(64, 64).outside().mean())
        if share > _MOST_OUTSIDE:
            why = f"undistorted, {share:.0%} of the image would be outside the recorded one"
            raise ValueError(f"{where}: {why}; at most {_MOST_OUTSIDE:.0%} may be: {distortion}")
        return lens

    def at(self, height: int, width: int) -> "Lens":
        """The same lens, for the same image at another size."""
        K = fit.scaled(calibration.intrinsics(*self.K), (self.height, self.width), (height, width))
        return Lens(_numbers(K), height, width, self.distortion)

    def undistort(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """[3, H, W] as recorded -> [3, H, W], bilinear; black where the recorded image shows nothing."""
        columns, rows, outside = _maps(self)
        planes = [cv2.remap(plane, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in image]
        return np.where(outside, np.float32(0), np.stack(planes))

    def nearest(self, planes: NDArray[Any], fill: int) -> NDArray[Any]:
        """[C, h, w] over the recorded image at any size -> [C, h, w], nearest; ``fill`` where it shows nothing."""
        columns, rows, outside = _maps(self.at(*planes.shape[1:]))
        row = np.rint(np.where(outside, 0, rows)).astype(np.intp).clip(0, planes.shape[1] - 1)
        column = np.rint(np.where(outside, 0, columns)).astype(np.intp).clip(0, planes.shape[2] - 1)
        return np.where(outside, planes.dtype.type(fill), planes[:, row, column])

    def outside(self) -> NDArray[np.bool_]:
        """[H, W]: pixels that the recorded image does not show."""
        return _maps(self)[2]


@dataclass(frozen=True)
class UndistortedImage:
    """An image file seen through a lens."""

    source: ImageFile
    lens: Lens

    @property
    def height(self) -> int:
        """Px."""
        return self.source.height

    @property
    def width(self) -> int:
        """Px."""
        return self.source.width

    @property
    def path(self) -> Path:
        """The file."""
        return self.source.path

    def read(self) -> NDArray[np.float32]:
        """[3, H, W] RGB in [0, 1], undistorted.

        Raises:
            ValueError: as `ImageFile.read`.
        """
        return self.lens.undistort(self.source.read())


@dataclass(frozen=True)
class UndistortedDepth:
    """A depth map over a recorded image. Distortion moves pixels, not their z."""

    source: DepthSource
    lens: Lens

    @property
    def path(self) -> Path | None:
        """The file, if there is one."""
        return getattr(self.source, "path", None)

    def read(self) -> NDArray[np.float32]:
        """[1, H, W] m, undistorted, valid iff > 0.

        Raises:
            ValueError: as the source.
        """
        return self.lens.nearest(self.source.read(), 0)


@dataclass(frozen=True)
class UndistortedLabels:
    """Classes over a recorded image."""

    source: LabelSource
    lens: Lens

    @property
    def path(self) -> Path | None:
        """The file, if there is one."""
        return getattr(self.source, "path", None)

    def read(self) -> NDArray[np.uint8]:
        """[1, H, W] train ids, undistorted, 255 = void.

        Raises:
            ValueError: as the source.
        """
        return self.lens.nearest(self.source.read(), VOID)


@dataclass(frozen=True)
class OutsideLens:
    """The pixels that the recorded image does not show: like a bonnet, they stay where they are in every frame."""

    lens: Lens

    def read(self) -> NDArray[np.bool_]:
        """[1, H, W]."""
        return self.lens.outside()[None]


def undistorted_image(source: ImageFile, lens: Lens | None) -> ImageSource:
    """The image as seen through ``lens``; itself where there is none."""
    return source if lens is None else UndistortedImage(source, lens)


def undistorted_depth(source: DepthSource | None, lens: Lens | None) -> DepthSource | None:
    """The depth map as seen through ``lens``; itself where there is none."""
    return source if source is None or lens is None else UndistortedDepth(source, lens)


def undistorted_labels(source: LabelSource | None, lens: Lens | None) -> LabelSource | None:
    """The classes as seen through ``lens``; themselves where there is none."""
    return source if source is None or lens is None else UndistortedLabels(source, lens)


def lens_of(image: ImageSource) -> Lens | None:
    """The lens that an image is undistorted by, if any: other maps of the recorded image need it, too."""
    return image.lens if isinstance(image, UndistortedImage) else None


def _numbers(K: calibration.Matrix) -> tuple[float, float, float, float]:
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


@functools.lru_cache(maxsize=4)
def _maps(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Columns and rows [H, W] in the recorded image, pixel centres at integers, and where it shows nothing."""
    fx, fy, cx, cy = lens.K
    K, size = calibration.intrinsics(fx, fy, cx - 0.5, cy - 0.5), (lens.width, lens.height)
    coefficients = np.array(lens.distortion.coefficients)
    if lens.distortion.fisheye:
        columns, rows = cv2.fisheye.initUndistortRectifyMap(K, coefficients, np.eye(3), K, size, cv2.CV_32FC1)
    else:
        columns, rows = cv2.initUndistortRectifyMap(K, coefficients, np.eye(3), K, size, cv2.CV_32FC1)
    x = (np.arange(lens.width) + 0.5 - cx) / fx
    y = (np.arange(lens.height) + 0.5 - cy) / fy
    radii = np.hypot(x[None], y[:, None])
    with np.errstate(invalid="ignore"):
        shown = (columns >= -0.5) & (columns < lens.width - 0.5) & (rows >= -0.5) & (rows < lens.height - 0.5)
    shown &= radii <= lens.distortion.reach(float(radii.max()))
    return np.asarray(columns, np.float32), np.asarray(rows, np.float32), ~shown

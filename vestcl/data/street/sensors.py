"""Simulated sensors and classifiers for a street's frame: sparse laser scans, and classes with errors."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.data.street.camera import intrinsics
from vestcl.data.street.clip import Shot
from vestcl.data.street.raycast import FOREGROUND, STREET_SKY_DEPTH

#: A scanner's elevations, degrees, its range in metres and the standard deviation of that: Velodyne's HDL-64E, as on
#: KITTI's car (data sheet 63-9194; 64 beams). BEAMS are drawn from: its number, half and a quarter of it.
ELEVATIONS: Final = (-24.8, 2.0)
FARTHEST: Final = 120.0
RANGE_STD: Final = 0.02
BEAMS: Final = (64, 32, 16)

#: Degrees from return to return at 10 revolutions per second (the same data sheet), but no fewer pixels than that: a
#: scan is sparse at any size of the image.
AZIMUTH_STEP: Final = 0.1728
LEAST_PIXELS: Final = 2.0

#: The share of returns that are lost, on dark or mirroring surfaces. Chosen.
LOST: Final = 0.1

#: Shares of instances that a classifier misses, and largest change of an outline in pixels of an image 416 px wide.
#: Both are choices: no classifier was measured.
MISSED: Final = 0.08
OUTLINE: Final = 2.5

#: Streams of random numbers, by sensor.
_SCAN, _CLASSES = 60, 61


@dataclass(frozen=True)
class StreetScan:
    """Depth of a laser scanner at the camera: beams of equal elevation that are swept around."""

    shot: Shot
    beams: int
    index: int
    """Index of the frame, which has its own noise."""

    def read(self) -> NDArray[np.float32]:
        """[1, H, W] m, valid iff > 0: of each return the z-depth in the pixel that it falls in."""
        depth = self.shot.take().depth[0, 0]
        rows, columns, lengths = self._rays()
        rng = np.random.default_rng([self.shot.street.seed, _SCAN, self.index])
        noise, kept = rng.normal(0, RANGE_STD, rows.shape), rng.random(rows.shape) > LOST
        z = depth[rows, columns]
        kept &= (z < STREET_SKY_DEPTH) & (z * lengths < FARTHEST)
        result = np.full(depth.shape, np.inf, np.float32)
        np.minimum.at(result, (rows[kept], columns[kept]), (z + noise / lengths)[kept].astype(np.float32))
        return np.where(np.isfinite(result), np.maximum(result, 0), np.float32(0))[None]

    def _rays(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
        """Rows and columns of the pixels that rays meet, and metres along each ray per metre of z."""
        height, width = self.shot.size
        K = intrinsics(height, width)
        half = np.degrees(np.arctan(width / 2 / K[0, 0]))
        step = max(AZIMUTH_STEP, np.degrees(LEAST_PIXELS / K[0, 0]))
        azimuth = np.radians(np.arange(-half, half, step))
        elevation = np.radians(np.linspace(*ELEVATIONS, self.beams))[:, None]
        x = np.broadcast_to(np.tan(azimuth), (self.beams, len(azimuth)))
        y = -np.tan(elevation) / np.cos(azimuth)
        columns, rows = np.floor(x * K[0, 0] + K[0, 2]), np.floor(y * K[1, 1] + K[1, 2])
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        lengths = np.sqrt(1 + x * x + y * y)
        return rows[inside].astype(np.intp), columns[inside].astype(np.intp), lengths[inside]


@dataclass(frozen=True)
class DisturbedLabels:
    """The true classes with a classifier's errors: instances that are missed, or whose outline is off."""

    shot: Shot
    index: int
    """Index of the frame, which has its own errors."""

    def read(self) -> NDArray[np.uint8]:
        """[1, H, W] Cityscapes train ids. A connected region of one foreground class counts as an instance."""
        labels = self.shot.take().labels[0, 0]
        rng = np.random.default_rng([self.shot.street.seed, _CLASSES, self.index])
        result = _without_foreground(labels)
        for label in FOREGROUND:
            count, regions = cv2.connectedComponents((labels == label).astype(np.uint8))
            for region in range(1, count):
                missed, change = rng.random() < MISSED, rng.uniform(-1, 1) * OUTLINE * labels.shape[1] / 416
                if not missed:
                    result[_grown(regions == region, change)] = label
        return result[None]


def _grown(region: NDArray[np.bool_], pixels: float) -> NDArray[np.bool_]:
    """The region dilated by this many pixels, or eroded by as many below 0."""
    size = 2 * round(abs(pixels)) + 1
    if size == 1:
        return region
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    change = cv2.dilate if pixels > 0 else cv2.erode
    return change(region.astype(np.uint8), brush).astype(bool)


def _without_foreground(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Foreground pixels with the class of the nearest background pixel."""
    hidden = np.isin(labels, [int(label) for label in FOREGROUND])
    if not hidden.any() or hidden.all():
        return labels.copy()
    _, nearest = cv2.distanceTransformWithLabels(
        hidden.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_nearest = np.zeros(int(nearest.max()) + 1, np.uint8)
    of_nearest[nearest[~hidden]] = labels[~hidden]
    return of_nearest[nearest]

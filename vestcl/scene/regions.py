"""Superpixels: small connected regions of one colour and one depth, which rarely cross an object's border."""

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.segmentation import slic

from vestcl.scene import checked

#: Superpixels are found in images of at most that width, which takes a few ms, and enlarged.
_WIDTH: Final = 208

#: How many units of CIELAB a change of depth by a factor e counts as: a tenth of depth as 6. Not tuned.
_DEPTH: Final = 60.0

#: SLIC's weight of nearness against likeness, in units of CIELAB, and its rounds: half of scikit-image's ten, for time.
_COMPACTNESS, _ROUNDS = 10.0, 5

#: Depths are compared up to this many metres: the sky is no farther than what is before it.
_NEAREST, _FARTHEST = 1.0, 200.0


def superpixels(image: ArrayLike, depth: ArrayLike, *, area: float = 100.0) -> NDArray[np.int32]:
    """SLIC: k-means of (L, a, b, 60 log z, x, y), where positions weigh the less the larger the regions are.

    Args:
        image: [3, H, W] RGB in [0, 1].
        depth: [1, H, W] m, above 0 everywhere.
        area: pixels of a superpixel in an image of 208 columns, on average; in wider ones in proportion.

    Returns:
        [H, W], 0 ... n - 1; each region is connected.

    Raises:
        ValueError: shapes, numbers that aren't finite, a depth of 0, an area below 1.

    Source: Achanta et al., SLIC Superpixels Compared to State-of-the-Art Superpixel Methods, 2012, by scikit-image.
    """
    image = checked.planes("image", image, 3)
    depth = checked.depth("depth", depth, image)
    if not depth.all():
        raise ValueError(f"`depth` must be above 0 m everywhere, got {int((depth == 0).sum())} pixels of 0")
    if not area >= 1:
        raise ValueError(f"`area` must be 1 px or more, got {area}")
    height, width = image.shape[1:]
    scale = min(1.0, _WIDTH / width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    colour = cv2.resize(image.transpose(1, 2, 0), size, interpolation=cv2.INTER_AREA)
    log_depth = cv2.resize(np.log(depth[0].clip(_NEAREST, _FARTHEST)), size, interpolation=cv2.INTER_NEAREST)
    planes = np.dstack([cv2.cvtColor(colour, cv2.COLOR_RGB2LAB), np.float32(_DEPTH) * log_depth])
    count = max(1, round(size[0] * size[1] / area))
    # Values are scaled to [0, 1] inside; nearness is not.
    compactness = _COMPACTNESS / max(float(np.ptp(planes)), 1e-6)
    options: dict[str, Any] = {"compactness": compactness, "max_num_iter": _ROUNDS, "convert2lab": False}
    labels = slic(planes, n_segments=count, start_label=0, channel_axis=-1, **options).astype(np.int32)
    return np.asarray(cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST), np.int32)


def mean_by_region(values: ArrayLike, regions: NDArray[np.int32]) -> NDArray[np.float32]:
    """Each pixel's value replaced by the mean over its region.

    Args:
        values: [H, W].
        regions: [H, W], 0 ... n - 1.

    Returns:
        [H, W].

    Raises:
        ValueError: other shapes.
    """
    values = np.asarray(values, np.float32)
    if values.shape != regions.shape or values.ndim != 2:
        raise ValueError(f"`values` must be [{', '.join(map(str, regions.shape))}], got {list(values.shape)}")
    count = np.bincount(regions.ravel())
    mean = np.bincount(regions.ravel(), values.ravel()) / np.maximum(count, 1)
    return mean.astype(np.float32)[regions]

"""Images with a camera and a pose each, as reconstructions list them: what the readers of such lists share."""

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vestcl.data import calibration, fit
from vestcl.data.calibration import Matrix
from vestcl.data.lens import Distortion, Lens, OutsideLens, undistorted_image
from vestcl.data.readers.files import natural
from vestcl.data.sample import Clip, Sample
from vestcl.data.sources import ImageFile
from vestcl.io.images import image_size


class Posed(NamedTuple):
    """An image of a list."""

    path: Path
    where: str
    """File and entry of the list, for messages."""
    K: Matrix
    """[3, 3] px, pixel centres at +0.5."""
    size: fit.Size | None
    """(height, width) that K is for; None is not known."""
    distortion: Distortion | None
    world_from_cam: Matrix
    """[4, 4], camera axes x right, y down, z forward, in the list's unit."""


def is_file(path: Path) -> bool:
    """Whether there is a file; not for a name that no file can have."""
    try:
        return path.is_file()
    except OSError:
        return False


def check_options(fps: float | None, scale: float) -> None:
    """Refuse what is no rate and no unit.

    Raises:
        ValueError: not positive and finite.
    """
    for name, value in (("fps", fps), ("scale", scale)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"`{name}` must be positive and finite, got {value}")


def posed_clip(name: str, kind: str, images: Sequence[Posed], fps: float | None, scale: float) -> Clip:
    """The images in natural order of their paths, as a clip of one camera.

    Args:
        name: of the clip.
        kind: of the reader.
        images: one or more.
        fps: frames per second; None is not known.
        scale: metres per unit of the list.

    Raises:
        ValueError: an image that is missing, two of one name, images of several sizes, or a camera that can't be of
            them; the message names the entry.
    """
    ordered = sorted(images, key=lambda image: natural(str(image.path)))
    _check_names(ordered)
    for image in ordered:
        if not is_file(image.path):
            raise ValueError(f"{image.where}: there is no image {image.path}")
    size = image_size(ordered[0].path)
    _check_sizes(ordered)
    lens_of = functools.lru_cache(maxsize=None)(_lens)
    samples = []
    for index, image in enumerate(ordered):
        K = fit.fit_intrinsics(image.K, image.size, size, image.where)
        key = None if image.distortion is None else (*K[(0, 1, 0, 1), (0, 1, 2, 2)].tolist(), image.distortion)
        lens, outside = (None, None) if key is None else lens_of(key, size, image.where)
        pose = image.world_from_cam.copy()
        pose[:3, 3] *= scale
        time = None if fps is None else index / fps
        file = undistorted_image(ImageFile(image.path, *size), lens)
        calibration.check_rigid(pose, image.where)
        samples.append(Sample(image.path.stem, file, K, timestamp=time, world_from_cam=pose, ego_vehicle=outside))
    return Clip(name, kind, tuple(samples))


def _lens(
    key: tuple[float, float, float, float, Distortion], size: fit.Size, where: str
) -> tuple[Lens, OutsideLens | None]:
    """The lens of a camera, and the pixels that it does not show, if there are any."""
    fx, fy, cx, cy, distortion = key
    lens = Lens.of(calibration.intrinsics(fx, fy, cx, cy), size, distortion, where)
    return lens, OutsideLens(lens) if lens.outside().any() else None


def _check_names(images: Sequence[Posed]) -> None:
    found: dict[str, Posed] = {}
    for image in images:
        name = image.path.stem
        if name in found:
            other = found[name].path
            both = f"{other} twice" if other == image.path else f"{other} and {image.path}"
            raise ValueError(
                f"{image.where}: frames must have different names, got {both}; a clip has the images of one camera"
            )
        found[name] = image


def _check_sizes(images: Sequence[Posed]) -> None:
    """Frames of a clip have one size."""
    first = images[0]
    for image in images:
        if image.size != first.size:
            sizes = f"{_shown(first.size)} and {_shown(image.size)}"
            raise ValueError(f"{image.where}: the images of a clip must have one size, got {sizes}")


def _shown(size: fit.Size | None) -> str:
    return "no size" if size is None else f"{size[0]} x {size[1]}"


def rotation_of(quaternion: Sequence[float], where: str) -> Matrix:
    """R [3, 3] of (w, x, y, z), which is normalised.

    Raises:
        ValueError: no direction: 0, or not finite.
    """
    q = np.array(quaternion, np.float64)
    length = math.hypot(*quaternion)
    if not (math.isfinite(length) and length > 1e-8):
        raise ValueError(f"{where}: a quaternion must be finite and not 0, got {list(quaternion)}")
    w, x, y, z = q / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )

"""K for images of another size than the one that their calibration is for: scaled where that is safe, else refused.

Both sizes known, K becomes diag(sx, sy, 1) K with each axis by its own factor, if the two factors agree within 1 %: a
resize rounds each side on its own (KITTI at 640 x 192: 0.5153 and 0.5120). Other proportions are a crop, or images of
another kind. Where the calibration does not state its size, it is not scaled: KITTI's published numbers are for their
own size only, and any other principal point has to be near the middle.
"""

import json
from typing import Any, Final

import torch

from vestcl import geometry
from vestcl.data.calibration import Matrix

#: How far the factors of the two axes may differ, relatively.
SAME: Final = 0.01

#: How far from the middle a principal point may be where nothing states the calibration's size, as a part of width and
#: of height. Of the public driving data sets' cameras Cityscapes has 0.036 of the width, KITTI-360 has 0.135 of the
#: height (it is cropped). Half the size gives 0.48, three quarters 0.15.
OFF_MIDDLE: Final = (1 / 8, 1 / 5)

#: Focal lengths as a part of the side of the image: fields of view from 0.06 to 178 degrees.
FOCAL: Final = (0.01, 1000.0)

#: (fx, cx, cy) of P in KITTI's calibrations, centres at integers -> (height, width) of the rectified images: the
#: drives of 2011-09-26, 09-28, 09-29, 09-30 and 10-03, which the odometry sequences are parts of.
KITTI_SIZES: Final = {
    (721.5377, 609.5593, 172.854): (375, 1242),
    (707.0493, 604.0814, 180.5066): (370, 1224),
    (718.3351, 600.3891, 181.5122): (374, 1238),
    (707.0912, 601.8873, 183.1104): (370, 1226),
    (718.856, 607.1928, 185.2157): (376, 1241),
}

Size = tuple[int, int]
"""(height, width) px."""


def fit_intrinsics(K: Matrix, calibrated: Size | None, size: Size, where: str, place: str = "") -> Matrix:
    """diag(sx, sy, 1) K for images of ``size``, or K itself where it does not state its size and may be for them.

    Args:
        K: [3, 3] px, pixel centres at +0.5.
        calibrated: what K is for; None is not known.
        size: of the images.
        where: file and entry that K is from, for messages.
        place: how messages introduce the camera.json that would settle it; "" is a folder's next to the images.

    Raises:
        ValueError: other proportions, a principal point that can't be of these images, or a field of view that no
            camera has; the message has the camera.json that would settle it.
    """
    place = place or "A folder with the images in image/ and this camera.json settles it:"
    if calibrated is None:
        known = KITTI_SIZES.get((round(K[0, 0], 4), round(K[0, 2] - 0.5, 4), round(K[1, 2] - 0.5, 4)))
        if known not in (None, size):
            assert known is not None
            raise ValueError(_mismatch(K, known, size, where, place))
        check_camera(K, size, where, f"{place} {_unknown_size(K)}", near=True)
        return K
    if not same_proportions(calibrated, size):
        raise ValueError(_mismatch(K, calibrated, size, where, place))
    fitted = scaled(K, calibrated, size)
    check_camera(fitted, size, where, "Its cx and cy must be those of these images", near=False)
    return fitted


def same_proportions(one: Size, other: Size) -> bool:
    """Whether a resize leads from one size to the other: the factors of both axes agree within 1 %."""
    return abs(one[0] * other[1] - other[0] * one[1]) <= SAME * other[0] * one[1]


def scaled(K: Matrix, source: Size, target: Size) -> Matrix:
    """diag(sx, sy, 1) K."""
    return geometry.scale_intrinsics(torch.from_numpy(K), target[1] / source[1], target[0] / source[0]).numpy()


def check_camera(K: Matrix, size: Size, where: str, remedy: str, near: bool) -> None:
    """Refuse a principal point outside the image or, if it has to be ``near``, far from its middle; and odd focals.

    Raises:
        ValueError: as described above, with ``remedy``.
    """
    sides, point, focals = size[::-1], (float(K[0, 2]), float(K[1, 2])), (float(K[0, 0]), float(K[1, 1]))
    for side, focal, axis in zip(sides, focals, "xy", strict=True):
        if not FOCAL[0] <= focal / side <= FOCAL[1]:
            allowed = f"{FOCAL[0] * side:.4g} ... {FOCAL[1] * side:.4g} px"
            raise ValueError(
                f"{where}: f{axis} must be {allowed} for images of {size} (height, width), got {focal:.6g}"
            )
    shown = f"its principal point ({point[0]:.6g}, {point[1]:.6g}) px"
    if not all(0 <= at <= side for at, side in zip(point, sides, strict=True)):
        raise ValueError(f"{where}: {shown} is outside the images, which are {size} (height, width). {remedy}")
    off = [abs(at / side - 0.5) for at, side in zip(point, sides, strict=True)]
    if near and any(part > most for part, most in zip(off, OFF_MIDDLE, strict=True)):
        why = f"is far from the middle of the images, which are {size} (height, width): it seems to be for another size"
        raise ValueError(f"{where}: {shown} {why}, which it does not state. {remedy}")


def camera_json(K: Matrix, size: Size | None = None, **more: Any) -> str:
    """The text of a camera.json, pixel centres at integers.

    Args:
        K: [3, 3] px, pixel centres at +0.5.
        size: of the images that K is for.
        **more: other keys.
    """
    numbers = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] - 0.5, "cy": K[1, 2] - 0.5}
    content: dict[str, Any] = {key: round(float(value), 4) for key, value in numbers.items()}
    if size is not None:
        content |= {"width": size[1], "height": size[0]}
    return json.dumps(content | more)


def _unknown_size(K: Matrix) -> str:
    text = camera_json(K).removesuffix("}")
    return f'{text}, "width": WIDTH, "height": HEIGHT}} with the size of the images that these numbers are for'


def _mismatch(K: Matrix, calibrated: Size, size: Size, where: str, place: str) -> str:
    sx, sy = size[1] / calibrated[1], size[0] / calibrated[0]
    cut = f"cx = {K[0, 2] - 0.5:.6g} - columns cut off at the left, cy = {K[1, 2] - 0.5:.6g} - rows cut off at the top"
    resized = camera_json(scaled(K, calibrated, size), size)
    return (
        f"{where}: is for images of {calibrated} (height, width), but they are {size}: {sx:.4f} of the width and "
        f"{sy:.4f} of the height. {place} {resized} if they were resized; if they were cropped, "
        f"with fx = {K[0, 0]:.6g}, fy = {K[1, 1]:.6g}, {cut}"
    )

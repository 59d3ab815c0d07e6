"""Semantic labels in files, all brought to Cityscapes train ids, and the background mask they give.

M = 1 (static background) for road 0, sidewalk 1, building 2, wall 3, fence 4, vegetation 8, terrain 9, sky 10 and
void 255; M = 0 for pole 5, traffic light 6, traffic sign 7 and everybody and everything that moves, 11 to 18.
"""

import io
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vestcl.io._headers import check_whole, checked_size
from vestcl.io.atomic import read_bytes
from vestcl.io.images import read_pixels

LabelKind = Literal["trainIds", "labelIds", "virtual_kitti"]
"""How a PNG encodes classes: Cityscapes train ids, Cityscapes label ids, or Virtual KITTI 2's colours."""

#: The train id of what belongs to no class.
VOID: Final = 255

#: The train id of the sky.
SKY: Final = 10

#: Train ids of the foreground, M = 0 (SPEC section 3.2).
FOREGROUND: Final = (5, 6, 7, 11, 12, 13, 14, 15, 16, 17, 18)

#: The last of the 19 train ids.
LAST_TRAIN_ID: Final = 18

#: Cityscapes label id of the recording car itself, its bonnet.
EGO_VEHICLE: Final = 1

#: Cityscapes label id of each train id, 0 to 18; every other label id is void.
LABEL_IDS: Final = (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33)

#: The last of the label ids.
LAST_LABEL_ID: Final = 33

#: Virtual KITTI 2's colour of each class and its train id. GuardRail is void in Cityscapes' own training, too.
VIRTUAL_KITTI: Final = {
    "Terrain": ((210, 0, 200), 9),
    "Sky": ((90, 200, 255), SKY),
    "Tree": ((0, 199, 0), 8),
    "Vegetation": ((90, 240, 0), 8),
    "Building": ((140, 140, 140), 2),
    "Road": ((100, 60, 100), 0),
    "GuardRail": ((250, 100, 255), VOID),
    "TrafficSign": ((255, 255, 0), 7),
    "TrafficLight": ((200, 200, 0), 6),
    "Pole": ((255, 130, 0), 5),
    "Misc": ((80, 80, 80), VOID),
    "Truck": ((160, 60, 60), 14),
    "Car": ((255, 127, 80), 13),
    "Van": ((0, 139, 139), 13),
    "Undefined": ((0, 0, 0), VOID),
}


def read_train_ids(path: str | Path, kind: LabelKind) -> NDArray[np.uint8]:
    """Cityscapes train ids [H, W] uint8, 255 = void.

    Args:
        path: an 8-bit PNG of one channel (or a palette's indices), or RGB for "virtual_kitti".
        kind: what it holds.

    Raises:
        ValueError: no such file, damaged, of another kind, or with a value or a colour that ``kind`` does not have.

    Source: SPEC section 3.2; labels.py of the Cityscapes scripts; colors.txt of Virtual KITTI 2.
    """
    if kind == "virtual_kitti":
        return _from_colours(path)
    if kind not in ("trainIds", "labelIds"):
        raise ValueError(f"`kind` must be trainIds, labelIds or virtual_kitti, got {kind!r}")
    ids = _read_ids(path)
    last = LAST_TRAIN_ID if kind == "trainIds" else LAST_LABEL_ID
    strange = ids[(ids > last) & (ids != VOID)]
    if strange.size:
        raise ValueError(f"{path}: {strange[0]} is not one of the {kind} (0 ... {last}, 255)")
    return ids if kind == "trainIds" else _train_from_label()[ids]


def background(train_ids: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """M: True where the class is static background, void and sky included.

    Args:
        train_ids: uint8 of any shape.
    """
    return ~np.isin(train_ids, FOREGROUND)


def read_ego_vehicle(path: str | Path) -> NDArray[np.bool_]:
    """Where a Cityscapes labelIds PNG shows the recording car itself, [H, W].

    Raises:
        ValueError: no such file, damaged, or not 8 bits of one channel.
    """
    return _read_ids(path) == EGO_VEHICLE


def _read_ids(path: str | Path) -> NDArray[np.uint8]:
    """The indices as stored: a palette, as some tools write one for looking at, is not applied."""
    content = read_bytes(path)
    check_whole(path, content)
    checked_size(path, content)
    try:
        with Image.open(io.BytesIO(content)) as image:
            mode, ids = image.mode, np.array(image)
    except Exception as error:  # Pillow's plugins raise what their format's damage leads them to
        raise ValueError(f"{path}: is not an image, or a damaged one") from error
    if mode not in ("L", "P"):
        raise ValueError(f"{path}: label ids must be an 8-bit image of one channel, got mode {mode}")
    return ids.astype(np.uint8, copy=False)


def _from_colours(path: str | Path) -> NDArray[np.uint8]:
    pixels = read_pixels(path)
    if pixels.dtype != np.uint8 or pixels.ndim != 3:
        raise ValueError(f"{path}: Virtual KITTI's classes must be 8-bit RGB, got {pixels.dtype} {list(pixels.shape)}")
    codes = _code(pixels)
    ids = np.full(codes.shape, VOID, np.uint8)
    known = np.zeros(codes.shape, bool)
    for colour, train_id in VIRTUAL_KITTI.values():
        here = codes == _code(np.array(colour))
        ids[here] = train_id
        known |= here
    if not known.all():
        strange = tuple(pixels[~known][0].tolist())
        raise ValueError(f"{path}: {strange} is not a colour of Virtual KITTI's classes")
    return ids


def _code(colours: NDArray[np.generic]) -> NDArray[np.int32]:
    """r 2^16 + g 2^8 + b."""
    return colours.astype(np.int32) @ np.array([1 << 16, 1 << 8, 1], np.int32)


def _train_from_label() -> NDArray[np.uint8]:
    table = np.full(256, VOID, np.uint8)
    table[list(LABEL_IDS)] = np.arange(len(LABEL_IDS))
    return table

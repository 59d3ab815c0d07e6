"""Classes of public segmentation networks as Cityscapes' train ids."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl.io.labels import LABEL_IDS, LAST_LABEL_ID, LAST_TRAIN_ID, SKY, VOID

#: Train ids of what a class that only "moves" becomes: a car, foreground of any mask.
_CAR: Final = 13

#: Classes, train ids by index (SceneParse150, "objectInfo150.txt"; counted from 0, without its "other").
_ADE20K: Final = {
    0: 3, 1: 2, 2: SKY, 4: 8, 6: 0, 9: 9, 11: 1, 12: 11, 13: 9, 16: 9, 17: 8, 20: 13, 25: 2, 29: 9, 32: 4, 34: 9, 38: 4,
    42: 5, 43: 7, 46: 9, 48: 2, 52: 1, 54: 0, 61: 2, 66: 8, 68: 9, 72: 8, 76: 13, 79: 2, 80: 15, 83: 14, 84: 2, 87: 5,
    91: 0, 93: 5, 94: 9, 102: 13, 103: 13, 116: 17, 126: 11, 127: 18, 136: 6,
}  # fmt: skip

#: The same of Pascal VOC's 21, class 0 = background: vehicles, people, and animals as people.
_PASCAL_VOC: Final = {
    1: 13, 2: 18, 3: 11, 4: 13, 6: 15, 7: 13, 8: 11, 10: 11, 12: 11, 13: 11, 14: 17, 15: 11, 16: 8, 17: 11, 19: 16,
}  # fmt: skip


def _table(count: int, train_ids: Mapping[int, int]) -> tuple[int, ...]:
    return tuple(train_ids.get(index, VOID) for index in range(count))


#: Train id of each class, by the name that a network's JSON gives.
TABLES: Final[Mapping[str, tuple[int, ...]]] = {
    "cityscapes": tuple(range(LAST_TRAIN_ID + 1)),
    "cityscapes_label_ids": _table(LAST_LABEL_ID + 1, {label: index for index, label in enumerate(LABEL_IDS)}),
    "ade20k": _table(150, _ADE20K),
    "pascal_voc": _table(21, _PASCAL_VOC),
}


def of_movable(count: int, movable: tuple[int, ...], sky: tuple[int, ...]) -> tuple[int, ...]:
    """Train ids of ``count`` classes, of which it is only known which move, and which are the sky.

    Args:
        count: of the network's classes.
        movable: their indices.
        sky: likewise.
    """
    return _table(count, dict.fromkeys(sky, SKY) | dict.fromkeys(movable, _CAR))


def to_train_ids(classes: NDArray[np.int64], table: tuple[int, ...]) -> NDArray[np.uint8]:
    """Train ids of classes of any shape; a class that the table does not have is void."""
    padded = np.array([*table, VOID], np.uint8)
    return padded[np.where((classes >= 0) & (classes < len(table)), classes, len(table))]

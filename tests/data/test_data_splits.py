"""vestcl.data.readers.splits."""

import numpy as np
import pytest

from vestcl.data.readers import splits


def test_published_sizes() -> None:
    train, test = splits.KITTI_PREDICTION_TRAIN, splits.KITTI_PREDICTION_TEST
    assert (len(train), len(test), len(set(train) & set(test))) == (24, 4, 0)
    views = splits.KITTI_VIEWS_TRAIN, splits.KITTI_VIEWS_VAL, splits.KITTI_VIEWS_TEST
    assert [len(drives) for drives in views] == [20, 4, 4]
    assert sorted(sum(views, ())) == sorted(train + test) and len(set(sum(views, ()))) == 28
    assert test[0] == "2011_09_26_drive_0060_sync" and train[-1] == "2011_09_29_drive_0071_sync"


def test_the_views_split_is_the_published_shuffle() -> None:
    """Of the 28 drives in order, by NumPy's generator of seed 0: 70 % train, 15 % validate, the rest test."""
    drives = sorted(splits.KITTI_PREDICTION_TRAIN + splits.KITTI_PREDICTION_TEST)
    np.random.RandomState(0).shuffle(drives)
    train, val = round(0.7 * len(drives)), round(0.15 * len(drives))
    assert sorted(splits.KITTI_VIEWS_TRAIN) == sorted(drives[:train])
    assert sorted(splits.KITTI_VIEWS_VAL) == sorted(drives[train : train + val])
    assert sorted(splits.KITTI_VIEWS_TEST) == sorted(drives[train + val :])


def test_windows_of_the_published_test_drives() -> None:
    """Their lengths are 78, 383, 433 and 475 frames."""
    assert sum(len(list(splits.windows(frames))) for frames in (78, 383, 433, 475)) == 1337


def test_windows_by_hand() -> None:
    first, second = splits.windows(10)
    assert (list(first.context), list(first.future)) == ([0, 1, 2, 3], [4, 5, 6, 7, 8])
    assert (list(second.context[-2:]), list(second.future)) == ([3, 4], [5, 6, 7, 8, 9])
    assert list(splits.windows(8)) == [] and list(splits.windows(0)) == []
    assert [w.context.start for w in splits.windows(30, context=2, future=3, stride=7)] == [0, 7, 14, 21]
    (cityscapes,) = splits.windows(30, context=20, future=10)
    assert list(cityscapes.future) == list(range(20, 30))


@pytest.mark.parametrize("wrong", [{"frames": -1}, {"context": 0}, {"future": 0}, {"stride": 0}])
def test_refuses(wrong: dict[str, int]) -> None:
    (name,) = wrong
    with pytest.raises(ValueError, match=f"`{name}` must be at least"):
        splits.windows(**({"frames": 9} | wrong))

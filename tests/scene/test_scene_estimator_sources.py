"""Estimates as a clip's own depth and classes: when they are computed, how long they are kept, what is refused."""

import numpy as np
import pytest
from numpy.typing import NDArray

from vestcl.data.sample import Clip, Sample
from vestcl.scene.estimators import with_estimates
from vestcl.scene.estimators.sources import KEPT

K = np.array([[10.0, 0, 8], [0, 10, 4], [0, 0, 1]])
Image = NDArray[np.float32]


def clip(frames: int = 2) -> Clip:
    """Frame i is grey i / frames, with depth 5 m and road of its own."""
    samples = [
        Sample.from_arrays(
            str(i), np.full((3, 8, 16), i / frames), K, depth=np.full((1, 8, 16), 5.0), train_ids=np.zeros((1, 8, 16))
        )
        for i in range(frames)
    ]
    return Clip("grey", "arrays", tuple(samples))


class Counted:
    """Depth 1 + grey, and how often it was asked for."""

    def __init__(self) -> None:
        self.seen: list[float] = []

    def __call__(self, image: Image) -> Image:
        self.seen.append(float(image[0, 0, 0]))
        return 1 + image[:1]


def cars(image: Image) -> NDArray[np.uint8]:
    ids = np.zeros((1, *image.shape[1:]), np.uint8)
    ids[..., 8:] = 13
    return ids


def test_each_frame_is_estimated_once_and_only_when_read() -> None:
    depth = Counted()
    estimated = with_estimates(clip(4), depth)
    assert depth.seen == []
    for _ in range(3):
        np.testing.assert_array_equal(estimated[1].read_depth(), np.full((1, 8, 16), 1.25, np.float32))
        np.testing.assert_array_equal(estimated[3].read_depth(), np.full((1, 8, 16), 1.75, np.float32))
    assert depth.seen == [0.25, 0.75]


def test_what_is_not_estimated_stays_the_clips_own() -> None:
    own = clip()
    depth_only, classes_only, neither = (
        with_estimates(own, Counted()),
        with_estimates(own, None, cars),
        with_estimates(own),
    )
    assert depth_only[0].labels is own[0].labels and classes_only[0].depth is own[0].depth
    assert neither[1].depth is own[1].depth and neither[1].labels is own[1].labels
    assert [sample.name for sample in depth_only] == ["0", "1"] and depth_only[1].K is own[1].K


def test_a_resized_sample_estimates_the_whole_image() -> None:
    shapes = []

    def depth(image: Image) -> Image:
        shapes.append(image.shape)
        return np.full((1, *image.shape[1:]), 7, np.float32)

    for estimated in (
        with_estimates(clip(), depth, cars).resized(4, 8),
        with_estimates(clip().resized(4, 8), depth, cars),
    ):
        assert estimated[0].read_depth().shape == (1, 4, 8)
        np.testing.assert_array_equal(estimated[0].read_mask()[0], np.tile(np.arange(8) < 4, (4, 1)))
    assert shapes == [(3, 8, 16)] * 2


def test_a_slice_keeps_its_frames() -> None:
    np.testing.assert_array_equal(with_estimates(clip(4), Counted())[2:][0].read_depth(), 1.5)
    np.testing.assert_array_equal(with_estimates(clip(4)[2:], Counted())[0].read_depth(), 1.5)


def test_the_least_recently_read_is_forgotten_first() -> None:
    depth = Counted()
    estimated = with_estimates(clip(KEPT + 1), depth)
    for frame in (*range(KEPT), 0, KEPT):  # reading 0 again leaves 1 as the oldest
        estimated[frame].read_depth()
    assert len(depth.seen) == KEPT + 1
    estimated[0].read_depth()
    assert len(depth.seen) == KEPT + 1
    estimated[1].read_depth()
    assert len(depth.seen) == KEPT + 2


def test_an_estimator_may_fill_one_array_again_and_again() -> None:
    buffer = np.zeros((1, 8, 16), np.float32)

    def depth(image: Image) -> Image:
        np.copyto(buffer, 1 + image[:1])
        return buffer

    estimated = with_estimates(clip(4), depth)
    for frame in (1, 3, 1, 3):
        np.testing.assert_array_equal(estimated[frame].read_depth(), np.float32(1 + frame / 4))


def test_a_readers_changes_are_its_own() -> None:
    sample = with_estimates(clip(), Counted())[0]
    assert sample.depth is not None
    sample.depth.read().fill(-1)
    np.testing.assert_array_equal(sample.read_depth(), 1)


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        (np.ones((8, 16)), r"`depth` must be \[1, 8, 16\], got \[8, 16\]"),
        (np.full((1, 8, 16), np.nan), "`depth` must be finite"),
        (np.full((1, 8, 16), -1.0), "`depth` must be 0"),
    ],
)
def test_depths_that_cannot_be(depth: Image, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        with_estimates(clip(), lambda _: depth)[0].read_depth()


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        (np.zeros((1, 8, 16), np.int64), r"`segmentation` must give \[1, 8, 16\] uint8, got \[1, 8, 16\] int64"),
        (np.zeros((8, 16), np.uint8), r"`segmentation` must give \[1, 8, 16\] uint8, got \[8, 16\] uint8"),
        (np.full((1, 8, 16), 19, np.uint8), r"train ids \(0 \.\.\. 18, 255\), got 19"),
    ],
)
def test_classes_that_cannot_be(ids: NDArray[np.uint8], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        with_estimates(clip(), None, lambda _: ids)[0].read_labels()

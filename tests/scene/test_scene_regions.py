"""vestcl.scene.regions: superpixels, and means over them."""

from typing import Any

import numpy as np
import pytest
from geometric_scenes import HEIGHT, WIDTH, Floats, flat, noise
from skimage.measure import label

from vestcl.scene.regions import mean_by_region, superpixels


def scene(coloured: bool, deep: bool) -> tuple[Floats, Floats]:
    """A box before a wall, which colour or depth shows, or neither."""
    image, depth = np.full((3, HEIGHT, WIDTH), 0.5, np.float32), flat(40)
    if coloured:
        image[:, 30:70, 90:170] = np.array([0.8, 0.3, 0.2], np.float32)[:, None, None]
    if deep:
        depth[:, 30:70, 90:170] = 10.0
    return image, depth


@pytest.mark.parametrize(("coloured", "deep"), [(True, False), (False, True), (True, True)])
def test_regions_do_not_cross_a_border_of_colour_or_depth(coloured: bool, deep: bool) -> None:
    regions = superpixels(*scene(coloured, deep))
    box = np.zeros((HEIGHT, WIDTH), np.float32)
    box[30:70, 90:170] = 1
    share = mean_by_region(box, regions)
    assert np.minimum(share, 1 - share).mean() < 0.015  # a grid of squares: 0.06


def test_labels_count_up_and_each_region_is_connected() -> None:
    regions = superpixels(noise(), flat(20))
    assert regions.shape == (HEIGHT, WIDTH) and regions.dtype == np.int32
    assert np.array_equal(np.unique(regions), np.arange(regions.max() + 1))
    assert label(regions + 1, connectivity=1).max() == regions.max() + 1


@pytest.mark.parametrize("area", [25.0, 100.0, 400.0])
def test_regions_have_the_area_that_is_asked_for(area: float) -> None:
    count = superpixels(noise(blur=8.0), flat(20), area=area).max() + 1
    assert 0.5 < HEIGHT * WIDTH * (208 / WIDTH) ** 2 / area / count < 2


def test_a_wider_image_has_as_many_regions() -> None:
    image, depth = scene(True, True)
    small, wide = (
        superpixels(image, depth),
        superpixels(image.repeat(4, 1).repeat(4, 2), depth.repeat(4, 1).repeat(4, 2)),
    )
    assert wide.shape == (4 * HEIGHT, 4 * WIDTH)
    assert 0.5 < (wide.max() + 1) / (small.max() + 1) < 2


def test_mean_by_hand() -> None:
    regions = np.array([[0, 0, 1], [2, 1, 1]], np.int32)
    got = mean_by_region(np.array([[1.0, 3.0, 6.0], [5.0, 0.0, 3.0]]), regions)
    np.testing.assert_allclose(got, [[2, 2, 3], [5, 3, 3]])


def test_one_pixel() -> None:
    assert superpixels(np.zeros((3, 1, 1), np.float32), np.ones((1, 1, 1), np.float32)).tolist() == [[0]]


def test_same_bits_twice() -> None:
    first, second = (superpixels(noise(), flat(20)) for _ in range(2))
    assert np.array_equal(first, second)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": np.zeros((1, 4, 4))}, r"`image` must be \[3, H, W\], got \[1, 4, 4\]"),
        ({"depth": np.ones((1, 4, 5))}, r"`depth` must be \[1, 4, 4\], got \[1, 4, 5\]"),
        ({"depth": np.eye(4)[None]}, "`depth` must be above 0 m everywhere, got 12 pixels of 0"),
        ({"area": 0.5}, "`area` must be 1 px or more, got 0.5"),
        ({"area": float("nan")}, "`area` must be 1 px or more, got nan"),
    ],
)
def test_refuses(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"image": np.zeros((3, 4, 4)), "depth": np.ones((1, 4, 4))}
    with pytest.raises(ValueError, match=message):
        superpixels(**arguments | change)


def test_mean_refuses_another_size() -> None:
    with pytest.raises(ValueError, match=r"`values` must be \[2, 2\], got \[2, 3\]"):
        mean_by_region(np.zeros((2, 3)), np.zeros((2, 2), np.int32))

"""vestcl.scene.depth.lidar on scans made from known depth, and on real ones."""

import time

import cv2
import numpy as np
import pytest
from data_files import real
from numpy.typing import NDArray
from scipy import ndimage

from vestcl.constants import SKY_DEPTH
from vestcl.io import read_depth, read_image
from vestcl.scene.depth.lidar import densify

HEIGHT, WIDTH = 96, 240

#: Of the depth PNGs of kitti_clip.
UNITS_PER_METRE = 256

#: What it may take for a frame of KITTI, seconds.
LIMIT = 1.0

Floats = NDArray[np.float32]


def scanned(depth: Floats, rows: int = 4, columns: int = 2) -> Floats:
    """Depth at every so-manieth row and column, 0 elsewhere."""
    kept = np.zeros_like(depth)
    kept[:, 1::rows, ::columns] = depth[:, 1::rows, ::columns]
    return kept


def board() -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """A bright board at 8 m before a dark wall at 30 m: image, depth, and where the board is."""
    on_board = np.zeros((1, HEIGHT, WIDTH), bool)
    on_board[:, 30:70, 90:150] = True
    image = np.repeat(np.where(on_board, np.float32(0.8), np.float32(0.2)), 3, axis=0)
    texture = np.random.default_rng(0).normal(0, 0.01, image.shape).astype(np.float32)
    return image + texture, np.where(on_board, np.float32(8), np.float32(30)), on_board


def test_a_plane_is_exact() -> None:
    """The inverse depth of a plane is affine in (u, v); an image without edges lets every fit see its surroundings."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    truth = (1 / (0.02 + 0.001 * v + 0.0001 * u))[None]
    dense = densify(scanned(truth), np.full((3, HEIGHT, WIDTH), 0.5, np.float32))
    inner = np.s_[:, 8:-8, 8:-8]
    np.testing.assert_allclose(dense[inner], truth[inner], rtol=0.02)


def test_edges_follow_the_image() -> None:
    image, truth, _ = board()
    dense = densify(scanned(truth, rows=6, columns=3), image)
    assert dense.shape == truth.shape and dense.dtype == np.float32
    assert (np.abs(dense / truth - 1) > 0.1).mean() < 0.01


def test_what_shines_through_is_dropped() -> None:
    """Returns of the wall among those of the board, as a scanner that stands elsewhere than the camera gives them."""
    image, truth, on_board = board()
    scan = scanned(truth)
    through = (scan > 0) & on_board & (np.random.default_rng(1).random(scan.shape) < 0.15)
    assert through.sum() > 20
    dense = densify(np.where(through, np.float32(30), scan), image)
    inner = ndimage.binary_erosion(on_board[0], iterations=4)[None]
    assert (dense[inner] > 10).mean() < 0.01


def test_never_beyond_the_returns_by_much() -> None:
    """Above all returns the depth continues, within a factor of the nearest return's."""
    image, truth, _ = board()
    scan = scanned(truth)
    scan[:, :50] = 0
    dense = densify(scan, image)
    assert (dense > 0).all() and np.isfinite(dense).all()
    assert dense.min() > 8 / 1.3 and dense.max() < 30 * 1.3


def test_the_sky_is_far() -> None:
    image, truth, _ = board()
    sky = np.zeros(truth.shape, bool)
    sky[:, :20] = True
    dense = densify(scanned(truth), image, sky=sky)
    assert np.array_equal(dense == SKY_DEPTH, sky)


@pytest.mark.parametrize("count", [1, 2, 20])
def test_few_returns(count: int) -> None:
    image, truth, _ = board()
    places = np.random.default_rng(count).choice(truth.size, count, replace=False)
    scan = np.zeros_like(truth)
    scan.flat[places] = 12
    np.testing.assert_allclose(densify(scan, image), 12, rtol=1e-4)


def test_the_same_twice() -> None:
    image, truth, _ = board()
    assert np.array_equal(densify(scanned(truth), image), densify(scanned(truth), image))


def test_arguments() -> None:
    image, truth, _ = board()
    with pytest.raises(ValueError, match="`depth` must have a valid pixel"):
        densify(np.zeros_like(truth), image)
    with pytest.raises(ValueError, match=r"`image` must be \[3, 96, 240\]"):
        densify(truth, image[:, 1:])
    with pytest.raises(ValueError, match="`sky` must be bool"):
        densify(truth, image, sky=np.zeros_like(truth))
    with pytest.raises(ValueError, match="`depth` must be finite"):
        densify(np.full_like(truth, np.nan), image)


@pytest.mark.parametrize("index", [8, 40])
def test_kitti_beats_the_nearest_return(index: int) -> None:
    """A fifth of the returns is hidden; both are compared with it in inverse depth, where what is near counts most."""
    folder = real("kitti_clip")
    image = read_image(folder / "image" / f"{index:06d}.jpg")
    scan = read_depth(folder / "depth" / f"{index:06d}.png", UNITS_PER_METRE)[None]
    hidden = (np.random.default_rng(index).random(scan.shape) < 0.2) & (scan > 0)
    seen = np.where(hidden, np.float32(0), scan)
    rows, columns = ndimage.distance_transform_edt(seen[0] == 0, return_distances=False, return_indices=True)
    inverse, nearest = 1 / densify(seen, image)[hidden], 1 / seen[:, rows, columns][hidden]
    truth = 1 / scan[hidden]
    assert np.sqrt(np.square(inverse - truth).mean()) < np.sqrt(np.square(nearest - truth).mean())
    assert np.median(np.abs(truth / inverse - 1)) < 0.01


def test_kitti_in_time() -> None:
    folder = real("kitti_clip")
    image = read_image(folder / "image" / "000000.jpg")
    scan = read_depth(folder / "depth" / "000000.png", UNITS_PER_METRE)[None]
    took = []
    for _ in range(3):
        start = time.perf_counter()
        densify(scan, image)
        took.append(time.perf_counter() - start)
    assert min(took) < LIMIT * 4 / min(cv2.getNumThreads(), 4)


def test_a_roof_above_the_returns_is_in_pieces_of_one_depth() -> None:
    depth, image = np.zeros((1, 64, 208), np.float32), np.full((3, 64, 208), 0.2, np.float32)
    depth[:, 40::4] = np.linspace(5, 40, 208)
    image += np.random.default_rng(0).normal(0, 0.03, image.shape).astype(np.float32)
    found = densify(depth, image.clip(0, 1))[0]
    assert len(np.unique(found[34])) < 70 and np.ptp(np.log(found[34])) > 1, "not one for each column"
    assert len(np.unique(found[50])) > 190, "between returns it is as measured"

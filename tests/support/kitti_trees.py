"""Procedural streets in KITTI raw's layout. As a script it writes the drives that the three tasks are tested on:

python tests/support/kitti_trees.py FOLDER HEIGHT WIDTH FRAMES
"""

import sys
from pathlib import Path

import numpy as np
from data_files import row, write_text

from vestcl.data import Street, street_clip
from vestcl.data.readers.splits import KITTI_PREDICTION_TEST, KITTI_VIEWS_TEST
from vestcl.data.sample import Sample
from vestcl.io import write_pixels
from vestcl.io.images import to_pixels

SIZE = 48, 160

P2 = "721.5377 0 609.5593 44.85728 0 721.5377 172.854 0.2163791 0 0 1 0.002745884"
P3 = "721.5377 0 609.5593 -339.5242 0 721.5377 172.854 2.199936 0 0 1 0.002729905"

#: The scanner looks along x, with y to the left and z up; every such pixel in each direction has a return.
CAM_FROM_VELO = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
_EVERY = 4

#: Of the script's streets; no training uses them, nor the evaluation of streets.
FIRST_SEED = 5000


def calibration(root: Path, left: str = P2, right: str = P3, size: str = "1242 375") -> None:
    sizes = (f"S_rect_0{camera}: {size}" for camera in (2, 3))
    lines = "R_rect_00: 1 0 0 0 1 0 0 0 1", f"P_rect_02: {left}", f"P_rect_03: {right}", *sizes
    write_text(root / "2011_09_26" / "calib_cam_to_cam.txt", *lines)


def drives(
    root: Path,
    names: tuple[str, ...],
    frames: int = 7,
    size: tuple[int, int] = SIZE,
    seed: int = 3,
    scans: bool = False,
) -> Path:
    """One street, seen by both cameras of KITTI's rig, as every one of the drives; with laser scans if asked for."""
    clip = street_clip(Street.generate(seed), frames, *size, samples=1)
    K, right = clip[0].K, clip[0].right
    assert right is not None
    flat = f"{K[0, 0]} 0 {K[0, 2] - 0.5} {{}} 0 {K[1, 1]} {K[1, 2] - 0.5} 0 0 0 1 0"
    calibration(root, flat.format(0), flat.format(K[0, 0] * right.right_from_left[0, 3]), f"{size[1]} {size[0]}")
    if scans:
        write_text(root / "2011_09_26" / "calib_velo_to_cam.txt", f"R: {row(CAM_FROM_VELO)}", "T: 0 0 0")
    for name in names:
        drive = root / name[:10] / name
        for index, sample in enumerate(clip):
            assert sample.right is not None
            for camera, image in (("02", sample.read_image()), ("03", sample.right.read_image())):
                path = drive / f"image_{camera}" / "data" / f"{index:010}.png"
                write_pixels(path, to_pixels(image).astype(np.uint8))
            if scans:
                _write_scan(drive / "velodyne_points" / "data" / f"{index:010}.bin", sample)
    return root


def _write_scan(path: Path, sample: Sample) -> None:
    depth = sample.read_depth()[0]
    y, x = (axis.ravel() for axis in np.mgrid[: depth.shape[0] : _EVERY, : depth.shape[1] : _EVERY])
    z = depth[y, x]
    points = (np.linalg.inv(sample.K) @ np.stack([x + 0.5, y + 0.5, np.ones(len(x))]) * z).T[(z > 0) & (z < 80)]
    path.parent.mkdir(parents=True, exist_ok=True)
    np.concatenate([points @ CAM_FROM_VELO, np.zeros((len(points), 1))], axis=1).astype("<f4").tofile(path)


def main(folder: str, height: str, width: str, frames: str) -> None:
    """A street for each drive of the two test splits, with scans."""
    for seed, name in enumerate(dict.fromkeys((*KITTI_PREDICTION_TEST, *KITTI_VIEWS_TEST))):
        drives(Path(folder), (name,), int(frames), (int(height), int(width)), FIRST_SEED + seed, scans=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""KITTI odometry: sequences/XX/{image_0 .. image_3/%06d.png, calib.txt, times.txt}, poses/XX.txt.

calib.txt has P0 .. P3 = K [I | p4]; a line of poses is 3x4 world_from_cam0, of the rectified camera 0.
"""

from pathlib import Path

from vestcl.data import calibration, fit
from vestcl.data.calibration import Matrix
from vestcl.data.readers import files
from vestcl.data.readers.files import Calibration
from vestcl.data.readers.kitti_raw import RIGS, Rig
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import ImageFile
from vestcl.io.images import image_size


def open_kitti_odometry(path: str | Path, sequence: str | None = None, rig: Rig | None = None) -> Clip:
    """A sequence: left camera, right camera where it is there, and poses where they are published (00 to 10).

    Args:
        path: .../sequences/XX, or the folder that has `sequences`.
        sequence: "06"; needed where ``path`` has several.
        rig: "colour" (image_2, image_3) or "grey" (image_0, image_1); None takes colour where it is there.

    Raises:
        ValueError: a file is missing or malformed, or the images can't be of its cameras; the message names it.

    Source: SPEC section 9; devkit of KITTI odometry (Geiger et al., CVPR 2012).
    """
    folder = _find(Path(path), sequence)
    left, right = RIGS[_rig(folder, rig)]
    frames = files.numbered_images(folder / f"image_{left}")
    if not frames:
        raise ValueError(f"{folder}: has no image_{left}/*.png")
    cameras = Calibration(folder / "calib.txt")
    size = image_size(next(iter(frames.values())))
    K, left_from_cam0 = _camera(left, size, cameras)
    last = max(frames)
    poses, times = _poses(folder, left_from_cam0, last), _times(folder, list(frames))
    rights = _rights(folder, right, left_from_cam0, cameras, list(frames))
    samples = [
        Sample(
            frame.stem,
            ImageFile(frame, *size),
            K,
            timestamp=None if times is None else float(times[number]),
            world_from_cam=None if poses is None else poses[number],
            right=rights.get(number),
        )
        for number, frame in frames.items()
    ]
    return Clip(folder.name, "KITTI odometry", tuple(samples))


def _find(path: Path, sequence: str | None) -> Path:
    if not (path / "sequences").is_dir():
        if sequence not in (None, path.name):
            raise ValueError(f"{path}: has no folder `sequences` to find sequence {sequence} in")
        return path
    names = sorted(folder.name for folder in (path / "sequences").iterdir() if folder.is_dir())
    if sequence is None and len(names) == 1:
        return path / "sequences" / names[0]
    if sequence not in names:
        raise ValueError(f"{path}: `sequence` must be one of {', '.join(names) or 'none'}, got {sequence}")
    return path / "sequences" / sequence


def _rig(folder: Path, rig: Rig | None) -> Rig:
    if rig is None:
        return "colour" if (folder / "image_2").is_dir() else "grey"
    if rig not in RIGS:
        raise ValueError(f"`rig` must be colour or grey, got {rig!r}")
    return rig


def _camera(camera: int, size: tuple[int, int], cameras: Calibration) -> tuple[Matrix, Matrix]:
    """K of images of ``size``, and cam_from_cam0. calib.txt does not state a size, so that K is not scaled."""
    name = f"P{camera}"
    K, cam_from_cam0 = cameras.projection(name)
    return fit.fit_intrinsics(K, None, size, f"{cameras.path}: `{name}`"), cam_from_cam0


def _rights(
    folder: Path, right: int, left_from_cam0: Matrix, cameras: Calibration, numbers: list[int]
) -> dict[int, RightCamera]:
    """By frame; none where the sequence has no images of that camera."""
    frames = files.numbered_next_to(folder / f"image_{right}", numbers)
    if not frames:
        return {}
    size = image_size(next(iter(frames.values())))
    K, right_from_cam0 = _camera(right, size, cameras)
    right_from_left = right_from_cam0 @ calibration.invert(left_from_cam0)
    return {number: RightCamera(ImageFile(frame, *size), K, right_from_left) for number, frame in frames.items()}


def _poses(folder: Path, left_from_cam0: Matrix, last: int) -> Matrix | None:
    """world_from_left by the number of the frame: a part of a sequence keeps the names of its frames."""
    path = folder.parent.parent / "poses" / f"{folder.name}.txt"
    if not files.is_present(path):
        return None
    return _long_enough(files.read_poses(path), path, last) @ calibration.invert(left_from_cam0)


def _times(folder: Path, frames: list[int]) -> Matrix | None:
    path = folder / "times.txt"
    return _long_enough(files.read_times(path, frames), path, frames[-1]) if files.is_present(path) else None


def _long_enough(rows: Matrix, path: Path, last: int) -> Matrix:
    if len(rows) <= last:
        raise ValueError(f"{path}: has {len(rows)} lines, none for frame {last}")
    return rows

"""Virtual KITTI 2: SceneXX/VARIANT/frames/{rgb,depth,classSegmentation}/Camera_{0,1}/*_%05d.*, and two text files.

A line of extrinsic.txt is the frame, the camera and 4x4 cam_from_world; one of intrinsic.txt is the frame, the camera
and fx, fy, cx, cy with pixel centres at integers, of 1242 x 375 pixels: K is scaled where images were resized. Depth is
uint16 centimetres, 65535 the sky.
"""

from pathlib import Path
from typing import Final

from vestcl.data import calibration, fit
from vestcl.data.calibration import Matrix
from vestcl.data.readers import files
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import DepthFile, ImageFile, LabelFile
from vestcl.io.depth import VIRTUAL_KITTI_UNITS
from vestcl.io.images import image_size

#: (height, width) that intrinsic.txt is for.
NATIVE: Final = (375, 1242)

#: Frames per second, as KITTI's.
FPS: Final = 10.0


def open_virtual_kitti(path: str | Path, variant: str | None = None) -> Clip:
    """A scene under one weather: Camera_0 with depth, classes and poses, and Camera_1 as right camera.

    Depth and classes come as separate downloads; where they are not there, the samples have none.

    Args:
        path: SceneXX/VARIANT, or SceneXX.
        variant: "clone", "fog", "15-deg-left" ...; needed where ``path`` has several.

    Raises:
        ValueError: a file is missing or malformed, or the images can't be of its cameras; the message names it.

    Source: SPEC section 9; Cabon et al., "Virtual KITTI 2" (2020).
    """
    folder = _find(Path(path), variant)
    rgb = folder / "frames" / "rgb"
    frames = files.numbered_images(rgb / "Camera_0", "rgb_")
    if not frames:
        raise ValueError(f"{folder}: has no frames/rgb/Camera_0/rgb_*.jpg")
    numbers, size = list(frames), image_size(next(iter(frames.values())))
    rights = files.numbered_next_to(rgb / "Camera_1", numbers, prefix="rgb_")
    depths = files.numbered_next_to(rgb.parent / "depth" / "Camera_0", numbers, (".png",), "depth_")
    labels = files.numbered_next_to(rgb.parent / "classSegmentation" / "Camera_0", numbers, (".png",), "classgt_")
    right_size = image_size(next(iter(rights.values()))) if rights else size
    cameras, poses = _cameras(folder / "intrinsic.txt"), _poses(folder / "extrinsic.txt")
    samples = []
    for number, file in frames.items():
        sample = Sample(
            file.stem.removeprefix("rgb_"),
            ImageFile(file, *size),
            cameras.fitted(number, 0, size),
            timestamp=number / FPS,
            world_from_cam=calibration.invert(poses[number, 0]),
            depth=DepthFile(depths[number], VIRTUAL_KITTI_UNITS) if number in depths else None,
            labels=LabelFile(labels[number], "virtual_kitti") if number in labels else None,
            right=_right(ImageFile(rights[number], *right_size), number, cameras, poses) if number in rights else None,
        )
        samples.append(sample)
    return Clip(f"{folder.parent.name}/{folder.name}", "Virtual KITTI 2", tuple(samples))


def variants(path: Path) -> list[str]:
    """Names of the folders in ``path`` that hold a scene's frames."""
    return sorted(folder.parent.parent.name for folder in path.glob("*/frames/rgb"))


def _find(path: Path, variant: str | None) -> Path:
    if (path / "frames" / "rgb").is_dir():
        if variant not in (None, path.name):
            raise ValueError(f"{path}: is variant {path.name}, not {variant}")
        return path
    names = variants(path)
    if variant is None and len(names) == 1:
        return path / names[0]
    if variant not in names:
        raise ValueError(f"{path}: `variant` must be one of {', '.join(names) or 'none'}, got {variant}")
    return path / variant


class _Table(dict[tuple[int, int], Matrix]):
    """Matrices by frame and camera; a missing one names their file."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def __missing__(self, key: tuple[int, int]) -> Matrix:
        raise ValueError(f"{self.path}: has no line for frame {key[0]} of camera {key[1]}")


class _Cameras(_Table):
    """K by frame and camera, of images of NATIVE size."""

    def fitted(self, frame: int, camera: int, size: tuple[int, int]) -> Matrix:
        """K of images of ``size``.

        Raises:
            ValueError: there is no line for it, or the images can't be of this camera.
        """
        where = f"{self.path}: frame {frame} of camera {camera}"
        return fit.fit_intrinsics(self[frame, camera], NATIVE, size, where)


def _right(image: ImageFile, number: int, cameras: _Cameras, poses: _Table) -> RightCamera:
    K = cameras.fitted(number, 1, (image.height, image.width))
    return RightCamera(image, K, poses[number, 1] @ calibration.invert(poses[number, 0]))


def _cameras(path: Path) -> _Cameras:
    """K [3, 3]."""
    cameras = _Cameras(path)
    for frame, camera, *numbers in files.read_rows(path, (6,), skip=1).tolist():
        K = calibration.intrinsics(*numbers)
        calibration.check_intrinsics(K, f"{path}: frame {frame:.0f}")
        cameras[int(frame), int(camera)] = calibration.from_integer_centres(K)
    return cameras


def _poses(path: Path) -> _Table:
    """cam_from_world [4, 4]."""
    poses = _Table(path)
    for row in files.read_rows(path, (18,), skip=1):
        pose = row[2:].reshape(4, 4)
        calibration.check_rigid(pose, f"{path}: frame {row[0]:.0f}")
        poses[int(row[0]), int(row[1])] = pose
    return poses

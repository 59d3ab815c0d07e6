"""A plain folder of frames with one camera.json: what everything else is brought to.

    camera.json          {"fx": 721.5, "fy": 721.5, "cx": 609.6, "cy": 172.9, "width": 1242, "height": 375, ...}
    image/*.png|jpg      or images/, or left/, or the images next to camera.json; in natural order of their names
    right/*.png|jpg      the right camera, if camera.json has "baseline"                  (names as in image/)
    depth/*.png|exr|npy  z-depth; PNG needs "depth_scale"                                 (names as in image/)
    labels/*.png         classes; needs "label_ids"                                       (names as in image/)
    poses.txt            a line per frame, 3x4 or 4x4 world_from_cam
    times.txt            a line per frame, seconds, increasing; without it "fps" gives the time

Keys of camera.json: fx, fy, cx, cy in pixels (required); pixel_centre "integer" (0 is the centre of the first pixel, as
in OpenCV and KITTI; the default) or "half" (0 is its edge); width, height of the images that these numbers are for:
evenly resized images get a scaled K, all others are refused; k1, k2, p1, p2, k3 ... k6, OpenCV's distortion, or with
distortion "fisheye" k1 ... k4: images, depth and labels are undistorted on reading; fps; depth_scale, file units per
metre (KITTI 256); label_ids "trainIds", "labelIds" or "virtual_kitti"; baseline, metres from the left camera to a right
one with parallel axes; right {fx, fy, cx, cy ...} where its numbers differ, with its own width, height and distortion.
"""

from dataclasses import replace
from pathlib import Path
from typing import Final

from vestcl.data import calibration
from vestcl.data.calibration import Matrix
from vestcl.data.lens import Lens, OutsideLens, undistorted_depth, undistorted_image, undistorted_labels
from vestcl.data.readers import files
from vestcl.data.readers.camera_file import CameraFile, LensCamera, read_camera
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import DepthFile, DepthSource, ImageFile, LabelFile, LabelSource
from vestcl.io.images import image_size

__all__ = ["FRAMES", "CameraFile", "LensCamera", "frames_of", "open_folder", "read_camera"]

#: Folders that frames are looked for in, the first that is there; else they are next to camera.json.
FRAMES: Final = ("image", "images", "left")

_DEPTHS: Final = (".png", ".exr", ".npy")


def open_folder(path: str | Path, fov: float | None = None) -> Clip:
    """The frames of a folder, with all that lies next to them. A frame without a depth or label file has none.

    Args:
        path: the folder.
        fov: horizontal field of view in degrees, in place of a camera.json that is not there.

    Raises:
        ValueError: a file is missing or malformed, the images can't be of the camera, or a folder is there of which
            no file fits a frame; the message names it.

    Source: SPEC section 9.
    """
    folder = Path(path)
    frames = frames_of(folder)
    if not frames:
        raise ValueError(f"{folder}: has no images, neither next to camera.json nor in {', '.join(FRAMES)}")
    size, names = image_size(frames[0]), [frame.stem for frame in frames]
    about = _camera_file(folder, size, fov)
    camera = about.camera.fit(size, about.path)
    lens = _lens(camera, size, about.path)
    times, poses = _table(folder / "times.txt", len(frames)), _table(folder / "poses.txt", len(frames))
    depths, labels, rights = (
        _depths(folder, names, about),
        _labels(folder, names, about),
        _rights(folder, names, about, size),
    )
    outside = OutsideLens(lens) if lens is not None and lens.outside().any() else None
    samples = []
    for index, frame in enumerate(frames):
        time = None if about.fps is None else index / about.fps
        sample = Sample(
            frame.stem,
            undistorted_image(ImageFile(frame, *size), lens),
            camera.K,
            timestamp=time if times is None else float(times[index]),
            world_from_cam=None if poses is None else poses[index],
            depth=undistorted_depth(depths.get(frame.stem), lens),
            labels=undistorted_labels(labels.get(frame.stem), lens),
            ego_vehicle=outside,
            right=rights.get(frame.stem),
        )
        samples.append(sample)
    return Clip(folder.resolve().name, "folder", tuple(samples))


def frames_of(folder: Path) -> list[Path]:
    """The images that `open_folder` takes as frames.

    Raises:
        ValueError: two of them have one name.
    """
    for name in FRAMES:
        if (folder / name).is_dir():
            return files.images(folder / name)
    return files.images(folder)


def _camera_file(folder: Path, size: tuple[int, int], fov: float | None) -> CameraFile:
    path = folder / "camera.json"
    if fov is not None:
        if files.is_present(path):
            raise ValueError(f"{path}: defines the camera; leave out `fov`")
        return CameraFile(path, LensCamera(calibration.intrinsics_from_fov(fov, *size), size))
    if not files.is_present(path):
        raise ValueError(f"{path}: no such file; write one with fx, fy, cx, cy, or give `fov` in degrees")
    return read_camera(path)


def _lens(camera: LensCamera, size: tuple[int, int], path: Path) -> Lens | None:
    return None if camera.distortion is None else Lens.of(camera.K, size, camera.distortion, str(path))


def _table(path: Path, frames: int) -> Matrix | None:
    """The seconds of times.txt or the matrices of poses.txt; None where there is no such file."""
    if not files.is_present(path):
        return None
    rows = files.read_poses(path) if path.name == "poses.txt" else files.read_times(path)
    if len(rows) != frames:
        raise ValueError(f"{path}: must have a line for each of {frames} frames, got {len(rows)}")
    return rows


def _depths(folder: Path, names: list[str], about: CameraFile) -> dict[str, DepthSource]:
    found = files.next_to(folder / "depth", names, _DEPTHS)
    for path in found.values():
        if path.suffix.lower() == ".png" and about.depth_scale is None:
            raise ValueError(f"{about.path}: must contain `depth_scale`, file units per metre, for {path}")
    return {name: DepthFile(path, about.depth_scale) for name, path in found.items()}


def _labels(folder: Path, names: list[str], about: CameraFile) -> dict[str, LabelSource]:
    found, kind = files.next_to(folder / "labels", names, (".png",)), about.label_ids
    if kind is None:
        for path in found.values():
            raise ValueError(f"{about.path}: must contain `label_ids` for {path}")
        return {}
    return {name: LabelFile(path, kind) for name, path in found.items()}


def _rights(folder: Path, names: list[str], about: CameraFile, left_size: tuple[int, int]) -> dict[str, RightCamera]:
    """By frame. Without its own numbers it is as the left camera, whose images may have another size."""
    found = files.next_to(folder / "right", names, files.IMAGE_SUFFIXES)
    if not found:
        return {}
    first = next(iter(found.values()))
    if about.baseline is None:
        raise ValueError(f"{about.path}: must contain `baseline` in metres for {first}")
    size = image_size(first)
    camera = about.right or replace(about.camera, size=about.camera.size or left_size)
    camera = camera.fit(size, about.path)
    lens, moved = _lens(camera, size, about.path), calibration.translation((-about.baseline, 0, 0))
    return {n: RightCamera(undistorted_image(ImageFile(p, *size), lens), camera.K, moved) for n, p in found.items()}

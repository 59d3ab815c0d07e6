"""KITTI raw: DATE/DATE_drive_NNNN_sync/{image_0{0..3}/data/%010d.png, oxts/data/%010d.txt}, DATE/calib_*.txt.

With the rectified projections P_rect_0i = K [I | p4_0i] every camera is the rectified camera 0 shifted by p4_0i =
K^-1 P[:, 3], so right_from_left shifts by p4_03 - p4_02. Poses are those of the GPS/IMU box, carried into the camera:
world_from_cam = world_from_imu imu_from_cam, cam_from_imu = cam_from_rect0 R_rect_00 cam0_from_velo velo_from_imu.
"""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from vestcl import times
from vestcl.data import calibration, fit
from vestcl.data.calibration import Matrix
from vestcl.data.readers import files
from vestcl.data.readers.files import Calibration
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import DepthFile, DepthSource, ImageFile
from vestcl.io.atomic import read_bytes
from vestcl.io.depth import KITTI_UNITS
from vestcl.io.images import image_size

#: Radius of the sphere of KITTI's Mercator projection, metres.
EARTH_RADIUS: Final = 6378137.0

#: Numbers in a line of oxts: latitude, longitude, altitude, roll, pitch, yaw and 24 more.
OXTS_NUMBERS: Final = 30

#: A laser's return is farther from the camera than this, metres.
NEAREST: Final = 0.01

#: Where KITTI's depth set has its depth maps, above the cameras' folders.
ACCUMULATED: Final = ("proj_depth", "groundtruth")

Rig = Literal["colour", "grey"]
"""Which stereo pair: cameras 2 and 3, or 0 and 1."""

RIGS: Final[dict[str, tuple[int, int]]] = {"colour": (2, 3), "grey": (0, 1)}


@dataclass(frozen=True, eq=False)
class VelodyneScan:
    """A laser scan projected into an image: depth of the nearest return in each pixel."""

    path: Path
    """float32 x, y, z, reflectance in the scanner's axes."""
    cam_from_velo: Matrix
    """[4, 4]."""
    K: Matrix
    """[3, 3] px of an image of ``height`` x ``width``, pixel centres at +0.5."""
    height: int
    width: int

    def read(self) -> NDArray[np.float32]:
        """[1, height, width] m, valid iff > 0; sparse, and seen through what is nearer, as the scanner sits higher.

        Raises:
            ValueError: no such file, or its length is not that of whole points.
        """
        content = read_bytes(self.path)
        if len(content) % 16:
            raise ValueError(f"{self.path}: must be float32 quadruples, got {len(content)} bytes")
        scan = np.frombuffer(content, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
        with np.errstate(invalid="ignore"):  # of points that are not finite
            points = scan @ self.cam_from_velo[:3, :3].T + self.cam_from_velo[:3, 3]
        points = points[(points[:, 2] > NEAREST) & np.isfinite(points).all(axis=1)]
        u, v = (points[:, :2] / points[:, 2:] * self.K[[0, 1], [0, 1]] + self.K[:2, 2]).T
        inside = (u >= 0) & (u < self.width) & (v >= 0) & (v < self.height)
        depth = np.full((1, self.height, self.width), np.inf, np.float32)
        pixels = v[inside].astype(np.intp) * self.width + u[inside].astype(np.intp)
        np.minimum.at(depth.reshape(-1), pixels, points[inside, 2].astype(np.float32))
        return np.where(np.isfinite(depth), depth, np.float32(0))


def open_kitti_raw(
    path: str | Path, rig: Rig = "colour", first_pose_identity: bool = True, accumulated_depth: bool = False
) -> Clip:
    """A drive: left camera, right camera, poses, and depth where there is any.

    Depth comes from `velodyne_points`, else there is none (the pair gives it). The maps of KITTI's depth set,
    `proj_depth/groundtruth/image_0i`, are accumulated from the scans of 11 frames, five of them later ones: no camera
    has them at time t, so that they are read only where they are asked for.

    Args:
        path: DATE/DATE_drive_NNNN_sync, with the date's calibration files next to it.
        rig: the colour or the grey cameras.
        first_pose_identity: the world is the first camera; otherwise the Mercator plane, far from its origin.
        accumulated_depth: depth comes from `proj_depth/groundtruth`, of the frames that have a map there.

    Raises:
        ValueError: a file is missing or malformed, no accumulated depth where it is asked for, or the images can't be
            of the rectified cameras; the message names it.

    Source: SPEC section 9; devkit of KITTI raw (Geiger et al., IJRR 2013).
    """
    drive = Path(path)
    if rig not in RIGS:
        raise ValueError(f"`rig` must be colour or grey, got {rig!r}")
    left, right = RIGS[rig]
    frames = files.numbered_images(drive / f"image_{left:02}" / "data")
    if not frames:
        raise ValueError(f"{drive}: has no image_{left:02}/data/*.png")
    cameras = Calibration(drive.parent / "calib_cam_to_cam.txt")
    size = image_size(next(iter(frames.values())))
    K, cam_from_rect0 = _camera(drive, left, size, cameras)
    poses = _poses(drive, list(frames), cam_from_rect0, cameras)
    seconds = _times(drive / f"image_{left:02}" / "timestamps.txt", list(frames))
    numbers = list(frames)
    depths = (
        _maps(drive, left, numbers) if accumulated_depth else _scans(drive, K, cam_from_rect0, size, cameras, numbers)
    )
    rights = _rights(drive, right, cam_from_rect0, cameras, list(frames))
    samples = []
    for (number, frame), time, pose in zip(frames.items(), seconds, poses, strict=True):
        image, depth, second = ImageFile(frame, *size), depths.get(number), rights.get(number)
        samples.append(Sample(frame.stem, image, K, timestamp=time, world_from_cam=pose, depth=depth, right=second))
    clip = Clip(drive.name, "KITTI raw", tuple(samples))
    return clip.from_first_pose() if first_pose_identity else clip


def mercator_pose(oxts: NDArray[np.float64], scale: float) -> Matrix:
    """world_from_imu: tx = s er lon pi / 180, ty = s er ln tan((90 + lat) pi / 360), tz = alt, R = Rz Ry Rx.

    Args:
        oxts: [>= 6], latitude and longitude in degrees, altitude in metres, roll, pitch, yaw in radians.
        scale: s = cos(lat) of the drive's first frame.

    Returns:
        [4, 4] m.
    """
    latitude, longitude, altitude, roll, pitch, yaw = oxts[:6]
    x = scale * EARTH_RADIUS * np.radians(longitude)
    y = scale * EARTH_RADIUS * np.log(np.tan(np.radians(90 + latitude) / 2))
    (sr, sp, sy), (cr, cp, cy) = np.sin([roll, pitch, yaw]), np.cos([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return calibration.rigid(about_z @ about_y @ about_x, (x, y, altitude))


def _camera(drive: Path, camera: int, size: tuple[int, int], cameras: Calibration) -> tuple[Matrix, Matrix]:
    """K of images of ``size``, and cam_from_rect0. `S_rect` states the size that `P_rect` is for."""
    K, cam_from_rect0 = cameras.projection(f"P_rect_{camera:02}")
    calibrated, recorded = cameras.size(f"S_rect_{camera:02}"), cameras.size(f"S_{camera:02}")
    where = f"{cameras.path}: `P_rect_{camera:02}`"
    unrectified = recorded is not None and fit.same_proportions(recorded, size)
    if drive.name.endswith("_extract") or (unrectified and calibrated and not fit.same_proportions(calibrated, size)):
        raise ValueError(
            f"{where}: is for rectified images, but those of {drive}, {size} (height, width), are as they were "
            f"recorded; open the drive's _sync folder{_recorded_camera(camera, cameras)}"
        )
    return fit.fit_intrinsics(K, calibrated, size, where), cam_from_rect0


def _recorded_camera(camera: int, cameras: Calibration) -> str:
    """The camera.json of images that are not rectified, as far as the file has their calibration."""
    names = [f"{name}_{camera:02}" for name in ("K", "D", "S")]
    if not all(name in cameras for name in names):
        return ""
    K, size = calibration.from_integer_centres(cameras.entry(names[0], 9).reshape(3, 3)), cameras.size(names[2])
    distortion = dict(zip(("k1", "k2", "p1", "p2", "k3"), cameras.entry(names[1], 5).tolist(), strict=True))
    return f", or a folder with the images in image/ and this camera.json: {fit.camera_json(K, size, **distortion)}"


def _rights(
    drive: Path, right: int, left_from_rect0: Matrix, cameras: Calibration, numbers: list[int]
) -> dict[int, RightCamera]:
    """By frame; none where the drive has no images of that camera."""
    frames = files.numbered_next_to(drive / f"image_{right:02}" / "data", numbers)
    if not frames:
        return {}
    size = image_size(next(iter(frames.values())))
    K, right_from_rect0 = _camera(drive, right, size, cameras)
    right_from_left = right_from_rect0 @ calibration.invert(left_from_rect0)
    return {number: RightCamera(ImageFile(frame, *size), K, right_from_left) for number, frame in frames.items()}


def _poses(drive: Path, frames: list[int], cam_from_rect0: Matrix, cameras: Calibration) -> list[Matrix | None]:
    """world_from_cam of every frame, in the Mercator plane; None for all where the drive has no oxts."""
    folder = drive / "oxts" / "data"
    if not folder.is_dir():
        return [None] * len(frames)
    velo_from_imu = Calibration(drive.parent / "calib_imu_to_velo.txt").rigid()
    imu_from_cam = calibration.invert(cam_from_rect0 @ _rect0_from_velo(drive, cameras) @ velo_from_imu)
    rows = [files.read_rows(folder / f"{frame:010}.txt", (OXTS_NUMBERS,))[0] for frame in frames]
    scale = float(np.cos(np.radians(rows[0][0])))
    poses: list[Matrix | None] = []
    for frame, row in zip(frames, rows, strict=True):
        with np.errstate(invalid="ignore"):  # of latitudes beyond the poles
            pose = mercator_pose(row, scale) @ imu_from_cam
        calibration.check_rigid(pose, str(folder / f"{frame:010}.txt"))
        poses.append(pose)
    return poses


def _rect0_from_velo(drive: Path, cameras: Calibration) -> Matrix:
    rectify = calibration.rigid(cameras.entry("R_rect_00", 9))
    calibration.check_rigid(rectify, f"{cameras.path}: `R_rect_00`")
    return rectify @ Calibration(drive.parent / "calib_velo_to_cam.txt").rigid()


def _times(path: Path, frames: list[int]) -> list[float | None]:
    """Seconds since the first frame; None for all where there is no such file."""
    if not files.is_present(path):
        return [None] * len(frames)
    moments = _moments(path, frames)
    seconds = [(moment - moments[0]).total_seconds() for moment in moments]
    times.check_increasing(seconds, [f"line {frame + 1}" for frame in frames], str(path))
    return list(seconds)


def _moments(path: Path, frames: list[int]) -> list[datetime]:
    """A frame's line is the one of its number: a blank line shifts nothing."""
    lines = files.numbered_lines(path)

    def moment(line: int) -> datetime:
        try:  # nanoseconds are more than datetime takes
            return datetime.fromisoformat(lines.get(line, "").strip()[:26])
        except ValueError as error:
            got = repr(lines[line].strip()[:60]) if line in lines else "none"
            wanted = f"must have a date and time for each of {frames[-1] + 1} frames"
            raise ValueError(f"{path}: {wanted}, got {got} in line {line}") from error

    return [moment(frame + 1) for frame in frames]


def _maps(drive: Path, left: int, numbers: list[int]) -> dict[int, DepthSource]:
    """By frame, KITTI's accumulated depth maps."""
    folder = drive.joinpath(*ACCUMULATED, f"image_{left:02}")
    maps = files.numbered_next_to(folder, numbers, (".png",))
    if not maps:
        raise ValueError(f"`accumulated_depth` needs KITTI's depth maps, and {folder} has none")
    return {number: DepthFile(path, KITTI_UNITS) for number, path in maps.items()}


def _scans(
    drive: Path, K: Matrix, cam_from_rect0: Matrix, size: tuple[int, int], cameras: Calibration, numbers: list[int]
) -> dict[int, DepthSource]:
    """By frame, the laser scans."""
    scans = files.numbered_next_to(drive / "velodyne_points" / "data", numbers, (".bin",))
    if not scans:
        return {}
    cam_from_velo = cam_from_rect0 @ _rect0_from_velo(drive, cameras)
    return {number: VelodyneScan(path, cam_from_velo, K, *size) for number, path in scans.items()}

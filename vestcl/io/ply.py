"""Point clouds as PLY, which Blender, CloudCompare, MeshLab and Open3D read. Binary, little-endian."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.io.atomic import read_bytes, write_bytes

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])

_HEADER = """ply
format binary_little_endian 1.0
comment vestcl: camera axes, x right, y down, z forward, metres
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""


def write_ply(path: str | Path, points_xyz: ArrayLike, colours: ArrayLike) -> None:
    """Write points with colours, in one step.

    Args:
        path: the file; its folder is made if it is missing.
        points_xyz: [N, 3] m, finite.
        colours: [N, 3] RGB in [0, 1].

    Raises:
        ValueError: other shapes, or points that are not finite.
        OSError: the file can't be written.
    """
    points, rgb = np.asarray(points_xyz, np.float32), np.asarray(colours, np.float32)
    for name, value in (("points_xyz", points), ("colours", rgb)):
        if value.ndim != 2 or value.shape[1] != 3 or len(value) != len(points):
            raise ValueError(f"`{name}` must be [N, 3] with N = {len(points)}, got {list(value.shape)}")
    if not np.isfinite(points).all():
        raise ValueError("`points_xyz` must be finite")
    vertices = np.empty(len(points), _VERTEX)
    vertices["xyz"], vertices["rgb"] = points, np.rint(rgb.clip(0, 1) * 255)
    write_bytes(Path(path), _HEADER.format(count=len(points)).encode() + vertices.tobytes())


def read_ply(path: str | Path) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points [N, 3] m and colours [N, 3] in [0, 1] of a file that `write_ply` wrote.

    Raises:
        ValueError: the file is missing, damaged, or a PLY of other properties.
    """
    content = read_bytes(Path(path))
    head, mark, body = content.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    counts = [line.split()[-1] for line in lines if line.startswith("element vertex ")]
    wanted = _HEADER.format(count=counts[0] if counts else "").removesuffix("end_header\n").splitlines()
    if not mark or not counts or lines != wanted or not counts[0].isdigit():
        raise ValueError(f"{path}: must be a PLY as vestcl writes it")
    if len(body) != int(counts[0]) * _VERTEX.itemsize:
        raise ValueError(f"{path}: must have {counts[0]} points, got {len(body)} bytes")
    vertices = np.frombuffer(body, _VERTEX)
    colours: NDArray[np.float32] = vertices["rgb"].astype(np.float32) / np.float32(255)
    return vertices["xyz"].astype(np.float32), colours

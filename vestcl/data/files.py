"""The files beside the pictures: numbered frames, tables of numbers, poses and KITTI's calibrations."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from vestcl.data.calibration import Matrix, check_intrinsics, check_rigid, rigid, split_projection
from vestcl.io.atomic import read_bytes

#: Suffixes of the pictures that readers look for; KITTI's PNGs are often kept as JPEG.
IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg")


def images(folder: Path) -> list[Path]:
    """The pictures of a folder by name, hidden files left out; none where there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(f for f in folder.iterdir() if f.suffix.lower() in IMAGE_SUFFIXES and not f.name.startswith("."))


def numbered_images(folder: Path, prefix: str = "", gaps: bool = False) -> dict[int, Path]:
    """The pictures of a folder by the number in their names, in order.

    Args:
        folder: need not exist.
        prefix: what stands before the number.
        gaps: whether numbers may be missing between the first and the last.

    Raises:
        ValueError: a name that is no number, two pictures of one number, or a gap.
    """
    found: dict[int, Path] = {}
    for file in images(folder):
        word = file.stem.removeprefix(prefix)
        if not (word.isascii() and word.isdigit() and file.stem.startswith(prefix)):
            raise ValueError(f"{file}: must be named by its number, as {prefix}000000{file.suffix}")
        if int(word) in found:
            raise ValueError(f"{file}: has the number of {found[int(word)].name}")
        found[int(word)] = file
    for number, following in zip(sorted(found), sorted(found)[1:], strict=False):
        if following != number + 1 and not gaps:
            raise ValueError(f"{folder}: the frame after {found[number].name} is missing")
    return dict(sorted(found.items()))


def read_lines(path: Path) -> list[str]:
    """The lines of a text file that are not empty.

    Raises:
        ValueError: it can't be read, or is no text.
    """
    try:
        text = read_bytes(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is no text") from error
    return [line for line in text.splitlines() if line.strip()]


def read_rows(path: Path, columns: Sequence[int], skip: int = 0) -> Matrix:
    """A text file's numbers as [rows, n].

    Args:
        path: the file.
        columns: the n that are allowed; all rows have the same.
        skip: lines of heading.

    Raises:
        ValueError: it can't be read, has no row, or one that is not n finite numbers; the message names the line.
    """
    rows: list[list[float]] = []
    for number, line in enumerate(read_lines(path)[skip:], start=skip + 1):
        try:
            row = [float(word) for word in line.split()]
        except ValueError as error:
            raise ValueError(f"{path}: line {number}: {error}") from error
        if len(row) not in (columns if not rows else (len(rows[0]),)) or not np.isfinite(row).all():
            wanted = " or ".join(map(str, columns))
            raise ValueError(f"{path}: line {number} must be {wanted} finite numbers, got {line.strip()[:60]!r}")
        rows.append(row)
    if not rows:
        raise ValueError(f"{path}: is empty")
    return np.array(rows)


def read_poses(path: Path) -> Matrix:
    """world_from_cam [N, 4, 4] of a file with 12 (3x4) or 16 (4x4) numbers a line, row by row.

    Raises:
        ValueError: it can't be read, or a line is no rigid motion.
    """
    rows = read_rows(path, (12, 16))
    poses = np.broadcast_to(np.eye(4), (len(rows), 4, 4)).copy()
    poses.reshape(-1, 16)[:, : rows.shape[1]] = rows
    for number, pose in enumerate(poses, start=1):
        check_rigid(pose, f"{path}: line {number}")
    return poses


class Calibration:
    """A KITTI calibration file, lines of `name: numbers`; lines whose words are no numbers (dates) are passed over."""

    def __init__(self, path: Path) -> None:
        """Read ``path``.

        Raises:
            ValueError: it can't be read.
        """
        self.path = path
        self._entries: dict[str, Matrix] = {}
        for line in read_lines(path):
            name, colon, words = line.partition(":")
            try:
                numbers = [float(word) for word in words.split()] if colon else []
            except ValueError:
                continue
            self._entries[name.strip()] = np.array(numbers)

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    def entry(self, name: str, size: int) -> Matrix:
        """The ``size`` numbers of entry ``name``.

        Raises:
            ValueError: it is not there, or is not so many finite numbers.
        """
        if name not in self._entries:
            raise ValueError(f"{self.path}: has no entry `{name}`; it has {', '.join(self._entries) or 'none'}")
        numbers = self._entries[name]
        if numbers.shape != (size,) or not np.isfinite(numbers).all():
            raise ValueError(f"{self.path}: `{name}` must be {size} finite numbers, got {numbers.tolist()}")
        return numbers

    def rigid(self) -> Matrix:
        """[[R, T], [0, 1]] of the entries `R` and `T`.

        Raises:
            ValueError: they are not there, or no rigid motion.
        """
        moved = rigid(self.entry("R", 9), self.entry("T", 3))
        check_rigid(moved, str(self.path))
        return moved

    def projection(self, name: str) -> tuple[Matrix, Matrix]:
        """`split_projection` of the 3x4 entry ``name``.

        Raises:
            ValueError: it is not there, or its K is no camera.
        """
        matrix = self.entry(name, 12).reshape(3, 4)
        check_intrinsics(matrix[:, :3], f"{self.path}: `{name}`")
        return split_projection(matrix)

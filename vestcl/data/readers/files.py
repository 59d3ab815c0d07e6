"""Files next to the images: names and numbers of frames, tables of numbers, poses, KITTI's calibrations."""

import logging
import re
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from vestcl import times
from vestcl.data.calibration import Matrix, check_intrinsics, check_rigid, rigid, split_projection
from vestcl.io.atomic import read_bytes

#: Suffixes of the images that readers look for, in lower case; KITTI's PNGs are often kept as JPEG.
IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg")

#: Bytes of the largest text file that is read.
_LARGEST_TEXT: Final = 1 << 28

_LOG: Final = logging.getLogger(__name__)

Entry = TypeVar("Entry")


# ---------------------------------------------------------------- names


def natural(name: str) -> tuple[list[str | int], str]:
    """A key that sorts names by the numbers in them: frame1, frame2, frame10."""
    parts = re.split(r"([0-9]+)", name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], name


def by_name(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """The files of a folder by their names without the suffix, in natural order; hidden ones are left out.

    Args:
        folder: need not exist.
        suffixes: in lower case; files may have them in any.

    Raises:
        ValueError: it is not a folder, can't be read, or has two files of one name.
    """
    found: dict[str, Path] = {}
    if not is_present(folder):
        return found
    try:
        entries = sorted(folder.iterdir(), key=lambda file: natural(file.name))
    except OSError as error:
        raise ValueError(f"{folder}: {error.strerror}") from error
    for file in entries:
        if file.suffix.lower() not in suffixes or file.name.startswith("."):
            continue
        if file.stem in found:
            raise ValueError(f"{file}: has the name of {found[file.stem].name}; one of the two must go")
        found[file.stem] = file
    return {name: found[name] for name in sorted(found, key=natural)}


def next_to(folder: Path, names: Sequence[str], suffixes: Sequence[str]) -> dict[str, Path]:
    """The files of a folder that have the frames' names; the frames that have none are logged.

    Args:
        folder: need not exist.
        names: of the frames, without suffix.
        suffixes: in lower case.

    Raises:
        ValueError: the folder is there, but none of its files fits.
    """
    found = by_name(folder, suffixes)
    if is_present(folder):
        check_fit(folder, names, found, suffixes)
    return {name: found[name] for name in names if name in found}


def check_fit(folder: Path, names: Sequence[Entry], found: Container[Entry], suffixes: Sequence[str] = ("",)) -> None:
    """Refuse files of which none fits a frame, and log it where some frames have none.

    Args:
        folder: for the message.
        names: of the frames, or their numbers.
        found: of the files.
        suffixes: of the files.

    Raises:
        ValueError: none fits.
    """
    missing = [name for name in names if name not in found]
    if len(missing) == len(names):
        wanted = " or ".join(f"{names[0]}{suffix}" for suffix in suffixes)
        have = next((file.name for file in sorted(folder.iterdir(), key=lambda file: natural(file.name))), "nothing")
        raise ValueError(
            f"{folder}: has no file for any of {len(names)} frames; the first must be {wanted}, got {have} "
            "(without such files, remove the folder)"
        )
    if missing:
        have = f"has files for {len(names) - len(missing)} of {len(names)} frames"
        _LOG.warning("%s: %s; the first frame without one is %s", folder, have, missing[0])


def is_present(path: Path) -> bool:
    """Whether there is anything at ``path``, be it a link that leads nowhere."""
    return path.exists() or path.is_symlink()


def images(folder: Path) -> list[Path]:
    """The images of a folder in natural order of their names, hidden files left out; none where it does not exist.

    Raises:
        ValueError: it is not a folder, or has two images of one name.
    """
    return list(by_name(folder, IMAGE_SUFFIXES).values())


def numbered_images(folder: Path, prefix: str = "", gaps: bool = False) -> dict[int, Path]:
    """`numbered` of the images of a folder.

    Raises:
        ValueError: as `numbered`.
    """
    return numbered(folder, IMAGE_SUFFIXES, prefix, gaps)


def numbered(folder: Path, suffixes: Sequence[str], prefix: str = "", gaps: bool = False) -> dict[int, Path]:
    """The files of a folder by the number in their names, in order.

    Args:
        folder: need not exist.
        suffixes: in lower case; files may have them in any.
        prefix: what comes before the number.
        gaps: whether numbers may be missing between the first and the last.

    Raises:
        ValueError: a name that is not a number, two files of one number, or a gap.
    """
    found: dict[int, Path] = {}
    for word, file in by_name(folder, suffixes).items():
        digits = word.removeprefix(prefix)
        if not (digits.isascii() and digits.isdigit() and word.startswith(prefix)):
            raise ValueError(f"{file}: must be named by its number, as {prefix}000000{file.suffix}")
        if int(digits) in found:
            raise ValueError(f"{file}: has the number of {found[int(digits)].name}")
        found[int(digits)] = file
    for number, following in zip(sorted(found), sorted(found)[1:], strict=False):
        if following != number + 1 and not gaps:
            raise ValueError(f"{folder}: the frame after {found[number].name} is missing")
    return dict(sorted(found.items()))


def numbered_next_to(
    folder: Path, numbers: Sequence[int], suffixes: Sequence[str] = IMAGE_SUFFIXES, prefix: str = ""
) -> dict[int, Path]:
    """`numbered` files that go with the frames of these numbers; an empty folder is as one that is not there.

    Raises:
        ValueError: as `numbered`, or the folder has files of which none fits.
    """
    found = numbered(folder, suffixes, prefix, gaps=True)
    if found:
        width = len(next(iter(found.values())).stem.removeprefix(prefix))
        names = [f"{prefix}{number:0{width}}" for number in numbers]
        check_fit(folder, names, {f"{prefix}{number:0{width}}" for number in found}, suffixes[:1])
    return found


# ---------------------------------------------------------------- contents


def read_lines(path: Path) -> list[str]:
    """The lines of a text file that are not blank.

    Raises:
        ValueError: it can't be read, or is not text.
    """
    return list(numbered_lines(path).values())


def numbered_lines(path: Path) -> dict[int, str]:
    """The lines of a text file that are not blank, by their number in the file, from 1.

    Raises:
        ValueError: it can't be read, or is not text.
    """
    try:
        text = read_bytes(path, _LARGEST_TEXT).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is not text") from error
    return {number: line for number, line in enumerate(text.splitlines(), start=1) if line.strip()}


def read_rows(path: Path, columns: Sequence[int], skip: int = 0, *, by_frame: bool = False) -> Matrix:
    """A text file's numbers as [rows, n].

    Args:
        path: the file.
        columns: the n that are allowed; all rows have the same.
        skip: lines of heading.
        by_frame: each line belongs to the frame of its number, so that a blank line before the last one is refused: it
            would shift what follows.

    Raises:
        ValueError: it can't be read, has no row, or one that is not n finite numbers; the message names the line.
    """
    rows: list[list[float]] = []
    lines = numbered_lines(path)
    if by_frame:
        _refuse_blank(path, lines)
    for number, line in list(lines.items())[skip:]:
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
    """world_from_cam [N, 4, 4] of a file with 12 (3x4) or 16 (4x4) numbers per line, row by row.

    Raises:
        ValueError: it can't be read, or a line is not a rigid motion.
    """
    rows = read_rows(path, (12, 16), by_frame=True)
    poses = np.broadcast_to(np.eye(4), (len(rows), 4, 4)).copy()
    poses.reshape(-1, 16)[:, : rows.shape[1]] = rows
    for number, pose in enumerate(poses, start=1):
        check_rigid(pose, f"{path}: line {number}")
    return poses


def read_times(path: Path, frames: Sequence[int] | None = None) -> Matrix:
    """Seconds of times.txt, a line per frame.

    Args:
        path: the file.
        frames: numbers of the frames that are looked at, from 0, increasing; None is all.

    Returns:
        [lines].

    Raises:
        ValueError: it can't be read, a line is blank or no finite number, or the frames' times do not increase; the
            message names the line.
    """
    seconds = read_rows(path, (1,), by_frame=True)[:, 0]
    known = [frame for frame in (range(len(seconds)) if frames is None else frames) if frame < len(seconds)]
    times.check_increasing(seconds[known].tolist(), [f"line {frame + 1}" for frame in known], str(path))
    return seconds


def _refuse_blank(path: Path, lines: Mapping[int, str]) -> None:
    blank = next((number for number in range(1, max(lines, default=0)) if number not in lines), None)
    if blank is not None:
        raise ValueError(f"{path}: line {blank} is blank; it must have what belongs to frame {blank - 1}")


class Calibration:
    """A KITTI calibration file, lines of `name: numbers`; lines whose words are no numbers (dates) are skipped."""

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

    def size(self, name: str) -> tuple[int, int] | None:
        """(height, width) of the entry ``name``, `width height`; None where it is not there.

        Raises:
            ValueError: it is not two whole numbers above 0.
        """
        if name not in self._entries:
            return None
        width, height = self.entry(name, 2)
        if not (width > 0 and height > 0 and width == int(width) and height == int(height)):
            raise ValueError(f"{self.path}: `{name}` must be a width and a height in pixels, got {[width, height]}")
        return int(height), int(width)

    def entry(self, name: str, size: int) -> Matrix:
        """The ``size`` numbers of entry ``name``.

        Raises:
            ValueError: it is not there, or is not this many finite numbers.
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
            ValueError: it is not there, its K is not a camera, or its shift is not a camera's.
        """
        matrix = self.entry(name, 12).reshape(3, 4)
        check_intrinsics(matrix[:, :3], f"{self.path}: `{name}`")
        K, cam_from_rect0 = split_projection(matrix)
        check_rigid(cam_from_rect0, f"{self.path}: `{name}`")
        return K, cam_from_rect0

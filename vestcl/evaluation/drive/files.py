"""The files of a drive: kept frame by frame, so that an interrupted run continues; then one video and one CSV."""

import csv
import io
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from vestcl.evaluation.compare import METRICS
from vestcl.evaluation.drive.frame import COLUMNS
from vestcl.evaluation.drive.plan import Drive, repeats, video_rate
from vestcl.io.atomic import read_bytes, remove_leftovers, replacing, write_bytes
from vestcl.io.contact_sheet import PAPER, Picture
from vestcl.io.images import read_pixels, write_pixels
from vestcl.io.strict_json import JsonError, parse_json
from vestcl.io.video.writing import write_mp4

#: Raised when a reader of earlier files would misread newer ones.
FORMAT: Final = "vestcl drive 1"

JSON: Final = "drive.json"
VIDEO: Final = "drive.mp4"
SCORES: Final = "scores.csv"

#: The folder of the frames.
FRAMES: Final = "frames"

#: What to do about a damaged image.
_REMEDY: Final = "delete it, and the same command makes it again"

#: Of the video's images: what H.264 loses is more.
_QUALITY: Final = 95


class DriveFolder:
    """The folder OUT of a drive.

    Args:
        folder: made if it is missing.
        request: all that the results depend on; anything that JSON holds.

    Raises:
        ValueError: the folder holds a drive of another request; the message names what differs.
    """

    def __init__(self, folder: str | Path, request: Mapping[str, Any]) -> None:
        self.folder = Path(folder)
        self.request: dict[str, Any] = json.loads(json.dumps(request, default=str))
        self._check()

    def _check(self) -> None:
        path = self.folder / JSON
        if not path.exists():
            if (frames := self.folder / FRAMES).exists():
                raise ValueError(f"{frames}: has frames of an unknown drive, without {JSON}; choose another `out`")
            write_bytes(path, self._encoded({}))
            return
        try:
            about = parse_json(read_bytes(path))
        except JsonError as error:
            raise ValueError(f"{path}: is not JSON ({error}); delete the file, or give `out` another folder") from error
        if not isinstance(about, dict) or about.get("format") != FORMAT or not isinstance(about.get("request"), dict):
            raise ValueError(f"{path}: must have the format {FORMAT!r}; delete the file, or give `out` another folder")
        kept = about["request"]
        if changed := [key for key in {**self.request, **kept} if kept.get(key) != self.request.get(key)]:
            what = "; ".join(f"{key} {_shown(kept.get(key))} (now {_shown(self.request.get(key))})" for key in changed)
            raise ValueError(
                f"{self.folder}: holds a drive with {what}: continue it with the same options, or choose another `out`"
            )

    def has(self, drive: Drive, index: int) -> bool:
        """Whether frame ``index`` is complete; one whose lines are damaged is not."""
        picture, rows = self._paths(drive, index)
        return rows.is_file() and picture.is_file() and _is_whole(read_bytes(rows), drive.steps)

    def add(self, drive: Drive, index: int, rows: Sequence[Sequence[str]], picture: Picture) -> None:
        """Keep a frame's results.

        Raises:
            OSError: a file can't be written; the message names it.
        """
        picture_path, rows_path = self._paths(drive, index)
        write_pixels(picture_path, picture, _QUALITY)
        write_bytes(rows_path, _csv(rows).encode())

    def finish(self, drives: Sequence[Drive], about: Mapping[str, Any]) -> None:
        """Write the scores, the video, and drive.json with ``about``.

        Raises:
            ValueError: an image is damaged; the message names it.
            OSError: a file can't be written; the message names it.
        """
        remove_leftovers(self.folder)
        self._write_scores(drives)
        write_mp4(self.folder / VIDEO, self._video(drives), video_rate(drives))
        write_bytes(self.folder / JSON, self._encoded(about))

    def rows(self, drive: Drive) -> Iterator[dict[str, str]]:
        """The lines of a drive's scores, by column."""
        for index in drive.indices:
            text = read_bytes(self._paths(drive, index)[1]).decode()
            yield from csv.DictReader(io.StringIO(text), [*COLUMNS, *METRICS])

    def _write_scores(self, drives: Sequence[Drive]) -> None:
        with replacing(self.folder / SCORES) as temporary, temporary.open("wb") as file:
            file.write(_csv([[*COLUMNS, *METRICS]]).encode())
            for drive in drives:
                for index in drive.indices:
                    file.write(read_bytes(self._paths(drive, index)[1]))

    def _video(self, drives: Sequence[Drive]) -> Iterator[Picture]:
        """All images in order, on paper of one size."""
        firsts = [self._read(drive, drive.indices[0]).shape for drive in drives]
        height, width = max(shape[0] for shape in firsts), max(shape[1] for shape in firsts)
        rate = video_rate(drives)
        for drive, first in zip(drives, firsts, strict=True):
            for index, count in zip(drive.indices, repeats(drive, rate), strict=True):
                picture = self._read(drive, index)
                if picture.shape != first:
                    sizes = f"{first[0]} x {first[1]} px as the first of its clip, got {picture.shape[:2]}"
                    raise ValueError(f"{self._paths(drive, index)[0]}: must be {sizes}; {_REMEDY}")
                yield from itertools.repeat(_on_paper(picture, height, width), count)

    def _read(self, drive: Drive, index: int) -> Picture:
        try:
            return np.asarray(read_pixels(self._paths(drive, index)[0]), np.uint8)
        except ValueError as error:
            raise ValueError(f"{error}; {_REMEDY}") from error

    def _paths(self, drive: Drive, index: int) -> tuple[Path, Path]:
        stem = self.folder / FRAMES / drive.folder / f"{index:06}"
        return stem.with_suffix(".jpg"), stem.with_suffix(".csv")

    def _encoded(self, about: Mapping[str, Any]) -> bytes:
        content = {"format": FORMAT, "request": self.request, **about}
        return f"{json.dumps(content, indent=1, default=str)}\n".encode()


def _on_paper(picture: Picture, height: int, width: int) -> Picture:
    if picture.shape[:2] == (height, width):
        return picture
    paper = np.empty((height, width, 3), np.uint8)
    paper[:] = PAPER
    paper[: picture.shape[0], : picture.shape[1]] = picture
    return paper


def _csv(rows: Sequence[Sequence[str]]) -> str:
    screen = io.StringIO()
    csv.writer(screen, lineterminator="\n").writerows(rows)
    return screen.getvalue()


def _is_whole(content: bytes, steps: int) -> bool:
    """Whether these are lines of scores.csv, ``steps`` per view and method; none where no view has a truth."""
    try:
        lines = list(csv.reader(io.StringIO(content.decode()), strict=True))
        for line in lines:
            int(line[len(COLUMNS) - 1])
            for value in filter(None, line[len(COLUMNS) :]):
                float(value)
    except (ValueError, IndexError, csv.Error):
        return False
    columns = len(COLUMNS) + len(METRICS)
    whole = all(len(line) == columns for line in lines) and content[-1:] in (b"", b"\n")
    return whole and len(lines) % steps == 0


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    return ", ".join(map(_shown, value)) if isinstance(value, list) else str(value)

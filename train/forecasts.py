"""Geometric forecasts as training data: ``python -m train.forecasts "street:30000-30599?drive=road" --out cache``.

What a network that refines geometric forecasts is shown in training is what it is given at inference: whole forecasts
from the frames up to t, with the true frames next to them. A window's file is written whole or not at all, and the same
bytes each time; windows whose file is there are kept, so that a killed run is resumed by the same command.
"""

import io
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console

from train.command import ERRORS, failed
from vestcl import interrupt
from vestcl.cli import command_line
from vestcl.cli import main as cli
from vestcl.cli.prepare import open_input, plan, shard
from vestcl.data.sample import Clip
from vestcl.data.street import input as street_input
from vestcl.forecasting.geometric import Perception, forecast_frames
from vestcl.forecasting.network.planes import forecast_planes
from vestcl.forecasting.result import View
from vestcl.io.atomic import read_bytes, write_bytes
from vestcl.models.config import FORECAST_PLANES
from vestcl.times import is_same

#: Frames before t that perception looks at, t included; and by how many frames the next window's t is later.
CONTEXT: Final = 3
STRIDE: Final = 2

#: Planes that are kept in 8 bits, image and coverage; and the last plane, time, which is the same everywhere.
COLOURS: Final = 4
TIME: Final = FORECAST_PLANES - 1


@dataclass(frozen=True)
class Forecasts:
    """Forecast windows of clips by geometry, and keep what refinement is shown of each, with the true frames.

    Windows that are there are kept; it may be stopped at any moment.
    """

    inputs: tyro.conf.Positional[tuple[str, ...]]
    """Clips and procedural streets, as `vestcl prepare` takes them."""
    out: Path
    """Folder of the cache; a folder in it for each clip."""
    height: int = 128
    """Pixels."""
    width: int = 416
    """Pixels."""
    frames: int = 10
    """Frames of each street."""
    samples: int = 1
    """Streets' colour is the mean over samples x samples rays per pixel."""
    windows: int = 2
    """Windows of a clip at most, evenly spaced."""
    horizons: tuple[int, ...] = (1, 3, 5)
    """Frames ahead."""
    right: bool = False
    """Show the right camera's view, too, where a clip has one."""
    fov: float | None = None
    """Horizontal field of view in degrees, of a video or a folder without camera.json."""
    rig: str | None = None
    """KITTI: colour or grey cameras."""
    shard: str | None = None
    """I/N, I from 0: every N-th clip from the I-th on."""

    def as_prepare(self) -> cli.Prepare:
        """The options of `vestcl prepare` that open the same clips."""
        shared = {name: getattr(self, name) for name in ("inputs", "out", "height", "width", "frames", "samples")}
        return cli.Prepare(**shared, fov=self.fov, rig=self.rig)


class Entry(NamedTuple):
    """One frame of a forecast, and the truth."""

    planes: NDArray[np.float32]
    """[FORECAST_PLANES, H, W], of `forecast_planes`."""
    target: NDArray[np.float32]
    """[3, H, W] RGB in [0, 1]."""
    ahead: int
    """Frame intervals."""


class ForecastWindow(NamedTuple):
    """What is forecast from one frame of a clip."""

    clip: str
    current: int
    """The frame t."""
    entries: list[Entry]
    """One per horizon and view."""

    @property
    def frames(self) -> tuple[int, int]:
        """The first and the last frame that it shows."""
        return 0, self.current + max(entry.ahead for entry in self.entries)


@dataclass
class Made:
    """What a run comes to."""

    windows: int = 0
    kept: int = 0
    seconds: float = 0.0
    failures: list[str] = field(default_factory=list)


def currents(clip: Clip, last: int, most: int) -> list[int]:
    """Up to ``most`` frames t, with `CONTEXT` frames up to t and ``last`` even intervals after it, evenly spaced."""
    whole = [
        t
        for t in range(CONTEXT - 1, len(clip) - last)
        if all(is_same(clip.elapsed(at), 1) for at in range(t, t + last + 1))
    ]
    if len(whole) <= most:
        return whole
    stride = max(STRIDE, (len(whole) - 1) // max(most - 1, 1)) if most > 1 else 1
    return whole[::stride][:most]


def entries(perception: Perception, truth: Clip, index: int, horizons: Sequence[int], right: bool) -> list[Entry]:
    """The forecast from frame ``index``, at each horizon and from each view that the truth has.

    Args:
        perception: of the clip, of which frames up to ``index`` are looked at.
        truth: the same clip, with its right camera.
        index: the frame t.
        horizons: frames ahead.
        right: whether the right camera is a view.
    """
    views, camera = [View("source", np.eye(4))], truth[index].right
    if right and camera is not None:
        views.append(View("right", camera.right_from_left, camera.K))
    made, found = forecast_frames(perception, index, max(horizons), views), []
    for ahead in horizons:
        later = truth[index + ahead]
        for view in views:
            source = later.right if view.name == "right" else later
            if source is not None:
                planes = forecast_planes(made.frames[ahead - 1][view.name], ahead, truth.interval)
                found.append(Entry(planes, source.read_image(), ahead))
    return found


def pack(window: ForecastWindow) -> bytes:
    """The file of a window: 8 bits for images and coverage, float16 for the rest, compressed."""
    arrays: dict[str, Any] = {
        "clip": np.array(window.clip), "current": np.array(window.current),
        "ahead": np.array([entry.ahead for entry in window.entries]),
        "seconds": np.array([float(entry.planes[TIME, 0, 0]) for entry in window.entries]),
    }  # fmt: skip
    for number, entry in enumerate(window.entries):
        arrays[f"colours{number}"] = _bytes(np.concatenate([entry.planes[:COLOURS], entry.target]))
        arrays[f"others{number}"] = entry.planes[COLOURS:TIME].astype(np.float16)
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def unpack(path: Path, which: Callable[[int], Sequence[int]] = range) -> ForecastWindow:
    """What `pack` wrote.

    Args:
        path: the file.
        which: (number of entries) -> those that are read.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        with np.load(io.BytesIO(read_bytes(path)), allow_pickle=False) as file:
            ahead, seconds = file["ahead"].tolist(), file["seconds"].astype(np.float32)
            found = []
            for number in which(len(ahead)):
                colours, others = file[f"colours{number}"].astype(np.float32) / 255, file[f"others{number}"]
                time_ = np.full_like(others[:1], seconds[number], np.float32)
                planes = np.concatenate([colours[:COLOURS], others.astype(np.float32), time_])
                if len(planes) != FORECAST_PLANES or len(colours) != COLOURS + 3:
                    raise ValueError(f"it has {len(planes)} planes, not {FORECAST_PLANES}")
                found.append(Entry(planes, colours[COLOURS:], ahead[number]))
            return ForecastWindow(str(file["clip"]), int(file["current"]), found)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(
            f"{path}: is not a window of `train.forecasts` ({error}); remove it and make it again"
        ) from error


def make(options: Forecasts, console: Console) -> Made:
    """Fill the cache with the windows of one shard.

    Raises:
        ValueError: an input that is not a clip, or an option out of range.
        OSError: a window can't be written.
    """
    check_options(options)
    made, prepare = Made(), options.as_prepare()
    tasks = plan(prepare, *shard(options.shard, {}))
    for number, task in enumerate(tasks, 1):
        try:
            clip, seen = _opened(task.text, prepare)
            for path in _windows(task.folder, clip, seen, options, made):
                each = made.seconds / max(made.windows, 1)
                line = f"clip {number}/{len(tasks)}: {path.parent.name}/{path.name}, {each:.1f} CPU s per window"
                console.print(line, highlight=False, markup=False, soft_wrap=True)
        except ValueError as error:  # noqa: PERF203 - one clip's failure stops no other
            made.failures.append(str(error))
    return made


def check_options(options: Forecasts) -> None:
    """Refuse options out of range.

    Raises:
        ValueError: names the option.
    """
    if not options.inputs:
        raise ValueError("`inputs` must be one or more clips, got none")
    if not options.horizons or min(options.horizons) < 1:
        raise ValueError(f"`horizons` must be 1 or more each, got {list(options.horizons)}")
    if options.windows < 1:
        raise ValueError(f"`windows` must be 1 or more, got {options.windows}")
    if options.frames < (least := CONTEXT + max(options.horizons)):
        raise ValueError(f"`frames` must be {least} or more for horizon {max(options.horizons)}, got {options.frames}")


def _opened(text: str, prepare: cli.Prepare) -> tuple[Clip, Clip]:
    """The clip, and as perception sees it: a street whose depth is from motion has one camera."""
    clip, street = open_input(text, prepare), street_input.parse(text)
    if street is None or street.seeds is None:
        return clip, clip
    return clip, street_input.perceived(clip, street.driven.drawn(street.seeds[0]))


def _windows(folder: Path, clip: Clip, seen: Clip, options: Forecasts, made: Made) -> Iterator[Path]:
    """Each window's file, once it is there."""
    perception, horizons = Perception(seen), sorted(set(options.horizons))
    for index in currents(clip, horizons[-1], options.windows):
        path = folder / f"{index:06}.npz"
        if path.is_file():
            made.kept += 1
            continue
        start = time.process_time()
        write_bytes(
            path, pack(ForecastWindow(clip.name, index, entries(perception, clip, index, horizons, options.right)))
        )
        made.windows, made.seconds = made.windows + 1, made.seconds + time.process_time() - start
        yield path


def _bytes(planes: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(planes.clip(0, 1) * 255).astype(np.uint8)


@interrupt.command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command; its exit status."""
    options = command_line.parsed(Forecasts, "python -m train.forecasts", __doc__, arguments)
    console = Console()
    try:
        made = make(options, console)
    except ERRORS as error:
        return failed(error)
    console.print(f"{made.windows} windows made, {made.kept} kept: {options.out}", highlight=False, soft_wrap=True)
    return failed("\n".join(made.failures)) if made.failures else 0


if __name__ == "__main__":
    sys.exit(main())

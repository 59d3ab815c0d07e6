"""A forecast on disk: images, videos and OpenEXR of every view, and forecast.json, which describes all of them.

    DIR/forecast.json          written last, whole or not at all: where it is, the forecast is complete
    DIR/VIEW/000001.png        the frame at t+1, 8 bit
    DIR/VIEW/000001.exr        its colour, depth, coverage and 3D motion (vestcl/io/exr.py)
    DIR/VIEW/forecast.mp4      the source view: the frames up to t, then the forecast; others: the forecast
    DIR/VIEW/forecast.gif      the same, if asked for
    DIR/VIEW/sheet.png         an overview, if there is one: next to the truth where that is known

Files are replaced one by one; what lies in DIR and is not written again stays.
"""

import json
import platform
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from vestcl import opencl
from vestcl._version import __version__
from vestcl.data import calibration
from vestcl.data.sample import Clip, Sample
from vestcl.forecasting.result import Forecast, Rendered, View
from vestcl.forecasting.views import check_name, seen_by
from vestcl.io.atomic import read_bytes, remove_leftovers, write_bytes
from vestcl.io.contact_sheet import Picture
from vestcl.io.exr import ExrFrame, read_exr_frame, write_exr_frame
from vestcl.io.images import read_image, to_pixels, write_pixels
from vestcl.io.video.writing import encoder_note, write_gif, write_mp4

#: Raised when a reader of earlier files would misread newer ones.
FORMAT: Final = "vestcl forecast 1"

JSON: Final = "forecast.json"

#: The stage that forecast.json adds to the forecast's own.
WRITING: Final = "write the files"

#: Frames per second of a video whose clip does not have any: KITTI's.
FPS: Final = 10.0

#: Frames up to t that the source view's videos show first: as many as the default evaluation gives (SPEC section 10).
CONTEXT: Final = 4

#: A list of numbers as JSON spreads it over lines.
_NUMBERS: Final = re.compile(r"\[\s+([-+.\deE]+(?:,\s+[-+.\deE]+)*)\s+\]")

Report = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Details:
    """What forecast.json contains in addition to the forecast itself."""

    input: str
    """Where the clip is from."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What was asked for; anything that JSON holds, and paths."""
    scores: Mapping[str, Any] | None = None
    """Scores of each view with known truth: method -> a list over steps of metric -> number."""
    sheets: Mapping[str, Picture] = field(default_factory=dict)
    """By view, [H, W, 3] uint8."""


@dataclass(frozen=True, eq=False)
class SavedForecast:
    """A forecast on disk; images are read when they are asked for."""

    folder: Path
    about: dict[str, Any]
    """forecast.json."""
    views: tuple[View, ...]
    """With K, also where it is the source's."""
    future_from_cur: tuple[NDArray[np.float64], ...]
    """Per step, [4, 4] m."""

    def image(self, step: int, view: str) -> NDArray[np.float32]:
        """[3, H, W] RGB in [0, 1], 8 bit, at t + ``step`` (1 is the first).

        Raises:
            ValueError: no such step or view, or its file is missing or damaged.
        """
        return read_image(self.folder / self._files(step, view)["image"])

    def frame(self, step: int, view: str) -> ExrFrame:
        """Colour, depth, coverage and motion at t + ``step`` (1 is the first).

        Raises:
            ValueError: no such step or view, it was written without OpenEXR, or its file is missing or damaged.
        """
        files = self._files(step, view)
        if "exr" not in files:
            raise ValueError(f"{self.folder / JSON}: was written without OpenEXR; `image` reads the colour")
        return read_exr_frame(self.folder / files["exr"])

    def _files(self, step: int, view: str) -> dict[str, str]:
        views = self.about["views"]
        if view not in views:
            raise ValueError(f"`view` must be one of {', '.join(views)}, got {view!r}")
        frames = views[view]["frames"]
        if not 1 <= step <= len(frames):
            raise ValueError(f"`step` must be 1 ... {len(frames)}, got {step}")
        return dict(frames[step - 1])


def write_forecast(
    out: str | Path,
    forecast: Forecast,
    clip: Clip,
    index: int,
    views: Sequence[View],
    details: Details,
    *,
    exr: bool = True,
    gif: bool = False,
    report: Report | None = None,
) -> Path:
    """Write all files of a forecast, forecast.json last.

    Args:
        out: the folder, made if it is missing.
        forecast: frames at t+1, ..., each with every view.
        clip: what it is a forecast of.
        index: of the frame t in ``clip``.
        views: the cameras; their names become folders.
        details: what else forecast.json contains.
        exr: write OpenEXR, too.
        gif: write a GIF, too.
        report: called with the share of the views that are written, 0 to 1.

    Returns:
        The path of forecast.json.

    Raises:
        ValueError: no frame, one without one of the views, an index outside the clip, or a view's name that is not
            a folder's.
        OSError: a file can't be written, the disk is full for one; the message names it.
    """
    _check(forecast, clip, index, views)
    out, start = Path(out), time.perf_counter()
    for folder in (out, *(path for path in out.glob("*") if path.is_dir())):
        remove_leftovers(folder)  # also where this forecast has no view
    (out / JSON).unlink(missing_ok=True)  # an earlier one would vouch for a mixture of two forecasts
    about = _about(forecast, clip, index, details) | {"views": {}}
    for done, view in enumerate(views, start=1):
        files = _write_frames(out, forecast, view.name, exr)
        files |= _write_videos(out, forecast, clip, index, view, about["fps"], gif)
        about["views"][view.name] = _about_view(forecast, clip, index, view) | files
        if report is not None:
            report(done / len(views))
    for name, sheet in details.sheets.items():
        about["views"][name]["sheet"] = f"{name}/sheet.png"
        write_pixels(out / name / "sheet.png", sheet)
    about["seconds"] = dict(forecast.seconds) | {WRITING: time.perf_counter() - start}
    write_bytes(out / JSON, _encoded(about))
    return out / JSON


def read_forecast(out: str | Path) -> SavedForecast:
    """What `write_forecast` wrote to the folder ``out``.

    Raises:
        ValueError: no forecast.json there (none, or one that was not finished), or it was not written by vestcl.
    """
    path = Path(out) / JSON
    try:
        about = json.loads(read_bytes(path))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: is not JSON ({error})") from error
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise ValueError(f"{path}: must have the format {FORMAT!r}; write the forecast again")
    views = [
        View(name, np.array(view["tgt_from_next"], np.float64), np.array(view["K"], np.float64))
        for name, view in about["views"].items()
    ]
    poses = (np.array(pose, np.float64) for pose in about["future_from_cur"])
    return SavedForecast(Path(out), about, tuple(views), tuple(poses))


def machine() -> dict[str, Any]:
    """What computed it: {"versions": {...}, "device": {...}}, the latter of the OpenCL device in use."""
    info = opencl.current().info
    return {
        "versions": {
            "vestcl": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "torch": str(torch.__version__),
            "opencv": cv2.__version__,
            "pyopencl": metadata.version("pyopencl"),
        },
        "device": {"name": info.name, "platform": info.platform, "driver": info.driver, "opencl": info.version},
    }


def _check(forecast: Forecast, clip: Clip, index: int, views: Sequence[View]) -> None:
    if not 0 <= index < len(clip):
        raise ValueError(f"`index` must be 0 ... {len(clip) - 1}, got {index}")
    if not views or not forecast.frames:
        raise ValueError(f"`forecast` must have a frame and a view, got {len(forecast.frames)} and {len(views)}")
    if len(forecast.future_from_cur) != len(forecast.frames):
        poses = len(forecast.future_from_cur)
        raise ValueError(f"`forecast` must have a pose for each of {len(forecast.frames)} frames, got {poses}")
    for view in views:
        check_name(view.name)
        calibration.check_rigid(view.tgt_from_next, f"view {view.name}: tgt_from_next")
        for step, frame in enumerate(forecast.frames, start=1):
            if view.name not in frame:
                raise ValueError(f"`forecast` must have view {view.name!r} at t+{step}, got {', '.join(frame)}")


def _of_view(forecast: Forecast, name: str) -> Iterator[Rendered]:
    return (frame[name] for frame in forecast.frames)


def _write_frames(out: Path, forecast: Forecast, view: str, exr: bool) -> dict[str, Any]:
    frames = []
    for step, rendered in enumerate(_of_view(forecast, view), start=1):
        files = {"image": f"{view}/{step:06}.png"}
        write_pixels(out / files["image"], rendered.pixels)
        if exr:
            files["exr"] = f"{view}/{step:06}.exr"
            frame = ExrFrame(rendered.image, rendered.depth, rendered.coverage, rendered.motion_xyz)
            write_exr_frame(out / files["exr"], frame)
        frames.append(files)
    return {"frames": frames}


def video_images(forecast: Forecast, clip: Clip, index: int, view: View) -> tuple[int, list[NDArray[np.uint8]]]:
    """What a view's video shows: in the source camera the last CONTEXT frames up to t first, then the forecast.

    Returns:
        How many frames come first, and all as [H, W, 3] uint8.
    """
    past = clip[max(0, index + 1 - CONTEXT) : index + 1] if isinstance(seen_by(view, clip[index]), Sample) else ()
    context = [to_pixels(sample.read_image()).astype(np.uint8, copy=False) for sample in past]
    return len(context), [*context, *(rendered.pixels for rendered in _of_view(forecast, view.name))]


def _write_videos(
    out: Path, forecast: Forecast, clip: Clip, index: int, view: View, fps: float, gif: bool
) -> dict[str, Any]:
    context, pixels = video_images(forecast, clip, index, view)
    files: dict[str, Any] = {"context_frames": context, "video": f"{view.name}/forecast.mp4"}
    K = clip[index].K if view.K is None else view.K
    write_mp4(out / files["video"], pixels, fps, pixel_aspect=K[1, 1] / K[0, 0])
    if gif:
        files["gif"] = f"{view.name}/forecast.gif"
        write_gif(out / files["gif"], pixels, fps)
    return files


def _about(forecast: Forecast, clip: Clip, index: int, details: Details) -> dict[str, Any]:
    sample = clip[index]
    about = {
        "format": FORMAT,
        "input": details.input,
        "clip": {"name": clip.name, "kind": clip.kind, "frames": len(clip)},
        "frame": {"index": index, "name": sample.name},
        "height": sample.height,
        "width": sample.width,
        "fps": clip.fps or FPS,
        "interval_s": clip.interval,
        "method": forecast.method,
        "steps": len(forecast.frames),
        "K": sample.K,
        "future_from_cur": forecast.future_from_cur,
        "settings": dict(details.settings),
        "notes": [*forecast.notes, *([note] if (note := encoder_note()) else [])],
        **machine(),
    }
    if forecast.mode:
        about["mode"] = forecast.mode
    if forecast.learned:
        about["learned"] = {part: one._asdict() for part, one in forecast.learned.items()}
    if forecast.profile:
        about["profile"] = forecast.profile
    if forecast.skipped:
        about["skipped"] = {switch: one._asdict() | {"share": one.share} for switch, one in forecast.skipped.items()}
    return about if details.scores is None else about | {"scores": details.scores}


def _about_view(forecast: Forecast, clip: Clip, index: int, view: View) -> dict[str, Any]:
    _, height, width = forecast.frames[0][view.name].image.shape
    K = clip[index].K if view.K is None else view.K
    return {"K": K, "tgt_from_next": view.tgt_from_next, "height": height, "width": width}


def _encoded(about: Mapping[str, Any]) -> bytes:
    """JSON with a matrix's row on a line, as a person reads it."""
    spread = json.dumps(_jsonable(about), indent=1, allow_nan=False)
    text = _NUMBERS.sub(lambda row: "[" + " ".join(row[1].split()) + "]", spread)
    return f"{text}\n".encode()


def _jsonable(value: Any) -> Any:
    """``value`` in JSON's own types; numbers that JSON does not have (the PSNR of equal images) become null."""
    if isinstance(value, Mapping):
        return {str(key): _jsonable(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [_jsonable(entry) for entry in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value

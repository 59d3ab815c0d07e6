"""A forecast to be shown: a page that opens from disk, and one video with all views side by side.

DIR/index.html              a slider over steps; views next to each other; forecast, truth, error, depth, scores
DIR/page/VIEW/000001_*.jpg  what the page shows beyond the forecast's own images
DIR/side_by_side.mp4        frames seen, then the forecast at natural speed, then its last frame held
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import jinja2
import numpy as np
from markupsafe import escape
from numpy.typing import NDArray

from vestcl.data.resize import resize_labels
from vestcl.data.sample import Clip
from vestcl.forecasting.files import CONTEXT, FPS
from vestcl.forecasting.result import Forecast, View
from vestcl.forecasting.views import seen_by
from vestcl.io.atomic import write_bytes
from vestcl.io.contact_sheet import Cell, Picture, depth_map, heat, rgb, sheet
from vestcl.io.images import write_pixels
from vestcl.io.video.writing import write_mp4

PAGE: Final = "index.html"
VIDEO: Final = "side_by_side.mp4"

#: Seconds that the last frame of the video is held.
HELD_SECONDS: Final = 1.5

#: Images of the video are shown no wider, px.
_WIDEST: Final = 1280

#: A bar on top of each frame of the video, px, and its colours: of frames that were seen, and of forecasts.
_BAR: Final = 6
_SEEN: Final = (90, 140, 200)
_FORECAST: Final = (240, 150, 40)

#: Names of metrics in the table of scores, and their digits.
_METRICS: Final = {"psnr": ("PSNR, dB", 2), "ms_ssim": ("MS-SSIM", 3), "ssim": ("SSIM", 3), "st_lpips": ("ST-LPIPS", 3)}

_TEMPLATE: Final = Path(__file__).with_name("page.html")


def write_page(
    out: str | Path,
    forecast: Forecast,
    clip: Clip,
    index: int,
    views: Sequence[View],
    *,
    truths: Mapping[str, Sequence[NDArray[np.float32]]] | None = None,
    scores: Mapping[str, Any] | None = None,
) -> Path:
    """Write the page and the video of a forecast that `vestcl.forecasting.files.write_forecast` wrote to ``out``.

    Args:
        out: the forecast's folder.
        forecast: as written there.
        clip: what it is a forecast of.
        index: of the frame t.
        views: the cameras.
        truths: by view, true images [3, H, W] in [0, 1] of the first steps.
        scores: by view, method -> steps -> metric -> number.

    Returns:
        The path of the page.

    Raises:
        OSError: a file can't be written.
    """
    out, truths, scores = Path(out), truths or {}, scores or {}
    entries = [
        {
            "name": view.name,
            "files": [_files(out, forecast, view.name, k, truths.get(view.name, ())) for k in _steps(forecast)],
            "tables": [_table(scores.get(view.name, {}), k) for k in _steps(forecast)],
        }
        for view in views
    ]
    kinds = list(dict.fromkeys(kind for entry in entries for kind in entry["files"][0]))
    title = f"{clip.name}: {forecast.method} forecast from frame {clip[index].name}"
    text = jinja2.Environment(autoescape=True).from_string(_TEMPLATE.read_text(encoding="utf-8")).render(
        title=title, steps=len(forecast.frames), kinds=kinds, shown=("forecast", "truth"), views=entries,
        data=jinja2.utils.htmlsafe_json_dumps(entries),
    )  # fmt: skip
    write_bytes(out / PAGE, text.encode())
    write_video(out / VIDEO, forecast, clip, index, views)
    return out / PAGE


def write_video(path: str | Path, forecast: Forecast, clip: Clip, index: int, views: Sequence[View]) -> None:
    """Write all views above each other: the frames seen (source view), then the forecast, marked, and the end held.

    Args:
        path: *.mp4.
        forecast: with every view.
        clip: what it is a forecast of.
        index: of the frame t.
        views: the cameras.

    Raises:
        OSError: the file can't be written.
    """
    fps = clip.fps or FPS
    frames = [*_seen(forecast, clip, index, views), *_future(forecast, views)]
    frames += [frames[-1]] * round(HELD_SECONDS * fps)
    write_mp4(path, frames, fps)


def _steps(forecast: Forecast) -> range:
    return range(1, len(forecast.frames) + 1)


def _files(
    out: Path, forecast: Forecast, view: str, step: int, truths: Sequence[NDArray[np.float32]]
) -> dict[str, str]:
    """By kind, the image's path in ``out``; all but the forecast's are written here."""
    frame = forecast.frames[step - 1][view]
    shown: dict[str, Picture] = {}
    if step <= len(truths):
        truth = truths[step - 1]
        shown["truth"] = rgb(truth)
        shown["error"] = heat(np.abs(frame.image - truth).mean(axis=0, keepdims=True))
    height, width = frame.depth.shape[1:]
    smaller = min(1.0, _WIDEST / width)
    shown["depth"] = depth_map(resize_labels(frame.depth, max(1, round(height * smaller)), round(width * smaller)))
    files = {"forecast": f"{view}/{step:06}.png"}
    for kind, pixels in shown.items():
        files[kind] = f"page/{view}/{step:06}_{kind}.jpg"
        write_pixels(out / files[kind], pixels)
    return files


def _table(methods: Mapping[str, Any], step: int) -> str:
    """HTML of one step's scores, a row per method; empty where the truth is not known."""
    rows = {name: steps[step - 1] for name, steps in methods.items() if step <= len(steps)}
    if not rows:
        return ""
    metrics = [metric for metric in _METRICS if metric in next(iter(rows.values()))]
    head = "".join(f"<th>{_METRICS[metric][0]}</th>" for metric in metrics)
    body = "".join(
        f"<tr><td>{escape(name)}</td>"
        + "".join(f"<td>{_number(values.get(metric), _METRICS[metric][1])}</td>" for metric in metrics)
        + "</tr>"
        for name, values in rows.items()
    )
    return f"<table><tr><th></th>{head}</tr>{body}</table>"


def _number(value: Any, digits: int) -> str:
    return "" if value is None else f"{float(value):.{digits}f}"


def _seen(forecast: Forecast, clip: Clip, index: int, views: Sequence[View]) -> Iterator[Picture]:
    """A frame of the video for each of the last frames up to t: what no camera saw then is black."""
    first = max(0, index + 1 - CONTEXT)
    for at in range(first, index + 1):
        label = "seen, t" if at == index else f"seen, t-{index - at}"
        cells = []
        for view in views:
            camera = seen_by(view, clip[at]) if view.name == "source" else None
            size = forecast.frames[0][view.name].image.shape[1:]
            cells.append((view.name, np.zeros((*size, 3), np.uint8) if camera is None else rgb(camera.read_image())))
        yield _stacked(cells, label, _SEEN)


def _future(forecast: Forecast, views: Sequence[View]) -> Iterator[Picture]:
    for step, frame in enumerate(forecast.frames, start=1):
        yield _stacked([(view.name, frame[view.name].pixels) for view in views], f"forecast, t+{step}", _FORECAST)


def _stacked(images: Sequence[tuple[str, Picture]], label: str, colour: tuple[int, int, int]) -> Picture:
    rows = []
    for name, image in images:
        pixels = image.copy()
        pixels[:_BAR] = colour
        rows.append([Cell(pixels, f"{name}: {label}")])
    return sheet(rows, cell_width=min(_WIDEST, max(image.shape[1] for _, image in images)))

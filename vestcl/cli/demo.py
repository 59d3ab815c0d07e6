"""`vestcl demo`: the whole job on a procedural street, whose future can be seen from any camera.

What a car with two cameras would have is all that the forecast gets: the stereo pairs up to now, their calibration, and
classes of the pixels, as a segmentation network predicts them. A network's forecast is compared with the geometric one,
which is made of the same depth and motion.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip
from vestcl.evaluation import metrics
from vestcl.evaluation.compare import FORECAST
from vestcl.forecasting import baselines, geometric, page
from vestcl.forecasting import files as forecast_files
from vestcl.forecasting.geometric import Perception
from vestcl.forecasting.geometric.forecast import METHOD as GEOMETRIC
from vestcl.forecasting.network import forecast as network
from vestcl.forecasting.result import Forecast, View
from vestcl.forecasting.sheets import forecast_sheet
from vestcl.forecasting.views import parse_views
from vestcl.io import contact_sheet as sheet
from vestcl.io.contact_sheet import Cell
from vestcl.io.images import write_pixels
from vestcl.models import shipped
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference import quality

#: Frames up to the current one, all that the forecast looks at, and the rate, frames per second.
CONTEXT, FPS = 4, 10.0

#: Seconds into the drive: an oncoming car is near.
START: Final = 0.7

#: Rays per pixel and direction: antialiased images, as from a camera.
SAMPLES: Final = 2

#: The source camera, the rig's right one, and one that no car has: next to it, higher up, turned to the left.
VIEWS: Final = ("source", "right", "0.6,-0.3,0,yaw=-4,name=beside")

#: Steps that the sheet shows.
SHOWN: Final = (1, 3, 5)

#: The trained network that forecasts where no other is named and its weights are here.
NETWORK: Final = "vest-s"

Image = NDArray[np.float32]


def run(
    out: Path,
    height: int,
    width: int,
    seed: int,
    model: str | None = None,
    level: quality.Quality = quality.USUAL,
    steps: int = 5,
) -> None:
    """Forecast one street from three cameras, compare with what then happens there, and write everything.

    Args:
        out: folder for forecast.json, a folder of images, video and OpenEXR per view, and sheet.png; made if missing.
        height: rows of the images.
        width: columns of the images.
        seed: of the street.
        model: NETWORK or any other that `Forecaster.from_pretrained` knows, or GEOMETRIC; None is
            NETWORK where this installation has it, else GEOMETRIC.
        level: the inference preset.
        steps: frames to forecast.

    Raises:
        ValueError: no such model.
    """
    name = model or (NETWORK if NETWORK in shipped.shipped() else GEOMETRIC)
    forecaster = None if name == GEOMETRIC else quality.load(name, level)
    console, street = Console(), Street.generate(seed)
    clip = street_clip(street, CONTEXT + steps, height, width, start=START, fps=FPS, samples=SAMPLES)
    seen, index = stereo_only(clip), CONTEXT - 1
    views = parse_views(VIEWS, clip[index])
    with console.status("forecasting") as status:
        perception = Perception(seen, lambda stage: status.update(f"forecasting: {stage}"))
        forecasts = _forecasts(perception, index, steps, views, forecaster)
        forecast = forecasts[FORECAST]
        status.update("rendering the truth")
        truth = {view.name: [true_image(street, clip, index + k, view) for k in range(1, steps + 1)] for view in views}
        status.update("writing")
        scores = {view.name: _scores(forecasts, truth[view.name], clip, index, view) for view in views}
        sheets = {view.name: forecast_sheet([frame[view.name] for frame in forecast.frames]) for view in views}
        settings: dict[str, Any] = {"height": height, "width": width, "model": name}
        if forecaster is not None:
            settings |= {"mode": forecaster.config.default_mode, **shipped.about_model(name), **quality.about(level)}
        about = forecast_files.Details(f"street:{seed}", settings, scores, sheets)
        forecast_files.write_forecast(out, forecast, seen, index, views, about)
        write_pixels(out / "sheet.png", _sheet(perception, index, forecast, truth))
        page.write_page(out, forecast, seen, index, views, truths=truth, scores=scores)
    console.print(_score_table(scores, forecast))
    console.print(_time_table(forecasts))
    for path in (
        *(out / view.name for view in views),
        out / forecast_files.JSON,
        out / "sheet.png",
        out / page.VIDEO,
        out / page.PAGE,
    ):
        console.print(str(path), soft_wrap=True, highlight=False)


def stereo_only(clip: Clip) -> Clip:
    """The clip as a car's two cameras record it, with classes: without depth and poses."""
    bare = (dataclasses.replace(sample, depth=None, world_from_cam=None) for sample in clip)
    return dataclasses.replace(clip, samples=tuple(bare))


def true_image(street: Street, clip: Clip, index: int, view: View) -> Image:
    """What ``view`` sees at frame ``index``, [3, H, W]: the street rendered from there."""
    sample = clip[index]
    assert sample.world_from_cam is not None and sample.timestamp is not None
    tgt_from_world = view.tgt_from_next @ np.linalg.inv(sample.world_from_cam)
    K = sample.K if view.K is None else view.K
    frame = street.render(tgt_from_world, K, sample.height, sample.width, sample.timestamp, samples=SAMPLES)
    return frame.colour[0]


def _forecasts(
    perception: Perception, index: int, steps: int, views: Sequence[View], forecaster: Forecaster | None
) -> dict[str, Forecast]:
    """The forecast, and next to a network's the geometric one, both from what is perceived once."""
    by_geometry = functools.partial(geometric.forecast_frames, perception, index, steps, views)
    if forecaster is None:
        return {FORECAST: by_geometry()}
    return {FORECAST: network.forecast_frames(perception, forecaster, index, steps, views), GEOMETRIC: by_geometry()}


def _scores(
    forecasts: dict[str, Forecast], truth: list[Image], clip: Clip, index: int, view: View
) -> dict[str, list[dict[str, float]]]:
    """method -> step -> metric. What the baselines know of another view is the source's."""
    pair = [torch.from_numpy(clip[at].read_image())[None] for at in (index - 1, index)]
    images: dict[str, Sequence[Image]] = {
        **{name: [frame[view.name].image for frame in forecast.frames] for name, forecast in forecasts.items()},
        "repeat last": list(baselines.repeat_last(pair[0], pair[1], len(truth))[0].numpy()),
        "optical flow": list(baselines.flow_extrapolation(pair[0], pair[1], len(truth))[0].numpy()),
    }
    return {
        method: [_score(image, wanted) for image, wanted in zip(of_method, truth, strict=True)]
        for method, of_method in images.items()
    }


def _score(image: Image, truth: Image) -> dict[str, float]:
    pair = (metrics.quantise(torch.from_numpy(np.ascontiguousarray(predicted))[None]) for predicted in (image, truth))
    first, second = pair
    return {"psnr": float(metrics.psnr(first, second)), "ssim": float(metrics.ssim(first, second))}


def _sheet(perception: Perception, index: int, forecast: Forecast, truth: dict[str, list[Image]]) -> sheet.Picture:
    """The preprocessed frame; then, for two of the views, forecast, truth and error at some steps."""
    layers = perception.seen(index).layers
    before, now = (sheet.rgb(perception.image(at)) for at in (index - 1, index))
    depth = sheet.depth_map(layers.depth)
    rows = [[Cell(before, "seen, t-1"), Cell(now, "seen, t"), Cell(depth, "depth at t, from stereo and motion")]]
    for name, title in (("source", "the same camera"), ("beside", "0.6 m to the right, 0.3 m higher, turned left")):
        for step in (step for step in SHOWN if step <= len(forecast.frames)):
            shown, wanted = forecast.frames[step - 1][name].image, truth[name][step - 1]
            error = np.abs(shown - wanted).mean(axis=0, keepdims=True)
            label = f"t+{step}, {title}: {_score(shown, wanted)['psnr']:.1f} dB"
            rows.append(
                [Cell(sheet.rgb(shown), label), Cell(sheet.rgb(wanted), "truth"), Cell(sheet.heat(error), "error")]
            )
    scale = ("error: 0", f"{sheet.WORST_ERROR} of the range and more")
    title = f"a street forecast from stereo pairs and class masks {_how(forecast)}"
    return sheet.sheet(rows, title=title, bar=scale)


def _how(forecast: Forecast) -> str:
    if forecast.method == GEOMETRIC:
        return "without any trained weights"
    return f"by the network {forecast.method}" + (f", mode {forecast.mode}" if forecast.mode else "")


def _score_table(scores: dict[str, dict[str, list[dict[str, float]]]], forecast: Forecast) -> Table:
    steps = len(forecast.frames)
    shown = [step for step in SHOWN if step <= steps]
    headings = [f"t+{step}" for step in shown]
    title = f"forecast {_how(forecast)}"
    table = Table("PSNR dB / SSIM", *headings, box=box.SIMPLE, title=title, title_justify="left")
    for view, methods in scores.items():
        for method, by_step in methods.items():
            cells = (f"{by_step[step - 1]['psnr']:.1f} / {by_step[step - 1]['ssim']:.3f}" for step in shown)
            table.add_row(f"{view}: {method}", *cells)
        table.add_section()
    return table


def _time_table(forecasts: dict[str, Forecast]) -> Table:
    """The forecast's stages, and what the geometric one took in addition to a network's."""
    table, stages = Table("stage", "ms", box=box.SIMPLE), dict(forecasts[FORECAST].seconds)
    if GEOMETRIC in forecasts:
        stages |= {"geometric, to compare": forecasts[GEOMETRIC].seconds["render"]}
    for name, seconds in stages.items():
        table.add_row(name, f"{1000 * seconds:.0f}")
    return table

"""The Python interface: `vestcl.open` a drive, `vestcl.forecast` its future, look at it, save it.

clip = vestcl.open("drive.mp4", fov=60)
future = vestcl.forecast(clip, steps=5, views=["source", "right"], model="vest-s")
future["right"][3].image          # [3, H, W], the frame at t+3 as the right camera sees it
future.save("out")
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from vestcl import times
from vestcl.constants import DEFAULT_STEPS, LEVELS, WORK_WIDTHS, Quality
from vestcl.data.open import open_sequence
from vestcl.data.sample import Clip
from vestcl.data.street import input as street_input
from vestcl.forecasting.future import Future
from vestcl.forecasting.progress import Progress
from vestcl.forecasting.result import Forecast, View
from vestcl.forecasting.views import parse_views
from vestcl.scene.perception import Perception
from vestcl.shapes import is_whole

if TYPE_CHECKING:
    from vestcl.models.forecaster import Forecaster

#: Frames of a street if no number is given.
STREET_FRAMES: Final = 12


WorkWidth = int | Literal["preset"] | None
"""Px, the largest width that scenes are perceived at; None is the clip's own."""


def open(
    source: str | Path,
    *,
    height: int | None = None,
    width: int | None = None,
    frames: int | None = None,
    **options: Any,
) -> Clip:
    """Open a driving clip of any kind; nothing is read before it is needed.

    Args:
        source: a KITTI raw drive, a KITTI odometry sequence, a frame of Cityscapes, a scene of Virtual KITTI 2, a
            folder with camera.json, nerfstudio's transforms.json, COLMAP's text model, a video, or "street:SEED" for a
            procedural street, which needs no file.
        height: px; None is as the clip is, or in proportion to ``width``.
        width: px, likewise.
        frames: of a street, STREET_FRAMES if not given.
        **options: of the reader, as `vestcl forecast` has them: ``fov`` (degrees) of a video, ``fps``
            and ``scale`` (metres per unit) of nerfstudio and COLMAP, ``depth``, ``labels``, ``rig``, ``sequence`` ...
            (`vestcl.data.open.open_sequence`).

    Returns:
        Its frames in order; ``clip[3]`` is a frame, ``clip[3:8]`` a clip.

    Raises:
        ValueError: nothing there that vestcl can open, or an option that this kind of clip does not have.
    """
    text = str(source)
    street = street_input.parse(text)
    if street is not None and street.seeds is not None:
        if options:
            raise ValueError(f"{text}: is a street, which takes height, width, frames, not {', '.join(options)}")
        default_height, default_width = street_input.DEFAULT_SIZE
        size = (height or default_height, width or default_width)
        made = street_input.clip(street.seeds[0], street.driven, frames or STREET_FRAMES, size)
        return street_input.perceived(made, street.driven.drawn(street.seeds[0]))
    if frames is not None:
        raise ValueError(f"`frames` is of streets, got {frames} for {text}; take a slice of the clip, clip[:{frames}]")
    return open_sequence(source, **options).fitted(height, width)


def forecast(
    clip: Clip | str | Path,
    frame: int | None = None,
    *,
    steps: int | None = None,
    seconds: float | None = None,
    views: str | Iterable[str | View] = ("source",),
    model: "str | Path | Forecaster | None" = None,
    quality: Quality = "balanced",
    progress: Progress | None = None,
    **how: Any,
) -> Future:
    """Forecast the frames after one frame of a clip, and show them from any camera.

    Args:
        clip: what `open` gave, or anything that it opens.
        frame: the current frame t, from 0, which has one before it; later frames are not looked at. None is the last.
        steps: frames to forecast, DEFAULT_STEPS if not given; step k is the clip's interval times k after t.
        seconds: in place of ``steps``, how far to forecast, rounded to whole intervals of the clip.
        views: cameras: "source", "right", "left", "x,y,z,yaw=,pitch=,roll=,fov=,name=" (`vestcl.forecasting.views`),
            or `View`.
        model: None forecasts by geometry only; else a network: "vest-s", a file, a training checkpoint's folder, or a
            `Forecaster`.
        quality: the preset: the width that the scene is perceived at, and how a network that is loaded here computes.
        progress: called with the stage and the share of the work that is done.
        **how: ``work_width`` (px, the largest width that the scene is perceived at, in place of the preset's; None is
            the clip's own), ``inpaint``
            and ``memory`` of `vestcl.forecasting.geometric.forecast_clip`, and ``mode``, ``perceive``, ``learned`` of
            `vestcl.forecasting.network.forecast.forecast_clip`.

    Returns:
        The future: ``future["right"][3].image``.

    Raises:
        ValueError: no such frame or none before it, no steps, both ``steps`` and ``seconds``, ``seconds`` of a clip
            without times, no such view or model; the message names the argument.

    Source: Yarram and Yuan, ECCV 2024; SPEC sections 2 to 6.
    """
    clip = clip if isinstance(clip, Clip) else open(clip)
    index = len(clip) - 1 if frame is None else frame
    if not 1 <= index < len(clip):
        got = f"{len(clip)} frames" if frame is None else str(frame)
        raise ValueError(f"`frame` must be 1 ... {len(clip) - 1}, to have a frame before it, got {got}")
    if steps is not None and seconds is not None:
        raise ValueError(f"`steps` and `seconds` both say how far to forecast: give one, got {steps} and {seconds}")
    if seconds is not None:
        steps = times.steps_ahead(seconds, clip.interval, clip.name)
    steps = DEFAULT_STEPS if steps is None else steps
    check_steps(steps)
    cameras = chosen_views(views, clip, index)
    return Future(clip, index, tuple(cameras), _made(clip, index, steps, cameras, model, quality, progress, how))


def chosen_views(views: str | Iterable[str | View], clip: Clip, index: int) -> list[View]:
    """The cameras that ``views`` of `forecast` are at frame ``index``.

    Raises:
        ValueError: none, no such view, or two of one name.
    """
    given = [views] if isinstance(views, str | View) or not isinstance(views, Iterable) else list(views)
    if not given:
        raise ValueError("`views` must be one camera or more, got none")
    if wrong := [view for view in given if not isinstance(view, str | View)]:
        raise ValueError(f"`views` must be cameras, each in words or a View, got {wrong[0]!r}")
    parsed = iter(parse_views([view for view in given if isinstance(view, str)], clip[index]))
    found = [view if isinstance(view, View) else next(parsed) for view in given]
    names = [view.name for view in found]
    if len(set(names)) < len(names):
        raise ValueError(f"`views` must have different names, got {', '.join(names)}")
    return found


def check_steps(steps: int) -> None:
    """Refuse what is no number of steps.

    Raises:
        ValueError: no whole number, or less than 1.
    """
    if not is_whole(steps) or steps < 1:
        raise ValueError(f"`steps` must be 1 or more, a whole number, got {steps!r}")


def check_model(model: Any, quality: str) -> None:
    """Refuse what is no network and no preset.

    Raises:
        ValueError: another type, or another word.
    """
    if quality not in LEVELS:
        raise ValueError(f"`quality` must be one of {', '.join(LEVELS)}, got {quality!r}")
    if model is None or isinstance(model, str | Path) or hasattr(model, "config"):
        return
    raise ValueError(f"`model` must be None, a name, a file or a Forecaster, got {model!r}")


def _made(
    clip: Clip,
    index: int,
    steps: int,
    views: Sequence[View],
    model: "str | Path | Forecaster | None",
    quality: Quality,
    progress: Progress | None,
    how: dict[str, Any],
) -> Forecast:
    check_model(model, quality)
    how = {"work_width": width_of("preset", quality), **how}
    if model is None:
        from vestcl.forecasting import geometric

        return geometric.forecast_clip(clip, index, steps, views, progress=progress, **how)
    from vestcl.forecasting.network import forecast as network

    return network.forecast_clip(clip, index, steps, views, _loaded(model, quality), progress=progress, **how)


def _loaded(model: "str | Path | Forecaster", quality: Quality) -> "Forecaster":
    from vestcl.models.inference import quality as presets

    return presets.load(model, quality) if isinstance(model, str | Path) else model


def width_of(work_width: WorkWidth, quality: Quality) -> int | None:
    """Px, None is the clip's own: ``work_width`` itself, or that of the preset."""
    return WORK_WIDTHS.get(quality) if work_width == "preset" else work_width


Make = Callable[[Perception, int, int, Sequence[View]], Forecast]
"""(perception, index of the frame t, steps, views) -> forecast."""


def forecaster(model: "str | Path | Forecaster | None", quality: Quality) -> Make:
    """What forecasts from frames that were perceived before; arguments as of `forecast`."""
    check_model(model, quality)
    if model is None:
        from vestcl.forecasting import geometric

        return geometric.forecast_frames
    from vestcl.forecasting.network import forecast as network

    loaded = _loaded(model, quality)
    return lambda perception, index, steps, views: network.forecast_frames(perception, loaded, index, steps, views)

"""Forecast windows and score them: in parts that are kept on disk, so that a killed run continues and several share
one.

A part is a run of consecutive windows of one clip. Its file is named by clip, first window and a key of all that its
numbers depend on; it is there whole or not at all.
"""

import dataclasses
import functools
import json
import math
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from train.evaluation.inputs import label_of, perceptions, plain
from train.evaluation.protocols import NOW, NOW_BORDER, Protocol, Source, currents
from train.evaluation.setup import Setup
from vestcl.data.sample import Clip
from vestcl.evaluation.methods import Method, forecasts_of
from vestcl.evaluation.motion import ego_errors, true_motion
from vestcl.evaluation.scores import (
    GEOMETRIC,
    OTHER_CAMERA,
    RIGHT,
    SOURCE,
    Prediction,
    Record,
    Timed,
    Truth,
    predictions,
    score,
)
from vestcl.forecasting import peer
from vestcl.forecasting.geometric import Perception, show_frame
from vestcl.forecasting.network import forecast as network
from vestcl.forecasting.network.later_frames import LaterFrames
from vestcl.forecasting.network.learned import Learned
from vestcl.forecasting.result import Forecast, Rendered, View
from vestcl.forecasting.views import parse_view, parse_views
from vestcl.io.atomic import read_bytes, write_bytes
from vestcl.models.forecaster import Forecaster
from vestcl.scene.inputs import Inputs

#: Windows of a part: a minute or so of work, which is what a killed run may lose, and few enough parts to list.
PART_WINDOWS: Final = 32

#: The "view" whose scores are errors of the camera's forecast motion, and the geometric method's name there.
CAMERA: Final = "camera"
CONSTANT_VELOCITY: Final = "constant velocity"

Made = TypeVar("Made")

Presenter = Callable[[Perception, int, Sequence[View]], dict[str, Rendered]]
"""(perception, t, cameras) -> frame t by the cameras' names."""

#: Baseline of the right camera's present: what the source camera sees.
AS_SEEN: Final = f"unchanged{OTHER_CAMERA}"


@dataclass(frozen=True)
class ShardPart:
    """Windows of one clip that are done in one go."""

    source: Source
    indices: tuple[int, ...]
    """Current frames t, in order."""
    file: Path
    """Where the scores are kept."""


def plan(
    sources: Iterable[Source], protocol: Protocol, steps: int, every: int, folder: Path, key: str
) -> list[ShardPart]:
    """All parts, in the order of clips and windows; of all clips' windows counted through, every ``every``-th. Windows
    whose future has a gap are left out.

    Args:
        sources: clips.
        protocol: which windows, see `train.evaluation.protocols.currents`.
        steps: frames that are forecast.
        every: 1 takes all.
        folder: of the parts' files.
        key: of the settings.

    Raises:
        ValueError: ``every`` below 1, or a clip that is too short for a single window, or has gaps in each.
    """
    if every < 1:
        raise ValueError(f"`every` must be 1 or more, got {every}")
    parts, count = list[ShardPart](), 0
    for source in sources:
        clip = source.opens()
        known = [t for t in currents(len(clip), steps, protocol.first, protocol.last) if clip.is_whole(t, steps)]
        if not known:
            wanted = f"{(protocol.first or 1) + steps + 1} frames and a window from `first` to `last` without a gap"
            raise ValueError(f"{source.name}: must have {wanted}, got {len(clip)} frames")
        chosen = [t for number, t in enumerate(known, start=count) if number % every == 0]
        count += len(known)
        name = re.sub(r"[^A-Za-z0-9_.-]+", "_", source.name)
        for at in range(0, len(chosen), PART_WINDOWS):
            indices = tuple(chosen[at : at + PART_WINDOWS])
            parts.append(ShardPart(source, indices, folder / f"{name}-{indices[0]:06d}-{key}.json"))
    return parts


def run_part(part: ShardPart, setup: Setup, advance: Callable[[], None] = lambda: None) -> None:
    """Forecast and score a part's windows, and write its file.

    Args:
        part: of `plan`.
        setup: as in the part's key.
        advance: called after each window.

    Raises:
        ValueError: as the readers and forecasts.
    """
    clip = prepared(part.source.opens(), setup)
    seen = inputs_of(clip, setup)
    truth = Truth(clip, setup.size, setup.trunk, setup.lpips, setup.st_lpips)
    records: list[Record] = []
    for index in part.indices:
        truth.forget(index - 1)
        records += window({ending: of[0] for ending, of in seen.items()}, truth, index, setup)
        advance()
    inputs = {ending: given.as_entries() for ending, (_, given) in seen.items()}
    done = [dataclasses.asdict(record) for record in records]
    content = {"windows": len(part.indices), "inputs": inputs, "records": done}
    write_bytes(part.file, json.dumps(content).encode())


def read_part(part: ShardPart) -> list[Record] | None:
    """What `run_part` wrote; None where the part is not done.

    Raises:
        ValueError: the file holds something else.
    """
    return _read(part, lambda content: [Record(**record) for record in content["records"]])


def read_inputs(part: ShardPart) -> dict[str, Inputs] | None:
    """What the part's frames were preprocessed with, by the label of rows; None where the part is not done.

    Raises:
        ValueError: as `read_part`.
    """
    return _read(part, lambda content: {ending: Inputs.read(of) for ending, of in content["inputs"].items()})


def _read(part: ShardPart, take: Callable[[Any], Made]) -> Made | None:
    if not part.file.is_file():
        return None
    try:
        return take(json.loads(read_bytes(part.file)))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ValueError(f"{part.file}: holds no scores ({error}); delete it to have them made again") from error


def prepared(clip: Clip, setup: Setup) -> Clip:
    """The clip at the size that is evaluated, with estimates in place of its own depth and labels."""
    return setup.preprocessing.estimated(clip.resized(*setup.size))


def inputs_of(clip: Clip, setup: Setup) -> dict[str, tuple[Perception, Inputs]]:
    """By the label of their rows, what forecasts see of the clip with each source of depth, and the sources in words.

    Args:
        clip: as `prepared` gives it.
        setup: its protocol, its preprocessing, and whether stereo pairs are asked for.
    """
    return perceptions(clip, setup.protocol, setup.stereo, setup.preprocessing)


def perceptions_of(clip: Clip, setup: Setup) -> dict[str, Perception]:
    """The same without the words."""
    return {ending: perception for ending, (perception, _) in inputs_of(clip, setup).items()}


def views_of(clip: Clip, setup: Setup) -> list[View]:
    """The protocol's cameras that the clip has.

    Raises:
        ValueError: it has none of them.
    """
    there = [name for name in setup.protocol.views if name != RIGHT or clip[0].right is not None]
    if not there:
        raise ValueError(f"{clip.name}: must have a right camera for this protocol, got none")
    return parse_views(there, clip)


# ---------------------------------------------------------------- a window


def window(perceptions: Perception | Mapping[str, Perception], truth: Truth, index: int, setup: Setup) -> list[Record]:
    """Every method's scores on one window.

    Args:
        perceptions: of the truth's clip, by the label of their rows (`perceptions_of`); a single one has no label.
        truth: of the clip as `prepared` gives it.
        index: the current frame t.
        setup: methods, views and steps.

    Returns:
        A record per view and method, and of `CAMERA` where the clip has poses.
    """
    clip, by_label = truth.clip, {"": perceptions} if isinstance(perceptions, Perception) else perceptions
    views = views_of(clip, setup)
    forecasts = {
        name + ending: made
        for ending, perception in by_label.items()
        for name, made in forecast(perception, index, views, setup).items()
    }
    shown = predictions(truth, index, setup.steps, views, forecasts)
    records = score(truth, index, views, shown, next(iter(forecasts.values())).forecast)
    if setup.protocol.now:
        records += _now(next(iter(by_label.values())), truth, index, setup)
    motion = true_motion(clip, index, setup.steps)
    if motion is not None:
        for name, made in forecasts.items():
            if plain(name) == peer.METHOD:  # images only: it forecasts no motion of the camera
                continue
            method = CONSTANT_VELOCITY + label_of(name) if plain(name) == GEOMETRIC else name
            errors = ego_errors(made.forecast, motion)
            records.append(Record(clip.name, clip[index].name, index, CAMERA, method, math.nan, errors))
    return records


def forecast(perception: Perception, index: int, views: Sequence[View], setup: Setup) -> dict[str, Timed]:
    """The geometric forecast, then the peer's and each model's, see `forecasts_of`.

    Args:
        perception: of the clip.
        index: the current frame t.
        views: cameras.
        setup: models, peer, mode and steps.
    """
    models: dict[str, Method] = {
        name: functools.partial(_network_forecasts, model, setup.later[name], setup.learned)
        for name, model in setup.models.items()
    }
    return forecasts_of(perception, index, setup.steps, views, models, setup.peer)


def _network_forecasts(
    model: Forecaster,
    later: LaterFrames,
    learned: Learned,
    perception: Perception,
    index: int,
    steps: int,
    views: Sequence[View],
) -> Forecast:
    how: dict[str, Any] = {"mode": later.mode, "perceive": later.perceive, "learned": learned}
    return network.forecast_frames(perception, model, index, steps, views, **how)


def presenters(setup: Setup) -> dict[str, Presenter]:
    """How each method shows frame t itself as other cameras see it.

    Args:
        setup: methods.
    """
    shown: dict[str, Presenter] = {GEOMETRIC: show_frame}
    for name, model in setup.models.items():
        shown[name] = functools.partial(_network_shows, model)
    return shown


def _network_shows(model: Forecaster, perception: Perception, index: int, views: Sequence[View]) -> dict[str, Rendered]:
    return network.show_frame(perception, model, index, views)


def _now(perception: Perception, truth: Truth, index: int, setup: Setup) -> list[Record]:
    """The right camera's image at t, by who can show it, and what the source camera sees; scored as VEST-MPI does."""
    clip = truth.clip
    truth = Truth(clip, truth.size, truth.trunk, truth.lpips, truth.st_lpips, NOW_BORDER)
    view = dataclasses.replace(parse_view(RIGHT, clip), name=NOW)
    methods = {AS_SEEN: Prediction([truth.full(parse_view(SOURCE, clip), index)], 0.0)}
    made = {name: _timed(functools.partial(by, perception, index, [view])) for name, by in presenters(setup).items()}
    methods |= {name: Prediction([shown[NOW].image], seconds) for name, (shown, seconds) in made.items()}
    return score(truth, index, [view], {NOW: methods}, Forecast(GEOMETRIC, [], [made[GEOMETRIC][0]]), first=0)


def _timed(make: Callable[[], Made]) -> tuple[Made, float]:
    """What ``make`` gives, and its seconds."""
    start = time.perf_counter()
    made = make()
    return made, time.perf_counter() - start

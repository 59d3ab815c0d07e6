"""Texts and tables of a model card, from a run's configuration and log, its data, and results of an evaluation."""

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, Final

import numpy as np
import torch

from train.card.images import PARTS, Rows, stages_of
from train.evaluation.inputs import label_of, plain
from train.fit import window_set
from train.settings.config import Config, DataConfig, LossConfig
from vestcl.data import Street
from vestcl.evaluation.scores import GEOMETRIC
from vestcl.evaluation.tables import METRICS, Grid, horizon, number, to_markdown
from vestcl.models.config import ModelConfig
from vestcl.prepare.prepared import PreparedClip

#: A procedural street's name in a clip.
_STREET: Final = re.compile(r"street (\d+)(?: .*)?")

#: Speeds and turns are listed from this to that percentile.
_RANGE: Final = (5, 95)

#: A pose that differs by less from the street's own at time 0 is that one, m.
_SAME_PLACE: Final = 1e-3


@dataclass(frozen=True, eq=False)
class Weights:
    """A model's file."""

    name: str
    size: int
    """Bytes."""
    sha256: str
    config: ModelConfig
    state: dict[str, torch.Tensor]

    @property
    def parameters(self) -> int:
        """How many numbers."""
        return sum(tensor.numel() for tensor in self.state.values())


def about_model(weights: Weights) -> str:
    """What the file holds: parameters per part, and the choices that its configuration makes."""
    parts = {key.split(".")[0]: 0 for key in weights.state}
    for key, tensor in weights.state.items():
        parts[key.split(".")[0]] += tensor.numel()
    rows = tuple((part, f"{count:,}") for part, count in parts.items())
    kinds = ", ".join(sorted({str(tensor.dtype).removeprefix("torch.") for tensor in weights.state.values()}))
    config = weights.config
    grid = Grid(f"Parameters, {kinds}", ("", "numbers"), (*rows, ("all", f"{weights.parameters:,}")))
    start = _START[config.start] + _camera(config)
    words = (
        f"`{weights.name}`, configuration `{config.name}`: motion starts from {start}, refinement adds "
        f"to {_base(config)}. CONVENTIONS.md explains the words, `vestcl/models/config.py` has all sizes."
    )
    return f"{words}\n\n{to_markdown(grid)}".rstrip()


def _base(config: ModelConfig) -> str:
    """What refinement adds to."""
    return "the geometric forecast's image" if config.refine.refines == "forecast" else _BASE[config.refine.base]


def _camera(config: ModelConfig) -> str:
    """What the camera's motion starts from, where that is the forecast path."""
    if config.start != "prior" or config.prior != "forecast":
        return ""
    corrected = config.ego_motion is not None and config.ego_motion.correction == "bounded"
    how = f", corrected by what a car can do in {config.learned_at} between frames" if corrected else ""
    return f" and the camera's forecast path{how}"


_START: Final = {"rest": "rest", "prior": "what was measured (the prior)"}
_BASE: Final = {
    "none": "nothing: it predicts RGB directly",
    "splatted": "the splatted colour",
    "filled": "the splatted colour, holes filled",
}


# ---------------------------------------------------------------- data


def data_table(config: Config) -> str:
    """A row for each set of data that stages are shown: clips, frames, windows, size, seeds, and how they drive.

    Raises:
        ValueError: data that is not there any more.
    """
    shown: dict[DataConfig, list[str]] = {}
    for stage in config.stages:
        shown.setdefault(config.data_of(stage), []).append(stage.name)
    rows = []
    for data, stages in shown.items():
        windows = window_set(data)
        clips = list(windows.clips)
        sizes = sorted({f"{clip.size[0]} x {clip.size[1]}" for clip in clips})
        speed, turn = _driving(clips)
        cells = (f"{len(clips)}", f"{sum(map(len, clips))}", f"{len(windows.windows)}", ", ".join(sizes))
        rows.append((", ".join(stages), _folders(data), *cells, _seeds(clips), speed, turn))
    heading = ("stages", "folders", "clips", "frames", "windows", "size, px", "streets", "speed, m/s", "turning, deg/s")
    note = f"Speed and turning: {_RANGE[0]} % to {_RANGE[1]} % of all frames, from their poses."
    changes = "; ".join(dict.fromkeys(_changes(data) for data in shown))
    return f"{to_markdown(Grid('What it was trained on', heading, tuple(rows), (note,)))}\n{changes}"


def _folders(data: DataConfig) -> str:
    return ", ".join(f"`{PurePath(root).name}`" for root in data.train)


def _changes(data: DataConfig) -> str:
    targets = ", ".join(f"t+{k} {w / sum(data.horizons):.0%}" for k, w in enumerate(data.horizons, 1) if w)
    said = [
        f"Targets: {targets}, {data.right:.0%} of them from the right camera",
        f"colours changed by {data.colour:g}",
    ]
    return ", ".join([*said, "half of the windows mirrored" if data.flip else "none mirrored"]) + "."


def _seeds(clips: Sequence[PreparedClip]) -> str:
    """ "21000-21159, 21200"; "-" for clips that are no streets."""
    numbers = sorted({int(found[1]) for clip in clips if (found := _STREET.fullmatch(clip.name))})
    return ", ".join(_ranges(numbers)) or "-"


def _ranges(numbers: Sequence[int]) -> list[str]:
    results = []
    for _, run in itertools.groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]):
        own = [value for _, value in run]
        results.append(f"{own[0]}-{own[-1]}" if len(own) > 1 else f"{own[0]}")
    return results


def _driving(clips: Sequence[PreparedClip]) -> tuple[str, str]:
    """Ranges of speed, m/s, and of the turn of the camera, deg/s; "-" where clips have no poses."""
    speeds, turns = list[float](), list[float]()
    for clip in clips:
        poses = [clip.world_from_cam(index) for index in range(len(clip))]
        for index, (before, after) in enumerate(itertools.pairwise(poses), start=1):
            if before is None or after is None or clip.interval is None:
                continue
            seconds = clip.interval * clip.elapsed(index)
            motion = np.linalg.inv(before) @ after
            cosine = min(max((float(np.trace(motion[:3, :3])) - 1) / 2, -1.0), 1.0)
            speeds.append(float(np.linalg.norm(motion[:3, 3])) / seconds)
            turns.append(math.degrees(math.acos(cosine)) / seconds)
    return _range(speeds), _range(turns)


def _range(values: Sequence[float]) -> str:
    if not values:
        return "-"
    low, high = np.percentile(values, _RANGE)
    return f"{low:.1f} to {high:.1f}"


def prepare_commands(config: Config) -> list[str]:
    """`vestcl prepare` of the streets that each folder holds, as far as they are known; "#" before what is not a
    street.

    Raises:
        ValueError: data that is not there any more.
    """
    lines = []
    for data in dict.fromkeys(config.data_of(stage) for stage in config.stages):
        clips = list(window_set(data).clips)
        streets = [f"street:{numbers}" for numbers in _seeds(clips).split(", ") if numbers != "-"]
        if any("=" in clip.name for clip in clips):  # the configuration lists the command that drew them
            streets = []
        height, width = clips[0].size
        random = " --drive random" if streets and _is_random(clips[0]) else ""
        sizes = f"--height {height} --width {width} --frames {max(map(len, clips))}{random}"
        folder = PurePath(data.train[0]).name
        lines.append(f"vestcl prepare {' '.join(streets)} --out {folder} {sizes}" if streets else f"# {folder}: yours")
    return list(dict.fromkeys(lines))


def _is_random(clip: PreparedClip) -> bool:
    """Whether a street's clip starts elsewhere than the street's own driving does."""
    found, pose = _STREET.fullmatch(clip.name), clip.world_from_cam(0)
    if found is None or pose is None or "=" in clip.name:
        return False
    default = Street.generate(int(found[1])).camera_pose(0.0)
    return bool(np.abs(default[:3, 3] - pose[:3, 3]).max() > _SAME_PLACE)


# ---------------------------------------------------------------- training


def training_table(config: Config, rows: Rows, step: int, machine: str | None, versions: str) -> str:
    """A row a stage that was begun, its wall time, and what holds for all of them.

    Args:
        config: of the run.
        rows: of its log.
        step: that it has reached.
        machine: what it ran on.
        versions: of packages.
    """
    seconds, cells = _stage_seconds(rows), []
    for index, stage in enumerate(config.stages):
        begun = sum(each.steps for each in config.stages[:index])
        if step <= begun:
            break
        data, parts = config.data_of(stage), ", ".join(stage.train)
        size = " x ".join(map(str, data.crop)) if data.crop else "whole"
        scale = "" if data.scale == (1.0, 1.0) else f", shrunk by {data.scale[0]:g} to {data.scale[1]:g}"
        done, rate = f"{min(step - begun, stage.steps):,}", f"{stage.learning_rate:g}"
        cells.append((stage.name, parts, "yes" if stage.render else "no", done, str(stage.batch), rate,
                      size + scale, *seconds.get(stage.name, ("-", "-"))))  # fmt: skip
    heading = ("stage", "learns", "renders", "steps", "batch", "learning rate", "size", "minutes", "splatting")
    note = "Splatting: its share of the time, forward and backward."
    losses = [f"In stage {stage.name}: {_loss(stage.loss)}" for stage in config.stages if stage.loss is not None]
    lines = [f"Loss: {_loss(config.loss)}", *losses, _optimiser(config), f"Packages: {versions}."] + [
        f"Machine: {machine}."
    ] * bool(machine)
    return "\n\n".join([to_markdown(Grid("Stages", heading, tuple(cells), (note,))).rstrip(), *lines])


def _stage_seconds(rows: Rows) -> dict[str, tuple[str, str]]:
    """Minutes of each stage, and the share of splatting: a row's seconds hold for the steps since the row before."""
    results, before = dict[str, tuple[str, str]](), 0
    for name, _, _ in stages_of(rows):
        sums = dict.fromkeys(PARTS, 0.0)
        for row in (row for row in rows if row["stage"] == name):
            for part in PARTS:
                sums[part] += (row.get(f"s_{part}") or 0.0) * (row["step"] - before)
            before = row["step"]
        total = sum(sums.values())
        results[name] = f"{total / 60:.1f}", f"{sums['splatting'] / total:.1%}" if total else "-"
    return results


def _loss(loss: LossConfig) -> str:
    perceptual = loss.perceptual
    weights = {"L1": loss.l1, "1 - SSIM": loss.ssim, "rotation (1/rad)": loss.pose.rotation,
               "translation (1/m)": loss.pose.translation, "residual motion": loss.residual_motion}  # fmt: skip
    if perceptual.kind != "none":
        weights[f"perceptual ({perceptual.kind})"] = perceptual.weight
    return f"{', '.join(f'{name} x {weight:g}' for name, weight in weights.items() if weight)}."


def _optimiser(config: Config) -> str:
    optimiser, run = config.optimiser, config.run
    decay = f", weight decay {optimiser.weight_decay:g}" if optimiser.weight_decay else ""
    clip = f", gradient's norm cut at {optimiser.clip_norm:g}" if optimiser.clip_norm else ""
    mean = f", EMA of the weights with {optimiser.ema:g}" if optimiser.ema else ""
    end = f"cosine to {optimiser.final_factor:g} of the learning rate in each stage"
    return f"Adam, {end}{decay}{clip}{mean}; {run.precision} in encoder and refinement, seed {config.seed}."


# ---------------------------------------------------------------- results


def result_tables(results: dict[str, Any], model: str, name: str, horizons: Sequence[int]) -> list[str]:
    """A table per view: a row per metric and horizon, a column a method, and how the model differs from the baseline.

    Args:
        results: a results.json.
        model: the method that the card is of.
        name: what the card calls it.
        horizons: steps to show, of those that there are.

    Returns:
        What was reported of the evaluation, and the tables, in Markdown.
    """
    first = {window["view"]: int(window["first"]) for window in results["windows"]}
    rivals = set(results["models"]) - {model}
    made = [" ".join([f"{_scope(results)}.", *results.get("notes", ())])]
    for view, methods in results["intervals"].items():
        shown = {method: found for method, found in methods.items() if plain(method) not in rivals}
        metrics = [metric for metric in METRICS if metric in next(iter(shown.values()))]
        difference = results["differences"].get(view, {}).get(model, {})
        rows = [
            (f"{METRICS[metric].label} {horizon(k)}", *_cells(shown, difference, metric, k - first[view]))
            for metric, k in itertools.product(metrics, (0, *horizons))
            if 0 <= k - first[view] < len(next(iter(shown.values()))[metric])
        ]
        baseline = GEOMETRIC if GEOMETRIC in shown else next(iter(shown))
        last = (f"{name} less {baseline}, better in",) * bool(difference)
        heading = ("", *(name + label_of(method) if plain(method) == model else method for method in shown), *last)
        notes = tuple(METRICS[metric].note for metric in metrics if METRICS[metric].note)
        made.append(to_markdown(Grid(f"View {view}", heading, tuple(rows), notes)).rstrip())
    return made


def _cells(methods: dict[str, Any], difference: dict[str, Any], metric: str, at: int) -> list[str]:
    """Cells of every method, and of the difference where there is one."""
    digits = METRICS[metric].digits
    cells = [_interval(found[metric][at], digits) for found in methods.values()]
    return [*cells, _difference(difference[metric][at], digits)] if difference else cells


def _scope(results: dict[str, Any]) -> str:
    settings, count = results["settings"], len({(w["clip"], w["index"]) for w in results["windows"]})
    height, width = settings["size"]
    clips = f"{len(results['clips'])} clip{'s' * (len(results['clips']) != 1)}"
    streets = f", seeds {settings['seeds'][0]} to {settings['seeds'][1]}" if settings["protocol"] == "street" else ""
    machine, date = results["machine"]["processor"], results["machine"]["date"][:10]
    return f"{count} windows of {clips}{streets}, {height} x {width} px; means with 95 % intervals; {date}, {machine}"


def _interval(cell: dict[str, float | None], digits: str) -> str:
    mean, low, high = (number(_float(cell[key]), digits) for key in ("mean", "low", "high"))
    return "-" if mean == "-" else f"{mean} [{low}, {high}]"


def _difference(cell: dict[str, float | None], digits: str) -> str:
    better = _float(cell["better"])
    interval = _interval(cell, f"+{digits}")
    return interval if math.isnan(better) else f"{interval}, {better:.0%}"


def _float(value: float | None) -> float:
    return math.nan if value is None else value

"""Which windows `vestcl bench forecast` measures: of which clips, and a list of them in a file.

A list, {"kitti_clip": {"use": "tuned", "frames": [1, 3, 5]}}, marks each clip as tuned on or checked.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from vestcl.bench.forecast.config import HELD_OUT, ForecastBench
from vestcl.cli.checks import check_input
from vestcl.cli.clip import load_estimators, with_estimates
from vestcl.data.open import open_sequence
from vestcl.data.sample import Clip
from vestcl.data.street import input as street_input
from vestcl.evaluation.scores import Record
from vestcl.io.strict_json import read_object

#: Streets of one input: their frames are made in memory.
MOST_STREETS: Final = 1000


@dataclass(frozen=True)
class Listed:
    """One clip of the list."""

    use: Literal["tuned", "checked"]
    """Whether constants were chosen on it, or it only checks them."""
    frames: tuple[int, ...]
    """The current frame t of each window, from 0."""


@dataclass(frozen=True)
class Facts:
    """Errors of one window's forecast other than in images."""

    clip: str
    frame: str
    index: int
    """Of the current frame t in the clip."""
    values: dict[str, list[float]]
    """By what is measured, a number a step."""


@dataclass
class Group:
    """Clips whose windows share tables."""

    name: str
    clips: list[tuple[Clip, list[int]]]
    """Each with the current frames t of its windows."""
    use: str = ""
    """ "tuned" or "checked", by the list of windows."""
    records: list[Record] = field(default_factory=list)
    facts: list[Facts] = field(default_factory=list)

    @property
    def title(self) -> str:
        """ "kitti_clip (tuned)"; without a list of windows only the name."""
        return f"{self.name} ({self.use})" if self.use else self.name


def groups_of(config: ForecastBench) -> list[Group]:
    """The inputs with their windows; with ``config.pool`` one group.

    Raises:
        ValueError: as `clips_of`; a clip that the list of windows lacks.
    """
    listed = None if config.windows is None else read_list(config.windows)
    groups, estimators = [], load_estimators(config.depth_model, config.mask_model)
    for text in config.inputs:
        clips = [with_estimates(clip, estimators) for clip in clips_of(text, config)]
        chosen = [(clip, chosen_windows(clip, config, listed)) for clip in clips]
        groups.append(Group(text, chosen, "" if listed is None else listed[clips[0].name].use))
    if not config.pool:
        return groups
    return [Group(", ".join(config.inputs), [clip for group in groups for clip in group.clips])]


def clips_of(text: str, config: ForecastBench) -> list[Clip]:
    """The clips of one input.

    Args:
        text: "street:", "street:SEED", "street:FIRST-LAST", or what `vestcl.data.open.open_sequence` opens.
        config: how streets are made.

    Raises:
        ValueError: no clip.
    """
    streets = street_input.parse(text)
    if streets is None:
        check_input(text)
        return [open_sequence(text)]
    seeds = HELD_OUT if streets.seeds is None else streets.seeds
    if len(seeds) > MOST_STREETS:
        raise ValueError(f"`inputs` must have {MOST_STREETS:,} streets or fewer, got {text}")
    about, made = streets.driven, (config.street_frames, config.street_size, config.samples)
    return [street_input.clip(seed, about, *made, about.drawn(seed).named()) for seed in seeds]


def chosen_windows(clip: Clip, config: ForecastBench, listed: Mapping[str, Listed] | None = None) -> list[int]:
    """The windows of a clip that are measured: frames t with one frame before and ``steps`` after, an interval apart.

    Args:
        clip: of any length.
        config: ``first``, ``last``, ``every`` and ``steps``.
        listed: the list of windows by clip; None takes those of ``config``.

    Raises:
        ValueError: none, a clip that is not listed, or a listed window without true frames.
    """
    end = len(clip) - 1 - config.steps
    asked = range(config.first, (end if config.last is None else min(config.last, end)) + 1, config.every)
    there = [index for index in asked if clip.is_whole(index, config.steps)]
    if listed is None:
        if not there:
            wanted = f"{config.first + config.steps + 1} frames and a window from `first` to `last` without a gap"
            got = f"{len(clip)} frames, {config.first} and {config.last}"
            raise ValueError(f"{clip.name}: must have {wanted}, got {got}")
        return there
    if clip.name not in listed:
        raise ValueError(f"{config.windows}: has no windows of {clip.name}, only of {', '.join(listed)}")
    missing = sorted(set(listed[clip.name].frames) - set(there))
    if missing:
        wanted = f"frames with one before and {config.steps} after without a gap"
        raise ValueError(f"{config.windows}: {clip.name} must have {wanted}, got {missing}")
    return list(listed[clip.name].frames)


def read_list(path: Path) -> dict[str, Listed]:
    """The list of windows, by clip.

    Raises:
        ValueError: no such file, or something else in it.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    return {name: _listed(f"{path}: {name}", of) for name, of in read_object(path, wanted="an object, by clip").items()}


def _listed(where: str, entry: object) -> Listed:
    if not isinstance(entry, dict) or set(entry) != {"use", "frames"}:
        raise ValueError(f"{where} must have `use` and `frames`, got {entry!r}")
    use, frames = entry["use"], entry["frames"]
    if use not in ("tuned", "checked"):
        raise ValueError(f"{where}: `use` must be tuned or checked, got {use!r}")
    if not isinstance(frames, list) or not frames or not all(type(t) is int and t >= 1 for t in frames):
        raise ValueError(f"{where}: `frames` must be one or more frames, 1 or later, got {frames!r}")
    return Listed(use, tuple(sorted(set(frames))))

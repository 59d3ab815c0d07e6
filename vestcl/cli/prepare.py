"""What `vestcl prepare` does: depth, masks, inpainting and motion of every frame of clips, once, into a cache."""

import dataclasses
import functools
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich import box
from rich.console import Console
from rich.table import Table

from vestcl import interrupt
from vestcl.cli.checks import check_file_options, is_network_file
from vestcl.cli.clip import open_clip
from vestcl.cli.commands import Prepare
from vestcl.cli.progress import progress_bar
from vestcl.data.sample import Clip
from vestcl.data.street import input as street_input
from vestcl.prepare.clip import Outcome, Report, prepare_clip
from vestcl.prepare.workers import Summary, Task, run_tasks
from vestcl.scene.inpainting.inpainters import LAMA, inpainter
from vestcl.scene.inputs import inputs_of

#: Where a data set's cache is without ``out``: in it, or for a file next to it.
CACHE_SUFFIX: Final = ".vestcl"

#: How a network's depth is used, in a cache's key: combined with motion's.
COMBINED: Final = "combined"

#: Options of a clip's reader, as `vestcl forecast` has them, with what they are if not given.
_READER: Final[Mapping[str, Any]] = {
    **dict.fromkeys(("fov", "depth", "depth_scale", "labels", "depth_model", "mask_model")),
    **dict.fromkeys(("fps", "scale", "rig", "sequence", "snippet", "variant")),
    "label_ids": "trainIds",
    "accumulated_depth": False,
}


def run(options: Prepare) -> None:
    """Do what the options ask for.

    A clip that can't be prepared stops none of the others.

    Raises:
        ValueError: an option out of range, an input that is not a clip, a file that is missing or malformed.
        OSError: a frame can't be written, or a process was killed. What is there stays.
    """
    _check(options)
    part, parts = shard(options.shard, os.environ)
    tasks = plan(options, part, parts)
    console = Console()
    bar = progress_bar(console, counted=True, hidden=os.environ.get("LOCAL_RANK", "0") != "0")  # one bar a terminal
    summary, done, total = Summary(), 0, sum(task.frames for task in tasks)
    with interrupt.summary(lambda: _stopped(done, total)), bar:
        shown = bar.add_task("frames", total=total)

        def advance() -> None:
            nonlocal done
            done += 1
            bar.advance(shown)

        run_tasks(tasks, functools.partial(_prepare, options=options), summary, advance, options.workers)
    if summary.computed + summary.kept:
        _print_end(console, summary, tasks, f", shard {part}/{parts}" if parts > 1 else "")
    if summary.failures:
        raise ValueError("\n".join(summary.failures))


def _stopped(done: int, total: int) -> str:
    """The line of a run that Ctrl-C stopped."""
    if not done:
        return "stopped; nothing was written"
    return f"stopped; {done} of {total} frames are prepared, and the same command prepares the others"


def shard(given: str | None, environment: Mapping[str, str]) -> tuple[int, int]:
    """Which part of the clips is this process's: (I, N), the clips I, I + N, I + 2 N ...

    Args:
        given: "I/N", 0 <= I < N, or None.
        environment: where torchrun sets RANK and WORLD_SIZE; without them and ``given`` it is all.

    Raises:
        ValueError: no such part.
    """
    name, text = "`shard`", given
    if text is None:
        if "RANK" not in environment or "WORLD_SIZE" not in environment:
            return 0, 1
        name, text = "RANK/WORLD_SIZE", f"{environment['RANK']}/{environment['WORLD_SIZE']}"
    numbers = re.fullmatch(r"(\d+)/(\d+)", text)
    if numbers is None or int(numbers[1]) >= int(numbers[2]):
        raise ValueError(f"{name} must be I/N with 0 <= I < N, got {text}")
    return int(numbers[1]), int(numbers[2])


def plan(options: Prepare, part: int = 0, parts: int = 1) -> list[Task]:
    """The clips of one part, each with its folder.

    Args:
        options: inputs, and where to.
        part: 0 <= part < parts.
        parts: how many processes share the inputs.

    Raises:
        ValueError: an input that is not a clip, a street without ``out``, or two clips for one folder.
    """
    texts = [text for given in options.inputs for text in _expanded(given)]
    tasks: dict[Path, Task] = {}
    plain = dataclasses.replace(options, depth_model=None, mask_model=None)  # no network is loaded to count frames
    for text in texts[part::parts]:
        clip = open_input(text, plain)
        name = re.sub(r"[^\w.-]+", "_", clip.name).lstrip(".") or "clip"
        folder = _cache(text, options) / f"{name}-{options.height}x{options.width}"
        if folder in tasks:
            both = f"{tasks[folder].text} and {text}"
            raise ValueError(f"{folder}: is where both {both} would go; `--out` can part them")
        tasks[folder] = Task(text, folder, len(clip))
    return list(tasks.values())


def open_input(text: str, options: Prepare) -> Clip:
    """A clip as `vestcl forecast` opens it, or the street of "street:SEED", at the options' size.

    Raises:
        ValueError: as `vestcl.cli.clip.open_clip`.
    """
    reader = {name: getattr(options, name) for name in _READER}
    street = street_input.parse(text)
    if street is None or street.seeds is None:
        return open_clip(text, options, (options.height, options.width), options.frames)
    if wrong := [name for name, unset in _READER.items() if reader[name] != unset]:
        raise ValueError(f"{text}: is a street, which brings depth and labels; it does not take {', '.join(wrong)}")
    seed, size = street.seeds[0], (options.height, options.width)
    driven = _driven(street, options)
    name = street.driven.drawn(seed).named()
    return street_input.clip(seed, driven, options.frames, size, options.samples, name)


def _driven(street: street_input.StreetInput, options: Prepare) -> street_input.Driven:
    """The street's settings from its input, else from the options."""
    fps = None if options.street_fps is None else street_input.rate(options.street_fps, "`street_fps`")
    given = street_input.Driven(options.drive, fps, options.street_depth, options.street_masks)
    return street.driven.over(given)


def _check(options: Prepare) -> None:
    check_file_options(options)
    if options.frames < 2:
        raise ValueError(f"`frames` must be 2 or more, got {options.frames}")
    if not options.inputs:
        raise ValueError("`inputs` must be one or more clips, got none")


def _expanded(text: str) -> list[str]:
    """A street each for street:FIRST-LAST; anything else is one clip."""
    streets = street_input.parse(text)
    return [text] if streets is None or streets.seeds is None else streets.each()


def _cache(text: str, options: Prepare) -> Path:
    if options.out is not None:
        return options.out
    if street_input.parse(text) is not None:
        raise ValueError(f"{text}: is not a folder to keep a cache in; `--out` must name one")
    path = Path(text)
    return (path if path.is_dir() else path.parent) / CACHE_SUFFIX


def estimators(options: Prepare) -> str:
    """A key of the networks that the options name; empty without any."""
    models = (options.depth_model, options.mask_model, *((options.inpaint,) if options.inpaint else ()))
    keys = [*map(identity, models), *([COMBINED] if options.depth_model else [])]
    return "|".join(keys) if any(models) else ""


def identity(model: str | None) -> str:
    """A key of a network: its name on the hub, or its files with their sizes and times.

    Args:
        model: a folder, a file, "lama:FILE" or a name.
    """
    if model and model.startswith(LAMA):
        files = [path] if (path := Path(model.removeprefix(LAMA))).is_file() else []
    else:
        files = _files_of(Path(model)) if model else []
    about = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    return repr(about) if about else repr(model)


def _files_of(model: Path) -> list[Path]:
    """A folder's files; an ONNX network's: itself, its JSON, its weights where they lie in other files."""
    if is_network_file("model", str(model)):
        from vestcl.scene.estimators.onnx import network_files

        return network_files(model)
    return sorted(path for path in model.rglob("*") if path.is_file())


def _prepare(task: Task, waits: bool, report: Report, options: Prepare) -> Outcome | None:
    clip, inpaint = open_input(task.text, options), None
    street, seen = street_input.parse(task.text), clip
    if street is not None and street.seeds is not None:
        seen = street_input.perceived(clip, _driven(street, options).drawn(street.seeds[0]))
    if options.inpaint is not None:
        inpaint = inpainter(options.inpaint, "inpaint")
    inputs = inputs_of(seen, depth_model=options.depth_model, mask_model=options.mask_model, inpaint=options.inpaint)
    key = estimators(options)
    return prepare_clip(
        clip, task.folder, inputs, perceived=seen, estimators=key, inpaint=inpaint, wait=waits, report=report
    )


def _print_end(console: Console, summary: Summary, tasks: Sequence[Task], which: str) -> None:
    table = Table("stage", box=box.SIMPLE)
    table.add_column("seconds", justify="right")
    for stage, taken in (summary.seconds | {"all": sum(summary.seconds.values())}).items():
        table.add_row(stage, f"{taken:.2f}")
    console.print(table)
    about = (
        f"{len(tasks)} clip{'s' * (len(tasks) != 1)}{which}: {summary.computed} frames computed, {summary.kept} kept"
    )
    console.print(about, highlight=False)
    if summary.computed:
        each, frames = sum(summary.seconds.values()) / summary.computed, sum(task.frames for task in tasks) / len(tasks)
        console.print(f"{each:.2f} s per computed frame, {each * frames:.1f} s per clip of {frames:g}", highlight=False)
    for folder in dict.fromkeys(str(task.folder.parent) for task in tasks):
        console.print(folder, highlight=False, markup=False, soft_wrap=True)

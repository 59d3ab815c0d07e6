"""What options may be, in every command of vestcl and train, and how messages name them: as they are typed."""

import dataclasses
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

#: Largest side of a frame, px, and most pixels: beyond, indices and memory of any machine come to their end.
LARGEST_SIDE: Final = 16384
MOST_PIXELS: Final = 1 << 25

#: Integers without a range: what NumPy and kernels hold.
_WHOLE: Final = 2**63 - 1


@dataclass(frozen=True)
class Range:
    """Numbers from ``lowest`` to ``highest``, which are among them unless ``between`` is set."""

    lowest: float
    highest: float = _WHOLE
    between: bool = False

    def fault(self, value: float) -> str:
        """What is wrong with ``value``, or nothing."""
        if self.between:
            inside = self.lowest < value < self.highest
            return "" if inside else f"must be between {self.lowest:,g} and {self.highest:,g}"
        if value < self.lowest:
            return f"must be {self.lowest:,g} or more"
        return "" if value <= self.highest else f"must be {self.highest:,} or less"


_SECONDS: Final = Range(0, 1e6, between=True)
_SIDE: Final = Range(1, LARGEST_SIDE)

#: By the name that an option has in any command.
RANGES: Final[Mapping[str, Range]] = {
    "batch": Range(1, 4096),
    "channels": Range(1, 4096),
    "depth_scale": Range(0, 10**9, between=True),
    "every": Range(1),
    "fail_above": Range(0, 10**9),
    "first": Range(0),
    "fov": Range(0, 180, between=True),
    "frame": Range(0),
    "frames": Range(1, 10000),
    "height": _SIDE,
    "horizons": Range(1, 1000),
    "last": Range(0),
    "port": Range(1, 65535),
    "radii": Range(0, 1e6, between=True),
    "radius": Range(0, 1e6, between=True),
    "runs": Range(1, 100000),
    "samples": Range(1, 16),
    "seconds": _SECONDS,
    "seed": Range(0),
    "seeds": Range(0),
    "steps": Range(1, 1000),
    "street_frames": Range(1, 10000),
    "street_size": _SIDE,
    "streets": Range(1, 10000),
    "threads": Range(1, 4096),
    "timeout": _SECONDS,
    "width": _SIDE,
    "workers": Range(1, 1024),
}

#: Options that name files to write.
_OUTPUT_FILES: Final = ("json", "markdown", "trace")
#: Options that name folders to write to, unless a command declares a file.
_OUTPUT_FOLDERS: Final = ("out", "plots")

#: How the annotation of a positional argument reads: tyro's marker, as a type or as text.
_POSITIONAL: Final = re.compile(r"\b_?Positional\b")

#: A message about an entry of such a file calls it as the file does; about an option only after one of these words.
_OF_A_FILE: Final = re.compile(r"[^`]*\.(json|ya?ml|txt): ")
#: "its" are a view's own: `--view 0,0,1,fov=200` has no --fov.
_QUOTED: Final = re.compile(r"(?<!its )`([a-z]\w*)`")
_ASKED_FOR: Final = re.compile(r"(?<=leave out )`([a-z]\w*)`|(?<=give )`([a-z]\w*)`")
#: A reader's message about options that it does not have.
_NOT_TAKEN: Final = re.compile(r"(?:(?<=, which takes )([\w, ]+), not |(?<=it does not take ))([\w, ]+)$")


def typed(name: str) -> str:
    """A field's name as the option is typed."""
    return f"--{name.replace('_', '-')}"


def as_typed(message: str, options: Any) -> str:
    """``message`` with the names of ``options``'s fields as the user typed them: `depth_scale` is --depth-scale.

    A name that a message begins with is an option's only if that was given: it may be any function's argument.

    Args:
        message: of an error; functions call their arguments by name, in backticks.
        options: a dataclass, the command's options.
    """
    if not dataclasses.is_dataclass(options):
        return message
    fields, positional = dataclasses.fields(options), positionals(options)
    names = {field.name: field.name.upper() if field.name in positional else typed(field.name) for field in fields}
    given = {field.name for field in fields if getattr(options, field.name) != field.default}

    def renamed(found: "re.Match[str]") -> str:
        name = next(filter(None, found.groups()))
        name = name if name in names else name.removesuffix("s")  # `views` are --view, repeated
        is_subject = found.start() == 0 or message[: found.start()].endswith(": ")
        return names[name] if name in names and (name in given or not is_subject) else found[0]

    def listed(found: "re.Match[str]") -> str:
        known, unknown = (", ".join(names.get(n, n) for n in (group or "").split(", ")) for group in found.groups())
        return f"{known}, not {unknown}" if found[1] else unknown

    message = _NOT_TAKEN.sub(listed, message)
    return (_ASKED_FOR if _OF_A_FILE.match(message) else _QUOTED).sub(renamed, message)


def positionals(options: Any) -> set[str]:
    """The fields that are no options but the command's inputs (tyro.conf.Positional)."""
    return {field.name for field in dataclasses.fields(options) if _POSITIONAL.search(repr(field.type))}


def check_arguments(arguments: Sequence[str]) -> None:
    """Refuse what no option takes, before types make something else of it: an empty path would be this folder.

    Raises:
        ValueError: an empty argument, or one that no file name can be.
    """
    for before, argument in zip(("", *arguments), arguments, strict=False):
        name, equals, value = argument.partition("=")
        option = name if name.startswith("--") and equals else (before if before.startswith("--") else "an argument")
        text = value if name.startswith("--") and equals else argument
        if not text.strip() and not (name.startswith("--") and not equals):
            raise ValueError(f"{option} must not be empty, got {text!r}")
        if "\0" in text:
            raise ValueError(f"{option} must not have a zero byte, got {text!r}")


def check_options(options: Any) -> None:
    """Hold every number against its range, and every file and folder to be written against what is there.

    Args:
        options: a dataclass; a field ``out`` is a folder unless its class names it in OUTPUT_FILES.

    Raises:
        ValueError: a number that is not finite or out of range, or an output that can't be written; the message calls
            the option as it is typed.
    """
    named = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    positional = positionals(options)
    for name, value in named.items():
        shown = name.upper() if name in positional else typed(name)
        for number in _numbers(value):
            _check_number(name, shown, number)
    check_pixels(named.get("height"), named.get("width"))
    files = (*_OUTPUT_FILES, *getattr(options, "OUTPUT_FILES", ()))
    for name, value in named.items():
        if isinstance(value, Path) and name in (*files, *_OUTPUT_FOLDERS):
            check_output(name.upper() if name in positional else typed(name), value, name in files)


def check_output(shown: str, path: Path, is_file: bool) -> None:
    """Refuse a file or folder that can't be written, before the work whose result goes there.

    Raises:
        ValueError: it is something else, or no folder above it can be written.
    """
    try:
        if path.exists() and path.is_dir() == is_file:
            wanted, got = ("file", "folder") if is_file else ("folder", "file")
            raise ValueError(f"{shown} must be a {wanted}, got the {got} {path}")
        there = path if path.is_dir() else next((above for above in path.absolute().parents if above.exists()), path)
    except OSError as error:
        raise ValueError(f"{shown} {str(path)[:80]}: {error.strerror}") from error
    if not there.is_dir():
        raise ValueError(f"{shown} {path}: can't be made, since {there} is not a folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{shown} {path}: can't be made, since {there} can't be written")


def _check_number(name: str, shown: str, number: float) -> None:
    if not math.isfinite(number):
        raise ValueError(f"{shown} must be finite, got {number}")
    fault = RANGES.get(name, Range(-_WHOLE)).fault(number)
    if fault:
        raise ValueError(f"{shown} {fault}, got {number}")


def check_pixels(height: Any, width: Any, name: str = "--height x --width") -> None:
    """Refuse a frame of more than `MOST_PIXELS`; a side that is not given is not checked.

    Raises:
        ValueError: too many pixels.
    """
    if isinstance(height, int) and isinstance(width, int) and height * width > MOST_PIXELS:
        raise ValueError(f"{name} must be {MOST_PIXELS:,} px or less, got {height} x {width}")


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, tuple | list):
        for part in value:
            yield from _numbers(part)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value

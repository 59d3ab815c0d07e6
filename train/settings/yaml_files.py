"""Settings before they are checked: YAML files that build on each other, overrides, and errors in words."""

import dataclasses
import difflib
import re
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError

Settings = TypeVar("Settings")

#: The key by which a file names the one that it builds on.
BASE: Final = "base"


class _Loader(yaml.SafeLoader):
    """YAML 1.2's numbers: PyYAML knows 1.1's, in which "1e-4" and "1.0e5" are strings."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def read_settings(path: Path | str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The mapping that ``path`` holds, over its bases, under the overrides; see `train.settings.config.load_config`.

    Args:
        path: a YAML file.
        overrides: ``key.sub=value`` each.

    Returns:
        Nested dicts, unchecked.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no YAML, no mapping, bases in a circle, or an override that leads nowhere.
    """
    settings = _read(Path(path), ())
    for override in overrides:
        _apply(settings, override)
    return settings


def checked(kind: type[Settings], settings: dict[str, Any], source: str) -> Settings:
    """The configuration that ``settings`` hold.

    Args:
        kind: a dataclass of pydantic's.
        settings: plain values.
        source: where they are from.

    Raises:
        ValueError: everything that is wrong, in one message: keys that are unknown, with the nearest that is known;
            values out of range or of another kind; what is not set.
    """
    try:
        return TypeAdapter(kind).validate_python(settings)
    except ValidationError as error:
        raise ValueError(_in_words(error, kind, source)) from error


def _in_words(error: ValidationError, kind: type, source: str) -> str:
    """All that is wrong, a line each."""
    lines = [f"  {_line(problem, kind)}" for problem in error.errors(include_url=False)]
    return "\n".join([f"{source}:", *lines])


def _read(path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    path = path.resolve()
    if path in above:
        raise ValueError(f"`{BASE}` must not lead back to a file that builds on it, got {path}")
    if not path.is_file():
        builds = f", which {above[-1]} builds on" if above else ""
        raise FileNotFoundError(f"no configuration at {path}{builds}")
    settings = _parse(_text_of(path), str(path))
    if not isinstance(settings, dict):
        raise ValueError(f"{path} must hold a mapping of keys to values, got {type(settings).__name__}")
    base = settings.pop(BASE, None)
    return settings if base is None else merged(_read(path.parent / str(base), (*above, path)), settings)


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} must be YAML in UTF-8: {error.reason} at byte {error.start}") from error


def _parse(text: str, source: str) -> Any:
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        said = getattr(error, "problem", None) or (str(error).splitlines() or [""])[0]
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise ValueError(f"{source} must be YAML: {where}{said}") from error


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """``above`` over ``below``: mappings are merged, everything else is replaced."""
    both = {
        key: merged(below[key], above[key])
        for key in below.keys() & above.keys()
        if isinstance(below[key], dict) and isinstance(above[key], dict)
    }
    return {**below, **above, **both}


def _apply(settings: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    parts = key.split(".")
    if not equals or not all(parts):
        raise ValueError(f"an override must be key=value or key.sub=value, got {override!r}")
    place: Any = settings
    for part in parts[:-1]:
        if isinstance(place, dict) and place.get(part) is None:  # absent, or a null for nothing
            place[part] = {}
        place = place[_index(place, part, override)]
    place[_index(place, parts[-1], override)] = _parse(text, f"the value of {override!r}")


def _index(place: Any, part: str, override: str) -> str | int:
    """``part`` as what ``place`` is subscripted by."""
    if isinstance(place, dict):
        return part
    if isinstance(place, list):
        names = [str(entry.get("name")) if isinstance(entry, dict) else None for entry in place]
        if part in names:
            return names.index(part)
        if part.isdecimal() and int(part) < len(place):
            return int(part)
        wanted = ", ".join(filter(None, names)) or "an index"
        raise ValueError(f"{override!r}: {part!r} must be {wanted} or below {len(place)}")
    raise ValueError(f"{override!r}: nothing is beneath the key before {part!r}, which is {place!r}")


def _line(problem: Any, kind: type) -> str:
    key, value = ".".join(map(str, problem["loc"])), problem.get("input")
    if problem["type"] == "unexpected_keyword_argument":
        nearest = _nearest(key, [known for known, _ in _keys(kind)])
        return f"`{key}` is not a key" + (f"; did you mean `{nearest}`?" if nearest else "")
    if problem["type"] == "missing" or (value is None and key):
        return f"`{key}` must be set: add {key}=..."
    if problem["type"] == "value_error":
        return f"{f'`{key}`: ' if key else ''}{problem['ctx']['error']}"
    said = problem["msg"].replace("Input should", "must", 1)
    return f"`{key}` {said if said.startswith('must') else f'must be of another kind ({said})'}, got {value!r}"


def _nearest(key: str, known: list[str]) -> str | None:
    """The known key most like ``key``, an unknown one; indices in ``key`` are kept."""
    plain = re.sub(r"\.\d+(?=\.)", "", key)
    siblings = [name for name in known if name.rpartition(".")[0] == plain.rpartition(".")[0]]
    leaves = {name.rpartition(".")[2]: name for name in reversed(known)}
    last = plain.rpartition(".")[2]
    if near := difflib.get_close_matches(last, [name.rpartition(".")[2] for name in siblings], 1):
        return f"{key.rpartition('.')[0]}.{near[0]}".lstrip(".")
    return leaves[near[0]] if (near := difflib.get_close_matches(last, list(leaves), 1)) else None


def _keys(kind: Any, above: str = "") -> Iterator[tuple[str, Any]]:
    """Every key beneath the dataclass ``kind``, dotted, with its type; a list's index is left out."""
    for name, hint in typing.get_type_hints(kind).items():
        yield f"{above}{name}", hint
        for inner in _dataclasses(hint):
            yield from _keys(inner, f"{above}{name}.")


def _dataclasses(hint: Any) -> Iterator[Any]:
    if dataclasses.is_dataclass(hint):
        yield hint
    for argument in typing.get_args(hint):
        yield from _dataclasses(argument)

"""JSON as its standard has it, where Python's reader takes more."""

import json
from pathlib import Path
from typing import Any, NoReturn

from vestcl.io.atomic import LARGEST, read_bytes


class JsonError(ValueError):
    """Why a text is not JSON."""


def parse_json(content: bytes) -> Any:
    """JSON as its standard has it: no NaN, no infinity, no key twice in one object.

    Raises:
        JsonError: it is not.
    """
    try:
        return json.loads(content, parse_constant=_refuse_constant, object_pairs_hook=_object)
    except JsonError:
        raise
    except RecursionError as error:
        raise JsonError("nested too deeply") from error
    except ValueError as error:  # of JSON, of its encoding, of a number of thousands of digits
        raise JsonError(str(error)) from error


def read_object(path: Path, largest: int = LARGEST, wanted: str = "an object") -> dict[str, Any]:
    """The object that a file holds.

    Args:
        path: of the file.
        largest: bytes that it may have.
        wanted: what it must be, for the message.

    Raises:
        ValueError: a file that can't be read or is too large, no JSON, or something else than an object.
    """
    try:
        content = parse_json(read_bytes(path, largest))
    except JsonError as error:
        raise ValueError(f"{path}: is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: must be {wanted}, got {type(content).__name__}")
    return content


def _refuse_constant(word: str) -> NoReturn:
    raise JsonError(f"{word} is not a number in JSON")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        keys = [key for key, _ in pairs]
        raise JsonError(f"the key {next(key for key in keys if keys.count(key) > 1)!r} is there twice")
    return content

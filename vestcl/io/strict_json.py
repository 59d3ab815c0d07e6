"""JSON as its standard has it, where Python's reader takes more."""

import json
from typing import Any, NoReturn


class JsonError(ValueError):
    """Why a text is no JSON."""


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


def _refuse_constant(word: str) -> NoReturn:
    raise JsonError(f"{word} is no number in JSON")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        keys = [key for key, _ in pairs]
        raise JsonError(f"the key {next(key for key in keys if keys.count(key) > 1)!r} is there twice")
    return content

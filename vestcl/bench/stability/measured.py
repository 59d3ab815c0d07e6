"""The errors that were measured, and the bounds that follow from them.

    bound = min(rounding's bound, 8 max(e, u)),   e the largest error of five seeds on every device measured, u = 2^-24

An error below one rounding, u, is chance: it counts as one.

`vestcl bench stability --device all --keep FILE` measures e. What a device has in the file already only falls, so that
bounds get tighter.
"""

import functools
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from vestcl.bench.stability.operators import UNIT
from vestcl.io.atomic import write_bytes

#: Kept with the bench: device -> case -> kind -> array -> the largest error over `SEEDS`.
FILE: Final = Path(__file__).with_name("measured.json")

#: Seeds of the cases that are measured.
SEEDS: Final = range(5)

#: A bound is at most so many times the largest error that was measured.
FACTOR: Final = 8.0

Errors = Mapping[str, Mapping[str, float]]
"""By kind and array, see `vestcl.bench.stability.bench.Errors`."""

ByCase = dict[str, dict[str, dict[str, float]]]


def tightened(case: str, bounds: Errors) -> dict[str, dict[str, float]]:
    """``bounds`` of the case of that name, where what was measured allows smaller ones."""
    errors = _largest().get(case, {})
    return {
        kind: {name: min(bound, _allowed(errors.get(kind, {}).get(name))) for name, bound in arrays.items()}
        for kind, arrays in bounds.items()
    }


def keep(path: Path, device: str, found: Mapping[str, Iterable[Errors]]) -> None:
    """Add what was ``found`` on a device to a file, by case the errors of each seed; smaller ones that are there stay.

    Raises:
        OSError: the file can't be written.
    """
    kept = read(path) if path.exists() else {}
    old, new = kept.get(device, {}), {case: _worst(each) for case, each in found.items()}
    for case, kinds in new.items():
        for kind, arrays in kinds.items():
            for name, error in arrays.items():
                arrays[name] = min(error, old.get(case, {}).get(kind, {}).get(name, error))
    write_bytes(path, f"{json.dumps(kept | {device: old | new}, indent=1, sort_keys=True)}\n".encode())


def read(path: Path) -> dict[str, ByCase]:
    """What `keep` wrote, by device."""
    content: dict[str, ByCase] = json.loads(path.read_text(encoding="utf-8"))
    return content


@functools.cache
def _largest() -> ByCase:
    """Over all devices of `FILE`."""
    by_device = read(FILE).values()
    names = dict.fromkeys(case for device in by_device for case in device)
    return {case: _worst(device[case] for device in by_device if case in device) for case in names}


def _worst(errors: Iterable[Errors]) -> dict[str, dict[str, float]]:
    """Array by array the largest, with three digits."""
    worst: dict[str, dict[str, float]] = {}
    for each in errors:
        for kind, arrays in each.items():
            for name, error in arrays.items():
                of_kind = worst.setdefault(kind, {})
                of_kind[name] = max(of_kind.get(name, 0.0), float(f"{error:.2e}"))
    return worst


def _allowed(error: float | None) -> float:
    return math.inf if error is None else FACTOR * max(error, UNIT)

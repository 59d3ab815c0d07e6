"""The windows that real clips are judged on, kept in a file: evenly spaced, each clip marked as tuned on or checked.

{"kitti_clip": {"use": "tuned", "frames": [1, 3, 5]}}
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vestcl.io.strict_json import read_object

Use = Literal["tuned", "checked"]


@dataclass(frozen=True)
class Listed:
    """One clip of the list."""

    use: Use
    """Whether constants were chosen on it, or it only checks them."""
    frames: tuple[int, ...]
    """The current frame t of each window, from 0."""


def evenly(windows: Sequence[int], count: int) -> list[int]:
    """``count`` of ``windows``, evenly spaced from the first to the last; all where there are fewer."""
    if len(windows) <= count:
        return list(windows)
    return [windows[round(i * (len(windows) - 1) / max(count - 1, 1))] for i in range(count)]


def read_list(path: Path) -> dict[str, Listed]:
    """By clip.

    Raises:
        ValueError: no such file, or something else in it.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    content = read_object(path, wanted="an object, by clip")
    return {name: _listed(f"{path}: {name}", entry) for name, entry in content.items()}


def _listed(where: str, entry: object) -> Listed:
    if not isinstance(entry, dict) or set(entry) != {"use", "frames"}:
        raise ValueError(f"{where} must have `use` and `frames`, got {entry!r}")
    use, frames = entry["use"], entry["frames"]
    if use not in ("tuned", "checked"):
        raise ValueError(f"{where}: `use` must be tuned or checked, got {use!r}")
    if not isinstance(frames, list) or not frames or not all(type(t) is int and t >= 1 for t in frames):
        raise ValueError(f"{where}: `frames` must be one or more frames, 1 or later, got {frames!r}")
    return Listed(use, tuple(sorted(set(frames))))

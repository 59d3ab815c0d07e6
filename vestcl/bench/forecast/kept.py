"""Windows that `vestcl bench forecast` has measured, one line each in a file, so that a stopped run can be resumed.

The first line is a key of all that the scores depend on: the settings and the package's source.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import vestcl
from vestcl.evaluation.scores import Record


@dataclass(frozen=True)
class Facts:
    """Errors of one window's forecast other than in images."""

    clip: str
    frame: str
    index: int
    """Of the current frame t in the clip."""
    values: dict[str, list[float]]
    """By what is measured, a number a step."""


Window = tuple[list[Record], list[Facts]]

#: The file next to OUT, until OUT is written.
SUFFIX: Final = ".windows.jsonl"


class Kept:
    """The file of measured windows.

    Args:
        path: of the file; None keeps nothing.
        settings: what scores depend on, next to the source code.

    Raises:
        ValueError: the file can't be read or written.
    """

    def __init__(self, path: Path | None, settings: Mapping[str, Any]) -> None:
        self.path, self.key = path, key_of(settings)
        self._windows = {} if path is None else _read(path, self.key)

    def __len__(self) -> int:
        return len(self._windows)

    def get(self, clip: str, index: int) -> Window | None:
        """Window ``index`` of a clip, or None: not measured yet."""
        return self._windows.get((clip, index))

    def add(self, clip: str, index: int, window: Window) -> None:
        """Keep a window; it is on the disk when this returns.

        Raises:
            ValueError: the file can't be written.
        """
        self._windows[clip, index] = window
        if self.path is None:
            return
        records, facts = ([dataclasses.asdict(one) for one in part] for part in window)
        line = {"clip": clip, "index": index, "records": records, "facts": facts}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            is_new = len(self._windows) == 1 or not self.path.exists()
            with self.path.open("w" if is_new else "a", encoding="utf-8") as file:
                if is_new:
                    file.write(json.dumps({"key": self.key}) + "\n")
                file.write("\n" + json.dumps(line) + "\n")  # a blank line ends what a killed run may have left torn
        except OSError as error:
            raise ValueError(f"{self.path}: can't be written: {error.strerror}") from error

    def remove(self) -> None:
        """Delete the file: all results are elsewhere."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def key_of(settings: Mapping[str, Any]) -> str:
    """Sixteen hexadecimal digits that change with ``settings`` and with the package's source."""
    digest = hashlib.sha256(json.dumps(dict(settings), sort_keys=True, default=str).encode())
    root = Path(vestcl.__file__).parent
    for file in sorted([*root.rglob("*.py"), *root.rglob("*.cl"), *root.parent.glob("kernels/**/*.cl")]):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _read(path: Path, key: str) -> dict[tuple[str, int], Window]:
    """What an earlier run with the same key has measured; lines that it did not finish don't count."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []
    except OSError as error:
        raise ValueError(f"{path}: can't be read: {error.strerror}") from error
    entries = [entry for entry in map(_entry, lines) if isinstance(entry, dict)]
    if not entries or entries[0].get("key") != key:
        return {}
    try:
        return {(each["clip"], each["index"]): _window(each) for each in entries[1:]}
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: holds no scores ({error}); delete it to measure them again") from error


def _entry(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _window(entry: Mapping[str, Any]) -> Window:
    return [Record(**each) for each in entry["records"]], [Facts(**each) for each in entry["facts"]]

"""Which models were trained on what they are evaluated on, by the record in their files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from train.evaluation.windows import ShardPart
from vestcl.models.checkpoint import read_trained_on

Sentences = tuple[str, ...]

#: Clips that a sentence lists.
_LISTED: Final = 8


def training_overlap(
    models: Sequence[Path], parts: Sequence[ShardPart], steps: int, names: Sequence[str] | None = None
) -> tuple[Sentences, Sentences]:
    """Sentences for the tables: on models that were trained on what is evaluated, and on those that may have been.

    Args:
        models: files.
        parts: the windows.
        steps: that are forecast.
        names: what tables call the models; None is their stems.

    Returns:
        On models whose files list frames of these windows, and on models whose files list nothing.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a damaged file.
    """
    leaks, unknown, clips = list[str](), list[str](), list(dict.fromkeys(part.source.name for part in parts))
    for model, path in zip(names or [path.stem for path in models], models, strict=True):
        frames = read_trained_on(path)
        if frames is None:
            unknown.append(f"The file of {model} has no record of what it was trained on.")
            continue
        seen = {part.source.name for part in parts if _overlap(part, frames.get(part.source.name), steps)}
        if shown := [name for name in clips if name in seen]:
            listed = ", ".join(shown[:_LISTED]) + f" and {len(shown) - _LISTED} more" * (len(shown) > _LISTED)
            leaks.append(f"{model} was trained on frames of {len(shown)} of these {len(clips)} clips: {listed}.")
    return tuple(leaks), tuple(unknown)


def _overlap(part: ShardPart, frames: tuple[int, int] | None, steps: int) -> bool:
    """Whether a window of the part shows one of these frames, the first to the last."""
    return frames is not None and any(t - 1 <= frames[1] and frames[0] <= t + steps for t in part.indices)

"""Progress of a forecast: the stage that begins, and the share of the work that is done."""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with the stage and the share of the work that is done, 0 to 1."""


def by_stage(progress: Progress | None, total: float) -> Callable[[str], None]:
    """What stages call when they begin: it counts them, and passes their share of ``total`` on.

    Args:
        progress: is called; None counts only.
        total: stages that are expected; more of them stay at 1.
    """
    done = 0

    def report(stage: str) -> None:
        nonlocal done
        if progress:
            progress(stage, min(done / total, 1.0))
        done += 1

    return report

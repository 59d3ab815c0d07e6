"""Statistics over windows: intervals by resampling clips, differences between methods, the extreme windows.

Neighbouring windows of a clip show the same objects, so clips are what is drawn again, with all of their windows:

    x* = sum_c n_c S_c / sum_c n_c N_c

with S_c the sum over a clip's windows, N_c their number, and n_c how often c was drawn. Where there is only one clip,
its windows are drawn instead; the interval is then too narrow.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.evaluation.scores import Record
from vestcl.evaluation.tables import METRICS, Grid, by_method, horizon, number, steps_of

#: Draws: the ends of an interval then vary by some hundredths of its width.
RESAMPLES: Final = 2000

#: The same draws in every run.
SEED: Final = 0

#: Quantiles of a 95 % interval.
TAILS: Final = (0.025, 0.975)


class Interval(NamedTuple):
    """A mean over windows and its 95 % interval; NaN where no window has a number."""

    mean: float
    low: float
    high: float


class Difference(NamedTuple):
    """One method less another, over the windows that both have."""

    interval: Interval
    better: float
    """Share of windows where the first one is better."""


def bootstrap(values: ArrayLike, clips: Sequence[str]) -> list[Interval]:
    """Mean and interval of each column.

    Args:
        values: [windows, K]; windows whose number is not finite don't count.
        clips: the clip of each window.

    Returns:
        K of them.

    Raises:
        ValueError: another shape, or another number of clips.

    Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993: percentile intervals of a cluster bootstrap.
    """
    table = np.asarray(values, np.float64)
    if table.ndim != 2 or len(table) != len(clips) or not len(table):
        raise ValueError(f"`values` must be [windows, K] of {len(clips)} windows, got {list(table.shape)}")
    known = np.isfinite(table)
    sums, counts = (_by_clip(each, clips) for each in (np.where(known, table, 0.0), known.astype(np.float64)))
    draws = np.random.default_rng(SEED).multinomial(len(sums), np.full(len(sums), 1 / len(sums)), RESAMPLES)
    means = _ratio(draws @ sums, draws @ counts)
    centre = _ratio(sums.sum(0), counts.sum(0))
    return [Interval(float(centre[k]), *_tails(means[:, k])) for k in range(table.shape[1])]


def unit(records: Sequence[Record]) -> str:
    """What is drawn again: "clips", or "windows" of a single one."""
    return "clips" if len({record.clip for record in records}) > 1 else "windows"


def intervals(records: Sequence[Record]) -> dict[str, list[Interval]]:
    """`bootstrap` of each metric of one view and method, by step."""
    clips = [record.clip for record in records]
    shown = [metric for metric in METRICS if all(metric in record.scores for record in records)]
    return {metric: bootstrap([record.scores[metric] for record in records], clips) for metric in shown}


def interval_grid(title: str, records: Sequence[Record], horizons: Sequence[int], metrics: Sequence[str]) -> Grid:
    """A table of `intervals`: a row per method, for each metric a column per horizon.

    Args:
        title: of the table.
        records: of one view.
        horizons: the steps to show; those that the view does not have are left out.
        metrics: that all records have.
    """
    steps, rows = steps_of(records, horizons), list[tuple[str, ...]]()
    for (_, method), own in by_method(records).items():
        found = intervals(own)
        rows.append((method, *(cell(found[m][k - own[0].first], METRICS[m].digits) for m in metrics for k in steps)))
    heading = ("", *(f"{METRICS[m].label} {horizon(k)}" for m in metrics for k in steps))
    return Grid(title, heading, tuple(rows), (drawn(records),))


def cell(interval: Interval, digits: str) -> str:
    """ "0.812 [0.801, 0.823]" """
    mean, low, high = (number(value, digits) for value in interval)
    return "-" if mean == "-" else f"{mean} [{low}, {high}]"


def drawn(records: Sequence[Record]) -> str:
    """The note of a table with intervals."""
    if unit(records) == "clips":
        count = len({record.clip for record in records})
        return f"Intervals: bootstrap over {count} clips, with all of their windows."
    return "Intervals: bootstrap over the windows of one clip. They resemble each other, so it is too narrow."


def differences(records: Sequence[Record], baseline: Sequence[Record]) -> dict[str, list[Difference]]:
    """Paired: of each window the score minus the baseline's, by metric and step.

    Args:
        records: of one view and method.
        baseline: of another method.

    Returns:
        Nothing where they share no window.
    """
    other = {(record.clip, record.index): record for record in baseline}
    pairs = [(one, other[key]) for one in records if (key := (one.clip, one.index)) in other]
    found: dict[str, list[Difference]] = {}
    for metric in METRICS:
        both = [(a, b) for a, b in pairs if metric in a.scores and metric in b.scores]
        if not both:
            continue
        table = np.array([[a.scores[metric], b.scores[metric]] for a, b in both], np.float64)
        known = np.isfinite(table).all(axis=1)
        less = np.where(known, table[:, 0], np.nan) - np.where(known, table[:, 1], np.nan)
        wins = np.where(known, less * METRICS[metric].better > 0, np.nan)
        parts = bootstrap(less, [a.clip for a, _ in both]), bootstrap(wins, [a.clip for a, _ in both])
        found[metric] = [Difference(difference, win.mean) for difference, win in zip(*parts, strict=True)]
    return found


def extremes(records: Sequence[Record], metric: str, step: int) -> dict[str, Record]:
    """The best, the median and the worst window of one view and method; of few windows some may be the same.

    Args:
        records: of one view and method.
        metric: of `vestcl.evaluation.METRICS`.
        step: by which horizon, from 1.

    Raises:
        ValueError: no window has a number.
    """
    known = [record for record in records if np.isfinite(record.scores[metric][step - record.first])]
    if not known:
        raise ValueError(f"`records` must have {metric} at t+{step}, got none of {len(records)} windows")
    order = sorted(known, key=lambda record: -METRICS[metric].better * record.scores[metric][step - record.first])
    return {"best": order[0], "median": order[len(order) // 2], "worst": order[-1]}


def _by_clip(table: NDArray[np.float64], clips: Sequence[str]) -> NDArray[np.float64]:
    """Sums over each clip's rows, or the rows themselves where there is one clip."""
    names, which = np.unique(clips, return_inverse=True)
    if len(names) == 1:
        return table
    sums = np.zeros((len(names), table.shape[1]))
    np.add.at(sums, which, table)
    return sums


def _ratio(sums: NDArray[np.float64], counts: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)


def _tails(means: NDArray[np.float64]) -> tuple[float, float]:
    known = means[~np.isnan(means)]
    low, high = np.quantile(known, TAILS) if len(known) else (np.nan, np.nan)
    return float(low), float(high)

"""What an evaluation leaves: tables, results.md, results.csv and results.json."""

import csv
import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

from train.evaluation.inputs import label_of, plain, sentences
from train.evaluation.protocols import PAPER_NOTE, Protocol
from train.evaluation.windows import CONSTANT_VELOCITY
from vestcl.evaluation.scores import GEOMETRIC, Record
from vestcl.evaluation.statistics import Difference, Interval, cell, differences, drawn, interval_grid, intervals
from vestcl.evaluation.tables import (
    METRICS,
    Grid,
    by_method,
    by_view,
    finite,
    horizon,
    means,
    number,
    picture_grids,
    steps_of,
    summarise,
    to_markdown,
)
from vestcl.scene.inputs import Inputs

#: What models are compared with: the forecast without weights and, for the camera's motion, where that takes it from.
_BASELINES: Final = (GEOMETRIC, CONSTANT_VELOCITY)

#: What ends the title of the paper's table.
_PAPER: Final = ", the paper"

#: Clips of a table per clip; more go to results.json only.
CLIP_ROWS: Final = 60

#: The first available one of each represents likeness and distance where a table has space for no more.
LIKENESS: Final = ("ms_ssim", "ssim", "psnr")
DISTANCE: Final = ("lpips", "st_lpips", "squeeze")


@dataclass(frozen=True)
class EvaluationResults:
    """An evaluation that is done."""

    protocol: Protocol
    records: Sequence[Record]
    horizons: tuple[int, ...]
    """That tables show."""
    models: tuple[str, ...]
    """As methods are called, without labels."""
    remarks: tuple[str, ...] = ()
    """What was given to methods and what was not measured, a sentence each."""
    leaks: tuple[str, ...] = ()
    """Which models were trained on what is evaluated, a sentence each: notes of every table."""
    modes: Mapping[str, str] = field(default_factory=dict)
    """How each model made the steps after the first, as notes below tables name it."""
    perceived: Mapping[str, str] = field(default_factory=dict)
    """Where depth and mask of forecast frames came from, of models of mode "feedback"."""
    inputs: Mapping[str, Mapping[str, Inputs]] = field(default_factory=dict)
    """Where those of recorded frames came from, by clip and label of rows."""

    @property
    def notes(self) -> tuple[str, ...]:
        """All sentences: on inputs, on what was not measured, on what models were trained on."""
        return (*sentences(self.inputs), *self.remarks, *self.leaks)

    def is_model(self, method: str) -> bool:
        """Whether a row is a model's, with whatever label."""
        return plain(method) in self.models

    def is_compared(self, method: str) -> bool:
        """Whether narrow tables show a row."""
        return self.is_model(method) or plain(method) in _BASELINES


def headline(records: Sequence[Record]) -> list[str]:
    """Likeness and distance, as far as the records have them."""
    known = {metric for record in records for metric in record.scores}
    if not known & {*LIKENESS, *DISTANCE}:
        return [metric for metric in METRICS if metric in known]
    return [next(m for m in choice if m in known) for choice in (LIKENESS, DISTANCE) if known & {*choice}]


# ---------------------------------------------------------------- tables


def grids(results: EvaluationResults) -> list[Grid]:
    """All tables: by horizon, differences, the paper's, running means, intervals, by clip."""
    name, records, horizons = results.protocol.title, results.records, results.horizons
    of_images = [record for record in records if record.first == 1 and "psnr" in record.scores]
    further = [
        *picture_grids(name, of_images, [k for k in horizons if k > 1], running=True),
        *(_interval_grid(view, of_view, results) for view, of_view in by_view(records).items()),
        *_clip_grids(results),
    ]
    return [*short_grids(results), *(_with_notes(grid, results) for grid in further)]


def short_grids(results: EvaluationResults) -> list[Grid]:
    """Those that a terminal has space for: by horizon, differences, the paper's."""
    name = results.protocol.title
    shown = picture_grids(name, results.records, results.horizons)
    own = [_with_notes(grid, results) for grid in (*shown, *_difference_grids(results))]
    return own + _paper_grids(results)


def _with_notes(grid: Grid, results: EvaluationResults) -> Grid:
    """With notes on inputs, on how the models made later frames, and on models that were trained on what is evaluated,
    once."""
    modes, perceived = (
        ", ".join(f"{model} {how}" for model, how in of.items()) for of in (results.modes, results.perceived)
    )
    own = (
        *sentences(results.inputs),
        *([f"Mode of later frames: {modes}."] if modes else []),
        *([f"Depth and masks of forecast frames (perceive): {perceived}."] if perceived else []),
        *results.leaks,
    )
    return replace(grid, notes=(*grid.notes, *(note for note in own if note not in grid.notes)))


def _interval_grid(view: str, records: Sequence[Record], results: EvaluationResults) -> Grid:
    title = f"{results.protocol.title}, view {view}, mean and 95 % interval"
    return interval_grid(title, records, results.horizons, headline(records))


def _difference_grids(results: EvaluationResults) -> list[Grid]:
    made = []
    for view, of_view in by_view(results.records).items():
        methods = {method: own for (_, method), own in by_method(of_view).items()}
        steps, of_baseline = steps_of(of_view, results.horizons), dict[str, list[tuple[str, ...]]]()
        for model in filter(results.is_model, methods):
            baseline = _baseline(model, methods)
            for metric, found in differences(methods[model], methods[baseline]).items() if baseline else ():
                shown = [found[k - of_view[0].first] for k in steps]
                cells = (f"{cell(d.interval, '+' + METRICS[metric].digits)}, {d.better:.0%}" for d in shown)
                of_baseline.setdefault(str(baseline), []).append((f"{model}, {METRICS[metric].label}", *cells))
        for baseline, rows in of_baseline.items():
            title = f"{results.protocol.title}, view {view}, model less {baseline}"
            notes = ("Each: mean difference, its 95 % interval, share of windows where the model is better.",)
            heading = ("", *map(horizon, steps))
            made.append(Grid(title, heading, tuple(rows), (*notes, drawn(of_view))))
    return made


def _baseline(method: str, methods: Collection[str]) -> str | None:
    """The row with the same label that a model is compared with, if there is one."""
    return next((name for name in (base + label_of(method) for base in _BASELINES) if name in methods), None)


def _clip_grids(results: EvaluationResults) -> list[Grid]:
    """A row per clip."""
    made = []
    for view, of_view in by_view(results.records).items():
        clips = list(dict.fromkeys(record.clip for record in of_view))
        own = [record for record in of_view if results.is_compared(record.method)]
        if not 1 < len(clips) <= CLIP_ROWS or not own:
            continue
        methods, metrics = list(dict.fromkeys(record.method for record in own)), headline(own)
        steps = sorted({steps_of(own, results.horizons)[i] for i in (0, -1)})
        rows = []
        for clip in clips:
            cells = [_of_clip(own, clip, method, m, k) for method in methods for m in metrics for k in steps]
            count = len({record.index for record in own if record.clip == clip})
            rows.append((clip, str(count), *cells))
        columns = (f"{method} {METRICS[m].label} {horizon(k)}" for method in methods for m in metrics for k in steps)
        made.append(Grid(f"{results.protocol.title}, view {view}, by clip", ("", "windows", *columns), tuple(rows)))
    return made


def _of_clip(records: Sequence[Record], clip: str, method: str, metric: str, step: int) -> str:
    own = [record for record in records if (record.clip, record.method) == (clip, method)]
    return number(means([record.scores for record in own])[metric][step - own[0].first], METRICS[metric].digits)


def _paper_grids(results: EvaluationResults) -> list[Grid]:
    rows = results.protocol.paper
    if not rows:
        return []
    steps = list(dict.fromkeys(k for row in rows for k in row.values))
    metrics = [metric for metric in METRICS if any(row.metric == metric for row in rows)]
    lines = []
    for method, view in dict.fromkeys((row.method, row.view) for row in rows):
        values = {(row.metric, k): v for row in rows if (row.method, row.view) == (method, view)
                  for k, v in row.values.items()}  # fmt: skip
        cells = (f"{values[m, k]:.3f}" if (m, k) in values else "-" for m in metrics for k in steps)
        lines.append((f"{method}, view {view}", *cells))
    heading = ("", *(f"{METRICS[m].label} {horizon(k)}" for m in metrics for k in steps))
    return [Grid(results.protocol.title + _PAPER, heading, tuple(lines), (PAPER_NOTE,))]


# ---------------------------------------------------------------- files


def markdown(results: EvaluationResults, about: Sequence[str]) -> str:
    """results.md.

    Args:
        results: all windows.
        about: lines on models, device and settings.
    """
    head = [f"# {results.protocol.title}", "", *(f"- {line}" for line in (*about, *results.notes)), ""]
    return "\n".join([*head, *map(to_markdown, grids(results))])


def table_of_windows(records: Sequence[Record]) -> str:
    """results.csv: a row per window, view, method and horizon; empty where a view has no such metric."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["clip", "frame", "t", "view", "method", "horizon", "seconds", *METRICS])
    for record in records:
        where = record.clip, record.frame, record.index, record.view, record.method
        for step in range(len(next(iter(record.scores.values())))):
            values = (record.scores[metric][step] if metric in record.scores else "" for metric in METRICS)
            writer.writerow([*where, step + record.first, record.seconds, *values])
    return text.getvalue()


def as_json(results: EvaluationResults, about: Mapping[str, Any]) -> dict[str, Any]:
    """results.json: everything.

    Args:
        results: all windows.
        about: machine, settings, models.
    """
    groups, by_clip = by_method(results.records), dict[str, Any]()
    for clip in dict.fromkeys(record.clip for record in results.records):
        by_clip[clip] = summarise([record for record in results.records if record.clip == clip])
    remarks: dict[str, Any] = {
        **about,
        "title": results.protocol.title,
        "notes": list(results.notes),
        "inputs": {
            clip: {ending.strip(", "): of.as_entries() for ending, of in by_label.items()}
            for clip, by_label in results.inputs.items()
        },
        "summary": summarise(results.records),
        "intervals": _nested({key: _plain(intervals(own)) for key, own in groups.items()}),
        "differences": _nested({key: _plain(found) for key, found in _all_differences(results).items()}),
        "clips": by_clip,
        "paper": [asdict(row) for row in results.protocol.paper],
        "windows": [asdict(record) for record in results.records],
    }
    checked: dict[str, Any] = finite(remarks)
    return checked


def _all_differences(results: EvaluationResults) -> dict[tuple[str, str], dict[str, list[Difference]]]:
    """Differences of each model from the geometric forecast, or from constant velocity."""
    groups = by_method(results.records)
    found = {}
    for (view, method), own in groups.items():
        baseline = _baseline(method, [name for of, name in groups if of == view])
        if results.is_model(method) and baseline:
            found[view, method] = differences(own, groups[view, baseline])
    return found


def _plain(by_metric: Mapping[str, Sequence[Interval | Difference]]) -> dict[str, list[dict[str, float]]]:
    """Intervals and differences by their parts' names."""

    def plain(value: Interval | Difference) -> dict[str, float]:
        if isinstance(value, Interval):
            return value._asdict()
        return value.interval._asdict() | {"better": value.better}

    return {metric: [plain(value) for value in of_steps] for metric, of_steps in by_metric.items()}


def _nested(groups: Mapping[tuple[str, str], Any]) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for (view, method), value in groups.items():
        nested.setdefault(view, {})[method] = value
    return nested

"""Tables of `vestcl bench pareto`, and figures of them: time to the right, error upwards. Notebook 04 draws them, too.

`tables` reads files of earlier versions likewise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import pandas as pd  # type: ignore[import-untyped]

from vestcl.bench.common.plots import Curve, curves
from vestcl.bench.common.results import Results
from vestcl.bench.common.table import Measurement, Section
from vestcl.bench.common.timing import Spread
from vestcl.bench.pareto.measure import Point, front, knee

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: What the titles of two tables begin with, and are.
COMBINATIONS: Final = "best of"
STEPS: Final = "several steps"

_NOTES: Final = (
    "time: ms/step, median and quartiles; t - 1 is remembered. x: the exact one's time over it.",
    "rms: difference from the float64 image with nothing skipped, of 1. PSNR, MS-SSIM: against the frame that follows.",
    "loss: mean and largest over streets of PSNR below the exact one's, dB.",
)


_RMS: Final = ("rms difference from float64", "rms")
_LOSS: Final = ("PSNR drop, dB", "loss")


def knob_section(name: str, about: str, points: Sequence[Point]) -> Section:
    """One knob; the first of ``points`` is the default, which is exact."""
    marks = {points[0].value: "default"}
    bend = knee(points).value
    marks[bend] = f"{marks.get(bend, '')} knee".strip()
    return Section(f"{name}: {about}", _rows(points, marks, f"{name} "), _NOTES, {name: draw})


def combined_section(points: Sequence[Point], qualities: Mapping[str, str]) -> Section:
    """Combinations of knobs, shown if they are of the Pareto front or named: ``qualities`` by level."""
    marks: dict[str, str] = dict.fromkeys((point.value for point in front(points)), "front")
    marks |= {value: f"{marks.get(value, '')} {level}".strip() for level, value in qualities.items()}
    rows = [
        row if row.row in marks else replace(row, column="")
        for row in _rows(points, marks, "combination ")
        if row.row in marks or row.name
    ]
    return Section(f"{COMBINATIONS} {len(points)} combinations", rows, _NOTES, {"front": draw})


def steps_section(found: Sequence[tuple[str, int, Spread, Spread]]) -> Section:
    """Both ways to forecast several steps: mode, steps, seconds of the whole forecast, PSNR over streets."""
    rows = list[Measurement]()
    for mode, steps, seconds, psnr in found:
        name = f"{mode} to t+{steps}"
        rows += [Measurement(name, "time", seconds, "s", name=f"{name}, time")]
        rows += [Measurement(name, "PSNR", psnr, "dB", ".2f", f"{name}, PSNR", "higher")]
    note = "compose repeats the first motion; feedback sees each forecast frame, and encodes it."
    return Section(STEPS, rows, (note,), {"recursion": draw})


def _rows(points: Sequence[Point], marks: Mapping[str, str], prefix: str) -> list[Measurement]:
    rows, exact = list[Measurement](), points[0].seconds.median
    for point in points:
        value, name = point.value, f"{prefix}{point.value}"
        has_ms_ssim = point.ms_ssim.median == point.ms_ssim.median
        rows += [
            Measurement(value, "time", point.seconds, "s", name=f"{name}, time"),
            Measurement(value, "x", exact / point.seconds.median, digits=".2f"),
            Measurement(value, "rms", point.rms, digits=".1e", name=f"{name}, rms"),
            Measurement(value, "PSNR", point.psnr, "dB", ".2f", f"{name}, PSNR", "higher"),
            Measurement(value, "MS-SSIM", point.ms_ssim, "1", ".4f", f"{name}, MS-SSIM" * has_ms_ssim, "higher"),
            Measurement(value, "loss", point.loss, "dB", ".3f", f"{name}, loss"),
            Measurement(value, "largest", point.worst, "dB", ".3f"),
            Measurement(value, "is", marks.get(value, "")),
        ]
    return rows


def tables(result: Results) -> dict[str, pd.DataFrame]:
    """The long tables of a result by title: a knob each, the combinations, several steps."""
    earlier, sections = result.details, []
    for name, knob in earlier.get("knobs", {}).items():
        sections.append(knob_section(name, knob["about"], [_point(one) for one in knob["points"]]))
    if "front" in earlier:
        points = [_point(one) for one in earlier["front"]["points"]]
        sections.append(combined_section(points, earlier["front"]["qualities"]))
    if "recursion" in earlier:
        steps = [(one["mode"], one["steps"], Spread(**one["seconds"]), Spread(**one["psnr"]))
                 for one in earlier["recursion"]]  # fmt: skip
        sections.append(steps_section(steps))
    frame = pd.concat([section.frame for section in sections]) if sections else result.frame
    return {str(title): own for title, own in frame.groupby("table", sort=False)}


def _point(content: Mapping[str, Any]) -> Point:
    seconds, rms, psnr, ms_ssim = (Spread(**content[name]) for name in ("seconds", "rms", "psnr", "ms_ssim"))
    return Point(content["value"], seconds, rms, psnr, ms_ssim, content["loss"], content["worst"])


def points(frame: pd.DataFrame) -> pd.DataFrame:
    """Of one long table a row each: "time", "low" and "high" in seconds, medians of "rms", "loss", ..., and "is"."""
    named = frame[frame["name"] != ""]
    kinds = named.assign(kind=named["name"].str.rsplit(", ", n=1).str[1])
    wide = kinds.pivot(index="row", columns="kind", values="median").loc[named["row"].unique()]
    times = kinds[kinds["kind"] == "time"].set_index("row")
    marks = frame[frame["column"] == "is"].set_index("row")["text"]
    return wide.assign(low=times["low"], high=times["high"]).join(marks.rename("is")).fillna({"is": ""})


def draw(frame: pd.DataFrame, title: str) -> "Figure":
    """Of a knob the error against float64 and the PSNR drop, of combinations the drop, of several steps PSNR."""
    table, found = frame["table"].iloc[0], points(frame)
    if table == STEPS:
        ways = found.groupby(found.index.str.split().str[0], sort=False)
        lines = [_curve(own, "PSNR", str(way), "o-", own.index.str.split().str[-1]) for way, own in ways]
        return curves(title, "ms, all steps", {"PSNR, dB": lines})
    if table.startswith(COMBINATIONS):
        levels = found["is"].str.removeprefix("front").str.strip()
        front = found[found["is"].str.startswith("front")].sort_values("loss")
        lines = [_curve(found, "loss", labels=levels), _curve(front, "loss", "Pareto front", "o-")]
        return curves(title, "ms/step", {_LOSS[0]: lines})
    kinds = {name: found[found["is"].str.contains(name)] for name in ("default", "knee")}
    panels = {
        label: [
            _curve(found, column, labels=found.index),
            *(_curve(own, column, name, style) for (name, own), style in zip(kinds.items(), "sD", strict=True)),
        ]
        for label, column in (_RMS, _LOSS)
    }
    return curves(title, "ms/step", panels)


def _curve(found: pd.DataFrame, column: str, name: str = "", style: str = "o", labels: Any = ()) -> Curve:
    time, low, high = ([*(1e3 * found[part])] for part in ("time", "low", "high"))
    return Curve(name, time, [*found[column]], style, [*labels], (low, high))

"""Tables and measures of `vestcl bench pareto`, from what it writes to JSON."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from vestcl.bench.common.results import Measure
from vestcl.evaluation.tables import Grid, number

_NOTES: Final = (
    "ms: a step, median and quartiles; t - 1 is remembered. x: the exact one's time over it.",
    "rms: difference from the float64 image with nothing skipped, of 1. PSNR, MS-SSIM: against the frame that follows.",
    "loss: mean and largest over streets of PSNR below the exact one's, dB.",
)


def grids(details: Mapping[str, Any]) -> list[Grid]:
    """One table a knob, one of the combinations, of several steps, and of each of the splatter's knobs."""
    found = [
        _table(f"{name}: {knob['about']}", knob["points"], {knob["default"]: "default", knob["knee"]: "knee"})
        for name, knob in details["knobs"].items()
    ]
    if "front" in details:
        together = details["front"]
        marks: dict[str, str] = dict.fromkeys(together["best"], "front")
        marks |= {value: f"{marks.get(value, '')} {level}".strip() for level, value in together["qualities"].items()}
        points = [point for point in together["points"] if point["value"] in marks]
        found.append(_table(f"best of {len(together['points'])} combinations", points, marks))
    if "recursion" in details:
        found.append(_recursion(details["recursion"]))
    found += [_splatter(name, choices) for name, choices in details.get("splatter", {}).items()]
    return found


def _table(title: str, points: list[dict[str, Any]], marks: Mapping[str, str]) -> Grid:
    exact = next(point for point in points if not point["setting"])["seconds"]["median"]
    rows = [
        (
            point["value"], *_seconds(point["seconds"]), f"{exact / point['seconds']['median']:.2f}",
            f"{point['rms']['median']:.1e}", f"{point['psnr']['median']:.2f}", _number(point["ms_ssim"]["median"]),
            f"{point['loss']:.3f}", f"{point['worst']:.3f}", marks.get(point["value"], ""),
        )
        for point in points
    ]  # fmt: skip
    heading = ("", "ms", "quartiles", "x", "rms", "PSNR", "MS-SSIM", "loss", "largest", "")
    return Grid(title, heading, tuple(rows), _NOTES)


def _recursion(rows: list[dict[str, Any]]) -> Grid:
    cells = [
        (row["mode"], f"t+{row['steps']}", *_seconds(row["seconds"]), f"{row['psnr']['median']:.2f}") for row in rows
    ]
    notes = ("compose repeats the first motion; feedback sees each forecast frame, and encodes it.",)
    return Grid("several steps", ("", "to", "ms", "quartiles", "PSNR"), tuple(cells), notes)


def _splatter(name: str, choices: list[dict[str, Any]]) -> Grid:
    rows = [
        (
            choice["value"],
            *(("-", "-") if choice["seconds"] is None else _seconds(choice["seconds"])),
            f"{choice['error']:.1e}",
            "default" if choice["default"] else "",
        )
        for choice in choices
    ]
    notes = {
        "fragments": "Nearest fragments kept a pixel. vestcl's kernels have no such limit; ms: torch's compositing.",
        "features": "vestcl's kernels store float32 and float64: of float16 the error is known, and no time.",
        "tile": "Side in pixels. The kernels pack places in a tile into five bits.",
    }
    heading = ("", "ms", "quartiles", "error", "")
    return Grid(f"splatter alone, {name}", heading, tuple(rows), (notes[name], "error: of the image's rms."))


def _seconds(spread: Mapping[str, float]) -> tuple[str, str]:
    median, low, high = (spread[key] * 1e3 for key in ("median", "low", "high"))
    digits = 1 if median >= 10 else 3
    return f"{median:.{digits}f}", f"{low:.{digits}f}-{high:.{digits}f}"


def _number(value: float | None) -> str:
    return number(float("nan") if value is None else value, ".4f")


def measures(details: Mapping[str, Any]) -> list[Measure]:
    """Time, error and PSNR of every point."""
    groups = {name: knob["points"] for name, knob in details["knobs"].items()}
    groups |= {"combination": details["front"]["points"]} if "front" in details else {}
    found = [measure for name, points in groups.items() for point in points for measure in _of(name, point)]
    for row in details.get("recursion", ()):
        name = f"{row['mode']} to t+{row['steps']}"
        found += [_measure(f"{name}, time", "s", row["seconds"]), _measure(f"{name}, PSNR", "dB", row["psnr"], True)]
    for knob, choices in details.get("splatter", {}).items():
        for choice in choices:
            name, error = f"splatter, {knob} {choice['value']}", choice["error"]
            found.append(Measure(f"{name}, error", "1", error, error, error))
            if choice["seconds"] is not None:
                found.append(_measure(f"{name}, time", "s", choice["seconds"]))
    return found


def _of(knob: str, point: Mapping[str, Any]) -> Iterator[Measure]:
    name = f"{knob} {point['value']}"
    yield _measure(f"{name}, time", "s", point["seconds"])
    yield _measure(f"{name}, rms", "1", point["rms"])
    yield _measure(f"{name}, PSNR", "dB", point["psnr"], True)
    if point["ms_ssim"]["median"] is not None:
        yield _measure(f"{name}, MS-SSIM", "1", point["ms_ssim"], True)


def _measure(name: str, unit: str, spread: Mapping[str, float], more: bool = False) -> Measure:
    return Measure(name, unit, spread["median"], spread["low"], spread["high"], "higher" if more else "lower")

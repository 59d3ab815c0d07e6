"""Rows of the tables on the camera's forecast, on inpainting and on the networks' time: the heading first."""

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from rows import CLIPS, Row, tables_of

#: Errors of a camera's forecast, and their digits.
CAMERA_ERRORS: Final = (("rotation_deg", ".3f"), ("translation_percent", ".2f"))

#: Metrics of the whole chain, and their digits.
CHAIN: Final = {"psnr": ".2f", "ms_ssim": ".3f", "st_lpips": ".3f"}

#: What inpainters are called; others have their own name.
INPAINTERS: Final = {
    "regions": "road from road, walls from walls (default)",
    "push-pull": "push and pull",
    "telea": "Telea",
    "ns": "Navier-Stokes",
    "fsr": "frequency-selective",
}


def camera(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per pose file, and one of its bends, of `vestcl bench camera`: errors, each with its ratio to constant
    velocity's."""
    times = list(next(iter(content["errors"].values())))
    yield ("rotation, deg (ratio) / translation, % (ratio)", *times)
    for path, by_time in content["errors"].items():
        name = str(path).rpartition("/")[2].partition(".")[0]
        for part, label in {"all": name, "bends": f"{name}, bends"}.items():
            yield (label, *(" / ".join(_against(by_time[time][part], *of) for of in CAMERA_ERRORS) for time in times))


def _against(methods: Mapping[str, Mapping[str, float]], error: str, digits: str) -> str:
    """ "0.177 (0.66)": the forecast's error, and its ratio to that of constant velocity."""
    ours, constant = methods["forecast"][error], methods["constant velocity"][error]
    return f"{ours:{digits}} ({ours / constant:.2f})"


def inpainting(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per method, of `vestcl bench inpaint`."""
    yield ("method", "PSNR, dB", "depth off by, median", "depth within 10 %", "s")
    for method, of in sorted(content["means"].items(), key=lambda item: -item[1]["psnr"]):
        shares = f"{of['depth_median']:.1%}", f"{of['depth_right']:.0%}"
        yield (INPAINTERS.get(method, method), f"{of['psnr']:.1f}", *shares, f"{of['seconds']:.2f}")


def memory(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per number of remembered frames, a column per clip, of `vestcl bench inpaint --clips`: means over what t
    and t-1 leave open."""
    clips, counts = (list(dict.fromkeys(each[key] for each in content["scores"])) for key in ("clip", "memory"))
    groups = {
        (clip, count): [each for each in content["scores"] if (each["clip"], each["memory"]) == (clip, count)]
        for clip in clips
        for count in counts
    }
    images = {clip: len(groups[clip, counts[0]]) for clip in clips}
    yield ("filled / PSNR / ST-LPIPS / delta PSNR, image", *(f"{clip}; {images[clip]} images" for clip in clips))
    for count in sorted(counts):
        yield (str(count), *(_open(groups[clip, count], groups[clip, min(counts)]) for clip in clips))


def _open(of: Sequence[Mapping[str, Any]], without: Sequence[Mapping[str, Any]]) -> str:
    share = sum(each["filled"] * each["open"] for each in of) / max(sum(each["open"] for each in of), 1e-9)
    gain = _mean([each["whole"] for each in of]) - _mean([each["whole"] for each in without])
    near, psnr = (_mean([each[name] for each in of]) for name in ("st_lpips", "psnr"))
    return f"{share:.0%} / {psnr:.2f} / {near:.4f} / {gain:+.2f}"


def _mean(values: Sequence[float | None]) -> float:
    """Of those that were measured."""
    known = [value for value in values if value is not None and math.isfinite(value)]
    return sum(known) / len(known) if known else math.nan


def network(*contents: Mapping[str, Any]) -> Iterator[Row]:
    """A row per stage, a column per model and kind, of files of `vestcl bench network`: medians in ms."""
    found: dict[str, Mapping[str, Mapping[str, Any]]] = {}
    for content in contents:
        (device,) = content["devices"]
        for kind, label in {"forecast": "forecast", "training": "training step"}.items():
            tables = (rows for title, rows in tables_of(device).items() if f", {kind}, " in title)
            found |= {f"{device['config']['model']}, {label}": rows for rows in tables}
    yield ("median, ms", *found)
    stages = dict.fromkeys(stage for rows in found.values() for stage in rows)
    for stage in sorted(stages, key=lambda stage: stage == "peak memory"):
        yield (stage, *(_stage(rows.get(stage, {})) for rows in found.values()))


def _stage(cells: Mapping[str, Mapping[str, Any]]) -> str:
    """Milliseconds, or GB of memory; "" if there is none."""
    if "ms (quartiles)" in cells:
        return f"{cells['ms (quartiles)']['median'] * 1e3:.0f}"
    return f"{cells['GB']['median']:.1f} GB" if "GB" in cells else ""


def training(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per set of parameters that learn, of `vestcl bench train-step`."""
    (device,) = content["devices"]
    rows = next(rows for title, rows in tables_of(device).items() if title.startswith("training step"))
    parts = {"step": "step, ms (quartiles)", "forward": "forward, ms", "backward": "backward, ms", "Adam": "Adam, ms"}
    yield ("median, ms", *parts, "OpenCL's share")
    for name, cells in rows.items():
        medians = {part: cells[column]["median"] for part, column in parts.items()}
        share = cells["OpenCL, ms"]["median"] / medians["step"]
        yield (name, *(f"{seconds * 1e3:.0f}" for seconds in medians.values()), f"{share:.1%}")


def forecast_times(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per clip, a column per working width, of docs/forecast_times.py: CPU time and memory."""
    widths = list(dict.fromkeys(row["work_width"] for row in content["rows"]))
    yield ("CPU time, memory", *(f"{width} px" if width else "own width" for width in widths))
    found = {(row["input"], row["work_width"]): row for row in content["rows"]}
    for name in dict.fromkeys(row["input"] for row in content["rows"]):
        cells = (found.get((name, width)) for width in widths)
        label = CLIPS.get(str(name), str(name))
        yield (label, *("-" if row is None else f"{row['cpu_s']:.0f} s, {row['memory_gb']:.1f} GB" for row in cells))


def front(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per method, of `vestcl bench front`: medians of the time over all windows, and means of the scores over
    clips."""
    records = content["records"]
    yield ("from a new frame to its forecast", "CPU, s", "PSNR, t+1", "PSNR", "MS-SSIM", "ST-LPIPS")
    for method in dict.fromkeys(each["method"] for each in records):
        own = [each for each in records if each["method"] == method]
        first, *others = _over_clips(own, "psnr", slice(1)), *(_over_clips(own, name) for name in CHAIN)
        cpu = statistics.median(each["cpu_s"] for each in own)
        scores = (f"{value:{digits}}" for value, digits in zip(others, CHAIN.values(), strict=True))
        yield (method, f"{cpu:.2f}", f"{first:.2f}", *scores)


def _over_clips(records: Sequence[Mapping[str, Any]], metric: str, steps: slice = slice(None)) -> float:
    """The mean over clips of their mean over windows and ``steps``."""
    by_clip: dict[str, list[float]] = {}
    for each in records:
        by_clip.setdefault(each["clip"], []).extend(each[metric][steps])
    return _mean([_mean(values) for values in by_clip.values()])

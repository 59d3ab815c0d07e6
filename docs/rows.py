"""Rows of the documentation's tables, from the contents of benches' JSON files: the heading first."""

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from typing import Any, Final

#: Steps that tables of forecasts show.
STEPS: Final = (1, 3, 5)

#: Metric -> its name in a table and its digits.
METRICS: Final = {"psnr": ("PSNR", ".2f"), "ms_ssim": ("MS-SSIM", ".3f"), "st_lpips": ("ST-LPIPS", ".3f")}

#: What clips are called; others have their own name.
CLIPS: Final = {
    "highway.mp4": "motorway in California (highway.mp4)",
    "motorway.mp4": "motorway (motorway.mp4)",
    "kitti_odometry": "KITTI odometry 06",
    "kitti_odometry_00": "KITTI odometry 00",
    "kitti_clip": "KITTI raw, dense traffic (kitti_clip)",
    "kitti_drive_0028": "KITTI raw, drive 0028",
    "kitti_tracking_0006": "KITTI tracking 0006",
    "street:": "procedural streets, held out",
}

#: Inference presets.
PRESETS: Final = ("exact", "balanced", "fast")

#: What methods are called; others as the file has them.
METHODS: Final = {
    "optical flow": "constant-velocity flow extrapolation",
    "optical flow, left camera": "constant-velocity flow extrapolation, left camera",
    "optical flow, right camera's past (oracle)": "flow extrapolation of the right camera's past (oracle)",
    "geometric, true poses": "geometric, oracle poses",
}

#: Facts of forecasts besides images -> their row and digits; of those only what a file has.
FACTS: Final = {
    "rotation_deg": ("rotation error of the camera, deg", ".3f"),
    "translation_percent": ("translation error of the camera, %", ".2f"),
    "motion_m": ("3D motion, mean error, m", ".3f"),
    "moving_m": ("3D motion of dynamic objects, mean error, m", ".3f"),
    "splatted_db": ("depth, motion and background true, splatted: PSNR, dB", ".2f"),
    "warped_db": ("the same, warped back: PSNR, dB", ".2f"),
}

#: Distance of an opacity from 1 -> how a table shows the opacity.
OPACITIES: Final = {1e-3: "0.999", 1e-6: "1 - 1e-6", 0: "1"}

#: Rows of the table of ablations.
VARIANTS: Final = {
    "full": "vest-s+from-rest",
    "no-omf": "C: without object motion",
    "no-emf": "B: without ego-motion",
    "fixed-depth": "A: every pixel 20 m away",
}

Row = Sequence[str]


def clips(view: str, metrics: Sequence[str] = tuple(METRICS)) -> Callable[[Mapping[str, Any]], Iterator[Row]]:
    """A row per clip and method of one view, of `vestcl bench forecast --out`.

    Args:
        view: "source" or "right"; clips without it are left out.
        metrics: of METRICS, joined by " / " in one cell per step.
    """

    def rows(content: Mapping[str, Any]) -> Iterator[Row]:
        label = " / ".join(METRICS[metric][0] for metric in metrics)
        yield (f"{label}; windows", "method", *(f"t+{k}" for k in STEPS))
        for group in content["inputs"]:
            for number, (method, of) in enumerate(group["views"].get(view, {}).items()):
                known = [metric for metric in metrics if metric in of["by_horizon"]]
                first = "" if number else f"{_clip(group)}; {of['windows']}"
                yield (first, METHODS.get(method, method), *(_scores(of, known, k) for k in STEPS))

    return rows


def methods(view: str) -> Callable[[Mapping[str, Any]], Iterator[Row]]:
    """A row per method of one view over all inputs that were pooled, of `vestcl bench forecast --pool --out`."""

    def rows(content: Mapping[str, Any]) -> Iterator[Row]:
        (group,) = content["inputs"]
        found = group["views"][view]
        count = max(of["windows"] for of in found.values())
        yield (f"PSNR / MS-SSIM / ST-LPIPS, {count} windows", *(f"t+{k}" for k in STEPS))
        for method, of in found.items():
            yield (METHODS.get(method, method), *(_scores(of, tuple(METRICS), k) for k in STEPS))

    return rows


def facts(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per fact besides images of the geometric forecast, of `vestcl bench forecast --pool --out`."""
    (group,) = content["inputs"]
    yield ("geometric forecast against the true motion", *(f"t+{k}" for k in STEPS))
    for name, (label, digits) in FACTS.items():
        if name in group["facts"]:
            yield (label, *(_number(group["facts"][name], k, digits) for k in STEPS))


def short(*contents: Mapping[str, Any]) -> Iterator[Row]:
    """PSNR of flow extrapolation and the geometric forecast, a row per clip of files of `vestcl bench forecast`."""
    names = ("optical flow", "geometric")
    yield ("PSNR, dB; windows", *(f"{name}, t+{k}" for name in ("flow extrapolation", "geometric") for k in STEPS))
    for group in (group for content in contents for group in content["inputs"]):
        found = group["views"]["source"]
        missing = [name for name in names if name not in found]
        if missing:
            raise ValueError(f"{group['input']}: has no method {', '.join(missing)}, only {', '.join(found)}")
        label = f"{_clip(group)}; {found[names[0]]['windows']}"
        yield (label, *(_scores(found[name], ("psnr",), k) for name in names for k in STEPS))


def work_widths(working: Mapping[str, Any], whole: Mapping[str, Any]) -> Iterator[Row]:
    """A row per clip and method of the source view, of two files of `vestcl bench forecast --out`.

    Args:
        working: perceived at the default width.
        whole: perceived at the clips' own; of it the geometric forecast of the same windows is one more row.
    """
    label = " / ".join(METRICS[metric][0] for metric in METRICS)
    yield (f"{label}; windows", "method", *(f"t+{k}" for k in STEPS))
    others = {group["input"]: group for group in whole["inputs"]}
    for group in working["inputs"]:
        found = dict(group["views"]["source"])
        frames = {each["index"] for each in group["windows"]}
        found["geometric, at the clip's own width"] = _mean_of(others[group["input"]], frames)
        for number, (method, of) in enumerate(found.items()):
            first = "" if number else f"{_clip(group)}; {of['windows']}"
            yield (first, METHODS.get(str(method), str(method)), *(_scores(of, tuple(METRICS), k) for k in STEPS))


def _mean_of(group: Mapping[str, Any], frames: Set[int]) -> dict[str, Any]:
    """The geometric forecast's means over some windows, as ``group["views"]`` has them over all."""
    records = [
        each["scores"]
        for each in group["windows"]
        if (each["view"], each["method"]) == ("source", "geometric") and each["index"] in frames
    ]
    if len(records) != len(frames):
        raise ValueError(f"{group['input']}: must have the windows {sorted(frames)}, has {len(records)} of them")
    means = {
        metric: [sum(steps) / len(steps) for steps in zip(*(scores[metric] for scores in records), strict=True)]
        for metric in METRICS
    }
    return {"windows": len(records), "by_horizon": means}


def ablation(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per variant, of `train.evaluate`."""
    yield ("PSNR / SSIM / ST-LPIPS", *(f"t+{k}" for k in STEPS))
    for name, label in VARIANTS.items():
        of = content["summary"]["source"][name]["by_horizon"]
        cells = (
            f"{of['psnr'][k - 1]:.2f} / {of['ssim'][k - 1]:.3f} / {of['st_lpips'][k - 1]:.3f}" for k in STEPS
        )  # fmt: skip
        yield (label, *cells)


def evaluated(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per camera and method, of `train.evaluate`."""
    yield ("PSNR / MS-SSIM / ST-LPIPS", "method", *(f"t+{k}" for k in STEPS))
    for view in ("source", "right"):
        for number, (method, of) in enumerate(content["summary"][view].items()):
            first = "" if number else f"{view}; {of['windows']} windows"
            yield (first, METHODS.get(method, method), *(_scores(of, tuple(METRICS), k) for k in STEPS))


def presets(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per inference preset, of `vestcl bench pareto`."""
    yield ("preset", "ms/step", "delta PSNR at t+1 against `exact`, dB", "MS-SSIM", "settings")
    (device,) = content["devices"]
    if "details" in device:
        front = device["details"]["front"]
        points = {point["value"]: point for point in front["points"]}
        found = {
            name: (value, *(points[value][key]["median"] for key in ("seconds", "psnr", "ms_ssim")))
            for name, value in front["qualities"].items()
        }
    else:
        together = next(rows for title, rows in tables_of(device).items() if title.startswith("best of"))
        found = {
            name: (value, *(cells[key]["median"] for key in ("time", "PSNR", "MS-SSIM")))
            for name in PRESETS
            for value, cells in together.items()
            if name in cells.get("is", {"text": ""})["text"].split()
        }
    for name, (value, seconds, psnr, ms_ssim) in found.items():
        delta = psnr - found["exact"][2]
        settings = "" if value == name else value
        yield (f"`{name}`", f"{seconds * 1e3:.0f}", f"{delta:+.2f}" if delta else "0", f"{ms_ssim:.3f}", settings)


def speed(content: Mapping[str, Any]) -> Iterator[Row]:
    """`presets` without the settings."""
    for *cells, _ in presets(content):
        yield cells


def skipping(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per scene, of `vestcl bench pipeline`."""
    yield ("scene", "foreground", "nothing skipped, ms", "skipped, ms", "saved", "of DMVFN's time")
    (device,) = content["devices"]
    for name, shares, before, after in _scenes(device):
        label = "worst case" if name == "everything" else name
        foreground, saved, of_peer = shares
        yield (label, foreground, f"{before * 1e3:.0f}", f"{after * 1e3:.0f}", f"{saved:.0%}", f"{of_peer:.2f}")


def _scenes(device: Mapping[str, Any]) -> Iterator[tuple[str, tuple[str, float, float], float, float]]:
    """Name; foreground, saved share and multiple of DMVFN's time; seconds with nothing and with all skipped."""
    if "details" in device:
        for name, scene in device["details"]["scenes"].items():
            saved, of_peer = scene["saved_share"]["all skipped"]["median"], scene["of_peer"]["median"]
            before, after = (scene["seconds"][key]["median"] for key in ("nothing skipped", "all skipped"))
            yield name, (f"{scene['foreground']:.0%}", saved, of_peer), before, after
        return
    tables = tables_of(device)
    for title, rows in tables.items():
        if title.startswith("forecast step, "):
            name, _, rest = title.removeprefix("forecast step, ").partition(" (")
            before, after = (rows[key]["ms (quartiles)"]["median"] for key in ("nothing skipped", "all skipped"))
            of_peer = tables["targets"][name]["of DMVFN's"]["median"]
            shares = rest.partition(" ")[0], rows["all skipped"]["saved"]["median"], of_peer
            yield name, shares, before, after


def splatting(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per radius, of `vestcl bench splat`."""
    yield ("radius, px", "fragments", "forward", "forward + backward", "scratch memory, x features")
    (device,) = content["devices"]
    if "details" in device:
        details = device["details"]
        memory = {found["radius"]: found["ratio"] for found in details["memory"]}
        for found in details["speed"]:
            facts = found["facts"]
            of = [
                (found[key]["time"]["median"], found[key]["copies"]["spread"]["median"]) for key in ("forward", "both")
            ]
            cells = (_time(*each) for each in of)
            yield (f"{facts['radius']:g}", f"{facts['fragments']:,}", *cells, f"{memory[facts['radius']]:.2f}")
        return
    for name, found in tables_of(device)["Splat"].items():
        cells = (_time(found[f"{key} ms"]["median"], found[f"{key} x copy"]["median"]) for key in ("forward", "both"))
        radius = name.rpartition("radius ")[2]
        yield (radius, found["fragments"]["text"], *cells, f"{found['x features']['median']:.2f}")


def opacities(content: Mapping[str, Any]) -> Iterator[Row]:
    """A row per opacity close to 1, worst errors of image and gradients, of `vestcl bench stability`."""
    peers = {"dividing": "dividing by 1 - alpha + 1e-9", "clamping": "alpha at most 0.99, T by division"}
    yield ("float32 against float64, image / gradient", "vestcl", *peers.values())
    (device,) = content["devices"]
    if "details" in device:
        for row in device["details"]["rows"]:
            if row["family"] == "opacity" and row["knob"] in OPACITIES:
                found = [row["errors"], *(row["peers"][name] for name in peers)]
                cells = (f"{_worst(of['outputs'])} / {_worst(of['gradients'])}" for of in found)
                yield (f"opacity {OPACITIES[row['knob']]}", *cells)
        return
    rows = next(rows for title, rows in tables_of(device).items() if title.startswith("opacity:"))
    for knob, label in OPACITIES.items():
        if (of := rows.get(f"{knob:.4g}")) is not None:
            found = [
                (of[f"{who}output"]["text"], of[f"{who}gradient"]["text"]) for who in ("", "dividing ", "clamping ")
            ]
            yield (f"opacity {label}", *(" / ".join(pair) for pair in found))


def tables_of(device: Mapping[str, Any]) -> dict[str, dict[str, dict[str, Mapping[str, Any]]]]:
    """The cells of a bench's long table, by table, row and column."""
    found: dict[str, dict[str, dict[str, Mapping[str, Any]]]] = {}
    for cell in device["measures"]:
        if cell["column"]:
            found.setdefault(cell["table"], {}).setdefault(cell["row"], {})[cell["column"]] = cell
    return found


def _clip(group: Mapping[str, Any]) -> str:
    name = CLIPS.get(str(group["input"]), str(group["input"]))
    return f"{name} ({group['use']})" if group.get("use") else name


def _scores(of: Mapping[str, Any], metrics: Sequence[str], step: int) -> str:
    """ "24.79 / 0.932"; "-" of a step that was not measured."""
    found = ((of["by_horizon"].get(metric, ()), METRICS[metric][1]) for metric in metrics)
    return " / ".join(_number(values, step, digits) for values, digits in found)


def _worst(errors: Mapping[str, float]) -> str:
    return f"{max(errors.values()):.1e}"


def _number(values: Sequence[float | None], step: int, digits: str) -> str:
    value = values[step - 1] if step <= len(values) else None
    return "-" if value is None else f"{value:{digits}}"


def _time(seconds: float, copies: float) -> str:
    """ "7.4 ms, 3.5x memcpy time", the latter of the bytes that must move."""
    return f"{seconds * 1e3:.1f} ms, {copies:.1f}x memcpy time"

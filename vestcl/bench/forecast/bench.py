"""`vestcl bench forecast`: forecasts against what then happened, on recorded clips and on procedural streets.

Seeds of `HELD_OUT` are for this bench: no test and no training may use them.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.common.table import Measurement, Section, show_grid
from vestcl.bench.forecast.config import HELD_OUT, ForecastBench, check
from vestcl.bench.forecast.run import Networks, kept_windows, run
from vestcl.bench.forecast.windows import Facts, Group, groups_of
from vestcl.evaluation import tables
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.regions import REGIONS
from vestcl.evaluation.scores import Record
from vestcl.evaluation.statistics import interval_grid
from vestcl.evaluation.trunks.trunks import load_trunk
from vestcl.forecasting import peer
from vestcl.io.atomic import write_bytes
from vestcl.models.inference import quality
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

__all__ = ["HELD_OUT", "ForecastBench", "main"]

#: Metrics of overviews and intervals.
_HEADLINE: Final = ("psnr", "ms_ssim", "st_lpips", "squeeze")

#: Facts besides images -> their row, and the digits that tell forecasts apart.
_FACTS: Final = {
    "rotation_deg": ("rotation error of the camera (deg)", ".3f"),
    "translation_percent": ("translation error of the camera (%)", ".2f"),
    "motion_m": ("3D motion, mean error (m)", ".4f"),
    "moving_m": ("3D motion of dynamic objects (m)", ".4f"),
    "motion_known": ("share of pixels with a 3D motion", ".3f"),
    "splatted_db": ("splatted, all true, PSNR (dB)", ".2f"),
    "warped_db": ("warped back, all true, PSNR (dB)", ".2f"),
    "splatter_loss_db": ("PSNR drop by splatting (dB)", ".2f"),
    "seen": ("share of pixels seen in both frames", ".3f"),
    **{f"error_in_{name}": (f"share of squared error, {name}", ".3f") for name in REGIONS},
    **{f"area_of_{name}": (f"share of pixels, {name}", ".3f") for name in REGIONS},
}


def main(config: ForecastBench) -> None:
    """Forecast, score, print and write.

    Raises:
        ValueError: a number out of range, an input that is no clip or has too few frames.
        DeviceError: no such device.
    """
    check(config)
    console = _results.console()
    with opencl.use(config.device) as session:
        machine = _results.describe(session)
        networks = Networks(
            None if config.squeeze is None else load_trunk("squeezenet1_0", config.squeeze),
            None if config.st_lpips is None else StLpips.load(config.st_lpips),
            None if config.peer is None else VoxelFlowNetwork.load(config.peer),
            {Path(name).stem: quality.load(name, config.quality or quality.USUAL) for name in config.model},
        )
        groups, kept = groups_of(config), kept_windows(config)
        if len(kept):
            console.print(f"resumed: {len(kept)} windows are measured already", highlight=False)
        run(groups, config, networks, kept, console)
    grids = grids_of(groups, config.shown)
    for grid in grids:
        show_grid(grid, console)
    for network, option, metric in (
        (networks.squeeze, "--squeeze", "squeeze distance"),
        (networks.st_lpips, "--st-lpips", "ST-LPIPS"),
    ):
        if network is None:
            console.print(f"without {option} there is no {metric}", highlight=False)
    if networks.peer is not None:
        console.print(f"{peer.METHOD}: {peer.ABOUT}", highlight=False, soft_wrap=True)
    console.print(f"{machine['device']}, {machine['cores']} cores", highlight=False, soft_wrap=True)
    if config.out is not None:
        inputs = [as_json(group) for group in groups]
        content = {"machine": machine, "config": _results.settings(config), "inputs": inputs}
        _results.write_json(config.out, content)
    if config.markdown is not None:
        write_bytes(config.markdown, "\n".join(map(tables.to_markdown, grids)).encode())
    _results.tell_written(console, config.out, config.markdown)
    kept.remove()


def as_json(group: Group) -> dict[str, Any]:
    """A group as the JSON file has it; means are by horizon, and running (the mean up to the horizon)."""
    found: dict[str, Any] = tables.finite({
        "input": group.name,
        "use": group.use,
        "views": tables.summarise(group.records),
        "facts": tables.means([facts.values for facts in group.facts]),
        "windows": [dataclasses.asdict(record) for record in group.records],
        "window_facts": [dataclasses.asdict(facts) for facts in group.facts],
    })  # fmt: skip
    return found


def grids_of(groups: Sequence[Group], horizons: Sequence[int]) -> list[tables.Grid]:
    """Each group's images, their 95 % intervals where it has several clips, its facts, and a table over all groups.

    Args:
        groups: measured.
        horizons: the steps to show, from 1.
    """
    grids = []
    for group in groups:
        grids += tables.picture_grids(group.title, group.records, horizons)
        for view, own in tables.by_view(group.records).items():
            if len({record.clip for record in own}) > 1:
                title = f"{group.title}, view {view}, mean and 95 % interval"
                grids.append(interval_grid(title, own, horizons, _headline(own)))
        grids += fact_grids(group.title, group.facts, horizons)
    if len(groups) > 1:
        views = dict.fromkeys(record.view for group in groups for record in group.records)
        grids += [overview(groups, view, horizons) for view in views]
    return grids


def fact_grids(name: str, facts: Sequence[Facts], horizons: Sequence[int]) -> list[tables.Grid]:
    """A table of what is known besides images, if anything is.

    Args:
        name: what the windows are of.
        facts: of all windows.
        horizons: the steps to show, from 1.
    """
    found = tables.means([fact.values for fact in facts])
    rows = [
        Measurement(label, f"t+{k}", found[metric][k - 1], digits=digits)
        for metric, (label, digits) in _FACTS.items()
        for k in horizons
        if k <= len(found.get(metric, ()))
    ]
    title = f"{name}, geometric forecast against true motion, mean over {len(facts)} window{'s' * (len(facts) != 1)}"
    return [Section(title, rows).grid()] if rows else []


def overview(groups: Sequence[Group], view: str, horizons: Sequence[int]) -> tables.Grid:
    """A table of one view over all groups: a row a group and method.

    Args:
        groups: measured.
        view: its name.
        horizons: the steps to show, from 1.
    """
    of_view = {group.title: [record for record in group.records if record.view == view] for group in groups}
    records = [record for own in of_view.values() for record in own]
    steps, shown, rows = tables.steps_of(records, horizons), _headline(records), list[Measurement]()
    for title, of_group in of_view.items():
        for (_, method), own in tables.by_method(of_group).items():
            found, row = tables.means([record.scores for record in own]), f"{title}: {method}"
            rows.append(Measurement(row, "windows", str(len(own))))
            for metric in shown:
                label, digits = tables.METRICS[metric].label, tables.METRICS[metric].digits
                numbers = ((tables.horizon(k), found[metric][k - own[0].first]) for k in steps)
                rows += [Measurement(row, f"{label} {at}", number, digits=digits) for at, number in numbers]
    return Section(f"all inputs, view {view}", rows).grid()


def _headline(records: Sequence[Record]) -> list[str]:
    return [metric for metric in _HEADLINE if all(metric in record.scores for record in records)]

"""`vestcl bench forecast`: forecasts beside what then happened, on recorded clips and on procedural streets.

Seeds of `HELD_OUT` are for this bench: no test and no training may use them.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.forecast import tables
from vestcl.bench.forecast.config import HELD_OUT, ForecastBench, check
from vestcl.bench.forecast.run import Group, Networks, groups_of, kept_windows, run
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.trunks.trunks import load_trunk
from vestcl.forecasting import peer
from vestcl.io.atomic import write_bytes
from vestcl.models.inference import quality
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

__all__ = ["HELD_OUT", "ForecastBench", "main"]

#: Columns where the tables don't go to a terminal, whose own number counts there: three horizons of five metrics.
WIDTH: Final = 170


def main(config: ForecastBench) -> None:
    """Forecast, score, print and write.

    Raises:
        ValueError: a number out of range, an input that is no clip or has too few frames.
        DeviceError: no such device.
    """
    check(config)
    console = _results.console(WIDTH)
    with opencl.use(config.device) as session:
        machine = _results.describe(session)
        networks = _networks(config)
        groups, kept = groups_of(config), kept_windows(config)
        if len(kept):
            console.print(f"resumed: {len(kept)} windows are measured already", highlight=False)
        run(groups, config, networks, kept, console)
    grids = [grid for group in groups for grid in _grids(group, config.shown)]
    if len(groups) > 1:
        grids += tables.overviews(
            {tables.titled(group.name, group.use): group.records for group in groups}, config.shown
        )
    for grid in grids:
        console.print(tables.to_rich(grid))
    if networks.squeeze is None:
        console.print("without --squeeze there is no squeeze distance", highlight=False)
    if networks.st_lpips is None:
        console.print("without --st-lpips there is no ST-LPIPS", highlight=False)
    if networks.peer is not None:
        console.print(f"{peer.METHOD}: {peer.ABOUT}", highlight=False, soft_wrap=True)
    console.print(f"{machine['device']}, {machine['cores']} cores", highlight=False, soft_wrap=True)
    _write(config, machine, groups, grids, console)
    kept.remove()


def _networks(config: ForecastBench) -> Networks:
    return Networks(
        None if config.squeeze is None else load_trunk("squeezenet1_0", config.squeeze),
        None if config.st_lpips is None else StLpips.load(config.st_lpips),
        None if config.peer is None else VoxelFlowNetwork.load(config.peer),
        {Path(name).stem: quality.load(name, config.quality or quality.USUAL) for name in config.model},
    )


# ---------------------------------------------------------------- tables and files


def _grids(group: Group, horizons: Sequence[int]) -> list[tables.Grid]:
    name = tables.titled(group.name, group.use)
    return [
        *tables.picture_grids(name, group.records, horizons),
        *tables.interval_grids(name, group.records, horizons),
        *tables.fact_grids(name, group.facts, horizons),
    ]


def _write(
    config: ForecastBench, machine: dict[str, str], groups: Sequence[Group], grids: Sequence[tables.Grid],
    console: Console,
) -> None:  # fmt: skip
    if config.out is not None:
        settings = {k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(config).items()}
        _results.write_json(
            config.out, {"machine": machine, "config": settings, "inputs": [_told(group) for group in groups]}
        )
        _results.tell_written(console, config.out)
    if config.markdown is not None:
        write_bytes(config.markdown, "\n".join(map(tables.to_markdown, grids)).encode())
        _results.tell_written(console, config.markdown)


def _told(group: Group) -> dict[str, Any]:
    """A group as the JSON file holds it."""
    told = {
        "input": group.name,
        "use": group.use,
        **tables.summary(group.records, group.facts),
        "windows": [dataclasses.asdict(record) for record in group.records],
        "window_facts": [dataclasses.asdict(facts) for facts in group.facts],
    }
    checked: dict[str, Any] = tables.finite(told)
    return checked

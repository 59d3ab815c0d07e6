"""What every benchmark hands over: figures with their noise and tables, a device at a time, on screen and in files."""

import contextlib
import dataclasses
import importlib.metadata
import json
import os
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from rich.console import Console
from rich.text import Text

from vestcl import doctor, opencl
from vestcl._version import __version__
from vestcl.bench.common import estimate, plots
from vestcl.bench.common.options import Options
from vestcl.bench.common.table import AGAIN, Better, Section, show_grid
from vestcl.bench.common.timing import busy_cores, is_quiet, torch_threads
from vestcl.evaluation.tables import Grid, finite, to_markdown
from vestcl.io import atomic
from vestcl.opencl import trace

#: The selector that means every device that works.
ALL: Final = "all"

#: What a measure's name ends with where it is another's time as a multiple of a copy of the same bytes, timed in turns
#: with it. `vestcl bench compare` trusts it more than seconds: what slows the machine down slows the copy, too.
X_COPY: Final = ", x copy"

#: Columns of tables that don't go to a terminal.
WIDTH: Final = 80

#: Of the files: the value of "vestcl".
_FORMAT: Final = 1

#: Of long tables; those that files of earlier versions lack have a value here.
_ABSENT: Final = {"table": "", "row": "", "column": "", "text": "", "runs": 1}
_REQUIRED: Final = ("median", "low", "high", "name", "unit", "better")
COLUMNS: Final = (*_ABSENT, *_REQUIRED)

_PACKAGES: Final = ("torch", "numpy", "pyopencl", "pocl-binary-distribution")


def check_positive(config: Any, *names: str) -> None:
    """Refuse settings that are not above 0.

    Raises:
        ValueError: the message names the first.
    """
    for name in names:
        if getattr(config, name) <= 0:
            raise ValueError(f"`{name}` must be positive, got {getattr(config, name)}")


def settings(config: Any) -> dict[str, Any]:
    """The fields of a benchmark's dataclass as JSON has them; files and folders as text."""
    return dict(plain(dataclasses.asdict(config)))


@dataclass(frozen=True)
class Results:
    """What a benchmark found out on one device."""

    bench: str
    """As in `vestcl bench NAME`."""
    machine: dict[str, str]
    """What `describe` returns."""
    config: dict[str, Any]
    """What `settings` makes of the benchmark's configuration."""
    frame: pd.DataFrame
    """The long tables of all sections, `COLUMNS`."""
    grids: list[Grid] = field(default_factory=list)
    """For the screen and Markdown; they are not in JSON."""
    details: dict[str, Any] = field(default_factory=dict)
    """What files of earlier versions have besides figures."""

    @property
    def figures(self) -> pd.DataFrame:
        """The rows that have a name."""
        return self.frame[self.frame["name"] != ""]


def run(
    bench: str,
    config: Options,
    measure: Callable[[opencl.Session, Console], Iterator[Section]],
    total: estimate.Total | None = None,
) -> list[Results]:
    """`vestcl bench BENCH`: ``measure`` every device that is asked for, print section after section, write the files.

    Args:
        bench: its name.
        config: its options.
        measure: gives the sections of a device.
        total: how long it takes; None is one measurement, or `vestcl.bench.common.estimate.announced` reports it.

    Raises:
        DeviceError: as `measure_each`.
    """
    screen, results = console(), list[Results]()

    def measured(session: opencl.Session) -> Results:
        machine = describe(session)
        for name, value in machine.items():
            screen.print(f"{name}: {value}", soft_wrap=True, highlight=False, markup=False)
        frames, grids, number = list[pd.DataFrame](), list[Grid](), f"{len(results)} " if results else ""
        busy_cores.set(0.0)
        for section in measure(session, screen):
            if not is_quiet():
                note = f"other processes kept {busy_cores.get():.1f} cores busy meanwhile: {AGAIN}"
                section = replace(section, notes=(*section.notes, note))
            busy_cores.set(0.0)
            frames.append(section.frame)
            grids.append(section.grid())
            show_grid(grids[-1], screen)
            for name, draw in section.plots.items() if config.plots else ():
                figure = draw(frames[-1], f"{section.title}\n{machine['device']}")
                plots.write(figure, Path(config.plots or "") / plots.file_name(number + name))
        results.append(Results(bench, machine, settings(config), pd.concat(frames), grids))
        return results[-1]

    with trace.record(config.trace), torch_threads(config.threads), estimate.announcing(screen, total):
        found = measure_each(config.device, measured, screen)
    save(found, config.json, config.markdown)
    tell_written(screen, config.json, config.markdown, config.trace, config.plots)
    return found


def measure_each(selector: str | None, measure: Callable[[opencl.Session], Results], console: Console) -> list[Results]:
    """``measure`` the device that ``selector`` means as in `opencl.select`, which is vestcl's current one meanwhile.

    "all" means every device that passes `vestcl doctor`, each tried in a process of its own first, because a driver may
    kill the one that loads it. Those that fail are reported, and the others go on.

    Raises:
        DeviceError: no such device, or with "all" none that works.
    """
    if selector != ALL:
        with opencl.use(selector) as session:
            return [measure(session)]
    results = []
    with console.status("trying every OpenCL device"):
        devices = doctor.examine().devices
    if not any(device.works for device in devices):
        raise opencl.DeviceError("no OpenCL device works: `vestcl doctor` tells why")
    for device in devices:
        reason = next(iter(device.notes), "does not work")
        if device.works:
            try:
                with opencl.use(device.info.index) as session:
                    results.append(measure(session))
                continue
            except Exception as error:  # drivers fail in many ways, and only runtime knows pyopencl's
                if isinstance(error, ValueError):  # a mistake in the settings is no device's
                    raise
                reason = f"{type(error).__name__}: {error}"
        about = f"{device.info.index} {device.info.platform} / {device.info.name} left out: {reason}"
        console.print(Text(about, "red"), soft_wrap=True)
    if not results:
        raise opencl.DeviceError("the benchmark failed on every device")
    return results


def console(width: int | None = None) -> Console:
    """Standard output: a terminal of its own width, or a file of ``width`` columns, None being WIDTH."""
    return Console(width=None if sys.stdout.isatty() else width or WIDTH)


def write_json(path: Path, results: dict[str, Any]) -> None:
    """Write ``results`` whole or not at all; ``path`` is the old file until then.

    Raises:
        TypeError: a value that JSON does not have.
        ValueError: the folder can't be made.
    """
    atomic.write_bytes(path, (json.dumps(results, indent=1) + "\n").encode())


def describe(session: opencl.Session | None = None) -> dict[str, str]:
    """What the numbers depend on: versions, processor, date, and the device of ``session``, if one is used."""
    versions = {}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    device = {}
    if session is not None:
        device = {
            "device": f"{session.info.index} {session.info.platform} / {session.info.name}",
            "driver": session.info.driver,
            "compute units": str(session.info.compute_units),
            "mapping": session.mapping,
        }
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "vestcl": __version__,
        **versions,
        "python": platform.python_version(),
        "system": platform.platform(),
        **device,
        "processor": _processor(),
        "cores": str(os.cpu_count()),
    }


def _processor() -> str:
    """The CPU's model, as its maker calls it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def save(results: Sequence[Results], json: Path | None, markdown: Path | None) -> None:
    """Write the results, each file whole or not at all.

    Args:
        results: of one benchmark, a device each, one or more.
        json: file {"vestcl": 1, "bench": ..., "devices": [{"machine", "config", "measures": [a row each]}]}, or None.
        markdown: file with machine and tables of each device, or None.

    Raises:
        ValueError: a value that `plain` refuses, a folder that can't be made.
    """
    if json is not None:
        devices = [
            {"machine": one.machine, "config": one.config, "measures": one.frame.to_dict("records")} for one in results
        ]
        write_json(json, plain({"vestcl": _FORMAT, "bench": results[0].bench, "devices": devices}))
    if markdown is not None:
        atomic.write_bytes(markdown, "\n".join(map(_to_markdown, results)).encode())


def tell_written(console: Console, *paths: Path | None) -> None:
    """Print which files and folders there are now."""
    for path in paths:
        if path is not None:
            console.print(f"wrote {path}", soft_wrap=True, highlight=False, markup=False)


def load(path: Path) -> list[Results]:
    """What `save` wrote as JSON; tables are not in there.

    Raises:
        ValueError: the file can't be read or is none of `save`'s; the message names it and what it lacks.
    """
    try:
        content = json.loads(atomic.read_bytes(path))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: no JSON: {error}") from error
    if not isinstance(content, dict) or content.get("vestcl") != _FORMAT:
        raise ValueError(f'{path}: must be a file of `vestcl bench NAME --json` with "vestcl": {_FORMAT}')
    try:
        return [_device(content["bench"], device) for device in content["devices"]]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{path}: a benchmark's file lacks or mistakes {error}") from error


def plain(value: Any) -> Any:
    """``value`` as JSON has it: dataclasses become objects, tuples and arrays lists, paths text, NaN and infinity null.

    Raises:
        ValueError: a value that JSON does not have.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain(vars(value))
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if value is not None and not isinstance(value, str | bool | int | float):
        raise ValueError(f"results must be plain values and dataclasses, got {type(value).__name__}")
    return finite(value)


def _to_markdown(result: Results) -> str:
    facts = "".join(f"- {name}: {value}\n" for name, value in result.machine.items())
    chosen = ", ".join(f"{name} {value}" for name, value in result.config.items() if value is not None)
    tables = "\n".join(map(to_markdown, result.grids))
    title = f"vestcl bench {result.bench}, {result.machine.get('device', 'unknown device')}"
    return f"## {title}\n\n{facts}- settings: {chosen}\n\n{tables}"


def _device(bench: str, device: dict[str, Any]) -> Results:
    """Of a file; those of earlier versions have figures only, which are in no table."""
    rows = [_ABSENT | {key: measure[key] for key in _REQUIRED} | measure for measure in device["measures"]]
    for row in rows:
        row |= {key: float("nan" if row[key] is None else row[key]) for key in ("median", "low", "high")}
        if row["better"] not in get_args(Better):
            raise TypeError(f'"better": {row["better"]!r}')
    frame = pd.DataFrame(rows, columns=COLUMNS)
    return Results(str(bench), dict(device["machine"]), dict(device["config"]), frame, [], device.get("details", {}))

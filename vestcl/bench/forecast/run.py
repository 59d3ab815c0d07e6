"""The run of `vestcl bench forecast` over its windows, and their file, so that a stopped run can be resumed.

Measured windows are a line each in the file. The first line is a key of all that the scores depend on: the settings and
the package's source.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from rich.console import Console

import vestcl
from vestcl.bench.common.estimate import first_of
from vestcl.bench.forecast.config import ForecastBench
from vestcl.bench.forecast.windows import Facts, Group
from vestcl.cli.progress import progress_bar
from vestcl.data.sample import Clip
from vestcl.evaluation import street
from vestcl.evaluation.methods import forecasts_of
from vestcl.evaluation.motion import ego_errors, true_motion
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.regions import error_shares
from vestcl.evaluation.scores import GEOMETRIC, SOURCE, Record, Truth, predictions, score
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.forecasting.geometric import Perception
from vestcl.forecasting.network import forecast as network
from vestcl.forecasting.result import Forecast, View
from vestcl.forecasting.views import parse_views
from vestcl.models.forecaster import Forecaster
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

#: Options that choose windows or tables: a window's scores don't depend on them.
_OF_TABLES: Final = ("inputs", "windows", "every", "first", "last", "horizons", "pool", "out", "markdown")

Window = tuple[list[Record], list[Facts]]

#: The file next to OUT, until OUT is written.
SUFFIX: Final = ".windows.jsonl"


@dataclass(frozen=True)
class Networks:
    """Networks whose weights were given."""

    squeeze: Trunk | None = None
    """SqueezeNet 1.0."""
    st_lpips: StLpips | None = None
    peer: VoxelFlowNetwork | None = None
    """That forecasts as a baseline."""
    models: Mapping[str, Forecaster] = field(default_factory=dict)
    """That forecast, by the name of their row."""

    @property
    def methods(self) -> dict[str, Callable[..., Forecast]]:
        """The forecasts of ``models``."""

        def forecast(model: Forecaster, perception: Perception, *window: object) -> Forecast:
            return network.forecast_frames(perception, model, *window)  # type: ignore[arg-type]

        return {name: partial(forecast, model) for name, model in self.models.items()}


class Kept:
    """The file of measured windows.

    Args:
        path: of the file; None keeps nothing.
        settings: what scores depend on, next to the source code.

    Raises:
        ValueError: the file can't be read or written.
    """

    def __init__(self, path: Path | None, settings: Mapping[str, Any]) -> None:
        self.path, self.key = path, key_of(settings)
        self._windows = {} if path is None else _read(path, self.key)

    def __len__(self) -> int:
        return len(self._windows)

    def get(self, clip: str, index: int) -> Window | None:
        """Window ``index`` of a clip, or None: not measured yet."""
        return self._windows.get((clip, index))

    def add(self, clip: str, index: int, window: Window) -> None:
        """Keep a window; it is on the disk when this returns.

        Raises:
            ValueError: the file can't be written.
        """
        self._windows[clip, index] = window
        if self.path is None:
            return
        records, facts = ([dataclasses.asdict(one) for one in part] for part in window)
        line = {"clip": clip, "index": index, "records": records, "facts": facts}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            is_new = len(self._windows) == 1 or not self.path.exists()
            with self.path.open("w" if is_new else "a", encoding="utf-8") as file:
                if is_new:
                    file.write(json.dumps({"key": self.key}) + "\n")
                file.write("\n" + json.dumps(line) + "\n")  # a blank line ends what a killed run may have left torn
        except OSError as error:
            raise ValueError(f"{self.path}: can't be written: {error.strerror}") from error

    def remove(self) -> None:
        """Delete the file: all results are elsewhere."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def key_of(settings: Mapping[str, Any]) -> str:
    """Sixteen hexadecimal digits that change with ``settings`` and with the package's source."""
    digest = hashlib.sha256(json.dumps(dict(settings), sort_keys=True, default=str).encode())
    root = Path(vestcl.__file__).parent
    for file in sorted([*root.rglob("*.py"), *root.rglob("*.cl"), *root.parent.glob("kernels/**/*.cl")]):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _read(path: Path, key: str) -> dict[tuple[str, int], Window]:
    """What an earlier run with the same key has measured; lines that it did not finish don't count."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []
    except OSError as error:
        raise ValueError(f"{path}: can't be read: {error.strerror}") from error
    entries = [entry for entry in map(_entry, lines) if isinstance(entry, dict)]
    if not entries or entries[0].get("key") != key:
        return {}
    try:
        return {(each["clip"], each["index"]): _window(each) for each in entries[1:]}
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: holds no scores ({error}); delete it to measure them again") from error


def _entry(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _window(entry: Mapping[str, Any]) -> Window:
    return [Record(**each) for each in entry["records"]], [Facts(**each) for each in entry["facts"]]


def kept_windows(config: ForecastBench) -> Kept:
    """What an earlier, stopped run with the same settings and code has measured, next to ``config.out``.

    Raises:
        ValueError: the file can't be read.
    """
    settings = {name: value for name, value in dataclasses.asdict(config).items() if name not in _OF_TABLES}
    return Kept(None if config.out is None else config.out.with_name(config.out.name + SUFFIX), settings)


def run(groups: Sequence[Group], config: ForecastBench, networks: Networks, kept: Kept, console: Console) -> None:
    """Measure all windows that are not kept yet, and fill the groups.

    Raises:
        ValueError: as the readers and forecasts; a window can't be kept.
    """
    wanted = [(clip.name, index) for group in groups for clip, chosen in group.clips for index in chosen]
    announce = first_of(sum(kept.get(*window) is None for window in wanted), console, "windows")
    with progress_bar(console, counted=True) as bar:
        task = bar.add_task("windows", total=len(wanted))
        for group in groups:
            for clip, chosen in group.clips:
                bar.update(task, description=clip.name)
                missing = [index for index in chosen if kept.get(clip.name, index) is None]
                bar.advance(task, len(chosen) - len(missing))
                for index, measured in zip(missing, run_clip(clip, missing, config, networks), strict=True):
                    kept.add(clip.name, index, measured)
                    announce()
                    bar.advance(task)
                for window in (kept.get(clip.name, index) for index in chosen):
                    records, facts = window or ([], [])
                    group.records += records
                    group.facts += facts


def run_clip(
    clip: Clip, indices: Sequence[int], config: ForecastBench, networks: Networks = Networks()
) -> Iterator[Window]:
    """Windows of a clip, in order; each shares its perception with the next.

    Args:
        clip: at its own size.
        indices: the current frames t, ascending.
        config: which views and steps.
        networks: that score, and that forecast.

    Yields:
        A window's records, and its facts.

    Raises:
        ValueError: as `vestcl.forecasting.geometric.forecast_frames`; the clip has none of the views.
    """
    views, steps = views_of(clip, config), config.steps
    perception = Perception(clip, work_width=config.work_width or None)
    truth = Truth(clip, (config.height, config.width), networks.squeeze, st_lpips=networks.st_lpips)
    for index in indices:
        truth.forget(index - 1)
        motion = true_motion(clip, index, steps)
        forecasts = forecasts_of(perception, index, steps, views, networks.methods, networks.peer, motion)
        forecast = forecasts[GEOMETRIC].forecast
        records = score(truth, index, views, predictions(truth, index, steps, views, forecasts), forecast)
        values = error_shares(truth, forecast, index, views[0])
        values |= {} if motion is None else ego_errors(forecast, motion)
        if street.shot(clip[index]) is not None:
            values |= street.motion_errors(forecast, clip, index, SOURCE) if SOURCE in config.views else {}
            values |= street.splatter_alone(clip, index)
        yield records, [Facts(clip.name, clip[index].name, index, values)]


def views_of(clip: Clip, config: ForecastBench) -> list[View]:
    """The wanted cameras that the clip has.

    Raises:
        ValueError: it has none of them.
    """
    there = [name for name in config.views if name != "right" or clip[0].right is not None]
    if not there:
        raise ValueError(f"`views` must have a camera of {clip.name}, which has no right one")
    return parse_views(there, clip)

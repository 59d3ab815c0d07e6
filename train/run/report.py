"""What a running training logs: a bar on the terminal, log.jsonl, TensorBoard's scalars and images."""

import json
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from torch.utils.tensorboard import SummaryWriter

from train.data.windows import Batch
from train.run.trainer import Update
from train.settings.config import Config
from vestcl.cli.progress import progress_bar
from vestcl.io import contact_sheet as sheet
from vestcl.io.atomic import write_bytes
from vestcl.io.images import write_pixels
from vestcl.models.forecaster import RenderedView

LOG: Final = "log.jsonl"

#: Losses on the bar are means over this many updates.
_SMOOTHED: Final = 50

#: Bytes of a damaged line that its error shows.
_SHOWN: Final = 40

#: Columns of a sheet of a training image, px.
_CELL: Final = 416


class Reporter:
    """Reports the run ``config`` from ``step`` on; in processes other than the first it is silent.

    Args:
        config: of the run.
        step: updates done.
        console: where lines and the bar go.
        speaks: whether this process is the first.
        recent: of the reporter that a resumed run's checkpoint is from; its updates count in the next row's means.

    Raises:
        ValueError: the run's log.jsonl has a line that is not a row.
    """

    def __init__(
        self, config: Config, step: int, console: Console, speaks: bool, recent: Iterable[Mapping[str, float]] = ()
    ) -> None:
        self.console, self._speaks, self._config = console, speaks, config
        self._recent = deque(recent, maxlen=max(_SMOOTHED, config.run.log_every))
        self._silenced = False
        if speaks:
            config.out.mkdir(parents=True, exist_ok=True)
            _cut_log(config.out / LOG, step)
            self._log = (config.out / LOG).open("a")
            self._board = SummaryWriter(str(config.out / "tensorboard"), purge_step=step + 1)

    @contextmanager
    def bar(self, step: int) -> Iterator[None]:
        """A bar from ``step`` to the run's end."""
        with progress_bar(self.console, counted=True, hidden=not self._speaks, stays=True) as self._bar:
            self._task = self._bar.add_task("", total=self._config.steps, completed=step)
            try:
                yield
            finally:
                self.close()

    def updated(self, step: int, stage: str, rate: float, update: Update, waited: float, batch: Batch) -> None:
        """Tell of the update that made ``step`` updates."""
        if not self._speaks:
            return
        seconds = {"data": waited, **update.seconds}
        logged = {**update.terms, **{f"s_{name}": value for name, value in seconds.items()}}
        if self._recent and self._recent[-1].keys() != logged.keys():  # a stage with other terms
            self._recent.clear()
        self._recent.append(logged)
        self._bar.update(self._task, completed=step, description=f"{stage}  loss {self.loss or 0:.4f}")
        run = self._config.run
        with self._even_on_a_full_disk():
            if step % run.log_every == 0 or step == self._config.steps:
                self._write(step, stage, rate, batch.horizon)
            if run.image_every and step % run.image_every == 0 and update.view is not None:
                self._show(step, update.view, batch)
        if update.skipped:
            self.say(f"step {step}: non-finite, skipped ({', '.join(batch.clips)})", "yellow")

    @property
    def loss(self) -> float | None:
        """Mean over the last updates; None before the first."""
        return _means_of(list(self._recent)[-_SMOOTHED:])["loss"] if self._recent else None

    @property
    def recent(self) -> list[dict[str, float]]:
        """Scalars of the last updates, for the reporter of a resumed run."""
        return [dict(update) for update in self._recent]

    def say(self, text: str, style: str = "") -> None:
        """A line above the bar."""
        if self._speaks:
            self.console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)

    def close(self) -> None:
        """Finish the files; may be called twice."""
        if self._speaks:
            with self._even_on_a_full_disk():
                self._log.close()
            with self._even_on_a_full_disk():
                self._board.close()

    @contextmanager
    def _even_on_a_full_disk(self) -> Iterator[None]:
        """What can't be written is reported once: no run is lost for its curves."""
        try:
            yield
        except OSError as error:
            if not self._silenced:
                self.say(f"scalars and images can't be written to {self._config.out}: {error}", "red")
            self._silenced = True

    def _means(self) -> dict[str, float]:
        return _means_of(list(self._recent)[-self._config.run.log_every :])

    def _described(self, stage: str) -> str:
        means = _means_of(list(self._recent)[-_SMOOTHED:])
        split = "+".join(f"{means[f's_{name}']:.2f}" for name in ("data", "networks", "splatting"))
        return f"{stage}  loss {means['loss']:.4f}  l1 {means.get('l1', 0):.4f}  {split} s data+networks+splatting"

    def _show(self, step: int, view: RenderedView, batch: Batch) -> None:
        picture = training_sheet(batch, view, f"step {step}, t+{batch.horizon}, {batch.clips[0]}")
        folder = self._config.out / "images"
        folder.mkdir(exist_ok=True)
        write_pixels(folder / f"step-{step:08d}.png", picture)
        self._board.add_image("forecast", picture, step, dataformats="HWC")

    def _write(self, step: int, stage: str, rate: float, horizon: int) -> None:
        means = self._means()
        about: dict[str, Any] = {"step": step, "stage": stage, "learning_rate": rate, "horizon": horizon}
        self._log.write(json.dumps(about | {name: _digits(value) for name, value in means.items()}) + "\n")
        self._log.flush()
        for name, value in (means | {"learning_rate": rate}).items():
            kind = "seconds" if name.startswith("s_") else "training"
            self._board.add_scalar(f"{kind}/{name.removeprefix('s_')}", value, step)
        if not self.console.is_terminal:
            self.say(f"step {step}/{self._config.steps}  {self._described(stage)}")


def training_sheet(batch: Batch, view: RenderedView, title: str) -> sheet.Picture:
    """The batch's first window: what was shown at t, what was forecast, the truth, and where they differ.

    Returns:
        [H, W, 3] uint8.
    """
    forecast = view.image[0].detach().float().clamp(0, 1).numpy()
    truth, before = batch.target[0].numpy(), batch.frame_cur.image[0].numpy()
    error = np.abs(forecast - truth).mean(0, keepdims=True)
    cells = [
        [sheet.Cell(sheet.rgb(before), "t"), sheet.Cell(sheet.rgb(truth), "truth")],
        [sheet.Cell(sheet.rgb(forecast), "forecast"), sheet.Cell(sheet.heat(error), "error")],
    ]
    return sheet.sheet(cells, title=title, cell_width=_CELL)


def read_log(path: Path) -> list[dict[str, Any]]:
    """The rows of a log.jsonl; a last line that a killed process left half written is left out.

    Raises:
        ValueError: a line is not a row; the message has the file and the line's number.
        OSError: the file can't be read.
    """
    lines = path.read_bytes().split(b"\n")[:-1]
    return [_row(path, number, line) for number, line in enumerate(lines, start=1)]


def _row(path: Path, number: int, line: bytes) -> dict[str, Any]:
    try:
        row = json.loads(line)
        if row["step"] >= 0 and all(_fits(name, value) for name, value in row.items()) and "stage" in row:
            return dict(row)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        pass
    got = line[:_SHOWN].decode(errors="replace")
    raise ValueError(f"{path}: line {number} must be a row of train.fit, got {got!r}; remove this line")


def _fits(name: str, value: Any) -> bool:
    """Whether a row may have the entry: a stage's name, whole numbers, and numbers or null for what is not finite."""
    if name == "stage":
        return isinstance(value, str)
    kinds = (int,) if name in ("step", "horizon") else (int, float, type(None))
    return isinstance(value, kinds) and not isinstance(value, bool)


def _cut_log(path: Path, step: int) -> None:
    """Rows after ``step`` are of updates that a checkpoint never saw, and will be made again."""
    if path.exists():
        kept = [row for row in read_log(path) if row["step"] <= step]
        write_bytes(path, "".join(json.dumps(row) + "\n" for row in kept).encode())


def _means_of(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[-1]}


def _digits(value: float) -> float | None:
    return float(f"{value:.6g}") if np.isfinite(value) else None

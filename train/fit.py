"""Train a model: ``python -m train.fit train/configs/vest-s_street.yaml data.train='[cache/*]' out=runs/first``.

From frames to the loss everything is differentiable, the OpenCL splatting included. A run can be killed at any moment:
``--resume`` continues from its last checkpoint to the same weights. Under torchrun processes share each batch.
"""

import dataclasses
import re
import shlex
import signal
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Final, Literal

import torch
import tyro
from rich.console import Console

from train.command import ERRORS, failed, lost_worker, warnings_in_lines
from train.data.windows import WindowSet, loader
from train.run import checkpoint, resume
from train.run.checkpoint import CheckpointError, TrainingState
from train.run.losses import build_perceptual
from train.run.ranks import Ranks, lost_processes_named
from train.run.report import Reporter
from train.run.trainer import Average, NotANumberError, Trainer, build_model
from train.settings.config import Config, DataConfig, load_config, to_dict
from vestcl import interrupt, opencl
from vestcl.cli import command_line
from vestcl.data.readers.splits import KITTI_TRAINING
from vestcl.models.checkpoint import Frames, read_trained_on
from vestcl.models.config import ModelConfig
from vestcl.models.forecaster import Forecaster
from vestcl.models.weights_file import misfit
from vestcl.prepare.prepared import find_prepared

#: The exit status of a run that was asked to stop (SIGTERM), as a shell has it.
STOPPED: Final = 128 + signal.SIGTERM


class TrainingError(RuntimeError):
    """Training can't continue; the message says what to do."""


@dataclass(frozen=True)
class FitOptions:
    """Train a model by a configuration."""

    config: tyro.conf.Positional[Path]
    """YAML file."""
    overrides: tyro.conf.Positional[tuple[str, ...]] = ()
    """key=value or key.sub=value each; values are YAML."""
    resume: bool = False
    """Go on from the run's last checkpoint, if it has one."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name."""


@interrupt.command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command; its exit status."""
    options = command_line.parsed(FitOptions, "python -m train.fit", __doc__, arguments)
    with warnings_in_lines():
        try:
            return 0 if _fit(options) else STOPPED
        except (*ERRORS, TrainingError) as error:
            return failed(error)
        except RuntimeError as error:
            if (line := lost_worker(error)) is None:
                raise
            return failed(line)


def _fit(options: FitOptions) -> bool:
    ranks = Ranks.join()
    try:
        config = load_config(options.config, options.overrides)
        with lost_processes_named() if ranks.world > 1 else nullcontext():
            restarted = ranks.restarted
            return fit(config, go_on=options.resume or restarted, ranks=ranks, device=options.device)
    finally:
        ranks.leave()


def fit(config: Config, *, go_on: bool = False, ranks: Ranks | None = None, device: str | None = None) -> bool:
    """Train to the end of the last stage, or until SIGTERM or SIGINT.

    Args:
        config: of the run.
        go_on: from the last checkpoint of ``config.out``, if there is one.
        ranks: the processes that train together; None is a single process.
        device: OpenCL device; None is `Ranks.device`'s choice.

    Returns:
        Whether the run is finished; False after SIGTERM, with a checkpoint of where it was.

    Raises:
        ValueError: data or weights that can't be used, a run that exists already, or another one's checkpoint.
        TrainingError: a non-finite loss or gradient.
        CheckpointError: the last checkpoint can't be written, or none can be read.
        ChildProcessError: a process that reads data was killed.
        KeyboardInterrupt: after SIGINT, with a checkpoint of where it was.
    """
    ranks = ranks or Ranks()
    state = _last_state(config, go_on)
    if config.run.threads:
        torch.set_num_threads(config.run.threads)
    with opencl.use(device or ranks.device()), _stop_signal() as stop:
        run = _Run(config, ranks, stop)
        with interrupt.summary(run.where):
            finished = run.go(state)
            if stop.asked == signal.SIGINT and not finished:
                raise KeyboardInterrupt
        return finished


def _last_state(config: Config, go_on: bool) -> TrainingState | None:
    if not go_on:
        if checkpoint.list_checkpoints(config.out):
            raise ValueError(f"`out` {config.out} has a run already: --resume continues it, or take another folder")
        return None
    state = checkpoint.load_latest(config.out)
    if state is not None:
        resume.check_resume(state, config)
    return state


class _Stop:
    """Set by SIGTERM and SIGINT: the update that is being made is still made.

    A second SIGINT, and one before the first update, ends the run at once.
    """

    asked = 0
    """The signal."""
    updated = False
    """Whether there is an update that a checkpoint would keep."""

    def __init__(self) -> None:
        numbers = (number for number in (signal.SIGTERM, signal.SIGINT) if signal.getsignal(number) != signal.SIG_IGN)
        self._before = {number: signal.signal(number, self) for number in numbers}

    def __call__(self, number: int, frame: FrameType | None) -> None:
        before = self._before.get(signal.Signals(number))
        if number == signal.SIGINT and (self.asked == number or not self.updated) and callable(before):
            before(number, frame)
        self.asked = number

    def restore(self) -> None:
        """The handlers that there were."""
        for number, before in self._before.items():
            signal.signal(number, before)


@contextmanager
def _stop_signal() -> Iterator[_Stop]:
    stop = _Stop()
    try:
        yield stop
    finally:
        stop.restore()


class _Run:
    """The model and its EMA, through all stages."""

    def __init__(self, config: Config, ranks: Ranks, stop: _Stop) -> None:
        self.config, self.ranks, self.stop = config, ranks, stop
        self.model: Forecaster = build_model(config)
        self.average = Average(self.model, config.optimiser.ema) if config.optimiser.ema else None
        #: What the weights were shown, those of ``init`` included as far as their file lists them.
        self.trained_on = (read_trained_on(config.init) if config.init else None) or {}
        self.perceptual = {loss: build_perceptual(loss) for loss in map(config.loss_of, config.stages)}
        self.step = 0

    def go(self, state: TrainingState | None) -> bool:
        """From ``state`` to the end; whether that was reached."""
        if state is not None:
            self._restore(state)
        recent = state.recent if state else ()
        self.report = Reporter(self.config, self.step, Console(), self.ranks.first, recent)
        self.report.say(self._about())
        with self.report.bar(self.step):
            while self.step < self.config.steps:
                position = self.config.position(self.step)
                perceptual = self.perceptual[self.config.loss_of(position.stage)]
                trainer = Trainer(self.config, position.stage, self.model, perceptual, self.ranks)
                if state is not None and position.step:
                    trainer.restore(state.optimiser, state.scheduler)
                state = None
                if not self._train(trainer, position.number, position.step):
                    if self.stop.asked != signal.SIGINT:  # whose line `interrupt.command` prints
                        self.report.say(f"stopped after step {self.step}; --resume continues")
                    return False
        for line in self._end():
            self.report.say(line)
        return True

    def _end(self) -> Iterator[str]:
        """The lines of a finished run: loss, checkpoint, and what to do with it."""
        loss = self.report.loss
        yield f"finished: {self.config.out}, step {self.step}" + ("" if loss is None else f", loss {loss:.4g}")
        last = next(iter(checkpoint.list_checkpoints(self.config.out)), None)
        if last is not None:
            name, path = re.sub(r"[^\w.+-]+", "_", self.config.name) or "mine", shlex.quote(str(last))
            yield f"checkpoint: {last}"
            yield f"next: python -m train.evaluate street --model {shlex.quote(f'{name}={last}')}"
            yield f"      vestcl forecast street:3 --model {path} --compare"

    def where(self) -> str:
        """The line of a run that Ctrl-C stopped; the first process prints it for all."""
        if not self.ranks.first:
            return ""
        last = next(iter(checkpoint.list_checkpoints(self.config.out)), None)
        there = "there is no checkpoint" if last is None else f"the last checkpoint is {last}; --resume resumes"
        return f"stopped after step {self.step}; {there}"

    def _train(self, trainer: Trainer, number: int, done: int) -> bool:
        """The rest of a stage, of which ``done`` updates are made; whether it was finished."""
        stage = trainer.stage
        windows = window_set(self.config.data_of(stage), self.model.config.prior)
        self.model.config = with_intervals(self.model.config, windows)
        self.trained_on = merged(self.trained_on, windows.shown)
        steps = range(done, stage.steps)
        batches = loader(
            windows, self.config.seed + number, stage.batch, steps, rank=self.ranks.rank, world=self.ranks.world,
            workers=self.config.data_of(stage).workers,
        )  # fmt: skip
        with interrupt.shielded():  # the processes that read
            reading = iter(batches)
        waiting = time.perf_counter()
        for batch in reading:
            waited, rate = time.perf_counter() - waiting, float(trainer.schedule.get_last_lr()[0])
            try:
                update = trainer.update(batch)
            except NotANumberError as error:
                raise TrainingError(self._broken(str(error), batch.clips)) from error
            self.step += 1
            self.stop.updated = True
            if self.average and not update.skipped:
                self.average.update(self.model)
            self.report.updated(self.step, stage.name, rate, update, waited, batch)
            stopping = self.ranks.any(bool(self.stop.asked))
            if stopping or self.step % self.config.run.checkpoint_every == 0 or self.step == self.config.steps:
                self._save(trainer, must=stopping or self.step == self.config.steps)
            if stopping and self.step < self.config.steps:
                return False
            waiting = time.perf_counter()
        return True

    def _save(self, trainer: Trainer, must: bool) -> None:
        """Write a checkpoint; without ``must`` a full disk is reported, and training continues."""
        if not self.ranks.first:
            return
        adam, schedule = trainer.state()
        ema = self.average.model.state_dict() if self.average else None
        count = self.average.count if self.average else 0
        state = TrainingState(
            self.step, to_dict(self.config), self.model.config, self.model.state_dict(), ema, adam, schedule,
            extra={"averaged": count}, recent=self.report.recent, trained_on=self.trained_on,
        )  # fmt: skip
        try:
            checkpoint.save(self.config.out, state, self.config.run.keep)
        except CheckpointError as error:
            if must:
                raise
            self.report.say(f"step {self.step}: {error}", "red")

    def _restore(self, state: TrainingState) -> None:
        if reason := misfit(state.model, self.model.state_dict()):
            model = self.config.model
            raise ValueError(f"the checkpoint of step {state.step} holds another model than {model}: it {reason}")
        self.step, self.trained_on = state.step, merged(self.trained_on, state.trained_on)
        self.model.load_state_dict(dict(state.model))
        if self.average and state.ema is not None:
            self.average.restore(dict(state.ema), state.extra["averaged"])
        checkpoint.restore_rng(state.rng)

    def _broken(self, what: str, clips: tuple[str, ...]) -> str:
        good = checkpoint.list_checkpoints(self.config.out)
        last = f"the last good checkpoint is {good[0]}" if good else "there is no checkpoint yet"
        return (
            f"step {self.step + 1}: a loss or gradient is not a number ({what}) with {', '.join(clips)}; {last}. "
            "`run.on_nan=skip` leaves such steps out; a lower learning rate or `run.precision=float32` may prevent them"
        )

    def _about(self) -> str:
        count = sum(parameter.numel() for parameter in self.model.parameters())
        begin = f"from step {self.step} " if self.step else ""
        return (
            f"{self.config.name}: {self.config.model}, {count:,} parameters, {begin}to step {self.config.steps}, "
            f"{self.ranks.world} process{'es' if self.ranks.world > 1 else ''}, {torch.get_num_threads()} threads, "
            f"{opencl.current().info.name}"
        )


def merged(frames: Frames, others: Frames) -> dict[str, tuple[int, int]]:
    """By clip, from the first of both to the last of both."""
    both = {**others, **frames}
    for name in frames.keys() & others.keys():
        first, last = zip(frames[name], others[name], strict=True)
        both[name] = min(first), max(last)
    return both


def with_intervals(config: ModelConfig, windows: WindowSet) -> ModelConfig:
    """The configuration with the seconds between frames that ``windows`` have: the median, and if EMF knows the time
    between frames the range over all stages."""
    learned, known = windows.interval or config.interval_s, [windows.intervals, config.intervals_s]
    seconds = [each for pair in known if pair is not None for each in pair]
    by_time = config.ego_motion is not None and config.ego_motion.correction == "bounded"
    range_s = (min(seconds), max(seconds)) if by_time and seconds else None
    return dataclasses.replace(config, interval_s=learned, intervals_s=range_s)


def window_set(data: DataConfig, prior: Literal["velocity", "forecast"] = "velocity") -> WindowSet:
    """The windows that a configuration's data hold.

    Args:
        data: of a stage.
        prior: of the model, see `vestcl.models.config.ModelConfig.prior`.

    Raises:
        ValueError: no prepared clip there, none of the split, or none long enough.
    """
    weights = _group_weights(data)
    found = [(clip, group) for group, root in enumerate(data.train) for clip in find_prepared(root)]
    if data.split is not None:
        drives = KITTI_TRAINING[data.split]
        found = [(clip, group) for clip, group in found if clip.name in drives]
        if not found:
            raise ValueError(f"`data.train` must have drives that {data.split} trains on, got none in {data.train}")
    clips, groups = [clip for clip, _ in found], tuple(group for _, group in found)
    return WindowSet(
        clips, horizons=data.horizons, crop=data.crop, flip=data.flip, colour=data.colour, right=data.right,
        frames=data.frames, scale=data.scale, degrade=data.degrade, groups=groups, weights=weights, prior=prior,
    )  # fmt: skip


def _group_weights(data: DataConfig) -> tuple[float, ...]:
    """The weight of each folder; none where none is listed.

    Raises:
        ValueError: a weight of a folder that is not there.
    """
    listed = dict(data.weights)
    if unknown := [name for name in listed if name not in data.train]:
        wanted = f"folders of `data.train`, {', '.join(data.train)}"
        raise ValueError(f"`data.weights` must name {wanted}, got {', '.join(unknown)}; data.weights=[] has none")
    return tuple(listed.get(name, 0.0) for name in data.train) if listed else ()


if __name__ == "__main__":
    warnings.simplefilter("default", UserWarning)
    sys.exit(main())

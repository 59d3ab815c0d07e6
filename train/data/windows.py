"""Batches of prepared clips. All of a batch follows from (seed, step, position in the global batch), and from nothing
else: there is no state to save, ranks share a batch without talking, and a resumed run sees what it would have seen."""

import functools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from train.data import augment, degrade
from train.data.augment import TrainingWindow
from train.settings.config import DegradeConfig
from vestcl.forecasting.network.input import PAST, CameraPath, NetworkInput, camera_path, last_motions, network_input
from vestcl.models.networks.layers import joined
from vestcl.models.steps.prior import MotionPrior
from vestcl.prepare.prepared import PreparedClip
from vestcl.scene.layers import LayerBatch

#: What random numbers are for, so that no two purposes share a stream: rng([seed, purpose, count]).
_ORDER, _HORIZON, _VIEW, _AUGMENT, _GROUP, _DEGRADE = range(6)

#: Frames that are looked at before the target: t - 1 and t.
_INPUTS: Final = 2

Item = TypeVar("Item")


class Batch(NamedTuple):
    """B windows, float32."""

    frame_prev: LayerBatch
    """At t - 1."""
    frame_cur: LayerBatch
    """At t."""
    K: torch.Tensor
    """[B, 3, 3] px, of both."""
    prior: MotionPrior
    horizon: int
    """k: the target is the frame at t + k, of all windows."""
    target: torch.Tensor
    """[B, 3, H, W] RGB in [0, 1]."""
    tgt_from_next: torch.Tensor
    """[B, 4, 4] m: the target's camera relative to the source camera at t + k; identity if it is the same."""
    target_K: torch.Tensor  # noqa: N815 (the matrix K)
    """[B, 3, 3] px."""
    future_from_cur: torch.Tensor
    """[B, 4, 4] m: the camera's true motion from t to t + k; the identity where it is not known."""
    path_from_cur: torch.Tensor
    """[B, K, 4, 4] m: the same to t + 1 ... t + K, as many as there are horizons."""
    pose_known: torch.Tensor
    """[B] bool: where it is."""
    clips: tuple[str, ...]
    """"clip name/name of frame t" of each window."""
    own: torch.Tensor | None = None
    """[B, 1, H, W], 1 where the recording car itself is in the input images; None is nowhere."""


class Draw(NamedTuple):
    """One sample of a batch: which window, and what is made of it."""

    clip: int
    """Index of the clip."""
    frame: int
    """Index of t in it."""
    horizon: int
    """k."""
    right: bool
    """Whether the right camera, where there is one, shows the target."""
    seed: tuple[int, ...]
    """For the augmentation's generator."""


@dataclass(frozen=True, eq=False)
class WindowSet:
    """All windows of some clips: frames t - 1 and t in, t + k to be forecast, for each t that has t + K.

    Raises:
        ValueError: no clip, a setting out of range, sizes that don't go together, or clips too short for a window.
    """

    clips: Sequence[PreparedClip]
    horizons: tuple[float, ...] = (1.0,)
    """Weights of k = 1 ... K, none negative; a batch has one k."""
    crop: tuple[int, int] | None = None
    """(height, width) px of what is cut out; None takes whole frames."""
    scale: tuple[float, float] = (1.0, 1.0)
    """Smallest and largest factor that images are shrunk by first, uniform between; without ``crop`` one factor."""
    flip: bool = False
    """Mirror half of the windows."""
    colour: float = 0.0
    """Strength of colour jitter, 0 ... 1, see `augment.draw_colour`."""
    right: float = 0.0
    """Probability that the target is the right camera's, where there is one."""
    frames: tuple[int, int] | None = None
    """First and last index, inclusive, of the frames that windows may show. What was measured in a frame may rest on
    the one before it."""
    degrade: DegradeConfig | None = None
    """How images are degraded, see `train.data.degrade`; None leaves them as they are."""
    groups: tuple[int, ...] = ()
    """The group of each clip, from 0, where groups have weights."""
    weights: tuple[float, ...] = ()
    """How often windows are of each group; none shows each window as often."""
    prior: Literal["velocity", "forecast"] = "velocity"
    """What the camera's motion starts from, see `vestcl.models.config.ModelConfig.prior`. "forecast" takes up to `PAST`
    measured motions and the clip's interval; of a clip's first frames there are fewer."""

    def __post_init__(self) -> None:
        if not self.clips:
            raise ValueError("`clips` must be one or more, got none")
        if not sum(self.horizons) > 0 or min(self.horizons) < 0:
            raise ValueError(f"`horizons` must be weights of 0 or more, one above 0, got {list(self.horizons)}")
        for name, share in (("colour", self.colour), ("right", self.right)):
            if not 0 <= share <= 1:
                raise ValueError(f"`{name}` must be 0 ... 1, got {share}")
        if not 0 < self.scale[0] <= self.scale[1] <= 1 or (self.crop is None and self.scale[0] < self.scale[1]):
            raise ValueError(f"`scale` must be 0 < low <= high <= 1, and low = high without crop, got {self.scale}")
        self._check_sizes()
        for group in self._weighted_windows:
            if self.weights[group] > 0 and not self._weighted_windows[group]:
                raise ValueError(f"`weights` must be 0 for a folder without a window, got {list(self.weights)}")
        if not self.windows:
            longest = max(len(clip) for clip in self.clips)
            within = "" if self.frames is None else f" within frames {self.frames[0]} ... {self.frames[1]}"
            needed = _INPUTS + len(self.horizons)
            wanted = f"{needed} frames or more{within} without a gap"
            raise ValueError(f"`clips` must have {wanted}, got {longest} in the longest clip")

    @functools.cached_property
    def windows(self) -> list[tuple[int, int]]:
        """(index of the clip, t), clip after clip; none with a gap, whose frames are not an interval apart."""
        found = []
        for number, clip in enumerate(self.clips):
            first, last = (0, len(clip) - 1) if self.frames is None else self.frames
            last = min(last, len(clip) - 1)
            chosen = range(max(first, 0) + _INPUTS - 1, last - len(self.horizons) + 1)
            found += [(number, t) for t in chosen if clip.is_whole(t - 1, 1 + len(self.horizons))]
        return found

    @functools.cached_property
    def _weighted_windows(self) -> dict[int, list[tuple[int, int]]]:
        """By group, its windows; empty without weights."""
        return {
            group: [(number, t) for number, t in self.windows if self.groups[number] == group]
            for group in range(len(self.weights))
        }

    @property
    def interval(self) -> float | None:
        """Seconds from frame to frame, the median over the clips whose times are known; None without any."""
        known = [clip.interval for clip in self.clips if clip.interval is not None]
        return round(float(np.median(known)), 6) if known else None

    @property
    def intervals(self) -> tuple[float, float] | None:
        """The shortest and the longest interval of the clips whose times are known; None without any."""
        known = [round(clip.interval, 6) for clip in self.clips if clip.interval is not None]
        return (min(known), max(known)) if known else None

    @property
    def shown(self) -> dict[str, tuple[int, int]]:
        """By clip, the first and the last frame that windows show."""
        found: dict[str, tuple[int, int]] = {}
        for number, t in self.windows:
            first, last = found.get(self.clips[number].name, (t - 1, t))
            found[self.clips[number].name] = min(first, t - 1), max(last, t + len(self.horizons))
        return found

    def global_batch(self, seed: int, step: int, batch: int) -> list[Draw]:
        """The samples of a step's batch, over all ranks.

        Position p = step batch + i of an endless sequence has the window that epoch p // n's permutation has at
        p mod n, with n windows: every window once per epoch. With weights p's group is drawn first, and n counts its
        windows: in an epoch each comes up or not, by the group's weight. k is drawn for the step, the camera and the
        augmentation for p.

        Args:
            seed: of the run, 0 or more.
            step: 0 or more.
            batch: windows in the batch of all ranks.

        Returns:
            ``batch`` draws.
        """
        weights = np.array(self.horizons) / np.sum(self.horizons)
        horizon = 1 + int(np.random.default_rng([seed, _HORIZON, step]).choice(len(weights), p=weights))
        return [self._draw(seed, position, horizon) for position in range(step * batch, (step + 1) * batch)]

    def batch(self, draws: Sequence[Draw]) -> Batch:
        """Read, augment and stack.

        Args:
            draws: of one horizon.

        Returns:
            The batch.

        Raises:
            ValueError: a frame that can't be read or used; the message begins with its clip and frame.
        """
        made = [self._made(draw) for draw in draws]
        inputs, windows = [given for given, _ in made], [window for _, window in made]
        poses = [window.future_from_cur for window in windows]
        given = joined(inputs)
        return Batch(
            *given[:4],
            draws[0].horizon,
            torch.from_numpy(np.stack([window.target for window in windows])),
            _matrices([window.tgt_from_next for window in windows]),
            _matrices([window.target_K for window in windows]),
            _matrices([np.eye(4) if pose is None else pose for pose in poses]),
            torch.stack([self._path(window) for window in windows]),
            torch.tensor([bool(window.path_from_cur) for window in windows]),
            tuple(self.label(draw) for draw in draws),
            given.own,
        )

    def window(self, draw: Draw) -> TrainingWindow:
        """The window as the clip has it, not augmented."""
        clip, later = self.clips[draw.clip], draw.frame + draw.horizon
        prev, cur = clip.frame(draw.frame - 1), clip.frame(draw.frame)
        image, K, tgt_from_next = (draw.right and clip.right(later)) or (clip.image(later), clip.K(later), np.eye(4))
        if image.shape != cur.layers.image.shape:
            raise ValueError(f"frame {clip.frame_name(later)} must be of size {clip.size}, got {image.shape[1:]}")
        here, there = clip.world_from_cam(draw.frame), clip.world_from_cam(later)
        future_from_cur = None if here is None or there is None else np.asarray(np.linalg.inv(there) @ here, np.float64)
        path = self._path_of(draw.clip, draw.frame) if self.prior == "forecast" else None
        return TrainingWindow(prev, cur, image, K, tgt_from_next, future_from_cur, self._poses(clip, draw.frame), path)

    def augmented(self, window: TrainingWindow, rng: np.random.Generator) -> TrainingWindow:
        """Cut out, shrunk, mirrored and coloured as set, by numbers from ``rng``."""
        (rows, columns), (share, down, across, side) = window.size, rng.random(4)
        scale = self.scale[0] + (self.scale[1] - self.scale[0]) * share
        if self.crop is None:
            height, width = max(round(rows * scale), 1), max(round(columns * scale), 1)
        else:  # cut out first: only what stays has to be shrunk
            height, width = self.crop
            tall, wide = min(round(height / scale), rows), min(round(width / scale), columns)
            top, left = int(down * (rows - tall + 1)), int(across * (columns - wide + 1))
            window = augment.crop(window, top, left, tall, wide)
        window = augment.resize(window, height, width)
        if self.flip and side < 0.5:
            window = augment.flip(window)
        if self.colour:
            grey = augment.mean_luma(window.cur.layers.image)
            window = augment.colour(window, augment.draw_colour(rng, self.colour, grey))
        return window

    def label(self, draw: Draw) -> str:
        """ "clip name/name of frame t"."""
        clip = self.clips[draw.clip]
        return f"{clip.name}/{clip.frame_name(draw.frame)}"

    @functools.cached_property
    def _forecast_paths(self) -> dict[tuple[int, int], CameraPath]:
        """By clip and frame: a filter takes 20 ms, and every epoch would need it again."""
        return {}

    def _path_of(self, number: int, frame: int) -> CameraPath:
        """The camera's forecast path from t = ``frame``, for as many intervals as there are horizons."""
        if (number, frame) not in self._forecast_paths:
            clip, first = self.clips[number], max(frame - PAST + 1, 1, 0 if self.frames is None else self.frames[0])
            seen = range(min(first, frame), frame + 1)
            motions = [np.asarray(np.linalg.inv(clip.prev_from_cur(i)), np.float64) for i in seen]
            by_flow = clip.inputs is not None and clip.inputs.by_flow
            path = camera_path(motions, list(map(clip.elapsed, seen)), clip.interval, len(self.horizons), by_flow)
            self._forecast_paths[number, frame] = path
        return self._forecast_paths[number, frame]

    def _poses(self, clip: PreparedClip, frame: int) -> tuple[NDArray[np.float64], ...]:
        """future_from_cur for k = 1 ... K; none where a pose is unknown."""
        poses = [clip.world_from_cam(frame + k) for k in range(len(self.horizons) + 1)]
        known = [pose for pose in poses if pose is not None]
        if len(known) < len(poses):
            return ()
        return tuple(np.asarray(np.linalg.inv(pose) @ known[0], np.float64) for pose in known[1:])

    def _path(self, window: TrainingWindow) -> torch.Tensor:
        return _matrices(window.path_from_cur or [np.eye(4)] * len(self.horizons))

    def _draw(self, seed: int, position: int, horizon: int) -> Draw:
        windows = self.windows
        if self.weights:
            shares = np.array(self.weights) / np.sum(self.weights)
            windows = self._weighted_windows[
                int(np.random.default_rng([seed, _GROUP, position]).choice(len(shares), p=shares))
            ]
        epoch, place = divmod(position, len(windows))
        clip, index = windows[int(_permutation(len(windows), seed, epoch)[place])]
        right = bool(np.random.default_rng([seed, _VIEW, position]).random() < self.right)
        return Draw(clip, index, horizon, right, (seed, _AUGMENT, position))

    def _made(self, draw: Draw) -> tuple[NetworkInput, TrainingWindow]:
        try:
            window, rng = self.window(draw), np.random.default_rng([draw.seed[0], _DEGRADE, *draw.seed[2:]])
            done = None if self.degrade is None else degrade.draw(rng, self.degrade)
            if done is not None and done.shutter and not draw.right:
                window = degrade.blur(window, self.clips[draw.clip].frame(draw.frame + draw.horizon), done.shutter)
            window = self.augmented(window, np.random.default_rng(draw.seed))
            if done is not None:
                window = degrade.degrade(window, done, rng)
            motions = last_motions(window.prev, window.cur)
            return network_input(window.prev, window.cur, motions, window.path), window
        except (OSError, ValueError) as error:
            raise ValueError(f"{self.label(draw)}: {error}") from error

    def _check_sizes(self) -> None:
        sizes = {clip.size for clip in self.clips}
        if self.crop is None and len(sizes) > 1:
            listed = " and ".join(f"{height}x{width}" for height, width in sorted(sizes))
            raise ValueError(f"`crop` must be given for clips of several sizes, got {listed}")
        for clip in self.clips if self.crop else ():
            wanted = [round(side / self.scale[0]) for side in self.crop or ()]
            if min(*wanted, *(self.crop or ())) < 1 or any(np.greater(wanted, clip.size)):
                raise ValueError(
                    f"`crop` must lie in the frames even at scale {self.scale[0]:g}, got {self.crop} for {clip.name}, "
                    f"which is {clip.size[0]}x{clip.size[1]}"
                )


@dataclass(frozen=True, eq=False)
class _Steps(Dataset[Batch | ValueError]):
    """A rank's part of each step's batch: positions rank, rank + world, ...

    What can't be read is given as the error itself: torch would put a worker's traceback into its message.
    """

    windows: WindowSet
    seed: int
    batch: int
    rank: int
    world: int

    def __getitem__(self, step: int) -> Batch | ValueError:
        try:
            return self.windows.batch(self.windows.global_batch(self.seed, step, self.batch)[self.rank :: self.world])
        except ValueError as error:
            return error


class _Batches(DataLoader[Batch | ValueError]):
    """Raises what `_Steps` gives as an error."""

    def __iter__(self) -> Iterator[Batch]:  # type: ignore[override]
        for batch in super().__iter__():
            if isinstance(batch, ValueError):
                raise batch
            yield batch


def loader(
    windows: WindowSet, seed: int, batch: int, steps: range, *, rank: int = 0, world: int = 1, workers: int = 0
) -> Iterable[Batch]:
    """The batches of ``steps``, one after the other.

    Args:
        windows: to draw from.
        seed: of the run.
        batch: windows per step, over all ranks.
        steps: range(next step, end), which is all that a resumed run has to know.
        rank: this process.
        world: number of processes; a divisor of ``batch``.
        workers: processes that read ahead; 0 reads when asked. They open no OpenCL device.

    Returns:
        An iterable of `Batch`, with batch / world windows in each; torch's own generators are not used.

    Raises:
        ValueError: a batch that can't be divided, or no such rank.
    """
    if batch < 1 or batch % world or not 0 <= rank < world:
        raise ValueError(
            f"`batch` must be a multiple of the {world} processes and `rank` one of them, got {batch}, {rank}"
        )
    return _Batches(
        _Steps(windows, seed, batch, rank, world),
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        collate_fn=_as_it_is,
        multiprocessing_context="forkserver" if workers else None,  # a fork would copy a running OpenCL driver's locks
        persistent_workers=workers > 0,
        generator=torch.Generator(),  # else each start draws a number from the global one
    )


def _as_it_is(batch: Item) -> Item:
    return batch


@functools.lru_cache(maxsize=16)
def _permutation(count: int, seed: int, epoch: int) -> NDArray[np.int64]:
    """The order of an epoch; a batch looks at two of them at most for each group, and the next one at the same."""
    return np.random.default_rng([seed, _ORDER, epoch]).permutation(count)


def _matrices(matrices: Sequence[NDArray[np.float64]]) -> torch.Tensor:
    return torch.from_numpy(np.stack(matrices)).float()

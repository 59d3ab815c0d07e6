"""What `vestcl prepare` computes once, every frame of a clip preprocessed, and how it is read back."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl import times
from vestcl.prepare.files import ALWAYS, DAMAGE, JSON, damaged, frame_path, read_clip, read_tensors
from vestcl.scene.inputs import Inputs
from vestcl.scene.layers import Layers
from vestcl.scene.perceived import PerceivedFrame

#: Characters that make the last part of a path a pattern.
_GLOB: Final = frozenset("*?[")

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class _Frame:
    name: str
    key: str
    K: NDArray[np.float64]
    world_from_cam: NDArray[np.float64] | None
    right: tuple[NDArray[np.float64], NDArray[np.float64]] | None
    """K and right_from_left."""
    right_size: tuple[int, int] | None
    """(height, width) px; None is the clip's."""


@dataclass(frozen=True, eq=False)
class PreparedClip:
    """A clip on disk; frames are read when they are asked for. `open` makes one."""

    folder: Path
    name: str
    kind: str
    """The reader it comes from, "KITTI raw"."""
    interval: float | None
    """Seconds, the median from frame to frame; None if not known."""
    size: tuple[int, int]
    """(height, width), px."""
    frames: tuple[_Frame, ...]
    positions: NDArray[np.float64]
    """[frames] times in intervals since the first frame, see `vestcl.data.sample.Clip.positions`."""
    inputs: Inputs | None = None
    """Where depth, masks, camera motion and inpainting come from; None in caches of former versions."""

    @classmethod
    def open(cls, folder: Path | str) -> "PreparedClip":
        """A complete clip.

        Args:
            folder: with clip.json.

        Raises:
            ValueError: clip.json is missing, damaged, or of another version of vestcl.
        """
        folder = Path(folder)
        about = read_clip(folder)
        try:
            frames = tuple(map(_frame, about["frames"]))
            height, width = map(int, about["size"])
            interval, positions = _times(about["frames"], about["fps"])
            inputs = Inputs.read(about["inputs"]) if "inputs" in about else None
            return cls(folder, about["name"], about["kind"], interval, (height, width), frames, positions, inputs)
        except DAMAGE as error:
            raise damaged(folder / JSON, error) from error

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def fps(self) -> float | None:
        """1 / `interval`; None if that is not known."""
        return None if self.interval is None else round(1 / self.interval, 6)

    def elapsed(self, index: int) -> float:
        """Intervals from the frame before ``index`` to ``index``; 1 for the first frame."""
        return float(self.positions[index] - self.positions[index - 1]) if index else 1.0

    def is_whole(self, index: int, steps: int) -> bool:
        """Whether frames t + 1 ... t + steps follow frame t = ``index`` without a gap: they are each other's next."""
        return times.frames_after(self.positions, index, steps) == list(range(index + 1, index + steps + 1))

    def frame_name(self, index: int) -> str:
        """The frame's name in its clip, "0000000012"."""
        return self._frame(index).name

    def K(self, index: int) -> NDArray[np.float64]:  # noqa: N802 - the camera's matrix in every formula
        """[3, 3] px."""
        return self._frame(index).K.copy()

    def world_from_cam(self, index: int) -> NDArray[np.float64] | None:
        """[4, 4] m, the true pose where the clip has it."""
        pose = self._frame(index).world_from_cam
        return None if pose is None else pose.copy()

    def prev_from_cur(self, index: int) -> NDArray[np.float64]:
        """[4, 4] m, the camera's motion to the frame before ``index``, from 1; nothing else of its file is read.

        Raises:
            ValueError: no such frame, none before it, or its file is missing or damaged.
        """
        if index == 0:
            raise ValueError(f"`index` must have a frame before it, 1 ... {len(self) - 1}, got 0")
        return np.asarray(self._read(index, "prev_from_cur")["prev_from_cur"], np.float64)

    def image(self, index: int) -> NDArray[np.float32]:
        """[3, H, W] RGB in [0, 1] of the frame ``index``, from 0; nothing else of its file is read.

        Raises:
            ValueError: no such frame, or its file is missing or damaged.
        """
        return _to_float(self._read(index, "image")["image"])

    def right_camera(self, index: int) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, int]] | None:
        """The right camera's K [3, 3] px, right_from_left [4, 4] m and (height, width) px; None if there is none."""
        known = self._frame(index)
        if known.right is None:
            return None
        return known.right[0].copy(), known.right[1].copy(), known.right_size or self.size

    def right(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]] | None:
        """The right camera's image [3, H, W], its K [3, 3] px and right_from_left [4, 4] m; None if there is none.

        Raises:
            ValueError: no such frame, or its file is missing or damaged.
        """
        known = self._frame(index)
        if known.right is None:
            return None
        pixels, size = self._read(index, "right")["right"], known.right_size or self.size
        if pixels.shape[1:] != size:
            wrong = f"right must be {list(size)}, got {list(pixels.shape[1:])}"
            raise damaged(frame_path(self.folder, index), wrong)
        return _to_float(pixels), known.right[0].copy(), known.right[1].copy()

    def frame(self, index: int) -> PerceivedFrame:
        """All that is known of the frame ``index``, from 0.

        Returns:
            As `Perception.seen`, with colours of 8 bits and velocities of 16.

        Raises:
            ValueError: no such frame, or its file is missing or damaged.
        """
        motion = ("prev_from_cur",) if index > 0 else ()
        known, tensors = self._frame(index), self._read(index, *ALWAYS, *motion)
        image, depth = _to_float(tensors["image"]), tensors["depth"][None]
        mask, own, moving = (self._bits(tensors[name]) for name in ("mask", "own", "moving"))
        background_image, background_depth, velocity = image.copy(), depth.copy(), np.zeros_like(image)
        _fill(background_image, ~mask, _to_float(tensors["background_image"]))
        _fill(background_depth, ~mask, tensors["background_depth"])
        _fill(velocity, moving, tensors["velocity"])
        layers = Layers(image, depth, mask, background_image, background_depth)
        motion_back = tensors.get("prev_from_cur")
        return PerceivedFrame(known.name, known.K.copy(), layers, velocity, own, motion_back, self.elapsed(index))

    def _frame(self, index: int) -> _Frame:
        if not 0 <= index < len(self):
            raise ValueError(f"`index` must be 0 ... {len(self) - 1}, a frame of {self.name}, got {index}")
        return self.frames[index]

    def _read(self, index: int, *wanted: str) -> dict[str, Array]:
        return read_tensors(self.folder, index, self._frame(index).key, wanted, self.size)

    def _bits(self, packed: Array) -> NDArray[np.bool_]:
        height, width = self.size
        return np.unpackbits(packed, count=height * width).reshape(1, height, width).view(bool)


def find_prepared(root: Path | str) -> list[PreparedClip]:
    """Every complete clip in a folder or beneath it, sorted by path.

    Args:
        root: a folder; its last part may be a pattern, "cache/street_1*".

    Returns:
        One or more clips; those that are not complete are left out.

    Raises:
        ValueError: no such folder, no complete clip in it, or one that is damaged or of another version of vestcl.
    """
    root = Path(root)
    roots = sorted(root.parent.glob(root.name)) if _GLOB & set(root.name) else [root]
    folders = {found.parent for each in roots for found in each.rglob(JSON)}
    if not folders:
        raise ValueError(f"{root}: has no prepared clip; `vestcl prepare` makes them")
    return [PreparedClip.open(folder) for folder in sorted(folders)]


def _times(frames: list[dict[str, Any]], fps: float | None) -> tuple[float | None, NDArray[np.float64]]:
    """The interval and the positions of clip.json's frames; without times they are evenly spaced, by its rate."""
    seconds = [frame["timestamp"] for frame in frames if frame.get("timestamp") is not None]
    interval = times.median_interval(seconds) if len(seconds) == len(frames) else None
    if interval is None:
        return 1 / fps if fps else None, np.arange(len(frames), dtype=np.float64)
    return interval, times.positions(seconds, interval)


def _frame(about: dict[str, Any]) -> _Frame:
    pose, right = about["world_from_cam"], about["right"]
    camera = None if right is None else (_matrix(right["K"], 3), _matrix(right["right_from_left"], 4))
    height, width = (right or {}).get("size", (0, 0))
    size = (int(height), int(width)) if height else None
    world_from_cam = None if pose is None else _matrix(pose, 4)
    return _Frame(about["name"], about["key"], _matrix(about["K"], 3), world_from_cam, camera, size)


def _matrix(rows: list[list[float]], side: int) -> NDArray[np.float64]:
    return np.array(rows, np.float64).reshape(side, side)


def _to_float(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """x / 255; torch divides an image ten times as fast as NumPy."""
    return torch.from_numpy(pixels).to(torch.float32).div_(255).numpy()


def _fill(planes: NDArray[np.float32], where: NDArray[np.bool_], values: Array) -> None:
    """planes[:, where] = values; by index, which takes a fifth of the time."""
    planes.reshape(len(planes), -1)[:, np.flatnonzero(where)] = values

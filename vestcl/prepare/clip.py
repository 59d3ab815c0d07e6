"""A clip's frames computed once: what each depends on, which are there already, and one process a clip at a time."""

import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from vestcl.clock import Clock
from vestcl.data.sample import Clip, Sample
from vestcl.io.atomic import read_bytes
from vestcl.io.images import to_float, to_pixels
from vestcl.io.video.reading import Video
from vestcl.prepare.files import JSON, RECIPE, Shape, frame_path, restore_frame, write_clip, write_frame
from vestcl.scene.inpainting.inpainters import Inpainter
from vestcl.scene.inputs import Inputs
from vestcl.scene.perception import Perception

#: Frames before it that perception looks at: depth from motion sees three, and the frame before has to have it, too.
LOOKS_BACK: Final = 3

#: Held by who writes to a clip's folder; the kernel lets go of it when the process ends, however it ends.
_LOCK: Final = ".lock"

#: What of a sample goes into a frame. Not its name, its time or its true pose, which clip.json has.
_SEEN: Final = ("image", "K", "size", "depth", "labels", "ego_vehicle", "right")

#: Bytes of a file that are hashed at once.
_CHUNK: Final = 1 << 20

#: Called for each frame: whether it was computed (True) or there already.
Report = Callable[[bool], None]


@dataclass(frozen=True)
class Outcome:
    """What was done for a clip."""

    computed: int
    """Frames."""
    kept: int
    """Frames that were there, whole and of the same key."""
    seconds: dict[str, float]
    """By stage."""


class EightBitPerception(Perception):
    """Perception of the images as the cache holds them, so that nothing in a file is of an image it lacks.

    The right camera's are not rounded here: matching takes 8 bits of them anyway.
    """

    def image(self, index: int) -> NDArray[np.float32]:
        """[3, H, W], rounded to 8 bits."""
        return to_float(to_pixels(super().image(index)))


def prepare_clip(
    clip: Clip,
    folder: Path,
    inputs: Inputs | None = None,
    *,
    perceived: Clip | None = None,
    estimators: str = "",
    inpaint: Inpainter | None = None,
    wait: bool = True,
    report: Report = lambda computed: None,
) -> Outcome | None:
    """Compute what is missing of a clip's cache; afterwards it is complete.

    Files are replaced whole, so that it may be killed at any moment and continues from there. Frames whose key is the
    same and which are whole are kept; whatever else has a frame's or clip.json's name, a folder, too, is replaced.
    Processes that prepare one clip at once do so one after the other.

    Args:
        clip: at the size wanted, two frames or more.
        folder: for this clip only.
        inputs: where depth, masks, camera motion and inpainting come from, for clip.json; None reads it off the clip.
        perceived: the same frames as perception sees them; None is ``clip``. Without right cameras depth is not
            matched against the right images, which ``clip`` has as targets.
        estimators: a key of the networks that estimate depth or classes for the clip, or inpaint.
        inpaint: how the background is filled, see `vestcl.forecasting.geometric.Perception`.
        wait: for another process that is at this clip.
        report: called after each frame.

    Returns:
        What was done, or None where another process is at this clip and ``wait`` is False.

    Raises:
        ValueError: a clip of one frame, a file of the clip that is missing or damaged, a folder that can't be written.
        OSError: a frame can't be written: the disk is full. What is there stays.
    """
    if len(clip) < 2:
        raise ValueError(f"{clip.name}: must have 2 frames or more, got 1: without a motion nothing is forecast")
    with _locked(folder, wait) as ours:
        if not ours:
            return None
        perception = EightBitPerception(clip if perceived is None else perceived, inpaint=inpaint)
        outcome, keys = _complete(clip, perception, folder, estimators, report)
        with _explained(folder / JSON):
            write_clip(folder, clip, keys, inputs)
        return outcome


def _complete(
    clip: Clip, perception: Perception, folder: Path, estimators: str, report: Report
) -> tuple[Outcome, list[str]]:
    """Write what is missing; returns what was done, and the frames' keys."""
    clock = Clock()
    with clock.time("check"):
        if perception.clip is not clip:  # the right images are in no frame's key otherwise
            estimators += f"|targets {_digest_of(clip).hex()}"
        keys = frame_keys(perception.clip, estimators)
        missing = {index for index, key in enumerate(keys) if not _is_there(clip, folder, index, key)}
    if missing or not (folder / JSON).is_file():
        _remove(folder / JSON)  # a clip of old and new frames is not a clip
    for path in (frame_path(folder, index) for index in missing):
        if not path.is_file():  # a file is replaced in one step, a folder can't be
            _remove(path)
    _tidy(folder, len(clip))
    for index, key in enumerate(keys):
        if index in missing:
            _write(clip, perception, folder, index, key, clock)
        report(index in missing)
    return Outcome(len(missing), len(clip) - len(missing), {**perception.seconds, **clock.seconds}), keys


def _write(clip: Clip, perception: Perception, folder: Path, index: int, key: str, clock: Clock) -> None:
    """Compute and write a frame; ``clock`` has what perception's has not."""
    frame, camera = perception.seen(index), clip[index].right
    with clock.time("right"):
        right = None if camera is None else camera.read_image()
    with clock.time("write"), _explained(frame_path(folder, index)):
        write_frame(folder, index, key, frame, right)


def _is_there(clip: Clip, folder: Path, index: int, key: str) -> bool:
    right = clip[index].right
    others: dict[str, Shape] = {"prev_from_cur": (4, 4)} if index > 0 else {}
    if right is not None:
        others["right"] = (3, right.height, right.width)
    try:
        restore_frame(folder, index, key, (clip[index].height, clip[index].width), others)
    except ValueError:  # missing, damaged or of something else: computed again in each case
        return False
    return True


def _tidy(folder: Path, frames: int) -> None:
    """Remove what killed processes left half written, and frames that the clip has no more."""
    wanted = {frame_path(folder, index) for index in range(frames)}
    half_written = folder.glob(f".{Path(JSON).stem}.*{Path(JSON).suffix}")
    for path in (*folder.glob("*.safetensors"), *half_written):  # hidden ones, too
        if path not in wanted:
            _remove(path)


def _remove(path: Path) -> None:
    """Whatever is there: a file, a link, a folder or nothing."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def _locked(folder: Path, wait: bool) -> Iterator[bool]:
    """Yields whether only this process may write to the folder."""
    lock = folder / _LOCK
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if lock.exists() and not lock.is_file():
            _remove(lock)
        file = lock.open("a")
    except OSError as error:
        raise ValueError(f"{folder}: can't be written ({error.strerror}); `--out` names another folder") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        yield True


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        why = f"{error.strerror}; what is prepared so far stays, and the same command continues from there"
        raise OSError(error.errno, f"can't be written: {why}", str(path)) from error


# ---------------------------------------------------------------- keys


def frame_keys(clip: Clip, estimators: str = "") -> list[str]:
    """For each frame the SHA-256 of all that it is computed from: the frames that perception sees for it, and RECIPE.

    Files count by their content, wherever they lie; a procedural street by its numbers.

    Args:
        clip: at the size wanted.
        estimators: a key of the networks that estimate depth or classes, or inpaint.

    Raises:
        ValueError: a file is missing.
    """
    samples = [_sample_digest(sample) for sample in clip]
    some = len({sample.labels is None for sample in clip}) > 1  # then they make no mask, as they once did
    keys = []
    for index in range(len(clip)):
        # The first frame has none before it, so that its depth may be from its motion to the second.
        first = max(index - LOOKS_BACK, 0)
        seen = samples[:2] if index == 0 else samples[first : index + 1]
        key = hashlib.sha256(f"{RECIPE}|{index == 0}|{estimators}{'|masks from motion' * some}".encode())
        elapsed = [clip.elapsed(before) for before in range(first, index + 1)]
        if set(elapsed) != {1.0}:  # velocities are per interval, and long gaps are not matched
            key.update(f"|{elapsed} intervals".encode())
        for digest in seen:
            key.update(digest)
        keys.append(key.hexdigest())
    return keys


def _digest_of(clip: Clip) -> bytes:
    return hashlib.sha256(b"".join(map(_sample_digest, clip))).digest()


def _sample_digest(sample: Sample) -> bytes:
    digest = hashlib.sha256()
    for name in _SEEN:
        digest.update(name.encode())
        _add(digest, getattr(sample, name))
    return digest.digest()


def _add(digest: Any, value: Any) -> None:
    """What a value is, down to the content of files. Of an unknown object its class: caches are no part of a frame."""
    digest.update(type(value).__qualname__.encode())
    if isinstance(value, Path):
        digest.update(hashlib.sha256(read_bytes(value)).digest())
    elif isinstance(value, Video):
        digest.update(b"by presentation time" + _file_digest(value.path, *_version(value.path)))
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value))
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            digest.update(field.name.encode())
            _add(digest, getattr(value, field.name))
    elif isinstance(value, bool | int | float | str | tuple | None):
        digest.update(repr(value).encode())


def _version(path: Path) -> tuple[int, int]:
    about = path.stat()
    return about.st_size, about.st_mtime_ns


@functools.lru_cache(maxsize=1)
def _file_digest(path: Path, size: int, changed: int) -> bytes:
    """Digest of a file that many frames share."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.digest()

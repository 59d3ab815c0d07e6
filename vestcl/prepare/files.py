"""The files of a prepared clip: whole or not at all, each frame with the key of what it was computed from.

    CLIP-HxW/clip.json           written last, whole or not at all: where it is, the clip is complete
    CLIP-HxW/000000.safetensors  a file a frame

A frame's file holds, with n pixels where M = 0 and m pixels that moves by itself:

    image, right [3, H, W] uint8, x = value / 255        background_image [3, n] uint8, background_depth [n] float32
    depth [H, W] float32, m                              velocity [3, m] float16, m per interval
    mask, own, moving [ceil(HW / 8)] uint8, a bit per pixel  prev_from_cur [4, 4] float64

right and prev_from_cur are left out where there is none. Its metadata hold the key of what it was computed
from (vestcl/prepare/clip.py) and a CRC-32 of every tensor; names, types and shapes are checked against this table.
clip.json holds a CRC-32 of its other entries, among them where depth, masks, camera motion and inpainting come from
("inputs"; files of former versions have none).
"""

import json
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from vestcl.data.sample import Clip, Sample
from vestcl.io.atomic import read_bytes, write_bytes
from vestcl.io.images import to_pixels
from vestcl.scene.inputs import Inputs, inputs_of
from vestcl.scene.perceived import PerceivedFrame

#: Raised when perception, the procedural street or these files change: it makes every frame be computed again.
RECIPE: Final = "vestcl prepared 4"

JSON: Final = "clip.json"

#: What an error about a file of the cache ends with.
REMEDY: Final = "run `vestcl prepare` again"

#: The metadata of a frame's file: JSON of its key and its tensors' CRC-32.
_ABOUT: Final = "vestcl"

#: Tensors of every frame, in the order in which they are written; some frames have the two others as well.
ALWAYS: Final = ("image", "depth", "mask", "background_image", "background_depth", "own", "moving", "velocity")
_ORDER: Final = (*ALWAYS, "prev_from_cur", "right")

#: In a shape: any number.
_ANY: Final = -1

#: Entry of clip.json: the CRC-32 of its other entries. Files of vestcl 0.3 and before have these entries and no
#: checksum.
_CHECKSUM: Final = "checksum"
_INPUTS: Final = "inputs"
_UNCHECKED: Final = frozenset(("recipe", "name", "kind", "fps", "size", "frames"))

#: What reading a damaged file raises: I/O, JSON and safetensors, and entries that are absent or of another type.
DAMAGE: Final = (
    SafetensorError, OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError,
    MemoryError,
)  # fmt: skip

Array = NDArray[Any]
Shape = tuple[int, ...]


def frame_path(folder: Path, index: int) -> Path:
    """Where a clip's folder has the frame ``index``."""
    return folder / f"{index:06}.safetensors"


def write_frame(folder: Path, index: int, key: str, frame: PerceivedFrame, right: NDArray[np.float32] | None) -> None:
    """Replace a frame's file in one step.

    Args:
        folder: of the clip.
        index: of the frame, from 0.
        key: of what it was computed from.
        frame: its colours are rounded to 8 bits, its velocity to 16.
        right: [3, H, W] of the right camera, or None.

    Raises:
        OSError: it can't be written.
    """
    write_bytes(frame_path(folder, index), _encoded(key, _packed(frame, right)))


def write_clip(folder: Path, clip: Clip, keys: Sequence[str], inputs: Inputs | None = None) -> None:
    """Write clip.json, which completes a folder of frames.

    Args:
        folder: with a file for every frame.
        clip: at the size it was prepared at.
        keys: of its frames.
        inputs: of its frames; None reads them off the clip.

    Raises:
        OSError: it can't be written.
    """
    frames = [_facts(sample, key) for sample, key in zip(clip, keys, strict=True)]
    size = [clip[0].height, clip[0].width]
    listed = {"size": size, "frames": frames, _INPUTS: (inputs or inputs_of(clip)).as_entries()}
    about = {"recipe": RECIPE, "name": clip.name, "kind": clip.kind, "fps": clip.fps, **listed}
    whole = about | {_CHECKSUM: _checksum(about)}
    write_bytes(folder / JSON, (json.dumps(whole, allow_nan=False) + "\n").encode())


def read_clip(folder: Path) -> dict[str, Any]:
    """The entries of clip.json, its checksum left out.

    Args:
        folder: of the clip.

    Raises:
        ValueError: clip.json is missing, damaged, or of another version of vestcl; the message names it.
    """
    path = folder / JSON
    try:
        about = json.loads(_regular(path).read_bytes())
        if (recipe := about["recipe"]) == RECIPE:
            _check_entries(about)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: {error.strerror}; {REMEDY}") from error
    except DAMAGE as error:
        raise damaged(path, error) from error
    if recipe != RECIPE:
        raise ValueError(f"{path}: must be {RECIPE!r}, got {str(recipe)[:40]!r}; {REMEDY}")
    return dict(about)


def damaged(path: Path, error: BaseException | str) -> ValueError:
    """The error about a damaged file of the cache: one line with the remedy."""
    reason = (str(error) or type(error).__name__).splitlines()[0]
    if isinstance(error, KeyError):
        reason = f"no entry {reason}"
    elif isinstance(error, OSError) and error.strerror:
        reason = error.strerror
    return ValueError(f"{path}: is damaged ({reason}); {REMEDY}")


def _check_entries(about: dict[str, Any]) -> None:
    """Removes the checksum and compares it; a file without one must have the entries of former versions."""
    if _CHECKSUM not in about:
        if about.keys() - {_INPUTS} != _UNCHECKED:
            raise ValueError("no checksum")
    elif about.pop(_CHECKSUM) != _checksum(about):
        raise ValueError("the checksum")


def _checksum(about: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(about).encode())


def _regular(path: Path) -> Path:
    """``path`` itself; reading a FIFO would wait for ever.

    Raises:
        FileNotFoundError: there is nothing of that name.
        OSError: it is not a regular file, or can't be looked at.
    """
    path.stat()
    if not path.is_file():
        raise OSError("no regular file")
    return path


def _facts(sample: Sample, key: str) -> dict[str, Any]:
    right, pose = sample.right, sample.world_from_cam
    camera = None if right is None else {"K": right.K.tolist(), "right_from_left": right.right_from_left.tolist()}
    if camera and right and (right.height, right.width) != (sample.height, sample.width):
        camera["size"] = [right.height, right.width]
    return {
        "name": sample.name,
        "key": key,
        "timestamp": sample.timestamp,
        "K": sample.K.tolist(),
        "world_from_cam": None if pose is None else pose.tolist(),
        "right": camera,
    }


def _packed(frame: PerceivedFrame, right: NDArray[np.float32] | None) -> dict[str, Array]:
    layers, hidden, velocity = frame.layers, ~frame.layers.mask[0], frame.velocity.astype(np.float16)
    moving = (velocity != 0).any(0)
    tensors: dict[str, Array] = {
        "image": _eight_bits(layers.image),
        "depth": layers.depth[0],
        "mask": np.packbits(layers.mask),
        "background_image": _eight_bits(layers.background_image)[:, hidden],
        "background_depth": layers.background_depth[0][hidden],
        "own": np.packbits(frame.own),
        "moving": np.packbits(moving),
        "velocity": velocity[:, moving],
    }
    if frame.prev_from_cur is not None:
        tensors["prev_from_cur"] = frame.prev_from_cur
    if right is not None:
        tensors["right"] = _eight_bits(right)
    return {name: np.ascontiguousarray(tensors[name]) for name in _ORDER if name in tensors}


def _encoded(key: str, tensors: Mapping[str, Array]) -> bytes:
    """A frame's file. The metadata are one entry, because several come in another order each time."""
    about = {"key": key, "checksums": {name: zlib.crc32(tensor.data) for name, tensor in tensors.items()}}
    return save(dict(tensors), {_ABOUT: json.dumps(about)})


def _eight_bits(image: NDArray[np.float32]) -> Array:
    return to_pixels(image).transpose(2, 0, 1)


def read_tensors(
    folder: Path, index: int, key: str, wanted: Sequence[str] | None = None, size: tuple[int, int] | None = None
) -> dict[str, Array]:
    """Tensors of a frame's file as they were written, each checked against its CRC-32, type and shape.

    Args:
        folder: of the clip.
        index: of the frame, from 0.
        key: what the file must have been computed from.
        wanted: their names; None is all.
        size: (height, width) px of the clip; None takes the depth's, which must be ``wanted``.

    Raises:
        ValueError: the file is missing, damaged, or computed from something else; the message names it.
    """
    path = frame_path(folder, index)
    try:
        about, tensors = _loaded(path, wanted)
        if about["key"] == key:
            _check_tensors(tensors, about["checksums"], size or tensors["depth"].shape)
            return tensors
    except FileNotFoundError as error:
        raise ValueError(f"{path}: is missing; {REMEDY}") from error
    except DAMAGE as error:
        raise damaged(path, error) from error
    raise ValueError(f"{path}: was computed from other frames than {JSON} lists; {REMEDY}")


def restore_frame(folder: Path, index: int, key: str, size: tuple[int, int], others: Mapping[str, Shape]) -> None:
    """Check a frame's file to the last byte; one whose tensors are whole but not its header is written again.

    Args:
        folder: of the clip.
        index: of the frame, from 0.
        key: what it must have been computed from.
        size: (height, width) px of the clip.
        others: of "right" and "prev_from_cur" those that it must have, with their shapes.

    Raises:
        ValueError: the file is missing, damaged, or computed from something else; the message names it.
        OSError: it can't be written.
    """
    path = frame_path(folder, index)
    tensors = read_tensors(folder, index, key, size=size)
    if tensors.keys() != {*ALWAYS, *others}:
        raise damaged(path, f"must hold {', '.join([*ALWAYS, *others])}, got {', '.join(tensors)}")
    if any(tensors[name].shape != shape for name, shape in others.items()):
        raise damaged(path, "the size of the right camera's image")
    content = _encoded(key, {name: tensors[name] for name in _ORDER if name in tensors})
    if read_bytes(path) != content:
        write_bytes(path, content)


def _loaded(path: Path, wanted: Sequence[str] | None) -> tuple[dict[str, Any], dict[str, Array]]:
    with safe_open(_regular(path), framework="np") as file:
        about = json.loads(file.metadata()[_ABOUT])
        return about, {name: file.get_tensor(name) for name in (file.keys() if wanted is None else wanted)}


def _check_tensors(tensors: Mapping[str, Array], checksums: Mapping[str, int], size: Shape) -> None:
    """Raises a ValueError or KeyError that names the tensor which is not what was written."""
    for name, tensor in tensors.items():
        if checksums[name] != zlib.crc32(tensor.data):
            raise ValueError(f"the checksum of {name}")
    height, width = size
    hidden = moving = _ANY
    if "mask" in tensors:
        hidden = height * width - int(np.unpackbits(tensors["mask"], count=height * width).sum())
    if "moving" in tensors:
        moving = int(np.unpackbits(tensors["moving"], count=height * width).sum())
    for name, tensor in tensors.items():
        kind, shape = _layout(height, width, hidden, moving)[name]
        fits = len(shape) == tensor.ndim and all(n in (_ANY, got) for n, got in zip(shape, tensor.shape, strict=True))
        if tensor.dtype != kind or not fits:
            raise ValueError(f"{name} must be {kind} {list(shape)}, got {tensor.dtype} {list(tensor.shape)}")


def _layout(height: int, width: int, hidden: int, moving: int) -> dict[str, tuple[str, Shape]]:
    """Type and shape of each tensor, as at the head of this file."""
    bits = ("uint8", (-(-height * width // 8),))
    return {
        "image": ("uint8", (3, height, width)), "depth": ("float32", (height, width)), "mask": bits,
        "background_image": ("uint8", (3, hidden)), "background_depth": ("float32", (hidden,)),
        "own": bits, "moving": bits, "velocity": ("float16", (3, moving)),
        "prev_from_cur": ("float64", (4, 4)), "right": ("uint8", (3, _ANY, _ANY)),
    }  # fmt: skip

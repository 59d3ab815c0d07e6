"""The files of a prepared clip: whole or not at all, each frame with the key of what it was computed from.

    CLIP-HxW/clip.json           written last, whole or not at all: where it is, the clip is complete
    CLIP-HxW/000000.safetensors  a file a frame

A frame's file holds, with n pixels where M = 0 and m pixels that move beside the camera:

    image, right [3, H, W] uint8, x = value / 255        background_image [3, n] uint8, background_depth [n] float32
    depth [H, W] float32, m                              velocity [3, m] float16, m per interval
    mask, own, moving [ceil(HW / 8)] uint8, a bit a pixel  prev_from_cur [4, 4] float64

right and prev_from_cur are left out where there is none. Its metadata tell the key of what it was computed
from (vestcl/prepare_clip.py) and a CRC-32 of every tensor.
"""

import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from vestcl.data.sample import Clip, Sample
from vestcl.io.atomic import write_bytes
from vestcl.io.images import to_pixels

if TYPE_CHECKING:
    from vestcl.prepared import Prepared

#: Raised when perception, the procedural street or these files change: it makes every frame be computed anew.
RECIPE: Final = "vestcl prepared 2"

JSON: Final = "clip.json"

#: What an error about a file of the cache ends with.
REMEDY: Final = "run `vestcl prepare` again"

#: The metadata of a frame's file: JSON of its key and its tensors' CRC-32.
_ABOUT: Final = "vestcl"

Array = NDArray[Any]


def frame_path(folder: Path, index: int) -> Path:
    """Where a clip's folder has the frame ``index``."""
    return folder / f"{index:06}.safetensors"


def write_frame(folder: Path, index: int, key: str, frame: "Prepared", right: NDArray[np.float32] | None) -> None:
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
    tensors = _packed(frame, right)
    about = {"key": key, "checksums": {name: zlib.crc32(tensor.data) for name, tensor in tensors.items()}}
    # One entry, because several come in another order each time.
    write_bytes(frame_path(folder, index), save(tensors, {_ABOUT: json.dumps(about)}))


def write_clip(folder: Path, clip: Clip, keys: Sequence[str]) -> None:
    """Write clip.json, which completes a folder of frames.

    Args:
        folder: with a file for every frame.
        clip: at the size it was prepared at.
        keys: of its frames.

    Raises:
        OSError: it can't be written.
    """
    frames = [_facts(sample, key) for sample, key in zip(clip, keys, strict=True)]
    size = [clip[0].height, clip[0].width]
    about = {"recipe": RECIPE, "name": clip.name, "kind": clip.kind, "fps": clip.fps, "size": size, "frames": frames}
    write_bytes(folder / JSON, (json.dumps(about, allow_nan=False) + "\n").encode())


def _facts(sample: Sample, key: str) -> dict[str, Any]:
    right, pose = sample.right, sample.world_from_cam
    return {
        "name": sample.name,
        "key": key,
        "timestamp": sample.timestamp,
        "K": sample.K.tolist(),
        "world_from_cam": None if pose is None else pose.tolist(),
        "right": None if right is None else {"K": right.K.tolist(), "right_from_left": right.right_from_left.tolist()},
    }


def _packed(frame: "Prepared", right: NDArray[np.float32] | None) -> dict[str, Array]:
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
    return {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}


def _eight_bits(image: NDArray[np.float32]) -> Array:
    return to_pixels(image).transpose(2, 0, 1)


def read_tensors(folder: Path, index: int, key: str, wanted: Sequence[str] | None = None) -> dict[str, Array]:
    """Tensors of a frame's file as they were written, each checked against its CRC-32.

    Args:
        folder: of the clip.
        index: of the frame, from 0.
        key: what the file must have been computed from.
        wanted: their names; None is all.

    Raises:
        ValueError: the file is missing, damaged, or computed from something else; the message names it.
    """
    path = frame_path(folder, index)
    try:
        with safe_open(path, framework="np") as file:
            about = json.loads(file.metadata()[_ABOUT])
            tensors = {name: file.get_tensor(name) for name in (file.keys() if wanted is None else wanted)}
    except FileNotFoundError as error:
        raise ValueError(f"{path}: is missing; {REMEDY}") from error
    except (SafetensorError, OSError, KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: is damaged ({error}); {REMEDY}") from error
    if about["key"] != key:
        raise ValueError(f"{path}: was computed from other frames than {JSON} tells; {REMEDY}")
    for name, tensor in tensors.items():
        if about["checksums"][name] != zlib.crc32(tensor.data):
            raise ValueError(f"{path}: is damaged (the checksum of {name}); {REMEDY}")
    return tensors

"""Damages to prepared clips, by a seeded generator: `python tests/stress/damaged_caches.py --share 1.0 --seed 0`.

Each trial copies a small prepared clip and damages its frames, its clip.json, or both. Reading it must then give what
was written, or a ValueError of one line that names the file and the remedy. Preparing it again must make it equal to a
fresh preparation, byte for byte.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip, Sample
from vestcl.prepare.clip import prepare_clip
from vestcl.prepare.prepared import PreparedClip

TRIALS = 400
HEIGHT, WIDTH, FRAMES = 24, 80, 4

Rng = np.random.Generator


# ---------------------------------------------------------------- clips


def street() -> Clip:
    """With a right camera, depth, labels and poses."""
    return street_clip(Street.generate(3), FRAMES, HEIGHT, WIDTH, start=2.0, samples=1)


def bare() -> Clip:
    """Images with depth and nothing else: a texture that moves sideways."""
    rng = np.random.default_rng(0)
    texture = rng.random((3, HEIGHT, WIDTH + 2 * FRAMES), np.float32)
    K = np.array([[60, 0, WIDTH / 2], [0, 60, HEIGHT / 2], [0, 0, 1.0]])
    depth = np.full((1, HEIGHT, WIDTH), 9.0)
    images = (texture[:, :, 2 * i : 2 * i + WIDTH] for i in range(FRAMES))
    return Clip("texture", "arrays", tuple(Sample.from_arrays(str(i), p, K, depth=depth) for i, p in enumerate(images)))


# ---------------------------------------------------------------- damages of any file


def flip_bit(rng: Rng, path: Path) -> None:
    change(path, rng, lambda byte: byte ^ 1 << int(rng.integers(8)))


def other_byte(rng: Rng, path: Path) -> None:
    change(path, rng, lambda byte: int(rng.integers(256)))


def whitespace(rng: Rng, path: Path) -> None:
    """A blank becomes a line's end: JSON of the same meaning, other bytes."""
    content = bytearray(path.read_bytes())
    blanks = [index for index, byte in enumerate(content[:2000]) if byte == 0x20]
    content[int(rng.choice(blanks))] = 0x0A
    path.write_bytes(content)


def truncate(rng: Rng, path: Path) -> None:
    path.write_bytes(path.read_bytes()[: int(rng.integers(path.stat().st_size))])


def empty(rng: Rng, path: Path) -> None:
    path.write_bytes(b"")


def lengthen(rng: Rng, path: Path) -> None:
    path.write_bytes(path.read_bytes() + rng.bytes(int(rng.integers(1, 100))))


def zero_part(rng: Rng, path: Path) -> None:
    content = bytearray(path.read_bytes())
    first = int(rng.integers(len(content)))
    last = min(first + int(rng.integers(1, 5000)), len(content))
    content[first:last] = bytes(last - first)
    path.write_bytes(content)


def zero_all(rng: Rng, path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def delete(rng: Rng, path: Path) -> None:
    path.unlink()


def folder_instead(rng: Rng, path: Path) -> None:
    path.unlink()
    path.mkdir()
    if rng.random() < 0.5:
        (path / "inside").write_text("x")


def unreadable(rng: Rng, path: Path) -> None:
    path.chmod(0)


def link_to_nothing(rng: Rng, path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name if rng.random() < 0.5 else "nothing")


def pipe_instead(rng: Rng, path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


# ---------------------------------------------------------------- damages of JSON


def other_json(rng: Rng, path: Path) -> None:
    texts = (
        "{}",
        "[]",
        "null",
        "0",
        '"clip"',
        "[" * 100_000,
        '{"recipe": "vestcl prepared 1"}',
        "9" * 5000,
        "{",
        "NaN",
    )
    path.write_text(str(rng.choice(np.array(texts, object))))


def json_key(rng: Rng, path: Path) -> None:
    path.write_text(json.dumps(damaged_json(rng, json.loads(path.read_text()))) + "\n")


def damaged_json(rng: Rng, value: Any) -> Any:
    """A key has ended or has another name, or a value is another one, somewhere in ``value``."""
    place = value
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = keys[int(rng.integers(len(keys)))]
        if not isinstance(place[key], dict | list) or not place[key] or rng.random() < 0.4:
            break
        place = place[key]
    kind = rng.random()
    if kind < 0.3:
        del place[key]
    elif kind < 0.5 and isinstance(place, dict):
        place[f"{key}x"] = place.pop(key)
    else:
        others = (None, True, -1, 10**30, 1e300, "x", [], {}, [[1]], {"a": 1})
        place[key] = others[int(rng.integers(len(others)))]
    return value


# ---------------------------------------------------------------- damages of a frame's header


def header_json(rng: Rng, path: Path) -> None:
    """As `json_key`, in the safetensors header."""
    header, data = opened(path)
    closed(path, damaged_json(rng, header), data)


def about_json(rng: Rng, path: Path) -> None:
    """As `json_key`, in the JSON that the header holds: key and checksums."""
    header, data = opened(path)
    about = header["__metadata__"]
    about["vestcl"] = json.dumps(damaged_json(rng, json.loads(about["vestcl"])))
    closed(path, header, data)


def header_dtype(rng: Rng, path: Path) -> None:
    """The same bytes as numbers of another type."""
    header, data = opened(path)
    same_width = {"F32": ["I32", "U32"], "U8": ["I8", "BOOL", "F8_E4M3"], "F16": ["BF16", "I16"], "F64": ["I64", "C64"]}
    entry = header[tensor_name(rng, header)]
    entry["dtype"] = str(rng.choice(same_width[entry["dtype"]]))
    closed(path, header, data)


def header_shape(rng: Rng, path: Path) -> None:
    """The same bytes in another order."""
    header, data = opened(path)
    entry = header[tensor_name(rng, header)]
    shape = entry["shape"]
    entry["shape"] = [shape[::-1], [int(np.prod(shape))], [1, *shape], [*shape, 0]][int(rng.integers(4))]
    closed(path, header, data)


def header_names(rng: Rng, path: Path) -> None:
    """Two tensors change their names."""
    header, data = opened(path)
    one, other = tensor_name(rng, header), tensor_name(rng, header)
    header[one], header[other] = header[other], header[one]
    closed(path, header, data)


def without_tensor(rng: Rng, path: Path) -> None:
    """A tensor and its checksum are missing, and everything else fits."""
    header, data = opened(path)
    gone = tensor_name(rng, header)
    first, last = header.pop(gone)["data_offsets"]
    for name, entry in header.items():
        if name != "__metadata__":
            entry["data_offsets"] = [at - (last - first) * (at > first) for at in entry["data_offsets"]]
    about = json.loads(header["__metadata__"]["vestcl"])
    del about["checksums"][gone]
    header["__metadata__"]["vestcl"] = json.dumps(about)
    closed(path, header, data[:first] + data[last:])


def opened(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def closed(path: Path, header: Any, data: bytes) -> None:
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)


def tensor_name(rng: Rng, header: dict[str, Any]) -> str:
    return str(rng.choice(sorted(header.keys() - {"__metadata__"})))


# ---------------------------------------------------------------- damages of a folder


def swap(rng: Rng, folder: Path) -> None:
    one, other = rng.choice(frames(folder), 2, replace=False)
    aside = folder / "aside"
    Path(one).rename(aside), Path(other).rename(one), aside.rename(other)


def copy_over(rng: Rng, folder: Path) -> None:
    one, other = rng.choice(frames(folder), 2, replace=False)
    shutil.copy(one, other)


def extra_files(rng: Rng, folder: Path) -> None:
    """A frame beyond the end, what a killed process left, a folder of a frame's name, and a user's own file."""
    shutil.copy(frames(folder)[0], folder / "000099.safetensors")
    (folder / ".000001.123-abcdef01.safetensors").write_bytes(b"half")
    (folder / ".clip.123-abcdef01.json").write_bytes(b"half")
    (folder / "000050.safetensors").mkdir(exist_ok=True)
    (folder / "notes.txt").write_text("mine")


def lock_instead(rng: Rng, folder: Path) -> None:
    (folder / ".lock").unlink()
    (folder / ".lock").mkdir()


OF_FILES: tuple[Callable[[Rng, Path], None], ...] = (
    flip_bit, other_byte, truncate, empty, lengthen, zero_part, zero_all, delete, folder_instead, unreadable,
    link_to_nothing, pipe_instead, whitespace,
)  # fmt: skip
OF_JSON = (other_json, json_key, json_key, *OF_FILES)
OF_FRAMES = (header_json, about_json, header_dtype, header_shape, header_names, without_tensor, *OF_FILES)
OF_FOLDERS = (swap, copy_over, extra_files, lock_instead)


def damage(rng: Rng, folder: Path) -> str:
    """One to three damages; what they were."""
    applied = []
    for path in rng.permutation([*frames(folder), folder / "clip.json"])[: int(rng.integers(1, 4))]:
        kinds = OF_JSON if Path(path).name == "clip.json" else OF_FRAMES
        kind = kinds[int(rng.integers(len(kinds)))]
        applied.append(f"{kind.__name__} {Path(path).name}")
        kind(rng, Path(path))
    if rng.random() < 0.25 and all(path.is_file() for path in frames(folder)):
        of_folder = OF_FOLDERS[int(rng.integers(len(OF_FOLDERS)))]
        applied.append(of_folder.__name__)
        of_folder(rng, folder)
    return ", ".join(applied)


def change(path: Path, rng: Rng, changed: Callable[[int], int]) -> None:
    """One byte becomes another; half of the time one of the first 2,000, where a frame has its header."""
    content = bytearray(path.read_bytes())
    at = int(rng.integers(min(len(content), 2000) if rng.random() < 0.5 else len(content)))
    content[at] = changed(content[at])
    path.write_bytes(content)


def frames(folder: Path) -> list[Path]:
    return [folder / f"{index:06}.safetensors" for index in range(FRAMES)]


# ---------------------------------------------------------------- trials


def read(folder: Path) -> list[Any]:
    """All that a prepared clip gives, as values that compare."""
    clip = PreparedClip.open(folder)
    values: list[Any] = [clip.name, clip.kind, clip.interval, clip.positions.tobytes(), clip.size, len(clip)]
    for index in range(len(clip)):
        frame, right, pose = clip.frame(index), clip.right(index), clip.world_from_cam(index)
        values += [clip.frame_name(index), clip.image(index).tobytes(), None if pose is None else pose.tobytes()]
        values += [frame.K.tobytes(), frame.velocity.tobytes(), frame.own.tobytes(), repr(frame.prev_from_cur)]
        values += [plane.tobytes() for plane in vars(frame.layers).values()]
        values += [None] if right is None else [part.tobytes() for part in right]
    return values


def fault_of(folder: Path, clip: Clip, whole: list[Any], content: dict[str, bytes]) -> str | None:
    """What is wrong with how a damaged clip is read and healed; None where nothing is."""
    try:
        if read(folder) != whole:
            return "was read, and it is not what was written"
    except ValueError as error:
        text = str(error)
        if "\n" in text or str(folder) not in text or not text.endswith("run `vestcl prepare` again"):
            return f"its error is not a line with file and remedy: {text!r}"
    except Exception as error:
        return f"reading raised {error!r}"
    try:
        prepare_clip(clip, folder)
        if read(folder) != whole or contents(folder) != content:
            return "was prepared again, and it is not what a fresh preparation is"
    except Exception as error:
        return f"preparing it again raised {error!r}"
    return None


def contents(folder: Path) -> dict[str, bytes]:
    """All files of the cache but the lock, and what should not be there."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name not in (".lock", "notes.txt")}


def faults(trials: int, seed: int, root: Path) -> Iterator[tuple[int, str, str | None]]:
    """(number, damage, fault) of each trial.

    Args:
        trials: how many.
        seed: of all of them; a trial's damage follows from it and the trial's number.
        root: an empty folder.
    """
    clips = [street(), bare()]
    for number, clip in enumerate(clips):
        prepare_clip(clip, root / str(number))
    known = [(read(root / str(number)), contents(root / str(number))) for number in range(len(clips))]
    for trial in range(trials):
        which, rng = trial % len(clips), np.random.default_rng([seed, trial])
        folder = root / "damaged"
        shutil.copytree(root / str(which), folder)
        what = damage(rng, folder)
        yield trial, what, fault_of(folder, clips[which], *known[which])
        shutil.rmtree(folder)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the trials")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    trials, wrong = round(TRIALS * options.share), 0
    with tempfile.TemporaryDirectory() as root:
        for trial, what, fault in faults(trials, options.seed, Path(root)):
            if fault:
                wrong += 1
                print(f"trial {trial} ({what}): {fault}")
    print(f"damaged caches: {trials} damaged, {trials - wrong} healed, seed {options.seed}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())

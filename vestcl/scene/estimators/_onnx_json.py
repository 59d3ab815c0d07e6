"""NETWORK.json next to NETWORK.onnx: what the network's input is, and what its output means. Read strictly.

All keys may be absent. Of every network:

- ``file``: the ONNX file, from the JSON's folder, where the JSON itself is given and has another stem.
- ``input``, ``output``: names, where the file has several.
- ``layout``: NCHW or NHWC; without it by the input's shape.
- ``size``: [height, width] px, only compared with the input's.
- ``colour``: RGB (default), BGR or grey.
- ``scale``, ``mean``, ``std``: its input is (scale p - mean) / std of pixels p in 0 to 255; mean and std are numbers
  or lists, one per channel.
  Defaults: scale 1/255; for depth mean 0 and std 1, for classes ImageNet's. A uint8 input is fed p itself.
- ``fit``: stretch (default) to the input's size, or letterbox: proportions kept, edges repeated around the image.

Of depth, ``meaning`` is

- depth_m (default): z = metres v of the output v, ``metres`` = 1 if absent;
- disparity: z = metres / (v + offset), ``metres`` in m per unit (baseline x focal length where v is in pixels), and
  ``offset`` = 0 if absent;
- inverse_depth: 1/z = a v + b with a and b unknown, to be found from the clip's motion and road.

Of classes, ``meaning`` is logits (default; any scores of which the highest counts) or classes (indices), and

- ``classes``: cityscapes (train ids, default), cityscapes_label_ids, ade20k, pascal_voc, or a list with the Cityscapes
  train id (255 = none) of each class;
- or ``movable`` and ``sky``: lists of the indices of such classes; all others are static.
"""

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from vestcl.io.labels import LAST_TRAIN_ID, VOID
from vestcl.io.strict_json import read_object
from vestcl.scene.estimators._class_tables import TABLES

Kind = Literal["depth", "classes"]

#: Bytes of the largest description that is read.
_LARGEST: Final = 1 << 20

#: The largest number that any key takes, and the most classes.
_MOST: Final = 1e9
_MOST_CLASSES: Final = 65536

_ANY: Final = ("file", "input", "output", "layout", "size", "colour", "scale", "mean", "std", "fit", "meaning")
_KEYS: Final[dict[Kind, tuple[str, ...]]] = {
    "depth": (*_ANY, "metres", "offset"),
    "classes": (*_ANY, "classes", "movable", "sky"),
}
_CHOICES: Final = {"layout": ("NCHW", "NHWC"), "colour": ("RGB", "BGR", "grey"), "fit": ("stretch", "letterbox")}
_MEANINGS: Final[dict[Kind, tuple[str, ...]]] = {
    "depth": ("depth_m", "disparity", "inverse_depth"),
    "classes": ("logits", "classes"),
}


@dataclass(frozen=True)
class Description:
    """A description, with its defaults."""

    path: Path
    """Path of the ONNX file."""
    given: bool
    """Whether there is a JSON."""
    meaning: str
    input: str | None = None
    output: str | None = None
    layout: str | None = None
    size: tuple[int, int] | None = None
    colour: str = "RGB"
    scale: float | None = None
    """None: the default for the input's type: 1/255, or 1 for uint8."""
    mean: tuple[float, ...] | None = None
    """One per channel; None: default of the input type: ImageNet's for classes, and 0 for depth and for uint8."""
    std: tuple[float, ...] | None = None
    fit: str = "stretch"
    metres: float = 1.0
    offset: float = 0.0
    classes: tuple[int, ...] | None = None
    """Train id of each class; None where only ``movable`` and ``sky`` are known."""
    movable: tuple[int, ...] = ()
    sky: tuple[int, ...] = ()


def read_description(path: str | Path, kind: Kind) -> Description:
    """What is known of a network.

    Args:
        path: the ONNX file, whose description has the same stem, or the description itself.
        kind: what the network is for; chooses keys and defaults.

    Raises:
        ValueError: no JSON, an unknown key, or a value out of range; the message names file and key.
    """
    path = Path(path)
    file = path.with_suffix(".json")
    content = read_object(file, _LARGEST) if (given := file.is_file()) else {}
    network = network_of(path)
    _check_keys(file, content, kind)
    return _description(file, content, kind, network, given)


def network_of(path: Path) -> Path:
    """The ONNX file: ``path``, or where that is a JSON the one that it names or that has its stem.

    Raises:
        ValueError: no JSON, or no such file.
    """
    network = path
    if path.suffix.lower() == ".json":
        content = read_object(path, _LARGEST)
        named = _text(path, content, "file") if "file" in content else path.with_suffix(".onnx").name
        network = path.parent / named
    if not network.is_file():
        raise ValueError(f'{path}: there is no file {network}; the key "file" names the ONNX file')
    return network


def _description(file: Path, content: dict[str, Any], kind: Kind, network: Path, given: bool) -> Description:
    meaning = _choice(file, content, "meaning", _MEANINGS[kind])
    channels = 1 if content.get("colour") == "grey" else 3
    values: dict[str, Any] = {key: _choice(file, content, key, _CHOICES[key]) for key in _CHOICES if key in content}
    values |= {key: _text(file, content, key) for key in ("input", "output") if key in content}
    values |= {key: _number(file, content, key) for key in ("scale", "metres", "offset") if key in content}
    values |= {key: _indices(file, content, key) for key in ("movable", "sky") if key in content}
    values |= {key: _per_channel(file, content, key, channels) for key in ("mean", "std") if key in content}
    if "size" in content:
        values["size"] = _size(file, content["size"])
    if not {"movable", "sky"} & set(content):
        values["classes"] = _table(file, content.get("classes", "cityscapes"))
    _check_together(file, content, meaning)
    return Description(network, given, meaning, **values)


def _check_together(file: Path, content: dict[str, Any], meaning: str) -> None:
    """Refuse keys that others leave without a meaning, and a disparity without its scale."""
    if meaning == "disparity" and "metres" not in content:
        raise ValueError(f'{file}: meaning disparity needs "metres": baseline x focal length in m px, or m per 1/unit')
    if meaning == "inverse_depth" and (wrong := {"metres", "offset"} & set(content)):
        raise ValueError(f"{file}: meaning inverse_depth has no unit and takes no {min(wrong)}; meaning disparity does")
    if meaning == "depth_m" and "offset" in content:
        raise ValueError(f"{file}: meaning depth_m takes no offset; meaning disparity does")
    if "classes" in content and (wrong := {"movable", "sky"} & set(content)):
        raise ValueError(f"{file}: must have classes, or movable and sky, got classes and {min(wrong)}")


def _check_keys(file: Path, content: dict[str, Any], kind: Kind) -> None:
    unknown = sorted(set(content) - set(_KEYS[kind]))
    if not unknown:
        return
    key = unknown[0] if unknown[0].isprintable() else repr(unknown[0])
    other: Kind = "classes" if kind == "depth" else "depth"
    if key in _KEYS[other]:
        raise ValueError(f"{file}: key {key} is for a network of {other}, and this one is to give {kind}")
    near = difflib.get_close_matches(key.lower(), _KEYS[kind], 1, cutoff=0.0)[0]
    raise ValueError(f"{file}: unknown key {key[:80]} (did you mean {near}?); it may have {', '.join(_KEYS[kind])}")


def _text(file: Path, content: dict[str, Any], key: str) -> str:
    value = content[key]
    if not isinstance(value, str) or not value:
        raise ValueError(f"{file}: {key} must be a name, got {_short(value)}")
    return value


def _choice(file: Path, content: dict[str, Any], key: str, choices: tuple[str, ...]) -> str:
    value = content.get(key, choices[0])
    if not isinstance(value, str) or value not in choices:
        near = [choice for choice in choices if difflib.get_close_matches(str(value).lower(), [choice.lower()], 1)]
        guess = f" (did you mean {near[0]}?)" if near else ""
        raise ValueError(f"{file}: {key} must be {' or '.join(choices)}, got {_short(value)}{guess}")
    return value


def _number(file: Path, content: dict[str, Any], key: str) -> float:
    value = content[key]
    lowest = -_MOST if key == "offset" else 0.0
    if not _is_number(value) or not lowest < value <= _MOST:
        raise ValueError(f"{file}: {key} must be a number{' above 0' if not lowest else ''}, got {_short(value)}")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MOST


def _per_channel(file: Path, content: dict[str, Any], key: str, channels: int) -> tuple[float, ...]:
    value = content[key]
    values = [value] * channels if _is_number(value) else value
    if not isinstance(values, list) or len(values) != channels or not all(map(_is_number, values)):
        raise ValueError(f"{file}: {key} must be a number or {channels} numbers, got {_short(value)}")
    if key == "std" and min(values) <= 0:
        raise ValueError(f"{file}: std must be above 0, got {_short(value)}")
    return tuple(map(float, values))


def _size(file: Path, value: Any) -> tuple[int, int]:
    whole = isinstance(value, list) and all(isinstance(side, int) and side is not True and side > 0 for side in value)
    if not whole or len(value) != 2:
        raise ValueError(f"{file}: size must be [height, width] in px, got {_short(value)}")
    return value[0], value[1]


def _indices(file: Path, content: dict[str, Any], key: str) -> tuple[int, ...]:
    value = content[key]
    if not isinstance(value, list) or not all(_is_index(index, _MOST_CLASSES - 1) for index in value):
        raise ValueError(f"{file}: {key} must be a list of class indices from 0, got {_short(value)}")
    return tuple(value)


def _is_index(value: Any, last: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= last


def _table(file: Path, value: Any) -> tuple[int, ...]:
    if isinstance(value, str) and value in TABLES:
        return TABLES[value]
    if isinstance(value, list) and value and all(_is_index(i, LAST_TRAIN_ID) or i == VOID for i in value):
        return tuple(value)
    wanted = f"{', '.join(TABLES)} or a list of train ids (0 ... {LAST_TRAIN_ID}, {VOID})"
    raise ValueError(f"{file}: classes must be {wanted}, got {_short(value)}")


def _short(value: Any) -> str:
    return repr(value)[:80]

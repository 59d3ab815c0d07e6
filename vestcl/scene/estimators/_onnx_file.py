"""An ONNX file's description of its inputs and outputs: a reader of the few protobuf fields that hold it.

Field numbers are those of onnx.proto3: ModelProto.graph = 7; GraphProto.initializer = 5, .input = 11, .output = 12;
ValueInfoProto.name = 1, .type = 2; TypeProto.tensor_type = 1; TypeProto.Tensor.elem_type = 1, .shape = 2;
TensorShapeProto.dim = 1; Dimension.dim_value = 1, .dim_param = 2; TensorProto.name = 8,
.external_data = 13; StringStringEntryProto.key = 1, .value = 2. Weights are skipped.
"""

import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

#: TensorProto.DataType by number, as far as networks have such inputs and outputs.
_TYPES: Final = {1: "float32", 2: "uint8", 3: "int8", 6: "int32", 7: "int64", 9: "bool", 10: "float16", 11: "float64"}

#: Bytes of the longest varint.
_VARINT: Final = 10

#: Bytes by wire type of a field of fixed length: 64 and 32 bits.
_FIXED: Final = {1: 8, 5: 4}


class _DamagedError(Exception):
    """The bytes are no protobuf message, or one that ends too early."""


@dataclass(frozen=True)
class Value:
    """An input or output of a graph."""

    name: str
    type: str
    """float32, uint8 ..., "type N" for any other."""
    shape: tuple[int | str | None, ...]
    """A size, the name of a dynamic axis, or None for an axis without either."""

    def __str__(self) -> str:
        """`image` float32 [1, 3, height, width]."""
        axes = ("?" if axis is None else str(axis) for axis in self.shape)
        return f"`{self.name}` {self.type} [{', '.join(axes)}]"


@dataclass(frozen=True)
class OnnxFile:
    """A graph's interface."""

    path: Path
    inputs: tuple[Value, ...]
    """Without those that the file has weights for."""
    outputs: tuple[Value, ...]
    weights: tuple[Path, ...]
    """Other files that hold its weights."""


def read_onnx(path: str | Path) -> OnnxFile:
    """The interface of a network.

    Args:
        path: an ONNX file, of any size: it is mapped, not read.

    Raises:
        ValueError: no such file, no ONNX file, a truncated one, or one whose weights lie in a file that is missing.
    """
    path = Path(path)
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            network = _model(path, content)
    except OSError as error:
        raise ValueError(f"{path}: can't be read: {error.strerror}") from error
    except (_DamagedError, ValueError) as error:  # an empty file can't be mapped; names may not be UTF-8
        raise ValueError(f"{path}: is not an ONNX file, or a truncated one ({error})") from error
    if missing := [file for file in network.weights if not file.is_file()]:
        raise ValueError(f"{path}: its weights are in {missing[0]}, which does not exist: keep both in one folder")
    return network


def _model(path: Path, content: mmap.mmap) -> OnnxFile:
    graphs = [span for number, span in _fields(content, 0, len(content)) if number == 7 and isinstance(span, tuple)]
    if len(graphs) != 1:
        raise _DamagedError(f"it has {len(graphs)} graphs")
    weights, files, inputs, outputs = set[str](), dict[Path, None](), list[Value](), list[Value]()
    for number, span in _fields(content, *graphs[0]):
        if not isinstance(span, tuple):
            continue
        if number == 5:
            weights |= {_text(content, name) for name in _spans(content, span, 8)}
            files |= {path.parent / name: None for name in _locations(content, span)}
        elif number in (11, 12):
            (inputs if number == 11 else outputs).append(_value(content, span))
    if not outputs:
        raise _DamagedError("its graph has no output")
    fed = tuple(value for value in inputs if value.name not in weights)
    return OnnxFile(path, fed, tuple(outputs), tuple(files))


def _locations(content: mmap.mmap, weights: tuple[int, int]) -> Iterator[str]:
    """The file that a tensor's external data is in, of entries with a key and a value."""
    for entry in _spans(content, weights, 13):
        texts = {number: _text(content, span) for number, span in _fields(content, *entry) if isinstance(span, tuple)}
        if texts.get(1) == "location" and 2 in texts:
            yield texts[2]


def _value(content: mmap.mmap, span: tuple[int, int]) -> Value:
    name = "".join(_text(content, part) for part in _spans(content, span, 1))
    kind, shape = 0, list[int | str | None]()
    for tensor in (inner for outer in _spans(content, span, 2) for inner in _spans(content, outer, 1)):
        kind = next((found for number, found in _fields(content, *tensor) if number == 1 and isinstance(found, int)), 0)
        for dimension in (inner for outer in _spans(content, tensor, 2) for inner in _spans(content, outer, 1)):
            shape.append(_axis(content, dimension))
    return Value(name, _TYPES.get(kind, f"type {kind}"), tuple(shape))


def _axis(content: mmap.mmap, span: tuple[int, int]) -> int | str | None:
    for number, found in _fields(content, *span):
        if number == 1 and isinstance(found, int) and 0 < found < 1 << 31:
            return found
        if number == 2 and isinstance(found, tuple):
            return _text(content, found)
    return None


def _spans(content: mmap.mmap, span: tuple[int, int], wanted: int) -> Iterator[tuple[int, int]]:
    """Start and end of each field ``wanted`` that is a message or a string."""
    return (found for number, found in _fields(content, *span) if number == wanted and isinstance(found, tuple))


def _fields(content: mmap.mmap, start: int, end: int) -> Iterator[tuple[int, int | tuple[int, int]]]:
    """Number of each field of a message, and its integer, or where its bytes start and end."""
    while start < end:
        key, start = _varint(content, start, end)
        number, wire = key >> 3, key & 7
        if number == 0:
            raise _DamagedError("a field has number 0")
        if wire == 0:
            integer, start = _varint(content, start, end)
            yield number, integer
            continue
        if wire == 2:
            length, start = _varint(content, start, end)
        elif wire in _FIXED:
            length = _FIXED[wire]
        else:
            raise _DamagedError(f"a field has wire type {wire}")
        if length > end - start:
            raise _DamagedError(f"a field of {length:,} bytes ends after its message")
        yield number, (start, start + length)
        start += length


def _varint(content: mmap.mmap, start: int, end: int) -> tuple[int, int]:
    """A base-128 integer, and the position after it."""
    value = 0
    for index in range(_VARINT):
        if start + index >= end:
            raise _DamagedError("a number ends after its message")
        byte = content[start + index]
        value |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return value, start + index + 1
    raise _DamagedError("a number is too long")


def _text(content: mmap.mmap, span: tuple[int, int]) -> str:
    return content[span[0] : span[1]].decode("utf-8")

"""Tiny ONNX networks, written byte by byte: the package onnx is not needed."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

#: TensorProto.DataType.
FLOAT, UINT8, INT64, FLOAT16 = 1, 2, 7, 10


def varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    low = value & 0x7F
    return bytes([low | 0x80]) + varint(value >> 7) if value > 0x7F else bytes([low])


def field(number: int, value: int | float | str | bytes) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    if isinstance(value, float):
        return varint(number << 3 | 5) + struct.pack("<f", value)
    content = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(content)) + content


def value_info(name: str, shape: Sequence[int | str], kind: int = FLOAT) -> bytes:
    """An input or output; a name in ``shape`` is a dynamic axis."""
    axes = b"".join(field(1, field(1, axis) if isinstance(axis, int) else field(2, axis)) for axis in shape)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, axes)))


def tensor(name: str, values: np.ndarray) -> bytes:
    kind = {"float32": FLOAT, "int64": INT64}[str(values.dtype)]
    return (
        b"".join(field(1, size) for size in values.shape) + field(2, kind) + field(8, name) + field(9, values.tobytes())
    )


def node(kind: str, inputs: Sequence[str], output: str, **attributes: int | float | list[int]) -> bytes:
    content = b"".join(field(1, name) for name in inputs) + field(2, output) + field(3, f"{kind}_0") + field(4, kind)
    return content + b"".join(field(5, _attribute(name, value)) for name, value in attributes.items())


def model(
    nodes: Sequence[bytes], inputs: Sequence[bytes], outputs: Sequence[bytes], weights: Sequence[bytes] = ()
) -> bytes:
    parts = ((1, nodes), (5, weights), (11, inputs), (12, outputs))
    graph = field(2, "g") + b"".join(field(number, part) for number, group in parts for part in group)
    return field(1, 8) + field(7, graph) + field(8, field(2, 13))


def write_mix(
    path: Path,
    weights: Sequence[Sequence[float]],
    size: tuple[int, int] = (4, 6),
    *,
    bias: Sequence[float] | None = None,
    nhwc: bool = False,
    kind: int = FLOAT,
    pool: int = 1,
    description: dict[str, Any] | None = None,
    **keys: Any,
) -> Path:
    """A network whose outputs are weighted sums of its input's channels at each pixel, and its description.

    Args:
        path: of the ONNX file.
        weights: [outputs][channels].
        size: (height, width) of the input.
        bias: [outputs].
        nhwc: whether the input is [1, H, W, C].
        kind: of the input.
        pool: the output is the mean over this many pixels per side.
        description: the JSON next to the file, with ``keys``; where both are empty there is none.
        keys: of the JSON.
    """
    matrix = np.array(weights, np.float32)[:, :, None, None]
    height, width = size
    count, channels = matrix.shape[:2]
    shape = [1, height, width, channels] if nhwc else [1, channels, height, width]
    source, nodes = "image", []
    if kind != FLOAT:
        nodes.append(node("Cast", [source], "cast", to=FLOAT))
        source = "cast"
    if nhwc:
        nodes.append(node("Transpose", [source], "nchw", perm=[0, 3, 1, 2]))
        source = "nchw"
    if pool > 1:
        nodes.append(node("AveragePool", [source], "pooled", kernel_shape=[pool, pool], strides=[pool, pool]))
        source = "pooled"
    nodes.append(node("Conv", [source, "weights", "bias"], "result", kernel_shape=[1, 1]))
    values = tensor("weights", matrix), tensor("bias", np.array(bias or [0.0] * count, np.float32))
    output = value_info("result", [1, count, height // pool, width // pool])
    path.write_bytes(model(nodes, [value_info("image", shape, kind)], [output], values))
    if content := (description or {}) | keys:
        path.with_suffix(".json").write_text(json.dumps(content))
    return path


def _attribute(name: str, value: int | float | list[int]) -> bytes:
    if isinstance(value, int):
        return field(1, name) + field(3, value) + field(20, 2)
    if isinstance(value, float):
        return field(1, name) + field(2, value) + field(20, 1)
    return field(1, name) + b"".join(field(8, item) for item in value) + field(20, 7)
